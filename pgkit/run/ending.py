"""What a run leaves behind when it ends: its summary, and the commands that go on from it."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping
from pathlib import Path
from statistics import median

from pgkit.run.args import RunArgs
from pgkit.run.config import recipe_file, recipe_target, write_json
from pgkit.run.metrics import column, read_csv, warm

NAN = float("nan")


def write_summary(
    run_dir: Path,
    args: RunArgs,
    recipe: str,
    wall: float,
    evaluated: Mapping[str, float],
    best: Mapping[str, float],
) -> None:
    """``summary.json``: the last evaluation, the best, and the speed after warm-up."""
    rows = read_csv(run_dir / "metrics.csv")[1]
    fps = [value for _, value in column(rows, "time/fps")]
    returns = column(rows, "rollout/ep_rew_mean")
    summary = {
        "recipe": recipe,
        "env_id": args.env_id,
        "seed": args.seed,
        **evaluated,
        "wall_s": wall,
        "time/fps": median(warm(fps)) if fps else NAN,
        "rollout/ep_rew_mean": returns[-1][1] if returns else NAN,
        "best/mean_reward": best.get("eval/mean_reward", NAN),
        "best/frames": best.get("frames", 0),
    }
    write_json(run_dir / "summary.json", summary, hashed=False)


def has_ended(run_dir: Path, frames: int) -> bool:
    """Whether the last evaluation is made, and the summary written, of a run that has come to so many frames."""
    try:
        return json.loads((run_dir / "summary.json").read_text())["frames"] == frames
    except (OSError, ValueError, KeyError, TypeError):
        return False


def how_to_go_on(run_dir: Path, args: RunArgs, recipe: str, frames: int, best: bool) -> str:
    """The commands that resume, evaluate and plot a run."""
    where, target = shlex.quote(str(run_dir)), recipe_target(type(args), recipe)
    total = args.total_frames * (2 if frames >= args.total_frames else 1)
    imports = " --trust" if args.imports() else ""
    trust = " --trust" if imports or recipe_file(type(args)) else ""
    return (
        f"run directory: {run_dir}\n"
        f"  resume    pgkit run {target} --resume {where} --total-frames {total}{imports}\n"
        f"  evaluate  pgkit eval {where}{'' if best else ' --which latest'}{trust}\n"
        f"  plot      pgkit plot {where}"
    )
