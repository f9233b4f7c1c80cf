"""Commands of a robot's actuators over time in a file, the servo file, and a player that sends them to drivers.

    file = CommandFile.load("commands.csv")
    print(file.check())
    player = Player(file, {"motor_0": write_0, "motor_1": write_1, "motor_2": write_2}, rate=50.0)
    print(player.run())

The file is CSV: lines that begin with ``#`` tell limits, zero offsets and units, one line per actuator; then a line of
names, time [s] first, and one row per moment. Between two moments a command runs straight. Values in the file are those
of the simulation; what a driver gets is ``sign * (value - zero)``: ``zero`` is the simulation's value at which the
actuator's own reading is 0, found when the robot is calibrated. Nothing of softwarp's simulation or of Torch is used.
"""

from __future__ import annotations

import csv
import io
import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softwarp import checks
from softwarp.advice import nearest
from softwarp.deploy.controller import Controller, Timing
from softwarp.io.atomic import write_text

FloatArray = NDArray[np.float64]

HEAD = "# softwarp commands, version 1"
TIME = "time [s]"
FIELDS = ("unit", "low", "high", "rate", "zero", "sign")
MOST_ROWS = 1_000_000
_ROUNDING = 1.0e-6  # part of a limit by which rounding in the file may pass it


@dataclass(frozen=True)
class Channel:
    """One actuator.

    Attributes:
        name: What the scene calls it; no comma, semicolon, equals sign or bracket.
        unit: Of its values: ``rad``, ``m``, ``Pa``, ``N``, ...
        low, high: Limits of its values.
        rate: Fastest change of its value [unit/s].
        zero: Value at which the actuator itself reads 0.
        sign: 1, or -1 for one that is mounted the other way round.
    """

    name: str
    unit: str
    low: float = -math.inf
    high: float = math.inf
    rate: float = math.inf
    zero: float = 0.0
    sign: int = 1

    def __post_init__(self) -> None:
        """Refuse what a file cannot hold.

        Raises:
            ValueError: Naming the channel, the value and what it must be.
        """
        for what, text in (("name", self.name), ("unit", self.unit)):
            if not isinstance(text, str) or not text.strip() or set(text) & set(",;=[]#\n\r\"'"):
                need = "be text without commas, semicolons, equals signs, brackets, quotes or line breaks"
                raise ValueError(checks.refusal(f"command channel: {what}", need, text))
        label = f"command channel {self.name!r}"
        for what in ("low", "high"):
            checks.number(getattr(self, what), f"{label}: {what}", low=-math.inf, infinite=True)
        checks.number(self.rate, f"{label}: rate", above=0.0, infinite=True)
        checks.number(self.zero, f"{label}: zero")
        if not self.low < self.high:
            raise ValueError(f"{label}: low must be below high, got {self.low:g} and {self.high:g} {self.unit}")
        if self.sign not in (1, -1):
            raise ValueError(f"{label}: sign must be 1 or -1, got {self.sign!r}")

    def to_device(self, value: float) -> float:
        """What the driver of this actuator gets for a value of the simulation."""
        return self.sign * (value - self.zero)


@dataclass(frozen=True)
class Check:
    """What a file asks of its actuators, one entry per channel.

    Attributes:
        seconds: From the first row to the last.
        lowest, highest: Values.
        fastest: Largest changes per second.
        faults: Sentences on limits and rates that are passed; none in a file that can be played.
    """

    seconds: float
    lowest: FloatArray
    highest: FloatArray
    fastest: FloatArray
    faults: tuple[str, ...]

    @property
    def is_sound(self) -> bool:
        """Whether every limit is kept."""
        return not self.faults

    def __str__(self) -> str:
        return "; ".join(self.faults) if self.faults else f"{self.seconds:.2f} s, within all limits and rates"


@dataclass(frozen=True, eq=False)
class CommandFile:
    """Commands over time.

    Attributes:
        times: Moments [s], rising, shape (row,).
        values: Commands in the channels' units, shape (row, channel).
        channels: Actuators.
        note: One line on where the commands come from.

    Raises:
        ValueError: If shapes do not fit, times do not rise, or a value is not finite.
    """

    times: FloatArray
    values: FloatArray
    channels: tuple[Channel, ...]
    note: str = ""

    def __post_init__(self) -> None:
        """Check shapes, names, times and values."""
        times = np.asarray(self.times, dtype=np.float64)
        values = np.asarray(self.values, dtype=np.float64)
        names = [channel.name for channel in self.channels]
        if times.ndim != 1 or len(times) < 1 or values.shape != (len(times), len(names)) or not names:
            raise ValueError(
                f"commands: times must have shape (row,) and values (row, {len(names)}), at least one of each, got "
                f"{times.shape} and {values.shape}"
            )
        if len(set(names)) < len(names):
            raise ValueError(f"commands: every channel needs its own name, got {', '.join(names)}")
        if not (np.isfinite(times).all() and np.isfinite(values).all()):
            raise ValueError("commands: times and values must be finite")
        if (np.diff(times) <= 0.0).any():
            row = int(np.flatnonzero(np.diff(times) <= 0.0)[0]) + 1
            raise ValueError(f"commands: times must rise, got {times[row]:g} s after {times[row - 1]:g} s in row {row}")
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "values", values)
        object.__setattr__(self, "note", " ".join(self.note.split()))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the channels."""
        return tuple(channel.name for channel in self.channels)

    @property
    def seconds(self) -> float:
        """From the first row to the last."""
        return float(self.times[-1] - self.times[0])

    def at(self, seconds: ArrayLike) -> FloatArray:
        """Commands some time after the first row, straight between rows, the last one afterwards, (..., channel)."""
        when = self.times[0] + np.asarray(seconds, dtype=np.float64)
        return np.stack([np.interp(when, self.times, column) for column in self.values.T], axis=-1)

    def check(self) -> Check:
        """Compare all values and changes with limits and rates."""
        rates = np.abs(np.diff(self.values, axis=0)) / np.diff(self.times)[:, None]
        fastest = rates.max(axis=0) if len(rates) else np.zeros(len(self.channels))
        lowest, highest = self.values.min(axis=0), self.values.max(axis=0)
        faults: list[str] = []
        for channel, low, high, speed in zip(self.channels, lowest, highest, fastest, strict=True):
            if low < channel.low - _ROUNDING * abs(channel.low):
                faults.append(f"{channel.name}: {low:g} {channel.unit} is below its limit, {channel.low:g}")
            if high > channel.high + _ROUNDING * abs(channel.high):
                faults.append(f"{channel.name}: {high:g} {channel.unit} is above its limit, {channel.high:g}")
            if speed > channel.rate * (1.0 + 1.0e-3):
                faults.append(
                    f"{channel.name}: {speed:g} {channel.unit}/s is faster than it can be, {channel.rate:g}; play it "
                    f"at {channel.rate / speed:.3g} of the speed"
                )
        return Check(self.seconds, lowest, highest, fastest, tuple(faults))

    def calibrated(self, zeros: Mapping[str, float], signs: Mapping[str, int] | None = None) -> CommandFile:
        """The same commands for a robot whose actuators read 0 at these values, or turn the other way.

        Raises:
            ValueError: For a channel that there is not.
        """
        signs = {} if signs is None else signs
        for name in (*zeros, *signs):
            if name not in self.names:
                raise ValueError(f"commands: there is no channel {name!r}; {nearest(name, self.names)}")
        new = [
            replace(channel, zero=zeros.get(channel.name, channel.zero), sign=signs.get(channel.name, channel.sign))
            for channel in self.channels
        ]
        return replace(self, channels=tuple(new))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the file, whole or not at all."""
        lines = [HEAD]
        if self.note:
            lines.append(f"# note: {self.note}")
        for channel in self.channels:
            told = "; ".join(f"{field}={_told(getattr(channel, field))}" for field in FIELDS)
            lines.append(f"# actuator {channel.name}: {told}")
        lines.append(",".join([TIME, *(f"{channel.name} [{channel.unit}]" for channel in self.channels)]))
        for moment, row in zip(self.times, self.values, strict=True):
            lines.append(",".join([f"{moment:.6f}", *(f"{value:.7g}" for value in row)]))
        write_text(path, "\n".join(lines) + "\n")

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> CommandFile:
        """Read a file.

        Raises:
            FileNotFoundError: If there is no such file.
            ValueError: If it is damaged; the message names the line.
        """
        target = Path(path)
        if not target.is_file():
            raise FileNotFoundError(f"command file {target} does not exist; make one with softwarp transfer PLAN.json")
        try:
            text = target.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise ValueError(f"{target} is no command file ({type(error).__name__})") from error
        try:
            return cls._parsed(text.splitlines())
        except ValueError as error:
            raise ValueError(f"{target}: {error}") from error

    @classmethod
    def _parsed(cls, lines: Sequence[str]) -> CommandFile:
        if not lines or lines[0].strip() != HEAD:
            raise ValueError(f"line 1 must be {HEAD!r}; the file is none of commands, or of another version")
        channels, note, row = [], "", 1
        while row < len(lines) and lines[row].startswith("#"):
            key, _, value = lines[row][1:].strip().partition(":")
            if key == "note":
                note = value.strip()
            elif key.startswith("actuator "):
                channels.append(_channel(key.removeprefix("actuator "), value, row + 1))
            row += 1
        wanted = [TIME, *(f"{channel.name} [{channel.unit}]" for channel in channels)]
        if row >= len(lines) or [name.strip() for name in lines[row].split(",")] != wanted:
            raise ValueError(f"line {row + 1} must be {','.join(wanted)!r}, the names of time and actuators")
        if len(lines) - row - 1 > MOST_ROWS:
            raise ValueError(f"has {len(lines) - row - 1} rows, more than {MOST_ROWS}")
        table = []
        for number, cells in enumerate(csv.reader(io.StringIO("\n".join(lines[row + 1 :]))), start=row + 2):
            if len(cells) != len(wanted):
                raise ValueError(f"line {number} must hold {len(wanted)} numbers, got {len(cells)}")
            table.append([_number(cell, f"line {number}") for cell in cells])
        array = np.array(table, dtype=np.float64).reshape(-1, len(wanted))
        return cls(array[:, 0], array[:, 1:], tuple(channels), note)


class Player:
    """Sends the commands of a file to the drivers of the actuators, at a fixed rate.

    Args:
        file: Commands.
        drivers: For every channel by its name, what takes the value that the actuator itself knows.
        rate: Ticks per second.
        speed: How fast the file is played; 0.5 takes twice as long.
        start: Values of the simulation that the actuators have now; None takes the first row. From there they go to the
            first row at their rates before the file begins.
        safe: Values that are written at the end, whatever ends it; None takes the last ones that were written.
        clock: Seconds of a clock that never goes back.
        sleep: Waits for some seconds.

    Raises:
        ValueError: For a driver that is missing or belongs to no channel, a file that passes limits or, played at this
            speed, rates, or a start outside the limits.
    """

    def __init__(
        self,
        file: CommandFile,
        drivers: Mapping[str, Callable[[float], object]],
        *,
        rate: float = 50.0,
        speed: float = 1.0,
        start: ArrayLike | None = None,
        safe: ArrayLike | None = None,
        clock: Callable[[], float] = time.perf_counter,
        sleep: Callable[[float], object] = time.sleep,
    ) -> None:
        self.file, self.drivers = file, dict(drivers)
        self.rate = checks.number(rate, "Player: rate [Hz]", above=0.0)
        self.speed = checks.number(speed, "Player: speed", above=0.0)
        for name in self.drivers:
            if name not in file.names:
                raise ValueError(f"Player: driver {name!r} belongs to no channel; {nearest(name, file.names)}")
        missing = [name for name in file.names if name not in self.drivers]
        if missing:
            raise ValueError(f"Player: channel {missing[0]!r} has no driver; drivers must hold what takes its values")
        report = replace(file, times=file.times / self.speed).check()
        if not report.is_sound:
            raise ValueError(f"Player: {report}")
        self.start = self._within(file.values[0] if start is None else start, "start")
        self.safe = None if safe is None else self._within(safe, "safe")
        self._clock, self._sleep = clock, sleep
        self._rates = np.array([channel.rate for channel in file.channels])
        self.reset()

    @property
    def seconds(self) -> float:
        """Time that ``run`` takes, the way to the first row included."""
        way = np.abs(self.file.values[0] - self.start)
        return float((way / self._rates).max()) + self.file.seconds / self.speed

    def dry_run(self) -> FloatArray:
        """What ``run`` writes if no tick is late, in values of the simulation, (tick, channel); no driver is called."""
        self.reset()
        rows = [self(tick / self.rate) for tick in range(self._ticks)]
        self.reset()
        return np.array(rows)

    def run(self) -> Timing:
        """Play the file once.

        SIGINT and SIGTERM end it after a tick, as they do ``Controller.run``; then, and after an error of a driver,
        ``safe`` is written.
        """
        clock, sleep = self._clock, self._sleep
        controller = Controller(self, clock, self._write, rate=self.rate, safe=None, clock=clock, sleep=sleep)
        return controller.run(ticks=self._ticks)

    @property
    def _ticks(self) -> int:
        return math.ceil(self.seconds * self.rate - 1.0e-9) + 1

    def reset(self) -> None:
        """Begin again, from ``start``."""
        self._last = self.start.copy()
        self._now: float | None = None
        self._played = 0.0  # s of the file
        self._has_begun = False  # the file; before, actuators go to its first row

    def __call__(self, now: float) -> FloatArray:
        """Values [units of the simulation] at a time of the clock [s], no faster than the rates."""
        passed = 0.0 if self._now is None else max(now - self._now, 0.0)
        self._now = now
        if self._has_begun:
            self._played += passed * self.speed
        goal = self.file.at(self._played)
        limit = self._rates * passed
        self._last = self._last + np.clip(goal - self._last, -limit, limit)
        self._has_begun = self._has_begun or bool(np.abs(self._last - goal).max() <= 1.0e-12)
        return self._last.copy()

    def _write(self, values: Any) -> None:
        if values is None:  # the end
            values = self._last if self.safe is None else self.safe
        for channel, value in zip(self.file.channels, values, strict=True):
            self.drivers[channel.name](channel.to_device(float(value)))

    def _within(self, values: ArrayLike, what: str) -> FloatArray:
        array = checks.array(values, f"Player: {what}", (len(self.file.channels),))
        for channel, value in zip(self.file.channels, array, strict=True):
            if not channel.low - _ROUNDING <= value <= channel.high + _ROUNDING:
                limits = f"[{channel.low:g}, {channel.high:g}]"
                raise ValueError(
                    f"Player: {what} of {channel.name!r} must lie in {limits} {channel.unit}, got {value:g}"
                )
        return np.asarray(array, dtype=np.float64)


def _channel(name: str, told: str, line: int) -> Channel:
    """A channel of its line in the head of a file."""
    parts = dict(part.strip().partition("=")[::2] for part in told.split(";"))
    if set(parts) != set(FIELDS):
        raise ValueError(f"line {line} must tell {', '.join(FIELDS)} of {name!r}")
    low, high, rate, zero, sign = (_number(parts[field], f"line {line}") for field in FIELDS[1:])
    if sign not in (1.0, -1.0):
        raise ValueError(f"line {line}: sign must be 1 or -1, got {parts['sign']}")
    return Channel(name, parts["unit"], low, high, rate, zero, int(sign))


def _told(value: float | str) -> str:
    """A field of a channel: numbers with the digits that a float32 has."""
    return f"{value:.7g}" if isinstance(value, float) else str(value)


def _number(text: str, where: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"{where}: {text!r} is no number") from None
