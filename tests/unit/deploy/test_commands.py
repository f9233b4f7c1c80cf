"""Command files and their player, against a bus of servos that remember what they were sent."""

import math

import numpy as np
import pytest

from softwarp.deploy import Channel, CommandFile, Player

SERVOS = tuple(Channel(f"motor_{i}", "rad", -2.0, 0.0, rate=2.0, zero=-1.5, sign=-1 if i == 1 else 1) for i in range(3))


class Bus:
    """Three servos on one line: angles of their own, a reach, and a log; time passes while it sleeps or writes."""

    def __init__(self, writes=lambda tick: 0.0) -> None:
        self.now, self.log, self.writes = 50.0, [], writes
        self.angles = dict.fromkeys((servo.name for servo in SERVOS), math.nan)

    def driver(self, name):
        def write(angle: float) -> None:
            if abs(angle) > math.radians(90.0):
                raise OSError(f"{name}: {angle:g} rad is outside the servo's reach")
            self.angles[name] = angle
            if name == SERVOS[-1].name:
                self.log.append((self.now, *self.angles.values()))
                self.now += self.writes(len(self.log))

        return write

    def clock(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds

    def player(self, file, **options) -> Player:
        drivers = {servo.name: self.driver(servo.name) for servo in SERVOS}
        return Player(file, drivers, clock=self.clock, sleep=self.sleep, **options)


def swing(seconds=1.0, rows=21, depth=0.3) -> CommandFile:
    """Half a sine of all three servos from -1 rad, the second the deepest."""
    times = np.linspace(0.0, seconds, rows)
    values = -1.0 + depth * np.sin(math.pi * times / seconds)[:, None] * np.array([1.0, -2.0, 0.5])
    return CommandFile(times, values, SERVOS, "a swing")


def test_file_comes_back(tmp_path):
    """Times to a microsecond, values to seven digits, all of the head exactly, infinite limits too."""
    channels = (*SERVOS[:2], Channel("pull", "m"))
    file = CommandFile([0.0, 0.05, 0.1], [[-1.0, -1.25, 0.0], [-1.1, -1.2, 1e-3], [-math.pi / 3, -1.0, 0.0]], channels)
    file.save(tmp_path / "made.csv")
    read = CommandFile.load(tmp_path / "made.csv")
    assert read.channels == channels
    np.testing.assert_allclose(read.times, file.times, atol=1e-6)
    np.testing.assert_allclose(read.values, file.values, rtol=1e-6)
    table = np.loadtxt(tmp_path / "made.csv", delimiter=",", comments="#", skiprows=5)  # what any program sees
    np.testing.assert_allclose(table, np.column_stack([file.times, file.values]), rtol=1e-6)


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("version 1", "version 9", "line 1 must be '# softwarp commands, version 1'"),
        ("rate=2; ", "", "line 3 must tell unit, low, high, rate, zero, sign of 'motor_0'"),
        ("sign=-1", "sign=3", "line 4: sign must be 1 or -1"),
        ("motor_2 [rad]", "motor_2 [deg]", "line 6 must be 'time [s],motor_0 [rad],motor_1 [rad],motor_2 [rad]'"),
        ("0.050000,", "0.050000,x", "line 8: 'x-0.9530697' is no number"),
        ("0.050000,", "", "line 8 must hold 4 numbers, got 3"),
        ("0.050000,", "0.000000,", "times must rise, got 0 s after 0 s in row 1"),
        ("low=-2;", "low=1;", "low must be below high, got 1 and 0 rad"),
    ],
)
def test_damaged_files_are_refused(tmp_path, old, new, told):
    """The message names the file and the line."""
    path = tmp_path / "swing.csv"
    swing().save(path)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(ValueError, match=r"swing\.csv") as error:
        CommandFile.load(path)
    assert told in str(error.value)


def test_limits_and_rates_are_checked():
    """Half a sine of 0.6 rad in 1 s moves at 0.6 pi rad/s at most; twice as fast passes 2 rad/s."""
    report = swing().check()
    assert report.is_sound and str(report) == "1.00 s, within all limits and rates"
    assert report.fastest[1] == pytest.approx(0.6 * math.pi, rel=5e-3)
    assert report.lowest[1] == pytest.approx(-1.6, abs=1e-3)
    fast = swing(seconds=0.5).check()
    assert len(fast.faults) == 1 and "motor_1: 3.75" in fast.faults[0] and "0.533 of the speed" in fast.faults[0]
    deep = swing(seconds=4.0, depth=0.6).check()
    assert deep.faults == ("motor_1: -2.2 rad is below its limit, -2",)


def test_servos_get_their_own_angles_in_time():
    """sign (value - zero), 20 ms apart, straight between rows; the last one stays."""
    bus, file = Bus(), swing()
    timing = bus.player(file).run()
    log = np.array(bus.log)
    assert (timing.ticks, timing.missed) == (51, 0)
    np.testing.assert_allclose(log[:51, 0] - 50.0, 0.02 * np.arange(51), atol=1e-9)
    expected = (file.at(0.02 * np.arange(51)) + 1.5) * np.array([1.0, -1.0, 1.0])
    np.testing.assert_allclose(log[:51, 1:], expected, atol=1e-9)
    np.testing.assert_allclose(log[51, 1:], log[50, 1:])


def test_dry_run_is_what_is_sent_and_sends_nothing():
    """From a start elsewhere: to the first row at 2 rad/s at most, then the file; no driver is called before."""
    bus, file = Bus(), swing()
    player = bus.player(file, start=[-1.3, -1.0, -0.9], safe=[-1.5, -1.5, -1.5])
    rows = player.dry_run()
    assert bus.log == [] and player.seconds == pytest.approx(0.15 + 1.0)
    np.testing.assert_allclose(rows[[0, 1, -1]], [[-1.3, -1.0, -0.9], [-1.26, -1.0, -0.94], file.values[-1]], atol=0.05)
    assert np.abs(np.diff(rows, axis=0)).max() <= 2.0 / 50.0 + 1e-12
    player.run()
    log = np.array(bus.log)
    np.testing.assert_allclose(log[:-1, 1:], (rows + 1.5) * np.array([1.0, -1.0, 1.0]), atol=1e-9)
    np.testing.assert_allclose(log[-1, 1:], 0.0, atol=1e-12)


def test_late_ticks_do_not_stretch_time():
    """A bus that hangs for 0.1 s: the next angles are those of their time, reached at the servo's rate."""
    bus, file = Bus(lambda tick: 0.1 if tick == 10 else 0.0), swing()
    timing = bus.player(file).run()
    log = np.array(bus.log)[:-1]
    assert timing.skipped == 4
    expected = (file.at(log[:, 0] - 50.0) + 1.5) * np.array([1.0, -1.0, 1.0])
    np.testing.assert_allclose(log[:, 1:], expected, atol=1e-9)


def test_slower_playing():
    """At a quarter of the speed a file that is too fast can be played, and takes four times as long."""
    bus = Bus()
    with pytest.raises(ValueError, match=r"motor_1: 3\.75"):
        bus.player(swing(seconds=0.5))
    player = bus.player(swing(seconds=0.5), speed=0.25)
    assert player.seconds == pytest.approx(2.0)
    rows = player.dry_run()
    np.testing.assert_allclose(rows[50], swing(seconds=0.5).at(0.25), atol=1e-9)


def test_errors_of_a_driver_end_in_the_safe_pose():
    """A servo that cannot follow raises; all have been sent to the safe pose before that is told."""
    bus = Bus()
    file = swing().calibrated({"motor_1": -3.0})
    with pytest.raises(OSError, match=r"motor_1: -2 rad is outside the servo's reach"):
        bus.player(file, safe=[-1.5, -2.0, -1.5]).run()
    assert bus.log[-1][1:] == pytest.approx((0.0, -1.0, 0.0))


def test_mistakes_are_told():
    """Drivers, starts and channels that do not fit."""
    file, bus = swing(), Bus()
    drivers = {servo.name: bus.driver(servo.name) for servo in SERVOS}
    with pytest.raises(ValueError, match="driver 'motor_4' belongs to no channel; did you mean"):
        Player(file, drivers | {"motor_4": print})
    with pytest.raises(ValueError, match="channel 'motor_0' has no driver"):
        Player(file, {})
    with pytest.raises(ValueError, match=r"start of 'motor_2' must lie in \[-2, 0\] rad, got 0.5"):
        Player(file, drivers, start=[-1.0, -1.0, 0.5])
    with pytest.raises(ValueError, match="there is no channel 'motor'"):
        file.calibrated({"motor": 0.0})
    with pytest.raises(ValueError, match="every channel needs its own name"):
        CommandFile([0.0], [[0.0, 0.0]], (SERVOS[0], SERVOS[0]))
    with pytest.raises(FileNotFoundError, match="softwarp transfer"):
        CommandFile.load("no.csv")
    with pytest.raises(ValueError, match="command channel: unit must be text without commas"):
        Channel("motor", "rad;")
