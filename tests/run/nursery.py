"""Imports pgkit once and forks a run for every line it reads: a run begins in a hundredth of a second, not in five.

A line is ``[recipe, argv, folder]`` as JSON. It answers with the pid of the run, which leads a process group of its
own, and when that has ended with its exit code, negative for a signal. What a run prints goes to ``folder/out.txt``.
"""

import json
import os
import sys
from pathlib import Path

import matplotlib.pyplot  # noqa: F401
import torch.utils.tensorboard  # noqa: F401

from pgkit import run
from pgkit.cli import recipes
from tests import faulty  # noqa: F401

ROOT = Path(__file__).resolve().parents[2]


def main() -> None:
    known = {name: recipes.load(recipes.find(name)) for name in ("ppo", "sac")}
    known["compiles"] = recipes.load(Path(__file__).with_name("compiles.py"))
    print("ready", flush=True)
    for line in sys.stdin:
        name, argv, folder = json.loads(line)
        pid = os.fork()
        if pid == 0:
            os.setsid()
            os.chdir(folder)
            out = os.open("out.txt", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
            os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
            for number in (1, 2):
                os.dup2(out, number)
            break
        print(pid, flush=True)
        print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), flush=True)
    else:
        return
    recipe = known[name]
    run.launch(recipe.main, recipe.Args, argv=argv)


if __name__ == "__main__":
    main()
