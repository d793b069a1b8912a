"""One training run, as a recipe holds it: log a step, and evaluation and checkpoints follow when due."""

from __future__ import annotations

import logging
import math
import secrets
import traceback
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from statistics import mean
from types import TracebackType
from typing import Any, Protocol, runtime_checkable

import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from pgkit import files
from pgkit.compiled import chosen, set_matmul
from pgkit.envs import vector_of
from pgkit.errors import Diverged, UserError
from pgkit.run import checkpoint, config, directory, ending, seeding
from pgkit.run.agent import Agent, as_built
from pgkit.run.args import RunArgs, check
from pgkit.run.clock import Clock
from pgkit.run.evaluate import evaluate
from pgkit.run.metrics import Metrics, averages, digest, finished_episodes, finished_infos
from pgkit.run.plots import plot
from pgkit.run.progress import Live
from pgkit.run.signals import Signals
from pgkit.run.threads import fastest_threads
from pgkit.seams import Stateful

NAN = float("nan")
_log = logging.getLogger("pgkit")


@runtime_checkable
class Compiles(Protocol):
    """What spends time on compiling, which does not count as training."""

    @property
    def compile_seconds(self) -> float: ...


class Run:
    """Seeds on entry, writes the run directory, ends with an evaluation, a summary and a curve.

    Nothing is written before :meth:`track`, and a run that ends before its first row leaves no directory behind. Ctrl-C
    (or SIGTERM, or SIGHUP) lets the running update finish, saves ``latest`` and ends the run; a second one ends it at
    once. One during an evaluation ends that, and a failed evaluation ends the run: both after ``latest`` is saved. Any
    other error ends the run after ``latest`` is saved as of the last whole update.

    Raises:
        UserError: the directory holds a run; or the resumed one has no checkpoint, is another recipe's, or
            has already trained for ``total_frames``.
        Diverged: at the end, or at a checkpoint: the losses, or the weights, are not finite. No checkpoint that is
            finite is replaced by one that is not.
    """

    def __init__(self, args: RunArgs, recipe: str):
        check(args)
        self.args, self.recipe = args, recipe
        self.dir = directory.choose(args, recipe)
        self.frames = 0
        self.best: dict[str, float] = {}
        self._evaluated: dict[str, float] = {}
        self._episodes = deque[tuple[float, int]](maxlen=100)
        self._recent: list[Mapping[str, float]] = []  # metrics since the last row
        self._clock = Clock()
        self._saved: dict[str, Any] | None = None
        self._tracked: dict[str, Stateful] = {}
        self._eval: Any = None
        self._signals = Signals(lambda text: self._live.line(text))
        self._lost = ""  # a metric of the last row that is not finite
        self._seen = self._saved_at = 0  # frames of the last step, and in the last checkpoint
        self._claimed = False
        self._lock: int | None = None

    def __enter__(self) -> Run:
        if self.args.resume:
            self._lock = directory.lock(self.dir)  # before it reads: another process may be further
            try:
                self._load(Path(self.args.resume))
            except BaseException:
                directory.unlock(self._lock)
                raise
        self.args.threads = self.args.threads or int(chosen("threads of a run", lambda: str(fastest_threads())))
        torch.set_num_threads(self.args.threads)
        set_matmul(self.args.matmul)
        seeding.seed_everything(self.args.seed)
        self._signals.listen()
        return self

    def _load(self, resume: Path) -> None:
        before = config.read_config(self.dir)
        if before["recipe"] != self.recipe:
            raise UserError(f"{self.dir} holds a run of {before['recipe']}, not of {self.recipe}: use that recipe")
        config.as_resumed(self.args, self.dir)
        theirs, mine = before.get("file"), config.recipe_file(type(self.args))
        if theirs != mine:
            names = (file or f"pgkit's {self.recipe}" for file in (theirs, mine))
            _log.warning("%s is a run of %s, this is %s: is it the same?", self.dir, *names)
        saved = checkpoint.load(resume if resume.suffix == ".pt" else resume / "checkpoints" / "latest.pt")
        if self.args.total_frames <= saved["frames"] and ending.has_ended(self.dir, saved["frames"]):
            if self.args.resume_if_possible:
                print(f"{self.dir} has already trained {saved['frames']:,} frames: there is nothing left to do")
                raise SystemExit(0)
            raise UserError(
                f"{self.dir} has already trained {saved['frames']} frames: give a --total-frames above that"
            )
        rows = self.dir / "metrics.csv"
        if rows.exists() and digest(rows, saved["frames"]) != saved["counters"].get("metrics"):
            raise UserError(f"{rows} is damaged: its rows are not those that were saved; move it away to go on without")
        self._saved = saved
        self.frames = self._seen = self._saved_at = saved["frames"]
        with checkpoint.damage(self.dir):
            counters = saved["counters"]
            self.best, self._evaluated = {**counters["best"]}, {**counters["evaluated"]}
            self._episodes.extend((float(reward), int(length)) for reward, length in counters["episodes"])
            self._clock = Clock(already=float(counters["wall_s"]))

    def track(
        self,
        *,
        eval_env: Callable[..., Any],
        agent: Agent | None = None,
        policy: torch.nn.Module | None = None,
        **stateful: Stateful,
    ) -> None:
        """Name what to evaluate and what to save; on a resume, load the checkpoint into it.

        With ``--explain`` it prints the update, which says how the agent is wired, and ends the program.

        Args:
            eval_env: ``eval_env(num_envs=, seed=)`` makes the evaluation's own env: ``args.make_env``.
            agent: what is trained; its actor is evaluated, and its parts are saved.
            policy: the actor alone, in place of an agent.
            stateful: whatever else the run must restore (update, collector, replay, ...).
        """
        if not callable(eval_env) or isinstance(eval_env, EnvBase):
            raise UserError(
                f"track(eval_env=...) takes a function that makes an environment, this is a {type(eval_env).__name__}: "
                "functools.partial(envs.make, env_id)"
            )
        if agent is None:
            if policy is None:
                raise UserError("track(...) takes an agent=run.Agent(...), or a policy=")
            agent = Agent(policy)
        if self.args.explain:
            print(stateful.get("update", agent.actor))
            raise SystemExit(0)
        self._agent, self._make_env = agent, eval_env
        self._eval_env()  # what is wrong with it shows before the training, not after
        tracked: dict[str, Stateful] = {"agent": agent, **stateful}
        self._claim(tracked)
        self._live = Live(self.args.total_frames, self.frames)
        self._tracked = tracked
        self._signals.at_once = False
        self._clock.restart(self.frames)

    def _claim(self, tracked: dict[str, Stateful]) -> None:
        """Restores what is resumed, or what the run begins with, and writes the first files."""
        before, identity = None, secrets.token_hex(4)
        if self._saved:
            checkpoint.restore(tracked, self._saved["states"], self.dir / "checkpoints" / "latest.pt")
            with checkpoint.damage(self.dir):
                seeding.set_rng_state(self._saved["rng"])
            before = config.read_config(self.dir)
            before["resumed_at"], identity = [*before["resumed_at"], self.frames], before["id"]
            self._saved["states"] = {}  # a copy of everything
        elif self.args.init:
            folder = self.args.init / "checkpoints"
            path = folder / ("best.pt" if (folder / "best.pt").exists() else "latest.pt")
            begun_with = {"agent": checkpoint.load(path)["states"].get("agent")}
            with as_built(self._agent):
                checkpoint.restore({"agent": self._agent}, begun_with, path)
        if not self._saved:
            self._lock = directory.claim(self.dir, self.args, self.recipe)
            self._claimed = True
        config.write_config(self.dir, self.args, self.recipe, before, identity, self._eval_env().env_id)
        self._metrics = Metrics(self.dir, upto=self.frames, identity=identity)

    def step(
        self,
        frames: int,
        rollout: TensorDictBase | None = None,
        metrics: Mapping[str, float] | None = None,
        compile_seconds: float | None = None,
        every: int = 1,
    ) -> dict[str, float]:
        """Log one update in ``metrics.csv``; evaluate and save when due. Returns the row, empty where none is due.

        Args:
            frames: env steps taken so far, all envs together.
            rollout: ``[num_envs, T]``; its finished episodes enter the mean of the last 100.
            metrics: logged as ``train/<name>``, or as they are if the name holds a ``/``.
            compile_seconds: seconds this process has spent compiling so far, left out of ``time/fps``; None: what the
                tracked objects say.
            every: a row only every so many frames, with the means of the metrics since the last one.
        """
        if not self._tracked:
            raise RuntimeError("call track(policy=..., eval_env=...) before the first step(...)")
        self._seen = frames
        self._episodes.extend(finished_episodes(rollout))
        self._recent += [metrics] if metrics else []
        self._recent += [infos] if (infos := finished_infos(rollout)) else []
        due = frames >= self.args.total_frames
        if self.args.eval_every:
            due |= frames // self.args.eval_every > self.frames // self.args.eval_every
        if not (due or self._signals.asked or frames // every > self.frames // every):
            return {}
        self.frames = frames
        if compile_seconds is None:
            compile_seconds = sum(x.compile_seconds for x in self._tracked.values() if isinstance(x, Compiles))
        row = self._row(compile_seconds)
        self._live.update(frames, row["rollout/ep_rew_mean"], row["time/fps"])
        if due and not self._signals.asked:
            try:
                row |= self._evaluate(row)
            except BaseException:  # also a second Ctrl-C: what was trained is kept
                self._metrics.write(row)
                self.save()
                raise
        self._metrics.write(row)
        if due or self._signals.asked:
            try:
                self.save()
            except UserError as error:
                _log.warning("%s; the training goes on", error)
        if self._signals.asked:
            raise KeyboardInterrupt
        return row

    def _row(self, compile_seconds: float) -> dict[str, float]:
        row: dict[str, float] = {
            "frames": self.frames,
            "time/fps": self._clock.fps(self.frames, compile_seconds),
            "time/wall_s": self._clock.wall,
            "rollout/ep_rew_mean": mean(reward for reward, _ in self._episodes) if self._episodes else NAN,
            "rollout/ep_len_mean": mean(length for _, length in self._episodes) if self._episodes else NAN,
        }
        row |= {name if "/" in name else f"train/{name}": value for name, value in averages(self._recent).items()}
        self._recent = []
        lost = [name for name, value in row.items() if name.startswith("train/") and not math.isfinite(value)]
        if lost and not self._lost:
            _log.warning(
                "%s is %s at %s frames: the training has diverged; stop it (Ctrl-C) and start again with lower "
                "learning rates or a lower --max-grad-norm", lost[0], row[lost[0]], f"{self.frames:,}",
            )  # fmt: skip
        self._lost = lost[0] if lost else ""
        return row

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
            try:
                self._signals.at_once = True
                scores = evaluate(self._agent.actor, env, self.args.eval_episodes)
            finally:
                self._signals.at_once = False
            self._evaluated = {"frames": self.frames, **scores}
            if scores["eval/mean_reward"] > self.best.get("eval/mean_reward", -float("inf")):
                self.best = self._evaluated
        self._live.evaluated(self.frames, row.get("rollout/ep_rew_mean", NAN), row.get("time/fps", NAN), scores)
        return scores

    def save(self) -> None:
        """Save ``latest`` (and ``best``, if the evaluation just made is) to ``checkpoints/``.

        Raises:
            Diverged: a weight is not finite; the checkpoints before stay.
            UserError: the files cannot be written.
        """
        folder = self.dir / "checkpoints"
        with self._clock.paused():
            try:
                folder.mkdir(exist_ok=True)
            except OSError as error:
                files.cannot_write(folder, error)
            for part in vars(self._agent).values():
                if isinstance(part, torch.nn.Module) and not checkpoint.finite(part):
                    raise Diverged(
                        f"the weights are not finite at {self.frames:,} frames: start again with lower learning rates; "
                        f"{self.dir} keeps its checkpoint of {self._saved_at:,} frames"
                    )
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
                    "metrics": digest(self.dir / "metrics.csv", self.frames),
                },
            }
            if self.best.get("frames") == self.frames:  # first: latest says that there is one
                files.save(folder / "best.pt", content)
            files.save(folder / "latest.pt", content)
            self._saved_at = self.frames

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None):
        # after a signal, any error may be of what else it ended: a compiler, a server of the environment's
        asked = self._signals.asked and not isinstance(error, Diverged)
        stopped = error is not None and (asked or self._signals.broke_off(error))
        try:
            self._end(error, trace, stopped)
        finally:
            self._signals.restore()
        if stopped and not isinstance(error, KeyboardInterrupt):
            raise KeyboardInterrupt from error

    def _end(self, error: BaseException | None, trace: TracebackType | None, stopped: bool) -> None:
        if not self._tracked:
            if self._claimed:
                directory.remove_if_bare(self.dir)
            directory.unlock(self._lock)
            return
        try:
            if error is None:
                self._finish()
            elif not self._signals.broke_off(error):
                self._rescue(error, trace)
        finally:
            self._live.close()
            self._close()
        if error is None or (stopped and self._saved_at):
            self._live.line(ending.how_to_go_on(self.dir, self.args, self.recipe, self.frames, bool(self.best)))
        if isinstance(error, SystemExit) and not stopped:
            raise UserError(f"something called sys.exit({error.code}) after {self._seen:,} frames") from error
        if error is None and self._lost:
            raise Diverged(f"the training has diverged: {self._lost} is not finite at the end ({self.frames:,} frames)")

    def _close(self) -> None:
        try:
            self._metrics.close()
        finally:
            if not self._saved:
                directory.remove_if_bare(self.dir)
            directory.unlock(self._lock)
            if self._eval is not None:
                self._eval.close()

    def _rescue(self, error: BaseException, trace: TracebackType | None) -> None:
        """Saves what was trained until an error, unless that broke into an update and left it half done."""
        if isinstance(error, Diverged) or self._seen <= self._saved_at:
            return
        update = self._tracked.get("update")
        if any(frame.f_locals.get("self") is update for frame, _ in traceback.walk_tb(trace) if update is not None):
            why = "the error came in the middle of an update"
        else:
            self.frames, why = self._seen, ""
            try:
                self.save()
            except Exception as other:  # of an environment or a worker that is gone; the first error is what counts
                why = f"{other}"
        where = f"the checkpoint of {self._saved_at:,} frames" if self._saved_at else "no checkpoint yet"
        _log.warning("the run ends at an error; %s has %s%s", self.dir, where, f" ({why})" if why else "")

    def _finish(self) -> None:
        is_saved = self._saved_at == self.frames
        if self._evaluated.get("frames") != self.frames:
            try:
                scores = self._evaluate({})
            except BaseException:
                self.save()
                raise
            self._metrics.write({"frames": self.frames, "time/wall_s": self._clock.wall, **scores})
            is_saved = False  # the checkpoint knows the rows, and the best policy
        if not is_saved:
            self.save()
        plot([self.dir], self.dir / "curve.png")
        ending.write_summary(self.dir, self.args, self.recipe, self._clock.wall, self._evaluated, self.best)  # the last
