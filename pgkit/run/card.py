"""The card of a policy folder: what was trained, how well it does, and the commands."""

from __future__ import annotations

import math
import shlex
from pathlib import Path
from typing import Any

from pgkit.run.metrics import read_csv

_TEXT = """---
library_name: pgkit
tags: [reinforcement-learning, pgkit, {recipe}]
---

# {recipe} on {env}

A policy trained with pgkit for {frames:,} frames.

{result}

It was trained by

```bash
{command}
```

To act with it:

```python
from pgkit import run

policy = run.load_policy("FOLDER"{trust})
action = policy.predict(obs)  # NumPy in and out
```

| package | version |
|---|---|
{versions}
"""


def scores(run_dir: Path, frames: int) -> dict[str, float]:
    """What the evaluation after so many frames gave, by metric; empty where there was none."""
    file = run_dir / "metrics.csv"
    rows = [row for row in (read_csv(file)[1] if file.exists() else []) if int(row["frames"]) == frames]
    return {name: float(x) for row in rows for name, x in row.items() if name.startswith("eval/") and x}


def text(config: dict[str, Any], frames: int, found: dict[str, float]) -> str:
    """The card, in Markdown."""
    settings = config["settings"]
    result = "The run has no evaluation at that point."
    if math.isfinite(mean := found.get("eval/mean_reward", math.nan)):
        deviation, episodes = found.get("eval/std_reward", 0.0), settings.get("eval_episodes", "?")
        result = (
            f"Mean return **{mean:,.2f}** (± {deviation:,.2f} over {episodes} whole episodes), "
            "with the likeliest actions."
        )
    return _TEXT.format(
        recipe=config["recipe"],
        env=settings.get("env_id", "its environment"),
        frames=frames,
        result=result,
        command=shlex.join(config["command"]) or f"pgkit run {config['recipe']}",
        trust=", trust=True" if config.get("file") else "",
        versions="\n".join(f"| {name} | {version} |" for name, version in config["versions"].items()),
    )
