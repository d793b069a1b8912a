"""TorchRL's collector behind pgkit's collector seam."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.data import Unbounded
from torchrl.envs import Compose, EnvBase, InitTracker, RewardSum, StepCounter, TensorDictPrimer, TransformedEnv

from pgkit.collectors.actor import check_types, memory
from pgkit.errors import UserError


class TorchRLCollector:
    """``torchrl.collectors.Collector`` as an iterable of rollouts that counts its frames.

    For any TorchRL environment, transformed or not. It adds ``RewardSum`` and ``StepCounter``, which write the
    ``("next", "episode_reward")`` and ``("next", "step_count")`` that finished episodes are read from; for a recurrent
    actor of pgkit's, also ``InitTracker`` and a primer of its ``recurrent_state``.

    Args:
        env: any TorchRL environment, pgkit's included; for a recurrent actor, a batch of environments.
        actor: TensorDict module that writes ``action``.
        frames_per_batch: frames of a rollout over all environments.
        total_frames: frames of the whole training; -1: endless.
        **kwargs: passed to TorchRL's collector.
    """

    def __init__(
        self,
        env: EnvBase,
        actor: TensorDictModuleBase,
        *,
        frames_per_batch: int,
        total_frames: int = -1,
        **kwargs: Any,
    ) -> None:
        from torchrl.collectors import Collector  # slow to import, and rarely needed

        check_types(actor, env.fake_tensordict())
        transforms = [RewardSum(), StepCounter()]
        if state := memory(actor, env.batch_size.numel()):
            if not env.batch_size:
                raise UserError("a recurrent actor reads a batch of environments, this is one: SerialEnv(1, make_env)")
            primers = {key: Unbounded(x.shape[1:]) for key, x in state.items() if key != "is_init"}
            transforms += [InitTracker(), TensorDictPrimer(primers, expand_specs=True)]
        env = TransformedEnv(env, Compose(*transforms))
        self.frames, self.total_frames, self.compile_seconds = 0, total_frames, 0.0
        kwargs = {"trust_policy": True, "auto_register_policy_transforms": True} | kwargs
        self.collector = Collector(env, actor, frames_per_batch=frames_per_batch, total_frames=total_frames, **kwargs)

    def __iter__(self) -> Iterator[TensorDictBase]:
        for rollout in self.collector:  # which counts from 0 again after a resume
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
