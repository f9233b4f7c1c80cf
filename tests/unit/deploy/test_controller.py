"""The fixed-rate loop on a clock of its own: due times, missed deadlines, the safe command, signals."""

import os
import signal
import threading

import numpy as np
import pytest

from softwarp.deploy import Controller


class Clock:
    """Time that passes while somebody sleeps or works."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now

    def pass_by(self, seconds: float) -> None:
        self.now += seconds


class Robot:
    """Remembers when it was written to."""

    def __init__(self, work=lambda tick: 0.002) -> None:
        self.clock, self.work, self.written, self.times, self.reads = Clock(), work, [], [], 0

    def read(self) -> np.ndarray:
        self.reads += 1
        return np.array([self.reads], dtype=np.float32)

    def decide(self, observation: np.ndarray) -> np.ndarray:
        return 2.0 * observation

    def write(self, action) -> None:
        if np.ndim(action):  # the safe command is a number here
            self.times.append(self.clock.now)
            self.clock.pass_by(self.work(len(self.times) - 1))
        self.written.append(action)

    def controller(self, rate=100.0, **changes) -> Controller:
        parts = {"policy": self.decide, "read": self.read, "write": self.write} | changes
        clock = {"clock": self.clock, "sleep": self.clock.pass_by}
        return Controller(**parts, rate=rate, safe=-1.0, **clock)


def test_ticks_come_at_their_times():
    """A period apart, however long each takes within it; latency is the work, and the safe command comes last."""
    robot = Robot(lambda tick: 0.001 * (1 + tick % 5))
    timing = robot.controller().run(seconds=0.2)
    np.testing.assert_allclose(np.array(robot.times) - 100.0, 0.01 * np.arange(20), atol=1e-9)
    assert (timing.ticks, timing.missed, timing.skipped, timing.interrupted) == (20, 0, 0, False)
    assert timing.mean == pytest.approx(0.003) and timing.p50 == pytest.approx(0.003)
    assert timing.worst == pytest.approx(0.005) and timing.seconds == pytest.approx(0.195)
    assert robot.written[-1] == -1.0 and len(robot.written) == 21
    assert str(timing).startswith("20 ticks at 100 Hz in 0.19 s; latency mean 3.000 ms, p50 3.000 ms")


def test_late_ticks_shift_nothing():
    """One of 13 ms delays the next alone; one of 35 ms leaves out those whose period has passed; no drift."""
    robot = Robot(lambda tick: {3: 0.013, 6: 0.035}.get(tick, 0.002))
    timing = robot.controller().run(ticks=15)
    due = np.array([0, 1, 2, 3, 4, 5, 6, 9, 10, 11, 12, 13, 14]) * 0.01
    late = np.zeros(13)
    late[[4, 7]] = 0.003, 0.005
    np.testing.assert_allclose(np.array(robot.times) - 100.0, due + late, atol=1e-9)
    assert (timing.ticks, timing.missed, timing.skipped) == (13, 2, 2)


def test_the_policy_is_warm_and_forgets_it():
    """It is called before the clock starts, and reset after that."""

    class Remembering:
        calls = 0

        def __call__(self, observation):
            self.calls += 1
            return observation * self.calls

        def reset(self):
            self.calls = 0

    robot = Robot()
    robot.controller(policy=Remembering()).run(ticks=2)
    assert [float(action[0]) for action in robot.written[:2]] == [2.0, 6.0] and robot.reads == 3


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_tick_and_is_followed_by_the_safe_command(number):
    """Ctrl-C in the middle of a tick: its action is still written, then the safe one, and handlers are put back."""
    before = signal.getsignal(number)
    robot = Robot()

    def read():
        if len(robot.times) == 4:
            os.kill(os.getpid(), number)
        return robot.read()

    timing = robot.controller(read=read).run()
    assert timing.interrupted and timing.ticks == 5
    assert robot.written[-1] == -1.0 and len(robot.written) == 6
    assert signal.getsignal(number) is before


def test_a_second_signal_breaks_into_a_tick_that_hangs():
    robot = Robot()

    def read():
        if len(robot.times) == 2:
            os.kill(os.getpid(), signal.SIGINT)
            os.kill(os.getpid(), signal.SIGINT)
            raise AssertionError("not reached")
        return robot.read()

    timing = robot.controller(read=read).run()
    assert timing.interrupted and timing.ticks == 2 and robot.written[-1] == -1.0


@pytest.mark.parametrize("error", [OSError("sensor lost"), FloatingPointError("not finite")])
def test_errors_leave_the_robot_safe(error):
    """Of a sensor, or an action that is not finite: the safe command is written and the error goes on."""
    robot = Robot()

    def decide(observation):
        if len(robot.times) < 3:
            return observation
        if isinstance(error, OSError):
            raise error
        return observation * np.nan

    with pytest.raises(type(error), match=str(error)):
        robot.controller(policy=decide).run(ticks=9)
    assert len(robot.times) == 3 and robot.written[-1] == -1.0


def test_it_runs_and_stops_in_other_threads():
    """Beside a main thread that goes on; on the real clock."""
    written = []
    controller = Controller(lambda x: x, lambda: np.zeros(2), written.append, rate=200.0, safe=None)
    told = []
    thread = threading.Thread(target=lambda: told.append(controller.run()))
    thread.start()
    while len(written) < 5:
        pass
    controller.stop()
    thread.join(5.0)
    assert told[0].ticks >= 5 and written[-1] is None and not told[0].interrupted


def test_bad_rates_are_refused():
    for rate in (0.0, -1.0, float("nan")):
        with pytest.raises(ValueError, match="Controller: rate"):
            Controller(abs, int, print, rate=rate, safe=0)
