"""One training run, as a recipe holds it: log a step, and evaluation and checkpoints follow when due."""

import logging
import math
import shlex
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from statistics import mean, median
from types import FrameType
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from pgkit.envs import vector_of
from pgkit.errors import UserError
from pgkit.run import checkpoint, directory, seeding
from pgkit.run.clock import Clock
from pgkit.run.evaluate import evaluate
from pgkit.run.metrics import Metrics, averages, column, finished_episodes, finished_infos, read_csv, warm
from pgkit.run.plots import plot
from pgkit.run.policy import describe_env
from pgkit.run.progress import Live
from pgkit.run.settings import RunArgs, as_resumed, check, recipe_target

NAN = float("nan")


class Run:
    """Seeds on entry, writes the run directory, ends with an evaluation, a summary and a curve.

    Nothing is written before :meth:`track`, and a run that ends before its first row leaves no directory behind. Ctrl-C
    (or SIGTERM) lets the running update finish, saves ``latest`` and ends the run; a second one ends it at once. One
    during an evaluation ends that, and a failed evaluation ends the run: both after ``latest`` is saved.

    Raises:
        UserError: the directory holds a run; or the resumed one has no checkpoint, is another recipe's, or
            has already trained for ``total_frames``.
    """

    def __init__(self, args: RunArgs, recipe: str):
        check(args)
        self.args, self.recipe = args, recipe
        self.dir = directory.choose(args, recipe)
        self._saved = self._load() if args.resume else None
        counters = self._saved["counters"] if self._saved else {}
        self.frames: int = self._saved["frames"] if self._saved else 0
        self.best: dict[str, float] = counters.get("best", {})
        self._evaluated: dict[str, float] = counters.get("evaluated", {})
        self._episodes = deque[tuple[float, int]](counters.get("episodes", ()), maxlen=100)
        self._recent: list[Mapping[str, float]] = []  # metrics since the last row
        self._clock = Clock(already=counters.get("wall_s", 0.0))
        self._tracked: dict[str, checkpoint.Stateful] = {}
        self._eval: Any = None
        self._interrupted = self._diverged = self._evaluating = False
        self._lock: int | None = None

    def _load(self) -> dict[str, Any]:
        config = directory.read_config(self.dir)
        if config["recipe"] != self.recipe:
            raise UserError(f"{self.dir} holds a run of {config['recipe']}, not of {self.recipe}: use that recipe")
        as_resumed(self.args, self.dir)
        first, now = (Path(command[0]).name for command in (config["command"], sys.argv))
        if first.endswith(".py") and first != now:
            logging.getLogger("pgkit").warning("%s is a run of %s, this is %s: is it the same?", self.dir, first, now)
        saved = checkpoint.load(self.dir / "checkpoints" / "latest.pt")
        if self.args.total_frames <= saved["frames"]:
            raise UserError(
                f"{self.dir} has already trained {saved['frames']} frames: give a --total-frames above that"
            )
        return saved

    def __enter__(self) -> "Run":
        torch.set_num_threads(self.args.threads)
        seeding.seed_everything(self.args.seed)
        if threading.current_thread() is threading.main_thread():
            self._handlers = {s: signal.signal(s, self._interrupt) for s in (signal.SIGINT, signal.SIGTERM)}
        return self

    def track(self, *, policy: torch.nn.Module, eval_env: Callable[..., Any], **stateful: checkpoint.Stateful) -> None:
        """Name what to evaluate and what to save; on a resume, load the checkpoint into it.

        With ``--explain`` it prints the update, which says how the agent is wired, and ends the program.

        Args:
            policy: the actor; reads ``observation``, writes ``action``.
            eval_env: picklable; ``eval_env(num_envs=, seed=)`` makes the evaluation's own env.
            stateful: whatever else the run must restore (update, collector, normalizer, ...).
        """
        if not callable(eval_env) or isinstance(eval_env, EnvBase):
            raise UserError(
                f"track(eval_env=...) takes a function that makes an environment, this is a {type(eval_env).__name__}: "
                "functools.partial(envs.make, env_id)"
            )
        tracked: dict[str, checkpoint.Stateful] = {"policy": policy, **stateful}
        if self.args.explain:
            print(stateful.get("update", policy))
            raise SystemExit(0)
        resumed_at = []
        if self._saved:
            self._lock = directory.lock(self.dir)
            checkpoint.restore(tracked, self._saved["states"], self.dir / "checkpoints" / "latest.pt")
            seeding.set_rng_state(self._saved["rng"])
            resumed_at = [*directory.read_config(self.dir)["resumed_at"], self.frames]
        self._policy, self._make_env = policy, eval_env
        self._eval_env()  # what is wrong with it shows before the training, not after
        directory.write_config(self.dir, self.args, self.recipe, resumed_at)
        self._lock = self._lock or directory.lock(self.dir)
        self._metrics = Metrics(self.dir, upto=self.frames)
        self._live = Live(self.args.total_frames, self.frames)
        self._tracked = tracked
        self._clock.restart(self.frames)

    def step(
        self,
        frames: int,
        rollout: TensorDictBase | None = None,
        metrics: Mapping[str, float] | None = None,
        compile_seconds: float = 0.0,
        every: int = 1,
    ) -> None:
        """Log one update in ``metrics.csv``; evaluate and save when due.

        Args:
            frames: env steps taken so far, all envs together.
            rollout: ``[num_envs, T]``; its finished episodes enter the mean of the last 100.
            metrics: logged as ``train/<name>``, or as they are if the name holds a ``/``.
            compile_seconds: seconds this process has spent compiling so far; left out of ``time/fps``.
            every: a row only every so many frames, with the means of the metrics since the last one.
        """
        if not self._tracked:
            raise RuntimeError("call track(policy=..., eval_env=...) before the first step(...)")
        self._episodes.extend(finished_episodes(rollout))
        self._recent += [metrics] if metrics else []
        self._recent += [infos] if (infos := finished_infos(rollout)) else []
        due = frames >= self.args.total_frames
        if self.args.eval_every:
            due |= frames // self.args.eval_every > self.frames // self.args.eval_every
        if not (due or self._interrupted or frames // every > self.frames // every):
            return
        self.frames = frames
        row: dict[str, float] = {
            "frames": frames,
            "time/fps": self._clock.fps(frames, compile_seconds),
            "time/wall_s": self._clock.wall,
            "rollout/ep_rew_mean": mean(reward for reward, _ in self._episodes) if self._episodes else NAN,
            "rollout/ep_len_mean": mean(length for _, length in self._episodes) if self._episodes else NAN,
        }
        row |= {name if "/" in name else f"train/{name}": value for name, value in averages(self._recent).items()}
        self._recent = []
        self._warn_of_divergence(row)
        self._live.update(frames, row["rollout/ep_rew_mean"], row["time/fps"])
        if due:
            try:
                row |= self._evaluate(row)
            except BaseException:  # also a second Ctrl-C: what was trained is kept
                self._metrics.write(row)
                self.save()
                raise
        self._metrics.write(row)
        if due or self._interrupted:
            self.save()
        if self._interrupted:
            raise KeyboardInterrupt

    def _warn_of_divergence(self, row: Mapping[str, float]) -> None:
        lost = [name for name, value in row.items() if name.startswith("train/") and not math.isfinite(value)]
        if lost and not self._diverged:
            self._diverged = True
            logging.getLogger("pgkit").warning(
                "%s is %s at %s frames: the training has diverged; stop it (Ctrl-C) and start again with lower "
                "learning rates or a lower --max-grad-norm",
                lost[0],
                row[lost[0]],
                f"{row['frames']:,}",
            )

    def _eval_env(self) -> Any:
        if self._eval is None:
            with seeding.preserved_rng():
                try:
                    self._eval = self._make_env(num_envs=min(self.args.eval_episodes, 10), seed=self.args.seed)
                except TypeError as error:
                    if "argument" not in str(error):
                        raise
                    raise UserError(
                        f"track(eval_env=...) is called as eval_env(num_envs=, seed=), this one cannot be ({error}): "
                        "functools.partial(envs.make, env_id)"
                    ) from error
            self._eval = vector_of(self._eval)
        return self._eval

    def _evaluate(self, row: Mapping[str, float]) -> dict[str, float]:
        with self._clock.paused(), seeding.preserved_rng():
            env = self._eval_env()
            env.set_seed(seeding.evaluation_seed(self.args.seed, self.frames))
            self._evaluating = True
            try:
                scores = evaluate(self._policy, env, self.args.eval_episodes)
            finally:
                self._evaluating = False
            self._evaluated = {"frames": self.frames, **scores}
            if scores["eval/mean_reward"] > self.best.get("eval/mean_reward", -float("inf")):
                self.best = self._evaluated
        self._live.evaluated(self.frames, row.get("rollout/ep_rew_mean", NAN), row.get("time/fps", NAN), scores)
        return scores

    def save(self) -> None:
        """Save ``latest`` (and ``best``, if the evaluation just made is) to ``checkpoints/``."""
        with self._clock.paused():
            folder = self.dir / "checkpoints"
            if not (folder / "policy.pt").exists():
                env = describe_env(self._eval_env())
                actor = {"actor": self._policy, "make_env": self._make_env}
                checkpoint.save(folder / "policy.pt", actor | env)
            content = {
                "recipe": self.recipe,
                "frames": self.frames,
                "states": {name: owner.state_dict() for name, owner in self._tracked.items()},
                "rng": seeding.rng_state(),
                "counters": {
                    "best": self.best,
                    "evaluated": self._evaluated,
                    "episodes": list(self._episodes),
                    "wall_s": self._clock.wall,
                },
            }
            if self.best.get("frames") == self.frames:  # first: latest says that there is one
                checkpoint.save(folder / "best.pt", content)
            checkpoint.save(folder / "latest.pt", content)

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        if threading.current_thread() is threading.main_thread():
            for number, handler in self._handlers.items():
                signal.signal(number, handler)
        if not self._tracked:
            directory.unlock(self._lock)
            return
        try:
            if kind is None:
                self._finish()
        finally:
            self._live.close()
            self._metrics.close()
            if not self._saved:
                directory.remove_if_bare(self.dir)
            directory.unlock(self._lock)
            if self._eval is not None:
                self._eval.close()
        if kind is None or (kind is KeyboardInterrupt and (self.dir / "checkpoints" / "latest.pt").exists()):
            self._say_how_to_go_on()

    def _interrupt(self, number: int, frame: FrameType | None) -> None:
        if self._interrupted or self._evaluating or not self._tracked:
            raise KeyboardInterrupt
        self._interrupted = True
        self._live.line("stopping after this update; press Ctrl-C again to stop at once")

    def _finish(self) -> None:
        if self._evaluated.get("frames") != self.frames:
            scores = self._evaluate({})
            self._metrics.write({"frames": self.frames, "time/wall_s": self._clock.wall, **scores})
            self.save()
        rows = read_csv(self.dir / "metrics.csv")[1]
        fps = [value for _, value in column(rows, "time/fps")]
        returns = column(rows, "rollout/ep_rew_mean")
        summary = {
            "recipe": self.recipe,
            "env_id": self.args.env_id,
            "seed": self.args.seed,
            **self._evaluated,
            "frames": self.frames,
            "wall_s": self._clock.wall,
            "time/fps": median(warm(fps)) if fps else NAN,
            "rollout/ep_rew_mean": returns[-1][1] if returns else NAN,
            "best/mean_reward": self.best.get("eval/mean_reward", NAN),
            "best/frames": self.best.get("frames", 0),
        }
        directory.write_json(self.dir / "summary.json", summary)
        plot([self.dir], self.dir / "curve.png")

    def _say_how_to_go_on(self) -> None:
        where = shlex.quote(str(self.dir))
        total = self.args.total_frames * (2 if self.frames >= self.args.total_frames else 1)
        print(
            f"run directory: {self.dir}\n"
            f"  resume    pgkit run {recipe_target(self.recipe)} --resume {where} --total-frames {total}\n"
            f"  evaluate  pgkit eval {where}{'' if self.best else ' --which latest'}\n"
            f"  plot      pgkit plot {where}"
        )
