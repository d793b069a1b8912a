"""``pgkit eval / export``: what a trained policy does, and the files that it leaves in."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pgkit.errors import UserError


def add(commands: Any, positive: Callable[[str], int], seed: Callable[[str], int]) -> None:
    """Adds the two commands to the grammar of ``pgkit``."""
    command = commands.add_parser("eval", help="play whole episodes with a trained policy")
    _which_policy(command)
    command.add_argument("--episodes", type=positive, default=10, help="how many (default: 10)")
    command.add_argument("--seed", type=seed, default=0, help="of the envs (default: 0)")
    command.add_argument("--video", type=Path, metavar="FILE.mp4", help="record the episodes; .gif needs no codec")
    command.set_defaults(command=evaluate_run)

    command = commands.add_parser("export", help="write a trained policy as ONNX, as torch.export's file, or a folder")
    _which_policy(command)
    command.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FILE", help="FILE.onnx, FILE.pt2, or a policy folder"
    )
    command.add_argument("--push", metavar="USER/NAME", help="upload the folder to the Hugging Face Hub")
    command.set_defaults(command=export_policy)


def _which_policy(command: argparse.ArgumentParser) -> None:
    command.add_argument("run_dir", type=Path, metavar="RUN_DIR", help="run directory, or a policy folder")
    command.add_argument("--which", choices=["best", "latest"], default="best", help="checkpoint (default: best)")
    command.add_argument("--trust", action="store_true", help="run the recipe file and import what RUN_DIR names")


def evaluate_run(args: argparse.Namespace) -> None:
    if args.video is not None and sys.platform == "linux" and not os.environ.get("DISPLAY"):
        os.environ.setdefault("MUJOCO_GL", "egl")  # before MuJoCo is imported
    from pgkit import run
    from pgkit.run import video

    policy = run.load_policy(args.run_dir, args.which, trust=args.trust)
    if args.video is None:
        env = policy.make_env(num_envs=min(args.episodes, 10), seed=args.seed)
        try:
            scores = run.evaluate(policy.actor, env, args.episodes)
        finally:
            env.close()
    else:
        scores, file = video.record(policy, args.video, args.episodes, args.seed)
    print(f"{args.run_dir}: {args.which} policy, after {policy.frames:,} frames, {args.episodes} episodes")
    for name, value in scores.items():
        print(f"  {name.removeprefix('eval/'):<16} {value:.2f}")
    if args.video is not None:
        print(f"wrote {file}")


def export_policy(args: argparse.Namespace) -> None:
    from pgkit import run

    if args.push and args.output.suffix:
        raise UserError(f"--push uploads a policy folder, {args.output} is a file: leave out its ending")
    path = run.export(run.load_policy(args.run_dir, args.which, trust=args.trust), args.output)
    print(f"wrote {path}")
    if args.push:
        print(f"pushed to {run.push_to_hub(path, args.push)}")
