"""TorchRL's collector behind pgkit's collector seam."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.data import Unbounded
from torchrl.envs import Compose, EnvBase, InitTracker, RewardSum, StepCounter, TensorDictPrimer, TransformedEnv

from pgkit.collectors.actor import check_types, memory
from pgkit.collectors.cluster import connect
from pgkit.errors import UserError

_PUSHES = {"update_after_each_batch": True}  # else the actors keep the first weights


class TorchRLCollector:
    """``torchrl.collectors.Collector`` as an iterable of rollouts that counts its frames.

    For any TorchRL environment, transformed or not. It adds ``RewardSum`` and ``StepCounter``, which write the
    ``("next", "episode_reward")`` and ``("next", "step_count")`` that finished episodes are read from; for a recurrent
    actor of pgkit's, also ``InitTracker`` and a primer of its ``recurrent_state``.

    With ``backend="ray"`` each function in ``env`` makes the environment of one Ray actor, which takes one CPU and no
    GPU. The present weights go to the actors before every rollout; that has the environments of all.

    Args:
        env: any TorchRL environment, pgkit's included; for a recurrent actor, a batch of environments. Or a list of
            functions that make one, for collectors with several.
        actor: TensorDict module that writes ``action``.
        frames_per_batch: frames of a rollout over all environments.
        total_frames: frames of the whole training; -1: endless.
        **kwargs: passed to TorchRL's collector.
    """

    def __init__(
        self,
        env: EnvBase | Sequence[Callable[[], EnvBase]],
        actor: TensorDictModuleBase,
        *,
        frames_per_batch: int,
        total_frames: int = -1,
        **kwargs: Any,
    ) -> None:
        from torchrl.collectors import Collector  # slow to import, and rarely needed

        makers = [] if isinstance(env, EnvBase) else list(env)
        one = env if isinstance(env, EnvBase) else makers[0]()
        check_types(actor, one.fake_tensordict())
        state = memory(actor, one.batch_size.numel())
        if state and not one.batch_size:
            raise UserError("a recurrent actor reads a batch of environments, this is one: SerialEnv(1, make_env)")
        if makers:
            one.close()  # it was made for its specs
        primers = {key: Unbounded(x.shape[1:]) for key, x in state.items() if key != "is_init"}
        made: Any = [partial(_transformed, make, primers) for make in makers]
        self.frames, self.total_frames, self.compile_seconds = 0, total_frames, 0.0
        kwargs = {"trust_policy": True} | kwargs
        self._on_ray = kwargs.get("backend") == "ray"
        if self._on_ray:
            if not makers:
                raise UserError('backend="ray" takes a list of functions, one for each actor: [make_env, make_env]')
            connect(cpus=len(made))
            given = kwargs.get("backend_options", {})
            kwargs |= {"sync": kwargs.get("sync", True), "num_collectors": len(made)}
            kwargs["backend_options"] = {"remote_configs": {"num_cpus": 1, "num_gpus": 0}, **_PUSHES, **given}
            total_frames = sys.maxsize if total_frames < 0 else total_frames  # TorchRL would collect none
        elif not makers:
            made = _transformed(one, primers)
            kwargs = {"auto_register_policy_transforms": True} | kwargs
        self.collector = Collector(made, actor, frames_per_batch=frames_per_batch, total_frames=total_frames, **kwargs)

    def __iter__(self) -> Iterator[TensorDictBase]:
        if self._on_ray:
            self.collector.update_policy_weights_()
        rollouts: Any = self.collector
        for rollout in rollouts:  # which counts from 0 again after a resume
            if self._on_ray and rollout.dim() > 2:  # one more dimension, of the actors
                rollout = rollout.flatten(0, -2)
            self.frames += rollout.numel()
            yield rollout
            if 0 <= self.total_frames <= self.frames:
                break

    def state_dict(self) -> dict[str, Any]:
        """Frames so far; TorchRL's environments start new episodes on a resume."""
        return {"frames": self.frames}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores :meth:`state_dict`."""
        self.frames = state["frames"]

    def shutdown(self) -> None:
        """Ends TorchRL's collector."""
        self.collector.shutdown()


def _transformed(env: EnvBase | Callable[[], EnvBase], primers: dict[Any, Any]) -> EnvBase:
    """The environment with what finished episodes and a recurrent actor are read from."""
    transforms = [RewardSum(), StepCounter()]
    if primers:
        transforms += [InitTracker(), TensorDictPrimer(primers, expand_specs=True)]
    return TransformedEnv(env if isinstance(env, EnvBase) else env(), Compose(*transforms))
