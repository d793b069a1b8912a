"""Advantages from lambda-returns, n-step returns and Monte-Carlo returns."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor

from pgkit.advantages.base import Advantage
from pgkit.errors import check_whole_number, within
from pgkit.functional import from_start, lambda_return, n_step_return


class TDLambda(Advantage):
    r"""The :math:`\lambda`-return as value target; the advantage is the target minus the value.

    The advantage equals GAE's. Arguments as in :class:`~pgkit.advantages.Advantage`, and

    Args:
        lmbda: weight of the long returns.
    """

    lmbda: Tensor

    def __init__(
        self,
        critic: TensorDictModule,
        *,
        gamma: float = 0.99,
        lmbda: float = 0.95,
        standardize: bool = False,
        per_agent: bool = False,
        return_scale: Any = None,
    ) -> None:
        super().__init__(critic, gamma=gamma, standardize=standardize, per_agent=per_agent, return_scale=return_scale)
        within(0, 1, lmbda=lmbda)
        self.register_buffer("lmbda", torch.tensor(float(lmbda), dtype=torch.float64))

    def estimate(self, value: Tensor, next_value: Tensor, rollout: TensorDictBase) -> tuple[Tensor, Tensor]:
        target = lambda_return(next_value, *self.ends(value, rollout), self.gamma, self.lmbda)
        return target - value, target


class NStep(Advantage):
    """The n-step return as value target; the advantage is the target minus the value.

    Arguments as in :class:`~pgkit.advantages.Advantage`, and

    Args:
        steps: rewards in a return; fewer where an episode or the rollout ends.
    """

    def __init__(
        self,
        critic: TensorDictModule,
        *,
        gamma: float = 0.99,
        steps: int = 5,
        standardize: bool = False,
        per_agent: bool = False,
        return_scale: Any = None,
    ) -> None:
        super().__init__(critic, gamma=gamma, standardize=standardize, per_agent=per_agent, return_scale=return_scale)
        check_whole_number(1, steps=steps)
        self.steps = steps

    def estimate(self, value: Tensor, next_value: Tensor, rollout: TensorDictBase) -> tuple[Tensor, Tensor]:
        target = n_step_return(next_value, *self.ends(value, rollout), self.gamma, self.steps)
        return target - value, target


class MonteCarlo(Advantage):
    """The sum of the rewards to come, minus the critic's value if there is a critic: REINFORCE's advantage.

    After the rollout's last step or a truncation, the critic's value stands for the rewards that are not seen. Without
    a critic they count as zero, so make rollouts several time limits and several ``1 / (1 - gamma)`` long.
    Arguments as in :class:`~pgkit.advantages.Advantage`, and

    Args:
        reward_to_go: count the rewards from each step on. False: those of the whole episode, from its first step within
            the rollout, for each of its steps: the original's, of much larger variance. The value target is the
            reward to go in either case.
    """

    def __init__(
        self,
        critic: TensorDictModule | None = None,
        *,
        gamma: float = 0.99,
        reward_to_go: bool = True,
        standardize: bool = False,
        per_agent: bool = False,
        return_scale: Any = None,
    ) -> None:
        super().__init__(critic, gamma=gamma, standardize=standardize, per_agent=per_agent, return_scale=return_scale)
        self.reward_to_go = reward_to_go

    def estimate(self, value: Tensor, next_value: Tensor, rollout: TensorDictBase) -> tuple[Tensor, Tensor]:
        reward, done, terminated = self.ends(value, rollout)
        target = lambda_return(next_value, reward, done, terminated, self.gamma, 1.0)
        counted = target if self.reward_to_go else from_start(target, done)
        return counted - value, target
