"""A policy on a robot: read, decide, write, at a fixed rate, with a safe command at the end whatever ends it.

    controller = Controller(policy, read, write, rate=50.0, safe=[0.0, 0.0, 0.0, 0.0])
    print(controller.run(seconds=30.0))

Tick i is due at ``start + i / rate``: one that comes late shifts none of those after it, and those whose whole period
has passed are left out, so the loop never drifts. Nothing of softwarp's simulation or of Torch is used here.
"""

from __future__ import annotations

import math
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from softwarp import checks

_KEPT = 100_000  # last ticks from which percentiles are taken
_WARM_UP = 3  # calls of the policy before the first tick: the first ones allocate


@dataclass(frozen=True)
class Timing:
    """How a stretch of control went; times in seconds."""

    ticks: int  # carried out
    period: float  # asked for
    seconds: float  # from the first tick's due time to the end of the last
    mean: float  # latency: from the beginning of ``read`` to the end of ``write``
    p50: float
    p99: float
    worst: float
    late: float  # 99th percentile of how long after its due time a tick began
    missed: int  # ticks that ended after the next one was due
    skipped: int  # ticks left out because those before them took too long
    interrupted: bool  # by a signal, or by KeyboardInterrupt

    def __str__(self) -> str:
        parts = [f"{self.ticks} ticks at {1.0 / self.period:g} Hz in {self.seconds:.2f} s"]
        latency = (("mean", self.mean), ("p50", self.p50), ("p99", self.p99), ("worst", self.worst))
        parts.append("latency " + ", ".join(f"{name} {1e3 * value:.3f} ms" for name, value in latency))
        parts.append(f"late (p99) {1e3 * self.late:.3f} ms")
        parts.append(f"{self.missed} deadlines missed, {self.skipped} ticks skipped")
        return "; ".join(parts) + ("; interrupted" if self.interrupted else "")


class Controller:
    """Runs a policy at a fixed rate.

    Args:
        policy: From an observation to an action: a ``LoadedPolicy``, an ``ExportedPolicy``, or any function. If it has
            a ``reset``, that is called at the beginning.
        read: Returns the observation; may wait for sensors.
        write: Takes the action.
        rate: Ticks per second.
        safe: Action that is written at the end: after the last tick, after Ctrl-C or SIGTERM, and after an error, which
            is then raised. It is written where nothing else was, too.
        clock: Seconds of a clock that never goes back.
        sleep: Waits for some seconds.

    Raises:
        ValueError: If the rate is not a positive number.
    """

    def __init__(
        self,
        policy: Callable[[Any], Any],
        read: Callable[[], Any],
        write: Callable[[Any], object],
        *,
        rate: float,
        safe: Any,
        clock: Callable[[], float] = time.perf_counter,
        sleep: Callable[[float], object] = time.sleep,
    ) -> None:
        self.policy, self.read, self.write, self.safe = policy, read, write, safe
        self.period = 1.0 / checks.number(rate, "Controller: rate [Hz]", above=0.0)
        self.clock, self.sleep = clock, sleep
        self._is_asked_to_stop = False

    def stop(self) -> None:
        """End ``run`` after the tick that is going on; from ``read``, ``write`` or another thread."""
        self._is_asked_to_stop = True

    def run(self, *, seconds: float = math.inf, ticks: int | None = None) -> Timing:
        """Control until the time or the ticks are over, ``stop`` is called, or a signal comes.

        The first SIGINT or SIGTERM lets the tick end; a second one breaks into it. Signals reach main threads only.

        Raises:
            FloatingPointError: If the policy's action is not finite; it is not written.
        """
        due = checks.number(seconds, "Controller: seconds", above=0.0, infinite=True)
        last = math.inf if ticks is None else checks.count(ticks, "Controller: ticks")
        last = min(last, math.ceil(due / self.period - 1e-9) if math.isfinite(due) else math.inf)
        self._is_asked_to_stop = False
        record = _Record(self.period)
        try:
            with self._hearing_signals(record):
                self._warm_up()
                self._loop(last, record)
        except KeyboardInterrupt:
            record.interrupted = True
        finally:
            self.write(self.safe)
        return record.timing()

    def _warm_up(self) -> None:
        observation, reset = self.read(), getattr(self.policy, "reset", None)
        for _ in range(_WARM_UP):
            self._decide(observation)
        if callable(reset):
            reset()

    def _decide(self, observation: Any) -> Any:
        action = self.policy(observation)
        if not np.isfinite(action).all():
            raise FloatingPointError(f"the policy's action is not finite: {checks.shown(action)}")
        return action

    def _loop(self, last: float, record: _Record) -> None:
        start, tick = self.clock(), 0
        while tick < last and not self._is_asked_to_stop:
            due = start + tick * self.period
            wait = due - self.clock()
            if wait > 0.0:
                self.sleep(wait)
                if self._is_asked_to_stop:
                    break
            begun = self.clock()
            self.write(self._decide(self.read()))
            ended = self.clock()
            following = max(tick + 1, math.floor((ended - start) / self.period + 1e-9))
            record.add(begun - due, ended - begun, ended - start, is_missed=ended > due + self.period)
            record.skipped += int(min(following, last)) - tick - 1
            tick = following

    @contextmanager
    def _hearing_signals(self, record: _Record) -> Iterator[None]:
        """Turn the first signal into a request, as long as this is the main thread."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return

        def hear(number: int, frame: Any) -> None:
            if self._is_asked_to_stop:
                raise KeyboardInterrupt
            self._is_asked_to_stop = record.interrupted = True

        before = {number: signal.signal(number, hear) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


class _Record:
    """Times of the ticks so far."""

    def __init__(self, period: float) -> None:
        self.period = period
        self.latencies: deque[float] = deque(maxlen=_KEPT)
        self.delays: deque[float] = deque(maxlen=_KEPT)
        self.ticks = self.missed = self.skipped = 0
        self.total = self.worst = self.seconds = 0.0
        self.interrupted = False

    def add(self, delay: float, latency: float, seconds: float, *, is_missed: bool) -> None:
        """One tick: how late it began, how long it took, when it ended."""
        self.ticks += 1
        self.missed += is_missed
        self.total += latency
        self.worst = max(self.worst, latency)
        self.seconds = seconds
        self.latencies.append(latency)
        self.delays.append(delay)

    def timing(self) -> Timing:
        """The summary."""
        latencies, delays = (list(values) or [0.0] for values in (self.latencies, self.delays))
        p50, p99 = (float(value) for value in np.percentile(latencies, (50.0, 99.0)))
        late = float(np.percentile(delays, 99.0))
        mean = self.total / max(1, self.ticks)
        return Timing(
            *(self.ticks, self.period, self.seconds, mean, p50, p99, self.worst, late),
            *(self.missed, self.skipped, self.interrupted),
        )
