"""The training loop: update, log, evaluate, checkpoint; stop on request and go on where it stopped.

The clock and signals are looked at after every step of the environment and of the optimiser. A run that is to end, ends
there: what the update has done so far is part of the last checkpoint, and a resumed run goes on in the middle of it.

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
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import torch

from softwarp import compiling, notices
from softwarp.policies.policy import Policy
from softwarp.training.algorithm import Algorithm
from softwarp.training.checkpoints import CheckpointError, CheckpointFolder, policy_content, save
from softwarp.training.evaluation import Episodes, score
from softwarp.training.logs import LoggerConfig, ProgressLine, RunLog, describe
from softwarp.training.options import RunConfig

_NOTICE = b"\nstopping after this step, with a checkpoint; once more ends at once, at the last checkpoint\n"
LOOK = 0.2  # s between two renewals of the progress line
OVERTIME = 0.1  # of the time limit, that an evaluation may take beyond it
DIVERGED = 1e6  # a network with a weight as large as this, or none, has diverged


@dataclass
class Counters:
    """Where a run stands."""

    update: int = 0
    steps: int = 0  # environment steps, summed over worlds
    seconds: float = 0.0  # spent training, over all sessions; compiling kernels left out
    evaluations: int = 0
    best_score: float = -math.inf


class StopSignals:
    """Turns the first SIGINT or SIGTERM into a request; a second one interrupts at once."""

    def __init__(self) -> None:
        self.received: int | None = None
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
        algorithm: Freshly made; its environment and networks fit ``resume`` if given.
        evaluate: Runs episodes on goals that training does not see.
        folder: Run folder.
        config: Budget and intervals.
        logger: What to write and show.
        settings: Resolved configuration of the run as plain values, stored in each checkpoint.
        resume: Content of a training checkpoint to continue from.

    Raises:
        CheckpointError: If ``resume`` does not fit.
        FloatingPointError: If training diverges.
        WriteError: If a file cannot be written; the checkpoints before it are whole.
    """
    counters = Counters() if resume is None else _restore(algorithm, resume)
    line = ProgressLine(enabled=logger.progress)
    with StopSignals() as stop, notices.telling(False):
        session = _Session(algorithm, folder, config, settings, counters, stop, line)
        if resume is not None:
            session.checkpoints.drop_after(counters.steps)
        kept = None if resume is None else session.kept_update
        log = RunLog(folder, logger, algorithm.metrics, resume_update=kept, settings=settings)
        evaluation: dict[str, float] = {}
        try:
            if resume is None:
                session.checkpoint(every=0.0)  # from here on the run can be resumed, whenever it is killed
            if config.evaluate_start and counters.update == 0:
                evaluation = session.evaluate(evaluate, log)
            while True:
                if session.evaluation_is_due():  # after an update, or left when the run was stopped
                    evaluation = session.evaluate(evaluate, log) or evaluation
                session.checkpoint(every=config.checkpoint_seconds)
                if session.is_over:
                    break
                session.update(log)
            session.checkpoint(every=0.0)
        finally:
            line.close()
            log.close()
    rollout = algorithm.rollout
    return Outcome(counters, evaluation, stop.received, rollout.taken * rollout.worlds)


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
        return self.stop.received is not None or self.progress >= 1.0

    @property
    def kept_update(self) -> int:
        """Last update whose rows of the log stay when the run is resumed; what precedes the first is done again."""
        return self.counters.update or -1

    def _part(self, steps: int, seconds: float) -> float:
        return max(steps / self.config.total_steps, seconds / self.config.time_limit)

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
        if self.stop.received is not None or seconds >= self.config.time_limit * (1.0 + overtime):
            raise Stopped
        if seconds - self.shown_at >= LOOK:
            self.shown_at = seconds
            self._show(seconds, "evaluating" if overtime else "")

    def _show(self, seconds: float, doing: str = "") -> None:
        rollout = self.algorithm.rollout
        steps = rollout.steps + rollout.taken * rollout.worlds
        part = self._part(steps, seconds)
        rate = (steps - self.counters.steps) / max(seconds - self.begun, 1e-9)
        now = {"steps": steps, "steps_per_second": rate} if rate and not doing else {"steps": steps}
        text = describe(self.row | now, seconds * (1.0 / part - 1.0) if part else math.inf)
        failures = int(rollout.failures)
        self.line.show(part, text + (f"  {failures} failed" if failures else "") + (f"  {doing}" if doing else ""))

    def update(self, log: RunLog) -> None:
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
            counters.seconds, self.saved_update = self.seconds, -1
            return
        except (RuntimeError, ValueError) as error:  # of a distribution whose parameters are not finite
            if all(bool((weight.abs() < DIVERGED).all()) for weight in self.algorithm.policy.parameters()):
                raise
            raise FloatingPointError(diverged) from error
        if not all(math.isfinite(number) for name, number in metrics.items() if name.startswith("loss")):
            raise FloatingPointError(diverged)
        counters.seconds = self.seconds
        rate = (self.algorithm.rollout.steps - counters.steps) / (counters.seconds - self.begun)
        counters.update += 1
        counters.steps = self.algorithm.rollout.steps
        self.row = {**self.position(), "steps_per_second": rate, **self.algorithm.rollout.statistics(), **metrics}
        log.add("progress", self.row)
        self._show(counters.seconds)

    def evaluation_is_due(self) -> bool:
        """Whether the run has passed the next of its evenly spaced evaluations."""
        if self.stop.received is not None or self.config.evaluations == 0:
            return False
        return self.progress * self.config.evaluations >= self.counters.evaluations + 1

    def evaluate(self, evaluate: Callable[[Policy], Episodes], log: RunLog) -> dict[str, float]:
        """Evaluate, tell it, and keep the policy if it is the best so far; empty if the run ended before that."""
        counters, policy = self.counters, self.algorithm.policy
        self.felt = self.seconds
        hook = policy.register_forward_pre_hook(lambda *_: self.pulse(OVERTIME))
        try:
            if self.seconds + self.pace >= self.config.time_limit * (1.0 + OVERTIME):
                raise Stopped
            summary = evaluate(policy).summary()
        except Stopped:
            counters.seconds = self.seconds
            if self.stop.received is None:
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
        if self.saved_update != self.counters.update and time.monotonic() - self.saved_at >= every:
            self.checkpoints.save(self.counters.steps, _content(self.algorithm, self.counters, self.settings))
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
    if torch.cuda.is_available():
        random["cuda"] = torch.stack(torch.cuda.get_rng_state_all())
    return {
        "config": settings,
        "counters": vars(counters).copy(),
        "random": random,
        **policy_content(algorithm.policy),
        **algorithm.state_dict(),
    }


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
    try:
        algorithm.load_state_dict(content)
    except (KeyError, RuntimeError, ValueError) as error:
        raise CheckpointError(f"checkpoint: does not fit this run's networks and environment ({error})") from error
    torch.set_rng_state(content["random"]["torch"].cpu())
    if "cuda" in content["random"] and torch.cuda.is_available():
        torch.cuda.set_rng_state_all([state.cpu() for state in content["random"]["cuda"]])
    return Counters(**content["counters"])
