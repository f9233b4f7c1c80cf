"""The training loop: update, log, evaluate, checkpoint; stop on request and go on where it stopped.

The clock and signals are looked at after every step of the environment and of the optimiser. A run that is to end, ends
there: what the update has done so far is part of the last checkpoint, and a resumed run goes on in the middle of it.

Of several ranks all are at the same update, and leave it at the same step. The clock is that of rank 0, which alone
evaluates, tells and writes; a signal to any of them is one to all. A checkpoint holds what every rank has for itself.

Run folder
    config.yaml run.json        resolved configuration at the start; commit, versions, device, command
    progress.csv evaluation.csv tensorboard/    logs
    checkpoints/step_*.pt       the last few, each enough to continue exactly; the first before anything is learned
    best.pt                     policy with the best evaluation so far
    curve.png                   learning curve
    .lock                       held by the process that trains
"""

import math
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import torch
from torch import Tensor

from softwarp import compiling, notices
from softwarp.policies.policy import Policy
from softwarp.training.algorithm import Algorithm
from softwarp.training.checkpoints import CheckpointError, CheckpointFolder, policy_content, save
from softwarp.training.evaluation import Episodes, score
from softwarp.training.logs import LoggerConfig, ProgressLine, RunLog, describe
from softwarp.training.options import RunConfig
from softwarp.training.ranks import Ranks, pack

_NOTICE = b"\nstopping after this step, with a checkpoint; once more ends at once, at the last checkpoint\n"
LOOK = 0.2  # s between two renewals of the progress line
OVERTIME = 0.1  # of the time limit, that an evaluation may take beyond it
TIME = 1  # what a rank votes for when the time is over; else the number of a signal, which is larger
DIVERGED = 1e6  # a network with a weight as large as this, or none, has diverged


@dataclass
class Counters:
    """Where a run stands."""

    update: int = 0
    steps: int = 0  # environment steps, summed over worlds and ranks
    seconds: float = 0.0  # spent training, over all sessions; compiling kernels left out
    evaluations: int = 0
    best_score: float = -math.inf


class StopSignals:
    """Turns the first SIGINT or SIGTERM into a request; a second one interrupts at once."""

    def __init__(self, *, is_told: bool = True) -> None:
        self.received: int | None = None
        self.is_told = is_told
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> "StopSignals":
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._previous[number] = signal.signal(number, self._receive)
        return self

    def __exit__(self, *unused: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _receive(self, number: int, frame: FrameType | None) -> None:
        if self.received is not None:
            raise KeyboardInterrupt
        self.received = number
        if not self.is_told:
            return
        os.write(sys.__stderr__.fileno() if sys.__stderr__ else 2, _NOTICE)  # a handler must not wait for a stream


class Stopped(Exception):
    """A run is to end, in the middle of an update or of an evaluation."""


@dataclass(frozen=True)
class Outcome:
    """How a session of a run ended."""

    counters: Counters
    evaluation: dict[str, float]  # the last one; empty if there was none
    signal: int | None  # that stopped the session; None if the run is complete
    begun: int = 0  # environment steps of a rollout that was left half way; counted when it is whole


def train(
    algorithm: Algorithm,
    evaluate: Callable[[Policy], Episodes],
    folder: Path,
    config: RunConfig,
    *,
    logger: LoggerConfig,
    settings: dict[str, Any],
    resume: dict[str, Any] | None = None,
) -> Outcome:
    """Train until the budget is spent or a signal asks to stop.

    Args:
        algorithm: Freshly made; its environment and networks fit ``resume`` if given. Every rank calls with its own.
        evaluate: Runs episodes on goals that training does not see; called on rank 0.
        folder: Run folder.
        config: Budget and intervals.
        logger: What to write and show.
        settings: Resolved configuration of the run as plain values, stored in each checkpoint.
        resume: Content of a training checkpoint to continue from; of several ranks as ``portion`` gives it.

    Raises:
        CheckpointError: If ``resume`` does not fit.
        FloatingPointError: If training diverges.
        RankLost: If another rank is gone; the checkpoints before it are whole.
        WriteError: If a file cannot be written; the checkpoints before it are whole.
    """
    counters = Counters() if resume is None else _restore(algorithm, resume)
    ranks = algorithm.ranks
    line = ProgressLine(enabled=logger.progress and ranks.is_first)
    with StopSignals(is_told=ranks.is_first) as stop, notices.telling(False):
        session = _Session(algorithm, folder, config, settings, counters, stop, line)
        if resume is not None and ranks.is_first:
            session.checkpoints.drop_after(counters.steps)
        kept = None if resume is None else session.kept_update
        log = None
        if ranks.is_first:
            log = RunLog(folder, logger, algorithm.metrics, resume_update=kept, settings=settings)
        evaluation: dict[str, float] = {}
        try:
            if resume is None:
                session.checkpoint(every=0.0)  # from here on the run can be resumed, whenever it is killed
            if config.evaluate_start and counters.update == 0:
                evaluation = session.evaluate(evaluate, log)
            while True:
                session.hear()
                if session.evaluation_is_due():  # after an update, or left when the run was stopped
                    evaluation = session.evaluate(evaluate, log) or evaluation
                session.checkpoint(every=config.checkpoint_seconds)
                session.hear()
                if session.is_over:
                    break
                session.update(log)
            session.checkpoint(every=0.0)
        finally:
            line.close()
            if log is not None:
                log.close()
    return Outcome(counters, evaluation, session.signal or None, algorithm.rollout.steps_begun)


class _Session:
    """One stretch of a run between start or resume and stop: its clock, its counters and what it saves and shows."""

    def __init__(
        self,
        algorithm: Algorithm,
        folder: Path,
        config: RunConfig,
        settings: dict[str, Any],
        counters: Counters,
        stop: StopSignals,
        line: ProgressLine,
    ) -> None:
        self.algorithm, self.folder, self.config, self.settings = algorithm, folder, config, settings
        self.ranks: Ranks = algorithm.ranks
        self.signal = 0  # that some rank has received, and all know of
        self.failed_elsewhere = 0  # worlds of other ranks, at the last update
        self.counters, self.stop, self.line = counters, stop, line
        self.checkpoints = CheckpointFolder(folder / "checkpoints", config.keep_checkpoints)
        self.saved_update = -1
        self.saved_at = time.monotonic()
        self.clock_zero = time.monotonic() - compiling.spent() - counters.seconds
        self.row: dict[str, float] = {}  # of the last update
        self.begun = counters.seconds  # when the present update began, or went on
        self.felt = counters.seconds  # when it was last looked at the clock
        self.pace = 0.0  # s that the last step took
        self.shown_at = -math.inf
        algorithm.feel(self.pulse)

    @property
    def seconds(self) -> float:
        """Spent training until now, over all sessions; compiling kernels left out."""
        return time.monotonic() - compiling.spent() - self.clock_zero

    @property
    def progress(self) -> float:
        """Part of the run that was over at the end of the last update; 1 or more at the run's end."""
        return self._part(self.counters.steps, self.counters.seconds)

    @property
    def is_over(self) -> bool:
        """Whether nothing is to be done any more."""
        return self.signal > 0 or self.progress >= 1.0

    @property
    def kept_update(self) -> int:
        """Last update whose rows of the log stay when the run is resumed; what precedes the first is done again."""
        return self.counters.update or -1

    def _part(self, steps: int, seconds: float) -> float:
        return max(steps / self.config.total_steps, seconds / self.config.time_limit)

    def hear(self) -> None:
        """Learn of signals that any rank has received."""
        self.signal = self.ranks.most(self.stop.received or 0)

    def position(self) -> dict[str, float]:
        """First columns of every row of the log."""
        return {name: getattr(self.counters, name) for name in ("update", "steps", "seconds")}

    def pulse(self, overtime: float = 0.0) -> None:
        """Look at the clock and for signals, and show how far the update has come.

        Raises:
            Stopped: If the run is to end here.
        """
        seconds = self.seconds
        self.pace, self.felt = seconds - self.felt, seconds
        is_late = self.ranks.is_first and seconds >= self.config.time_limit * (1.0 + overtime)
        wish = self.stop.received or (TIME if is_late else 0)
        verdict = wish if overtime else self.ranks.vote(wish)  # the others wait while rank 0 evaluates
        if verdict:
            self.signal = verdict if verdict > TIME else 0
            raise Stopped
        if self.ranks.is_first and seconds - self.shown_at >= LOOK:
            self.shown_at = seconds
            self._show(seconds, "evaluating" if overtime else "")

    def _show(self, seconds: float, doing: str = "") -> None:
        rollout = self.algorithm.rollout
        steps = rollout.steps + rollout.steps_begun
        part = self._part(steps, seconds)
        rate = (steps - self.counters.steps) / max(seconds - self.begun, 1e-9)
        now = {"steps": steps, "steps_per_second": rate} if rate and not doing else {"steps": steps}
        text = describe(self.row | now, seconds * (1.0 / part - 1.0) if part else math.inf)
        failures = int(rollout.failures) + self.failed_elsewhere
        self.line.show(part, text + (f"  {failures} failed" if failures else "") + (f"  {doing}" if doing else ""))

    def update(self, log: RunLog | None) -> None:
        """One update of the algorithm and its row in the log, or as much of an update as there is time for."""
        counters = self.counters
        self.begun = self.felt = self.seconds
        diverged = (
            f"training diverged in update {counters.update + 1}: the loss is not finite; lower algo.learning_rate "
            "and continue from the last checkpoint"
        )
        try:
            metrics = self.algorithm.update(self.progress)
        except Stopped:
            counters.seconds, self.saved_update = self.ranks.told(self.seconds), -1
            return
        except (RuntimeError, ValueError) as error:  # of a distribution whose parameters are not finite
            if all(bool((weight.abs() < DIVERGED).all()) for weight in self.algorithm.policy.parameters()):
                raise
            raise FloatingPointError(diverged) from error
        if not all(math.isfinite(number) for name, number in metrics.items() if name.startswith("loss")):
            raise FloatingPointError(diverged)
        rollout = self.algorithm.rollout
        counters.seconds = self.ranks.told(self.seconds)
        rate = (rollout.steps - counters.steps) / (counters.seconds - self.begun)
        counters.update += 1
        counters.steps = rollout.steps
        self.row = {**self.position(), "steps_per_second": rate, **rollout.statistics(), **metrics}
        if self.ranks.size > 1:
            self.failed_elsewhere = int(self.ranks.gather(rollout.failures).sum() - rollout.failures)
        if log is not None:
            log.add("progress", self.row)
            self._show(counters.seconds)

    def evaluation_is_due(self) -> bool:
        """Whether the run has passed the next of its evenly spaced evaluations."""
        if self.signal or self.config.evaluations == 0:
            return False
        return self.progress * self.config.evaluations >= self.counters.evaluations + 1

    def evaluate(self, evaluate: Callable[[Policy], Episodes], log: RunLog | None) -> dict[str, float]:
        """Evaluate, tell it, and keep the policy if it is the best so far; empty if the run ended before that."""
        summary: dict[str, float] = self._evaluate(evaluate, log) if log is not None else {}
        if self.ranks.size == 1:
            return summary
        shared: dict[str, Any] = self.ranks.share({"counters": vars(self.counters), "summary": summary})
        vars(self.counters).update(shared["counters"])
        self.hear()
        return dict(shared["summary"])

    def _evaluate(self, evaluate: Callable[[Policy], Episodes], log: RunLog) -> dict[str, float]:
        counters, policy = self.counters, self.algorithm.policy
        self.felt = self.seconds
        hook = policy.register_forward_pre_hook(lambda *_: self.pulse(OVERTIME))
        try:
            if self.seconds + self.pace >= self.config.time_limit * (1.0 + OVERTIME):
                raise Stopped
            summary = evaluate(policy).summary()
        except Stopped:
            counters.seconds = self.seconds
            if not self.signal:
                self.line.note("the last evaluation does not fit into the time limit; softwarp eval makes up for it")
            return {}
        finally:
            hook.remove()
        counters.evaluations = math.floor(self.progress * self.config.evaluations)
        counters.seconds = self.seconds
        if score(summary) > counters.best_score:
            counters.best_score = score(summary)
            told = {"config": self.settings, "steps": counters.steps, "evaluation": summary}
            save(self.folder / "best.pt", "policy", told | policy_content(policy))
        log.add("evaluation", {**self.position(), **summary})
        self.line.note(f"evaluation at {counters.steps:,} steps: {describe_evaluation(summary)}")
        return summary

    def checkpoint(self, *, every: float) -> None:
        """Save everything if the last time was ``every`` seconds ago, and not for this update."""
        if self.saved_update == self.counters.update or not self.ranks.told(time.monotonic() - self.saved_at >= every):
            return
        content = _content(self.algorithm, self.counters, self.settings)
        if self.ranks.size > 1:
            own = {key: content[key] for key in (*self.algorithm.own, "random")}
            content["others"] = self.ranks.collect(own)
        if self.ranks.is_first:
            self.checkpoints.save(self.counters.steps, content)
        self.saved_update, self.saved_at = self.counters.update, time.monotonic()


def describe_evaluation(summary: dict[str, float]) -> str:
    """An evaluation in a few words."""
    text = f"return {summary['return']:.3g}, success {100.0 * summary['success']:.0f}%"
    if "distance" in summary:
        text += f", final distance {1e3 * summary['distance']:.1f} mm (median)"
    return text


def _content(algorithm: Algorithm, counters: Counters, settings: dict[str, Any]) -> dict[str, Any]:
    """Everything that continues the run exactly."""
    random = {"torch": torch.get_rng_state()}
    if algorithm.ranks.size > 1 and algorithm.device.type == "cuda":  # the other GPUs are other ranks'
        random["cuda"] = torch.cuda.get_rng_state(algorithm.device).unsqueeze(0)
    elif algorithm.ranks.size == 1 and torch.cuda.is_available():
        random["cuda"] = torch.stack(torch.cuda.get_rng_state_all())
    return {
        "config": settings,
        "counters": vars(counters).copy(),
        "random": random,
        **policy_content(algorithm.policy),
        **algorithm.state_dict(),
    }


def portion(content: dict[str, Any] | None, ranks: Ranks, own: Sequence[str]) -> dict[str, Any]:
    """What a rank continues from: what all have in common, and what it has for itself.

    Where a checkpoint has another number of ranks, rank r goes on with the worlds of the one that had its number. If
    there was none it has worlds of its own, and ``is_new`` is true.

    Args:
        content: Of a training checkpoint on rank 0; not looked at elsewhere.
        ranks: That go on.
        own: Keys of the algorithm's state that every rank has for itself.
    """
    common: dict[str, Any] = {}
    first: dict[str, Any] = {}
    parts: list[Tensor] = []
    if ranks.is_first:
        assert content is not None
        others = content.get("others", [])
        saved = 1 + len(others)
        first = {key: content[key] for key in (*own, "random") if key in content}
        common = {key: value for key, value in content.items() if key not in (*first, "others")}
        common["saved_ranks"] = saved
        held = [pack(first) if saved < ranks.size else torch.empty(0), *others]
        parts = [held[rank % saved] for rank in range(1, ranks.size)]
    common = ranks.share(common)
    mine = ranks.hand_out(parts) or first
    return {**common, **mine, "is_new": ranks.rank >= common["saved_ranks"]}


def _restore(algorithm: Algorithm, content: dict[str, Any]) -> Counters:
    """Put a checkpoint's state back.

    Raises:
        CheckpointError: If it holds only a policy, or belongs to another environment or network.
    """
    if content["kind"] != "training":
        raise CheckpointError(f"checkpoint: holds a {content['kind']} only; resume needs a run's checkpoints/step_*.pt")
    spaces = policy_content(algorithm.policy)["spaces"]
    if content["spaces"] != spaces:
        raise CheckpointError(f"checkpoint: made for {content['spaces']}, but the environment has {spaces}")
    is_new, saved = content.get("is_new", False), content.get("saved_ranks", 1)
    try:
        if saved == algorithm.ranks.size:
            algorithm.load_state_dict(content)
        else:
            algorithm.regroup(content, is_new=is_new)
    except (KeyError, RuntimeError, ValueError) as error:
        raise CheckpointError(f"checkpoint: does not fit this run's networks and environment ({error})") from error
    if is_new:
        return Counters(**content["counters"])
    torch.set_rng_state(content["random"]["torch"].cpu())
    states = [state.cpu() for state in content["random"].get("cuda", ())]
    if algorithm.device.type == "cuda" and (algorithm.ranks.size > 1 or len(states) == 1):
        torch.cuda.set_rng_state(states[0], algorithm.device)
    elif states and torch.cuda.is_available():
        torch.cuda.set_rng_state_all(states)
    return Counters(**content["counters"])
