"""What a training run tells: a progress line, CSV tables, TensorBoard curves, and curves of a logging service.

``progress.csv`` has a row per update, ``evaluation.csv`` a row per evaluation. Rows are appended whole; when a run is
resumed, rows after the checkpoint and a row cut short by a kill are dropped first, so no update is told twice.
"""

import csv
import io
import math
import os
import shutil
import socket
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from softwarp import checks
from softwarp.io.atomic import write_text, writing

KINDS = ("csv", "tensorboard", "wandb", "mlflow")
LINE_SECONDS = 15.0  # between progress lines where no bar can be drawn

PROGRESS_COLUMNS = (
    *("update", "steps", "seconds", "steps_per_second"),
    *("return", "length", "success", "distance"),  # of the last 100 training episodes; distance [m], median
)  # and the algorithm's own
EVALUATION_COLUMNS = (
    *("update", "steps", "seconds", "episodes", "return", "return_std", "length", "success", "failed", "lost"),
    *("distance", "distance_mean", "distance_p25", "distance_p75", "distance_p90"),
    *("force", "force_max"),  # N, largest on a vessel's wall in an episode: median and worst
)


@dataclass
class LoggerConfig:
    """What a run writes and shows."""

    csv: bool = True  # progress.csv and evaluation.csv
    tensorboard: bool = True  # the same for TensorBoard
    progress: bool = True  # a bar on a terminal, else a line now and then
    picture: bool = True  # learning curve at the end
    kind: str = "csv"  # what stands beside these tables: csv: nothing; tensorboard; wandb or mlflow: their services
    project: str = "softwarp"  # where a service files the run
    offline: bool = False  # what is for a service stays in the run folder

    def __post_init__(self) -> None:
        """Refuse a service that there is not."""
        checks.choice(self.kind, "logger.kind", KINDS)


class CsvTable:
    """A CSV file that rows are appended to."""

    def __init__(self, path: Path, columns: Sequence[str], *, resume_update: int | None = None) -> None:
        """Start the table, or continue it after ``resume_update``, dropping later and torn rows."""
        self.path, self.columns = path, tuple(columns)
        kept = [] if resume_update is None else [row for row in read_csv(path) if row["update"] <= resume_update]
        write_text(path, self._line(self.columns) + "".join(self._line(self._cells(row)) for row in kept))

    def append(self, row: Mapping[str, float]) -> None:
        """Add a row; a missing column stays empty.

        Raises:
            ValueError: If the row has a column that the table does not.
            WriteError: If it cannot be written; the table is then as it was.
        """
        unknown = sorted(set(row) - set(self.columns))
        if unknown:
            raise ValueError(f"table {self.path.name}: has no column {', '.join(unknown)}; add it to its columns")
        with writing(self.path):
            size = self.path.stat().st_size if self.path.exists() else 0
            try:
                with self.path.open("a", encoding="utf-8") as file:
                    file.write(self._line(self._cells(row)))
            except OSError:
                with suppress(OSError):
                    os.truncate(self.path, size)
                raise

    def _cells(self, row: Mapping[str, float]) -> list[str]:
        return [f"{row[name]:.9g}" if name in row else "" for name in self.columns]

    @staticmethod
    def _line(cells: Sequence[str]) -> str:
        buffer = io.StringIO()
        csv.writer(buffer, lineterminator="\n").writerow(cells)
        return buffer.getvalue()


def read_csv(path: Path, needed: Sequence[str] = ("update",)) -> list[dict[str, float]]:
    """Rows of a table written by ``CsvTable``; empty cells are left out, a row cut short ends the table.

    Args:
        path: The table; one that does not exist has no rows.
        needed: Columns that every row must have.

    Raises:
        ValueError: If it holds something else.
    """
    if not path.is_file():
        return []
    try:
        header, *lines = path.read_text(encoding="utf-8").split("\n")
        columns = header.strip().split(",")
        rows = []
        for line in lines[:-1]:  # what follows the last end of a line is none, or cut short
            cells = line.split(",")
            if len(cells) != len(columns):
                break
            rows.append({name: float(cell) for name, cell in zip(columns, cells, strict=True) if cell})
            absent = [name for name in needed if name not in rows[-1]]
            if absent:
                raise ValueError(f"row {len(rows)} has no {', '.join(absent)}")
    except (ValueError, OSError) as error:
        raise ValueError(f"table {path}: not a table of numbers ({error}); delete it or restore it") from error
    return rows


class EventFile:
    """Curves for TensorBoard, written as they come: its own writer would do so, and fail, in a thread of its own."""

    def __init__(self, folder: Path, purge_step: int | None) -> None:
        """Start a file; TensorBoard then hides what other files of the folder tell from ``purge_step`` on.

        Raises:
            WriteError: If it cannot be written, here as in the other methods.
        """
        from tensorboard.compat.proto.event_pb2 import Event, SessionLog
        from tensorboard.summary.writer.record_writer import RecordWriter

        self.path = folder / f"events.out.tfevents.{time.time():.6f}.{socket.gethostname()}.{os.getpid()}"
        with writing(self.path):
            folder.mkdir(parents=True, exist_ok=True)
            self._file = self.path.open("wb")
        self._record = RecordWriter(self._file)
        self._write(Event(file_version="brain.Event:2"))
        if purge_step is not None:
            self._write(Event(step=purge_step, session_log=SessionLog(status=SessionLog.START)))

    def add(self, curves: Mapping[str, float], step: int) -> None:
        """Add a point to each of the curves."""
        from tensorboard.compat.proto.event_pb2 import Event
        from tensorboard.compat.proto.summary_pb2 import Summary

        values = [Summary.Value(tag=tag, simple_value=number) for tag, number in curves.items()]
        self._write(Event(step=step, summary=Summary(value=values)))

    def close(self) -> None:
        """Close the file."""
        with writing(self.path):
            self._file.close()

    def _write(self, event: Any) -> None:
        event.wall_time = time.time()
        with writing(self.path):
            try:
                self._record.write(event.SerializeToString())
                self._record.flush()
            except OSError:
                with suppress(OSError):  # what is yet to be written cannot be
                    self._file.close()
                raise


class RunLog:
    """Writes the rows of a run wherever its configuration says."""

    def __init__(
        self,
        folder: Path,
        config: LoggerConfig,
        metrics: Sequence[str],
        *,
        resume_update: int | None = None,
        settings: Mapping[str, Any] | None = None,
    ) -> None:
        """Start the tables, or continue them after ``resume_update``.

        Args:
            folder: Run folder.
            config: What to write.
            metrics: The algorithm's columns.
            resume_update: Last update whose rows stay; None for a run that begins.
            settings: Resolved configuration of the run, for a service.

        Raises:
            ImportError: If the package of a service is not installed.
            WriteError: If they cannot be written, here as in the other methods.
        """
        self.tables = {}
        if config.csv:
            tables = {"progress": (*PROGRESS_COLUMNS, *metrics), "evaluation": EVALUATION_COLUMNS}
            for name, columns in tables.items():
                self.tables[name] = CsvTable(folder / f"{name}.csv", columns, resume_update=resume_update)
        self.writers: list[Any] = []  # each with the methods of EventFile
        if config.tensorboard or config.kind == "tensorboard":
            purge = None if resume_update is None else resume_update + 1
            self.writers.append(EventFile(folder / "tensorboard", purge))
        if config.kind in ("wandb", "mlflow"):
            from softwarp.training.services import ServiceLog  # it loads TorchRL's loggers

            resumed = resume_update is not None
            told: dict[str, Any] = {"project": config.project, "offline": config.offline, "settings": settings or {}}
            self.writers.append(ServiceLog(config.kind, folder, is_resumed=resumed, **told))

    def add(self, table: str, row: Mapping[str, float]) -> None:
        """Write a row to the table ``progress`` or ``evaluation``; the x axis of curves is the update."""
        if table in self.tables:
            self.tables[table].append(row)
        curves = {f"{table}/{key}": number for key, number in row.items() if key != "update"}
        for writer in self.writers:
            writer.add(curves, int(row["update"]))

    def close(self) -> None:
        """Flush and close."""
        for writer in self.writers:
            writer.close()


class ProgressLine:
    """A bar on a terminal; elsewhere a printed line every ``LINE_SECONDS``."""

    def __init__(self, *, enabled: bool = True) -> None:
        self.enabled = enabled
        self.is_terminal = enabled and sys.stderr.isatty()
        self.bar: Any = None
        self.last_line = -math.inf
        if self.is_terminal:
            from tqdm import tqdm

            size = shutil.get_terminal_size()  # also of a terminal that does not tell its own
            form = "{percentage:3.0f}%|{bar:16}| {desc}"
            self.bar = tqdm(total=1.0, bar_format=form, ncols=size.columns, nrows=size.lines)

    def show(self, part: float, text: str) -> None:
        """Show that ``part`` of the run, in [0, 1], is over, and its state in words."""
        part = min(part, 1.0)
        if self.bar is not None:
            self.bar.n = part
            self.bar.set_description_str(text)
        elif self.enabled and time.monotonic() - self.last_line >= LINE_SECONDS:
            self.last_line = time.monotonic()
            self.note(f"{100.0 * part:3.0f}%  {text}")

    def note(self, text: str) -> None:
        """Print a line above the bar."""
        if self.bar is not None:
            self.bar.write(text, file=sys.stderr)
        elif self.enabled:
            try:
                sys.stderr.write(text + "\n")
                sys.stderr.flush()
            except OSError:  # a full disk below a redirection: the tables tell the same
                self.enabled = False

    def close(self) -> None:
        """Leave the terminal in order."""
        if self.bar is not None:
            self.bar.close()


def describe(row: Mapping[str, float], remaining: float) -> str:
    """A progress row in one line: return, success rate, final distance, speed, time left [s]."""
    parts = [f"{row['steps']:,.0f} steps"]
    if "steps_per_second" in row:
        parts.append(
            f"{row['steps_per_second']:,.3g}/s" if row["steps_per_second"] < 10 else f"{row['steps_per_second']:,.0f}/s"
        )
    if "return" in row:
        parts.append(f"return {row['return']:.3g}")
    if "success" in row:
        parts.append(f"success {100.0 * row['success']:.0f}%")
    if "distance" in row:
        parts.append(f"distance {1e3 * row['distance']:.1f} mm")
    parts.append(f"{clock(remaining)} left")
    return "  ".join(parts)


def clock(seconds: float) -> str:
    """Seconds as h:mm:ss or m:ss."""
    if not math.isfinite(seconds):
        return "--:--"
    minutes, second = divmod(round(max(seconds, 0.0)), 60)
    hours, minute = divmod(minutes, 60)
    return f"{hours}:{minute:02d}:{second:02d}" if hours else f"{minute}:{second:02d}"
