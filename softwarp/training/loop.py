"""The training loop: update, log, evaluate, checkpoint; stop on request and go on where it stopped.

Run folder
    config.yaml                 resolved configuration
    progress.csv evaluation.csv tensorboard/    logs
    checkpoints/step_*.pt       the last few, each enough to continue exactly
    best.pt                     policy with the best evaluation so far
    curve.png                   learning curve
"""

import math
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import torch
from tensordict import TensorDictBase

from softwarp.policies.actor_critic import ActorCritic
from softwarp.training.checkpoints import CheckpointError, CheckpointFolder, policy_content, save
from softwarp.training.evaluation import Episodes, score
from softwarp.training.logs import LoggerConfig, ProgressLine, RunLog, describe
from softwarp.training.ppo import PPO


@dataclass
class RunConfig:
    """How long to train, and how often to look and to save."""

    total_steps: int = 1_000_000  # environment steps, summed over worlds
    time_limit: float = math.inf  # s; the run ends at whichever comes first
    evaluations: int = 10  # evenly spaced, the last one at the end; 0: never
    evaluation_episodes: int = 64
    evaluation_seed: int = 1_000_003  # of the goals that training does not see
    checkpoint_seconds: float = 30.0  # s between checkpoints; each waits for the end of an update
    keep_checkpoints: int = 3

    def __post_init__(self) -> None:
        """Refuse values outside their range."""
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

    def progress(self, config: RunConfig) -> float:
        """Part of the run that is over; 1 or more at its end."""
        return max(self.steps / config.total_steps, self.seconds / config.time_limit)


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


@dataclass(frozen=True)
class Outcome:
    """How a session of a run ended."""

    counters: Counters
    evaluation: dict[str, float]  # the last one; empty if there was none
    signal: int | None  # that stopped the session; None if the run is complete


def train(
    algorithm: PPO,
    evaluate: Callable[[Callable[[TensorDictBase], TensorDictBase]], Episodes],
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
    """
    counters = Counters() if resume is None else _restore(algorithm, resume)
    log = RunLog(folder, logger, resume_update=None if resume is None else counters.update)
    line = ProgressLine(enabled=logger.progress)
    checkpoints = CheckpointFolder(folder / "checkpoints", config.keep_checkpoints)
    evaluation: dict[str, float] = {}
    seconds_before, start = counters.seconds, time.monotonic()
    saved_at, saved_update = start, -1

    def checkpoint() -> None:
        nonlocal saved_at, saved_update
        if saved_update != counters.update:
            checkpoints.save(counters.steps, _content(algorithm, counters, settings))
            saved_at, saved_update = time.monotonic(), counters.update

    with StopSignals() as stop:
        try:
            while True:
                if config.evaluations and counters.progress(config) * config.evaluations >= counters.evaluations + 1:
                    evaluation = evaluate(algorithm.policy).summary()
                    _note_evaluation(evaluation, algorithm.policy, counters, config, folder, settings)
                    counters.seconds = seconds_before + time.monotonic() - start
                    log.add("evaluation", {**_position(counters), **evaluation})
                    line.note(f"evaluation at {counters.steps:,} steps: {describe_evaluation(evaluation)}")
                if stop.received is not None or counters.progress(config) >= 1.0:
                    break
                row = _update(algorithm, counters, config)
                counters.seconds = seconds_before + time.monotonic() - start
                log.add("progress", row)
                part = counters.progress(config)
                line.show(part, describe(row, counters.seconds * (1.0 / part - 1.0)))
                if time.monotonic() - saved_at >= config.checkpoint_seconds:
                    checkpoint()
            checkpoint()
        finally:
            line.close()
            log.close()
    return Outcome(counters, evaluation, stop.received)


def _update(algorithm: PPO, counters: Counters, config: RunConfig) -> dict[str, float]:
    """One update; its row for the log.

    Raises:
        FloatingPointError: If the loss is no longer a finite number.
    """
    start = time.monotonic()
    metrics = algorithm.update(counters.progress(config))
    if not math.isfinite(metrics["loss_objective"] + metrics["loss_critic"]):
        raise FloatingPointError(
            f"training diverged in update {counters.update + 1}: the loss is not finite; lower algo.learning_rate and "
            "continue from the last checkpoint"
        )
    rate = (algorithm.rollout.steps - counters.steps) / (time.monotonic() - start)
    counters.update += 1
    counters.steps = algorithm.rollout.steps
    return {**_position(counters), "steps_per_second": rate, **algorithm.rollout.statistics(), **metrics}


def _position(counters: Counters) -> dict[str, float]:
    return {"update": counters.update, "steps": counters.steps, "seconds": counters.seconds}


def describe_evaluation(summary: dict[str, float]) -> str:
    """An evaluation in a few words."""
    text = f"return {summary['return']:.3g}, success {100.0 * summary['success']:.0f}%"
    if "distance" in summary:
        text += f", final distance {1e3 * summary['distance']:.1f} mm (median)"
    return text


def _note_evaluation(
    summary: dict[str, float],
    policy: ActorCritic,
    counters: Counters,
    config: RunConfig,
    folder: Path,
    settings: dict[str, Any],
) -> None:
    """Count an evaluation and keep the policy if it is the best so far."""
    counters.evaluations = math.floor(counters.progress(config) * config.evaluations)
    if score(summary) > counters.best_score:
        counters.best_score = score(summary)
        content = {"config": settings, "steps": counters.steps, "evaluation": summary, **policy_content(policy)}
        save(folder / "best.pt", "policy", content)


def _content(algorithm: PPO, counters: Counters, settings: dict[str, Any]) -> dict[str, Any]:
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


def _restore(algorithm: PPO, content: dict[str, Any]) -> Counters:
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
