"""Many agents on one thread, in CPU time: the recorded step, collecting, and gradient steps beside others'.

    python tests/benchmarks/agents_speed.py step      # vmas/balance as it is and recorded, with resets
    python tests/benchmarks/agents_speed.py collect   # frames with the policy, beside VMAS alone with its resets
    python tests/benchmarks/agents_speed.py train     # a minibatch of 4,096 frames, 256-256 tanh, IPPO and MAPPO

The settings are those that BenchMARL tuned for VMAS: 600 environments x 100 steps, minibatch 4,096, two layers of 256.
BenchMARL needs ``pip install benchmarl``, and a name that TorchRL 0.14 dropped; it is left out where it is not there.
"""

import argparse
import sys
import time
from collections.abc import Callable
from importlib.util import find_spec
from statistics import median
from typing import Any

import torch
import torchrl.collectors
from tensordict.nn import TensorDictModule
from torch import nn

from pgkit import advantages, collectors, envs, losses, modules, updates

ENVS, STEPS, MINIBATCH, SIZES, AGENTS = 600, 100, 4096, (256, 256), 4


def balance(compile: str = "off") -> Any:
    return envs.make("vmas/balance", ENVS, seed=1, compile=compile, n_agents=AGENTS)


def seconds(call: Callable[[], Any]) -> float:
    """CPU time of one call, of all threads."""
    start = time.process_time()
    call()
    return time.process_time() - start


def alternate(calls: dict[str, Callable[[], Any]], rounds: int) -> dict[str, float]:
    """The median of each call's CPU seconds over rounds in alternation."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds):
        for name, call in calls.items():
            times[name].append(seconds(call))
    return {name: median(found) for name, found in times.items()}


def report(times: dict[str, float], frames: int) -> None:
    first = next(iter(times.values()))
    for name, spent in times.items():
        print(f"{name:34} {1e3 * spent:9.1f} ms   {frames / spent:10,.0f} frames/s   {spent / first:5.2f} of the first")


@torch.no_grad()
def stepping(simulator: Any, steps: int) -> Callable[[], None]:
    spec = simulator.action_spec["agents", "action"]
    actions = [spec.rand() for _ in range(steps)]
    simulator.reset()

    def call() -> None:
        for action in actions:
            simulator.step({("agents", "action"): action})

    return call


def step(rounds: int) -> None:
    calls = {name: stepping(balance(how).simulator, 50) for name, how in (("as it is", "off"), ("recorded", "on"))}
    for call in calls.values():
        call()
    report(alternate(calls, rounds), 50 * ENVS)


def vmas_alone(steps: int) -> Callable[[], None]:
    """VMAS's own step with random actions, and its own reset of each environment that ended."""
    import vmas

    env: Any = vmas.make_env("balance", ENVS, seed=1, max_steps=100, n_agents=AGENTS)
    env.reset()
    actions = [env.get_random_actions() for _ in range(steps)]

    def call() -> None:
        for action in actions:
            done = env.step(action)[2]
            for i in done.nonzero().flatten().tolist():
                env.reset_at(i)

    return call


def collect(rounds: int) -> None:
    made: dict[str, Callable[[], Any]] = {"VMAS alone with its resets": vmas_alone(STEPS)}
    for name, how in (("pgkit, as it is", "off"), ("pgkit, recorded", "on")):
        env = balance(how)
        actor = modules.gaussian_actor(env, SIZES)
        made[name] = collectors.VectorCollector(env, actor, frames_per_batch=ENVS * STEPS, compile="on").rollout
        made[name]()
    report(alternate(made, rounds), ENVS * STEPS)


def ours(env: Any, centralized: bool, rollout: Any) -> Callable[[], Any]:
    actor = modules.gaussian_actor(env, SIZES)
    critic = modules.state_value(env, SIZES, centralized=centralized)
    loss = losses.ClipPPOLoss(actor, critic, critic_coeff=1.0)
    update = updates.OnPolicyUpdate(
        loss, advantages.GAE(critic, gamma=0.99, lmbda=0.9), torch.optim.Adam(loss.parameters(), lr=5e-5), epochs=1,
        minibatch_size=MINIBATCH, max_grad_norm=5.0, compile="on",
    )  # fmt: skip
    return lambda: update(rollout)


def torchrls(env: Any, centralized: bool, rollout: Any) -> Callable[[], Any]:
    """TorchRL's own parts, put together as in its multi-agent tutorial."""
    from tensordict.nn.distributions import NormalParamExtractor
    from torchrl.modules import MultiAgentMLP, ProbabilisticActor, TanhNormal
    from torchrl.objectives import ClipPPOLoss, ValueEstimators

    inputs, common = rollout["agents", "observation"].shape[-1], {"n_agents": AGENTS, "share_params": True}
    shape = {"depth": 2, "num_cells": SIZES[0], "activation_class": nn.Tanh, "device": "cpu"}
    net = MultiAgentMLP(n_agent_inputs=inputs, n_agent_outputs=4, centralized=False, **common, **shape)
    own = TensorDictModule(
        nn.Sequential(net, NormalParamExtractor()),
        [("agents", "observation")],
        [("agents", "loc"), ("agents", "scale")],
    )
    actor = ProbabilisticActor(
        own, spec=env.full_action_spec, in_keys=[("agents", "loc"), ("agents", "scale")],
        out_keys=[("agents", "action")], distribution_class=TanhNormal, return_log_prob=True,
    )  # fmt: skip
    values = MultiAgentMLP(n_agent_inputs=inputs, n_agent_outputs=1, centralized=centralized, **common, **shape)
    critic = TensorDictModule(values, [("agents", "observation")], [("agents", "state_value")])
    loss = ClipPPOLoss(actor, critic, clip_epsilon=0.2, entropy_coeff=0.0, normalize_advantage=False)
    loss.set_keys(
        reward=("agents", "reward"), action=("agents", "action"), value=("agents", "state_value"),
        done=("agents", "done"), terminated=("agents", "terminated"), sample_log_prob=("agents", "action_log_prob"),
    )  # fmt: skip
    loss.make_value_estimator(ValueEstimators.GAE, gamma=0.99, lmbda=0.9)
    optimizer = torch.optim.Adam(loss.parameters(), lr=5e-5)
    with torch.no_grad():
        rollout = actor(rollout.clone())

    def call() -> None:
        data = rollout.clone()
        for key in ("done", "terminated"):
            whole = data["next", key].unsqueeze(-2).expand(*data.shape, AGENTS, 1)
            data["next", "agents", key] = whole
        with torch.no_grad():
            loss.value_estimator(
                data, params=loss.critic_network_params, target_params=loss.target_critic_network_params
            )
        flat = data.reshape(-1)
        for rows in torch.randperm(len(flat)).split(MINIBATCH):
            out = loss(flat[rows])
            sum(x for key, x in out.items() if key.startswith("loss_")).backward()
            nn.utils.clip_grad_norm_(loss.parameters(), 5.0)
            optimizer.step()
            optimizer.zero_grad()

    return call


def benchmarls(centralized: bool, minibatches: int) -> float:
    """CPU seconds of BenchMARL's gradient step, the median."""
    vars(torchrl.collectors).setdefault("SyncDataCollector", torchrl.collectors.Collector)
    from benchmarl.algorithms import IppoConfig, MappoConfig  # pyright: ignore[reportMissingImports]
    from benchmarl.environments import VmasTask  # pyright: ignore[reportMissingImports]
    from benchmarl.experiment import Experiment, ExperimentConfig  # pyright: ignore[reportMissingImports]
    from benchmarl.models.mlp import MlpConfig  # pyright: ignore[reportMissingImports]

    config = ExperimentConfig.get_from_yaml()
    config.on_policy_collected_frames_per_batch, config.on_policy_n_envs_per_worker = 60_000, ENVS
    config.on_policy_n_minibatch_iters, config.on_policy_minibatch_size = 1, MINIBATCH
    config.max_n_iters, config.max_n_frames, config.loggers, config.evaluation = 1, None, [], False
    config.render, config.create_json = False, False
    algorithm = (MappoConfig if centralized else IppoConfig).get_from_yaml()
    nets = [MlpConfig(num_cells=list(SIZES), layer_class=nn.Linear, activation_class=nn.Tanh) for _ in range(2)]
    experiment = Experiment(
        task=VmasTask.BALANCE.get_from_yaml(), algorithm_config=algorithm, model_config=nets[0],
        critic_model_config=nets[1], seed=0, config=config,
    )  # fmt: skip
    times, loop = [], experiment._optimizer_loop

    def timed(group: str) -> Any:
        start = time.process_time()
        out = loop(group)
        times.append(time.process_time() - start)
        return out

    experiment._optimizer_loop = timed
    experiment.run()
    return median(times[:minibatches])


def train(rounds: int) -> None:
    env = balance()
    actor = modules.gaussian_actor(env, SIZES)
    rollout = collectors.VectorCollector(env, actor, frames_per_batch=ENVS * STEPS, compile="off").rollout()
    few = rollout[:512, :32].clone()  # four minibatches, so that a round fits into seconds
    for name, centralized in (("IPPO", False), ("MAPPO", True)):
        calls = {"pgkit": ours(env, centralized, few), "TorchRL's parts": torchrls(env, centralized, few)}
        for call in calls.values():
            call()
        print(f"{name}: {few.numel():,} frames, minibatches of {MINIBATCH:,}")
        report(alternate(calls, rounds), few.numel())
        if find_spec("benchmarl"):
            print(f"BenchMARL, a minibatch: {1e3 * benchmarls(centralized, 15):.1f} ms")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=sys.modules["__main__"].__doc__)
    parser.add_argument("part", choices=["step", "collect", "train"])
    parser.add_argument("--rounds", type=int, default=5)
    given = parser.parse_args()
    torch.set_num_threads(1)
    {"step": step, "collect": collect, "train": train}[given.part](given.rounds)
