"""GRPO on verifiable rewards: a small language model learns a task from its own completions.

A warm start on an imperfect teacher comes first, as a policy learns only from what it sometimes gets right.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any, Literal

import torch
from tensordict import TensorDict

from pgkit import advantages, collectors, envs, losses, modules, run, updates


@dataclass
class Args(run.RunArgs):
    """Settings of GRPO; a frame is a completion."""

    task: str = "addition"
    """addition, sorting, countdown, or reasoning_gym/NAME."""
    total_frames: int = 500_000
    """Completions to train for."""
    eval_every: int = 40_960
    """Evaluate and save a checkpoint every so many completions; 0 = only at the end."""
    eval_episodes: int = 2_000
    """Held-out prompts, completed at temperature 1, in each evaluation."""
    prompts: int = run.setting(128, low=1)
    """Prompts of a rollout."""
    group_size: int = run.setting(16, low=2)
    """Completions of each prompt."""
    temperature: float = run.setting(1.0, above=0)
    """Divides the logits when the training's completions are drawn and scored."""
    top_p: float = run.setting(1.0, above=0, high=1)
    """Draw from the likeliest tokens of so much probability."""
    epochs: int = run.setting(1, low=1)
    """Passes over a rollout."""
    minibatches: int = run.setting(4, low=1)
    """Gradient steps of a pass."""
    learning_rate: float = run.setting(2e-4, low=0)
    """Adam's step size."""
    max_grad_norm: float = run.setting(1.0, above=0)
    """Bound of the gradient's norm."""
    advantage: Literal["group", "mean", "leave_one_out", "batch", "gae"] = "mean"
    """Against the group: by mean and deviation, mean alone (Dr. GRPO), the others' mean (RLOO), the batch's deviation.
    gae: PPO with a value head."""
    drop: bool = True
    """Leave groups without spread out of the update."""
    ratio: Literal["token", "sequence"] = "token"
    """Probability ratio of each token, or of the whole completion (GSPO)."""
    aggregation: Literal["token", "sequence", "constant"] = "constant"
    """How tokens are averaged: each alike, each completion alike, or over a constant length (Dr. GRPO)."""
    clip_epsilon: tuple[float, float] = run.setting((0.2, 0.2), low=0)
    """How far the ratio may fall below 1 and rise above it."""
    kl_coeff: float = run.setting(0.0, low=0)
    """Weight of the divergence from the policy that training began with."""
    kl: Literal["k1", "k2", "k3"] = "k3"
    """Its estimate."""
    kl_in: Literal["loss", "reward"] = "loss"
    """Where it is subtracted."""
    entropy_coeff: float = run.setting(0.0, low=0)
    """Weight of the entropy bonus."""
    layers: int = run.setting(2, low=1, high=1000)
    """Blocks of the transformer."""
    width: int = run.setting(128, low=1, high=2**16)
    """Its features."""
    heads: int = run.setting(4, low=1, high=1000)
    """Its attention heads."""
    model: Path | None = None
    """Hugging Face folder or GGUF file in place of the transformer; --init takes such a folder too."""
    warm_start: float = run.setting(0.38, low=0, high=1)
    """Learn from the task's imperfect teacher until so many of the held-out prompts are solved; 0: not at all."""
    warm_steps: int = run.setting(4_000, low=1)
    """Supervised steps at most, of 64 answers each; their learning rate rises for a twentieth of them, then falls."""
    teacher: Literal["imperfect", "perfect"] = "imperfect"
    """perfect: the warm start learns from correct solutions, for comparison."""

    def __post_init__(self) -> None:
        if self.init is not None and self.init.exists() and not (self.init / "checkpoints").is_dir():
            self.model, self.init = self.init, None
        self.env_id, self.num_envs = self.task, self.prompts

    @property
    def minibatch_size(self) -> int:
        """Rows of a gradient step."""
        return -(-self.prompts * self.group_size // self.minibatches)

    def make_env(self, num_envs: int, seed: int, workers: int = 1) -> Any:
        """Held-out prompts, for evaluation."""
        return self.prompt_env(500, seed, held_out=True)

    def prompt_env(self, batch: int, seed: int, held_out: bool = False) -> envs.Prompts:
        """Prompts of the task, with the model's tokenizer."""
        tokenizer = modules.hugging_face_tokenizer(self.model) if self.model else None
        return envs.prompts(self.task, batch, seed=seed, held_out=held_out, tokenizer=tokenizer)


def agent(args: Args, env: envs.Prompts) -> run.Agent:
    """Model, loss and advantage; the actor that is evaluated completes observations."""
    size = {"layers": args.layers, "width": args.width, "heads": args.heads}
    if args.model is None:
        actor = modules.causal_lm(env, **size, temperature=args.temperature)
    else:
        actor = modules.hugging_face(args.model, env, temperature=args.temperature)
    critic = modules.token_value(env, **size) if args.advantage == "gae" else None
    loss = losses.GRPOLoss(
        actor,
        critic,
        clip_epsilon=args.clip_epsilon,
        ratio=args.ratio,
        aggregation=args.aggregation,
        max_length=env.completion_length,
        kl_to_ref_coeff=args.kl_coeff if args.kl_in == "loss" else None,
        kl=args.kl,
        entropy_coeff=args.entropy_coeff,
    )
    if critic is not None:
        advantage = advantages.TokenGAE(critic)
    else:
        in_reward = args.kl_coeff if args.kl_in == "reward" else 0.0
        advantage = advantages.GroupRelative(
            args.group_size,
            kind=args.advantage,
            drop=args.drop,
            multiple=args.minibatch_size,
            kl_coeff=in_reward,
            kl=args.kl,
        )
    return run.Agent(modules.TokenPolicy(actor, env.completion_length), loss, critic, advantage)


def warm_start(args: Args, env: envs.Prompts, policy: modules.TokenPolicy) -> None:
    """Supervised learning from the task's teacher, until enough held-out prompts are solved."""
    test, random = args.prompt_env(500, args.seed, held_out=True), Random(args.seed)
    optimizer = torch.optim.Adam(policy.parameters(), lr=1.5e-3, betas=(0.9, 0.95))
    loss = losses.SFTLoss(policy.actor)
    update = updates.OnPolicyUpdate(
        loss,
        None,
        optimizer,
        epochs=1,
        minibatch_size=64,
        max_grad_norm=1.0,
        schedules={"lr": lambda progress: 1.5e-3 * min(0.1 + 20 * progress, 1 - progress)},
        total_frames=64 * args.warm_steps,
        compile="off",
    )
    answer = env.task.solution if args.teacher == "perfect" else lambda prompt: env.task.teacher(prompt, random)
    for step in range(50, args.warm_steps + 1, 50):
        texts = env.draw(50 * 64)
        metrics = update(env.rows(texts, [answer(text) for text in texts]))
        solved = share_solved(test, policy)
        if step % 250 == 0 or solved >= args.warm_start:
            print(f"warm start: step {step}, loss {metrics['loss_sft']:.2f}, {solved:.1%} of held-out prompts solved")
        if solved >= args.warm_start:
            break


def share_solved(env: envs.Prompts, policy: modules.TokenPolicy) -> float:
    """Mean reward of the completions of an environment's next prompts."""
    with torch.no_grad():
        action = policy(TensorDict(env.reset(), [env.num_envs]))["action"]
    return float(sum(x.mean() for x in env.verify(env.texts, action).values()))


def main(args: Args) -> None:
    """Trains, logs, evaluates, saves."""
    with run.Run(args, recipe="grpo") as log:
        env = args.prompt_env(args.prompts, args.seed)
        with run.placed(args):
            built = agent(args, env)
        policy = built.actor
        if args.warm_start and not (args.resume or args.init or args.model):
            warm_start(args, env, policy)
        reference = copy.deepcopy(policy.actor).requires_grad_(False) if args.kl_coeff else None
        rows = args.prompts * args.group_size
        update = updates.OnPolicyUpdate(
            loss=built.loss,
            advantage=built.advantage,
            optimizer=torch.optim.Adam(built.parameters(), lr=args.learning_rate),
            epochs=args.epochs,
            minibatch_size=args.minibatch_size,
            max_grad_norm=args.max_grad_norm,
            total_frames=args.total_frames,
            compile=args.compile,
        )
        collector = collectors.TokenCollector(
            env,
            policy.actor,
            group_size=args.group_size,
            total_frames=args.total_frames,
            top_p=args.top_p,
            reference=reference,
        )
        kept = {"reference": reference} if reference is not None else {}
        log.track(agent=built, eval_env=args.make_env, update=update, collector=collector, **kept)
        if args.init and not args.resume:
            policy.actor.temperature.fill_(args.temperature)  # --init gave the actor its own
            if reference is not None:
                reference.load_state_dict(policy.actor.state_dict())
        greedy, test = (
            modules.TokenPolicy(policy.actor, env.completion_length, greedy=True),
            args.make_env(1, args.seed),
        )
        for rollout in collector:
            metrics = update(rollout) | collector.metrics
            if args.eval_every and collector.frames % args.eval_every < rows:
                test.set_seed(args.seed + collector.frames)  # a resumed run asks the same prompts
                metrics |= {"eval/greedy": share_solved(test, greedy)}
            log.step(collector.frames, rollout.unsqueeze(1), metrics)
    collector.shutdown()


if __name__ == "__main__":
    run.launch(main, Args)
