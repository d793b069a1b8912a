"""The way out: a trained policy as an ONNX file, as torch.export's file, or as a folder for the Hub."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

from pgkit import files
from pgkit.errors import UserError
from pgkit.run import card
from pgkit.run.agent import numbers
from pgkit.run.config import read_config, write_json
from pgkit.run.exported import needs, write_onnx, write_pt2
from pgkit.run.load import ABOUT, WEIGHTS
from pgkit.run.policy import Policy


def export(policy: Policy, file: str | Path) -> Path:
    """Writes a policy; the file's ending says how.

    ``.onnx`` and ``.pt2`` (torch.export) hold one function, from the observation's entries ``[N, ...]`` to the action
    ``[N, ...]`` that the environment takes: the likeliest, clipped to the bounds, with the normalizer inside. A
    recurrent policy's also takes ``is_init [N, 1]`` and ``recurrent_state``, and returns the next state. Any other name
    is a folder's: weights (safetensors), settings (JSON) and a card, for :func:`load_policy` and :func:`push_to_hub`.

    Args:
        policy: from :func:`load_policy`; an actor of your own is ``Policy.of(actor, env)``.
        file: where to; a file that is there is replaced.

    Raises:
        UserError: a package of the extra ``export`` is missing; or the policy is of no run, and a folder is asked for.
    """
    path = Path(file)
    if not path.parent.is_dir():
        raise UserError(f"no directory {path.parent} to write {path.name} into")
    if path.suffix == ".onnx":
        write_onnx(policy, path)
    elif path.suffix == ".pt2":
        write_pt2(policy, path)
    elif path.suffix:
        raise UserError(f"{path.name}: give a name that ends in .onnx or .pt2, or a folder's, without an ending")
    else:
        _write_folder(policy, path)
    return path


def _write_folder(policy: Policy, folder: Path) -> None:
    safetensors = needs("safetensors.torch", "export")
    if policy.args is None or policy.args.run_dir is None:
        raise UserError("a policy folder is written from a run, which says how the policy is built again: use .onnx")
    try:
        there = folder.exists()
    except OSError as error:
        files.cannot_write(folder, error)
    if there and not (folder / ABOUT).is_file() and (not folder.is_dir() or any(folder.iterdir())):
        raise UserError(f"{folder} holds something else: give another name")
    config, run_dir = read_config(policy.args.run_dir), policy.args.run_dir
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        files.cannot_write(folder, error)
    if config.get("file"):  # a recipe of one's own goes along
        shutil.copyfile(run_dir / config["file"], folder / "recipe.py")
        config["file"] = "recipe.py"
    config["settings"] |= {"run_dir": None, "init": None}  # no paths of this machine
    config["command"] = ["pgkit", *config["command"][1:]] if _by_pgkit(config["command"]) else []
    write_json(folder / "config.json", config)
    weights = {name: x.detach().cpu().contiguous().clone() for name, x in policy.actor.state_dict().items()}
    with files.replacing(folder / WEIGHTS) as file:
        file.write(safetensors.save(weights))
    scores = card.scores(run_dir, policy.frames)
    about = {"frames": policy.frames, "scores": scores, "numbers": numbers(policy.actor)}
    write_json(folder / ABOUT, about)
    with files.replacing(folder / "README.md") as file:
        file.write(card.text(config, policy.frames, scores).encode())


def _by_pgkit(command: list[str]) -> bool:
    """Whether a command was ``pgkit run ...``, not a script with a path of its own."""
    return bool(command) and (
        Path(command[0]).name == "pgkit" or Path(command[0]).parts[-2:] == ("pgkit", "__main__.py")
    )


def push_to_hub(folder: str | Path, repo: str, *, private: bool = False, api: Any = None) -> str:
    """Uploads a policy folder to the Hugging Face Hub, as your login there allows; returns its address.

    Args:
        folder: what :func:`export` wrote.
        repo: ``user/name``; it is made if there is none.
        private: whether a new one is yours alone.
        api: a ``huggingface_hub.HfApi`` of your own.

    Raises:
        UserError: it is no policy folder, huggingface-hub is missing (extra ``hub``), or the Hub refuses.
    """
    folder = Path(folder)
    if not (folder / ABOUT).is_file():
        raise UserError(f"{folder} is no policy folder: pgkit export RUN --output {folder}")
    if repo.count("/") != 1:
        raise UserError(f"{repo}: give user/name")
    api = needs("huggingface_hub", "hub").HfApi() if api is None else api
    names = [WEIGHTS, ABOUT, "config.json", "README.md", "recipe.py"]
    try:
        address = api.create_repo(repo, private=private, exist_ok=True)
        api.upload_folder(repo_id=repo, folder_path=folder, allow_patterns=names, commit_message="Policy from pgkit")
    except Exception as error:  # the network's, the Hub's and the file system's, each of a class of its own
        reason = next(iter(str(error).strip().splitlines()), type(error).__name__)
        raise UserError(f"the Hub does not take {repo}: {reason}") from error
    return str(address)
