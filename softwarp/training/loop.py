"""The training loop: update, log, evaluate, checkpoint; stop on request and go on where it stopped.

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

from softwarp.policies.policy import Policy
from softwarp.ranges import Limit, Seed, check_fields
from softwarp.training.algorithm import Algorithm
from softwarp.training.checkpoints import CheckpointError, CheckpointFolder, policy_content, save
from softwarp.training.evaluation import Episodes, score
from softwarp.training.logs import LoggerConfig, ProgressLine, RunLog, describe

_NOTICE = b"\nstopping when this update is done and saved; once more ends at once, at the last checkpoint\n"
DIVERGED = 1e6  # a network with a weight as large as this, or none, has diverged


@dataclass
class RunConfig:
    """How long to train, and how often to look and to save."""

    total_steps: int = 1_000_000  # environment steps, summed over worlds
    time_limit: Limit = math.inf  # s; the run ends at whichever comes first
    evaluations: int = 10  # evenly spaced, the last one at the end; 0: never
    evaluation_episodes: int = 64
    evaluation_deterministic: bool = True  # most likely actions instead of drawn ones
    evaluate_start: bool = False  # also evaluate the policy that learned nothing
    evaluation_seed: Seed = 1_000_003  # of the goals that training does not see
    checkpoint_seconds: float = 30.0  # s between checkpoints; each waits for the end of an update
    keep_checkpoints: int = 3

    def __post_init__(self) -> None:
        """Refuse values outside their range."""
        check_fields(self, "run")
        for name in ("total_steps", "evaluation_episodes", "keep_checkpoints"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: must be at least 1, got {getattr(self, name)}")
        for name in ("evaluations", "evaluation_seed", "checkpoint_seconds"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name}: must not be negative, got {getattr(self, name)}")
        if not self.time_limit > 0.0:
            raise ValueError(f"time_limit: must be a positive number of seconds, got {self.time_limit:g}")


@dataclass
class Counters:
    """Where a run stands."""

    update: int = 0
    steps: int = 0  # environment steps, summed over worlds
    seconds: float = 0.0  # spent training, over all sessions
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


@dataclass(frozen=True)
class Outcome:
    """How a session of a run ended."""

    counters: Counters
    evaluation: dict[str, float]  # the last one; empty if there was none
    signal: int | None  # that stopped the session; None if the run is complete


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
    session = _Session(algorithm, folder, config, settings, counters)
    if resume is not None:
        session.checkpoints.drop_after(counters.steps)
    kept = None if resume is None else session.kept_update
    log = RunLog(folder, logger, algorithm.metrics, resume_update=kept, settings=settings)
    line = ProgressLine(enabled=logger.progress)
    evaluation: dict[str, float] = {}
    with StopSignals() as stop:
        try:
            if resume is None:
                session.checkpoint(every=0.0)  # from here on the run can be resumed, whenever it is killed
            if config.evaluate_start and counters.update == 0:
                evaluation = session.evaluate(evaluate, log, line)
            while stop.received is None and session.progress < 1.0:
                row = session.update()
                log.add("progress", row)
                line.show(session.progress, describe(row, counters.seconds * (1.0 / session.progress - 1.0)))
                if session.evaluation_is_due():
                    evaluation = session.evaluate(evaluate, log, line)
                session.checkpoint(every=config.checkpoint_seconds)
            session.checkpoint(every=0.0)
        finally:
            line.close()
            log.close()
    return Outcome(counters, evaluation, stop.received)


class _Session:
    """One stretch of a run between start or resume and stop: its clock, its counters and what it saves."""

    def __init__(
        self, algorithm: Algorithm, folder: Path, config: RunConfig, settings: dict[str, Any], counters: Counters
    ) -> None:
        self.algorithm, self.folder, self.config, self.settings = algorithm, folder, config, settings
        self.counters = counters
        self.checkpoints = CheckpointFolder(folder / "checkpoints", config.keep_checkpoints)
        self.saved_update = -1
        self.saved_at = time.monotonic()
        self.clock_zero = time.monotonic() - counters.seconds

    @property
    def progress(self) -> float:
        """Part of the run that is over; 1 or more at its end."""
        return max(self.counters.steps / self.config.total_steps, self.counters.seconds / self.config.time_limit)

    @property
    def kept_update(self) -> int:
        """Last update whose rows of the log stay when the run is resumed; what precedes the first is done again."""
        return self.counters.update or -1

    def position(self) -> dict[str, float]:
        """First columns of every row of the log."""
        return {name: getattr(self.counters, name) for name in ("update", "steps", "seconds")}

    def update(self) -> dict[str, float]:
        """One update of the algorithm; its row for the log."""
        start, counters = time.monotonic(), self.counters
        diverged = (
            f"training diverged in update {counters.update + 1}: the loss is not finite; lower algo.learning_rate "
            "and continue from the last checkpoint"
        )
        try:
            metrics = self.algorithm.update(self.progress)
        except (RuntimeError, ValueError) as error:  # of a distribution whose parameters are not finite
            if all(bool((weight.abs() < DIVERGED).all()) for weight in self.algorithm.policy.parameters()):
                raise
            raise FloatingPointError(diverged) from error
        if not all(math.isfinite(number) for name, number in metrics.items() if name.startswith("loss")):
            raise FloatingPointError(diverged)
        rate = (self.algorithm.rollout.steps - counters.steps) / (time.monotonic() - start)
        counters.update += 1
        counters.steps = self.algorithm.rollout.steps
        counters.seconds = time.monotonic() - self.clock_zero
        statistics = self.algorithm.rollout.statistics()
        return {**self.position(), "steps_per_second": rate, **statistics, **metrics}

    def evaluation_is_due(self) -> bool:
        """Whether the run has passed the next of its evenly spaced evaluations."""
        return self.config.evaluations > 0 and self.progress * self.config.evaluations >= self.counters.evaluations + 1

    def evaluate(self, evaluate: Callable[[Policy], Episodes], log: RunLog, line: ProgressLine) -> dict[str, float]:
        """Evaluate, tell it, and keep the policy if it is the best so far."""
        counters = self.counters
        summary = evaluate(self.algorithm.policy).summary()
        counters.evaluations = math.floor(self.progress * self.config.evaluations)
        counters.seconds = time.monotonic() - self.clock_zero
        if score(summary) > counters.best_score:
            counters.best_score = score(summary)
            told = {"config": self.settings, "steps": counters.steps, "evaluation": summary}
            save(self.folder / "best.pt", "policy", told | policy_content(self.algorithm.policy))
        log.add("evaluation", {**self.position(), **summary})
        line.note(f"evaluation at {counters.steps:,} steps: {describe_evaluation(summary)}")
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
