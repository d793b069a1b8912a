"""Can I use it: every cell trains. ``python tests/docs/test_spaces.py`` writes the table into docs/pages/spaces.md."""

import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from torch import nn

from pgkit import advantages, collectors, envs, losses, modules, updates
from pgkit.errors import UserError

PAGE = Path(__file__).parents[2] / "docs" / "pages" / "spaces.md"
BOX, CHOICE = spaces.Box(-1, 1, (3,)), spaces.Discrete(3)
BOUNDED, UNBOUNDED = spaces.Box(-1, 1, (2,)), spaces.Box(-np.inf, np.inf, (2,))
DICT = spaces.Dict({"picture": spaces.Box(0, 1, (1, 4, 4)), "speed": BOX})
CORES: dict[str, Any] = {"PPO": None, "PPO, GRU": modules.gru, "PPO, LSTM": modules.lstm}


def with_mask(n: int) -> spaces.Dict:
    return spaces.Dict({"observation": BOX, "action_mask": spaces.MultiBinary(n)})


def picture() -> nn.Module:
    return nn.Sequential(nn.Conv2d(1, 2, 3), nn.ReLU(), nn.Flatten())


def each_its_own() -> nn.Module:
    return modules.dict_encoder({"picture": picture(), "speed": modules.mlp(3, None, (8,))})


def tanh_normal(env: Any, **parts: Any) -> Any:
    return modules.tanh_normal_actor(env, tanh_loc=True, log_std_bounds=(-5, -1), **parts)


Row = tuple[spaces.Space, spaces.Space, Callable[..., Any], bool, Callable[[], nn.Module] | None]
actor_of, gaussian, NONE = modules.categorical_actor, modules.gaussian_actor, None
# what: ((observation, action, builder, flatten, encoder), how)
ROWS: dict[str, tuple[Row, str]] = {
    "observation: Box": ((BOX, CHOICE, actor_of, True, NONE), "as it is, in float32"),
    "observation: Box, image": ((DICT["picture"], CHOICE, actor_of, True, picture), "`encoder=`, which divides by 255"),
    "observation: Box, matrix": (
        (spaces.Box(-1, 1, (5, 5)), CHOICE, actor_of, True, NONE),
        "flattened by the networks",
    ),
    "observation: Discrete": ((spaces.Discrete(3), CHOICE, actor_of, True, NONE), "becomes one-hot"),
    "observation: MultiDiscrete": ((spaces.MultiDiscrete([2, 3]), CHOICE, actor_of, True, NONE), "one-hots, joined"),
    "observation: MultiBinary": ((spaces.MultiBinary(3), CHOICE, actor_of, True, NONE), "as it is"),
    "observation: Tuple": ((spaces.Tuple([BOX, CHOICE]), CHOICE, actor_of, True, NONE), "becomes one vector"),
    "observation: Dict": ((DICT, CHOICE, actor_of, True, NONE), "becomes one vector"),
    "observation: Dict, apart": (
        (DICT, CHOICE, actor_of, False, each_its_own),
        "`envs.make(..., flatten=False)`, `encoder=modules.dict_encoder({...})`",
    ),
    "observation: Dict with text": (
        (spaces.Dict({"speed": BOX, "mission": spaces.Text(5)}), CHOICE, actor_of, True, NONE),
        "what holds no numbers is left out, with a warning",
    ),
    "observation: Text": ((spaces.Text(5), CHOICE, actor_of, True, NONE), "becomes numbers of characters"),
    "observation: Sequence": ((spaces.Sequence(BOX), CHOICE, actor_of, True, NONE), "encode it in a wrapper"),
    "action: Box, bounded": ((BOX, BOUNDED, gaussian, True, NONE), "`gaussian_actor`, clipped by the environment"),
    "action: Box, bounded, squashed": (
        (BOX, BOUNDED, tanh_normal, True, NONE),
        "`tanh_normal_actor(tanh_loc=True, log_std_bounds=(-5, -1))`",
    ),
    "action: Box, unbounded": ((BOX, UNBOUNDED, gaussian, True, NONE), "`gaussian_actor`"),
    "action: Box, unbounded, squashed": ((BOX, UNBOUNDED, tanh_normal, True, NONE), "bound the Box"),
    "action: Discrete": ((BOX, CHOICE, actor_of, True, NONE), "`categorical_actor`"),
    "action: MultiDiscrete": ((BOX, spaces.MultiDiscrete([2, 3]), actor_of, True, NONE), "`categorical_actor`"),
    "action: MultiBinary": ((BOX, spaces.MultiBinary(2), actor_of, True, NONE), "`categorical_actor`"),
    "action: Discrete, masked": (
        (with_mask(3), CHOICE, actor_of, False, NONE),
        "an entry `action_mask`, `envs.make(..., flatten=False)`",
    ),
    "action: MultiDiscrete, masked": (
        (with_mask(5), spaces.MultiDiscrete([2, 3]), actor_of, False, NONE),
        "an entry `action_mask`, the choices' masks side by side",
    ),
    "action: Dict, Tuple": ((BOX, spaces.Tuple([BOUNDED, CHOICE]), actor_of, True, NONE), "flatten it in a wrapper"),
}
NO = {"observation: Sequence", "action: Box, unbounded, squashed", "action: Dict, Tuple"}


class Any_(gym.Env):
    """Any spaces; five steps an episode; checks that what it is given is an action."""

    def __init__(self, observation: spaces.Space, action: spaces.Space) -> None:
        self.observation_space, self.action_space = observation, action
        observation.seed(0)

    def _observe(self) -> Any:
        obs = self.observation_space.sample()
        if isinstance(obs, dict) and "action_mask" in obs:
            obs["action_mask"][:] = 1
        return obs

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.t = 0
        return self._observe(), {}

    def step(self, action: Any) -> Any:
        assert self.action_space.contains(action), action
        self.t += 1
        return self._observe(), 1.0, False, self.t == 5, {}


def trains(row: Row, core: Any) -> bool:
    """Whether an agent of that kind is made, collects, and takes its gradient steps; a clear refusal is a no."""
    observation, action, build, flatten, encoder = row
    torch.manual_seed(0)
    try:
        env = envs.make(lambda: Any_(observation, action), num_envs=2, flatten=flatten)
        parts: dict[str, Any] = {"hidden": (8,)} | ({"encoder": encoder()} if encoder else {})
        if core is not None:
            parts = {"encoder": core(env, 8, **parts)}
        actor, critic = build(env, **parts), modules.state_value(env, **parts)
    except UserError:
        return False
    loss = losses.ClipPPOLoss(actor, critic)
    update = updates.OnPolicyUpdate(
        loss,
        advantages.GAE(critic),
        torch.optim.Adam(loss.parameters()),
        epochs=2,
        minibatch_size=16,
        sequence_length=None if core is None else 8,
        compile="off",
    )
    before = [p.clone() for p in loss.parameters()]
    metrics = update(collectors.VectorCollector(env, actor, frames_per_batch=32, compile="off").rollout())
    assert all(np.isfinite(value) for value in metrics.values()), metrics
    return all(not torch.equal(a, b) for a, b in zip(before, loss.parameters(), strict=True))


def table(cell: Callable[[str, str], bool]) -> str:
    """The table as Markdown."""
    lines = [f"| | {' | '.join(CORES)} | how |", "|---" * (len(CORES) + 2) + "|"]
    for what, (_, how) in ROWS.items():
        cells = ["yes" if cell(what, core) else "no" for core in CORES]
        lines.append(f"| {what} | {' | '.join(cells)} | {how} |")
    return "\n".join(lines)


@pytest.mark.parametrize("core", CORES)
@pytest.mark.parametrize("what", ROWS)
def test_a_cell_is_true(what: str, core: str) -> None:
    assert trains(ROWS[what][0], CORES[core]) == (what not in NO)


def test_the_page_has_this_table() -> None:
    assert table(lambda what, core: what not in NO) in PAGE.read_text()


if __name__ == "__main__":
    made = table(lambda what, core: trains(ROWS[what][0], CORES[core]))
    around = re.split(r"(?<=<!-- table -->\n).*(?=\n<!-- end of the table -->)", PAGE.read_text(), flags=re.DOTALL)
    PAGE.write_text(made.join(around))
    sys.stdout.write(made + "\n")
