"""What softwarp tells of its own accord, on standard error: lines that are renewed while something takes long.

The logger ``softwarp`` says how much: at its usual level these notices are shown and Warp's own lines are not, ``INFO``
(or the environment variable ``SOFTWARP_VERBOSE=1``) brings Warp's lines back, ``ERROR`` is silence.

    logging.getLogger("softwarp").setLevel(logging.ERROR)
"""

from __future__ import annotations

import logging
import math
import os
import shutil
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

PLAIN_SECONDS = 10.0  # between two lines where a line cannot be renewed in place
WAIT_SECONDS = 2.0  # of work before its progress is told
RENEW_SECONDS = 0.2  # between two looks of a line that can

log = logging.getLogger("softwarp")
if os.environ.get("SOFTWARP_VERBOSE", "0") not in ("", "0"):
    log.setLevel(logging.INFO)


def are_shown() -> bool:
    """Whether notices are shown."""
    return log.isEnabledFor(logging.WARNING)


class Line:
    """A line that is renewed in place on a terminal, and written anew now and then elsewhere.

    Args:
        every: Seconds between two lines where it is no terminal.
    """

    latest: Line | None = None  # that was shown, of all

    def __init__(self, every: float = PLAIN_SECONDS) -> None:
        self.every = every
        self._told_at = -math.inf
        self._is_open = False

    def show(self, text: str) -> None:
        """Renew the line, unless that was done a moment ago."""
        now, is_terminal = time.monotonic(), _is_terminal()
        if now - self._told_at < (RENEW_SECONDS if is_terminal else self.every):
            return
        self._told_at, self._is_open = now, is_terminal
        Line.latest = self
        width = shutil.get_terminal_size().columns - 1  # a line that wraps cannot be renewed
        _write(f"\r\x1b[K{text[:width]}" if is_terminal else f"{text}\n")

    @property
    def is_told(self) -> bool:
        """Whether it was shown so lately that it will be soon again, if it has not ended."""
        return time.monotonic() - self._told_at < self.every + 1.0

    def clear(self) -> None:
        """Make room for what others write, until the line is shown again."""
        if self._is_open:
            _write("\r\x1b[K")
        self._is_open = False

    def end(self, text: str = "") -> None:
        """Leave a last line, or none."""
        self.clear()
        self._told_at = -math.inf
        if text:
            note(text)


def note(text: str) -> None:
    """Write a line that stays, in the place of one that is renewed."""
    _write(f"\r\x1b[K{text}\n" if _is_terminal() else f"{text}\n")


class Progress:
    """What is told of some long work, from when it has taken a while."""

    def __init__(self) -> None:
        self.is_told = False
        self._what, self._begun = "", 0.0
        self._line = Line()

    def show(self, what: str, state: str) -> None:
        """Tell how far the work ``what`` has come, if it has taken more than two seconds; another begins anew."""
        now = time.monotonic()
        if what != self._what:
            self._line.end()
            self._what, self._begun = what, now
        if now - self._begun > WAIT_SECONDS and are_shown():
            self._line.show(f"{what}: {state}, {now - self._begun:.0f} s")

    def end(self) -> None:
        """The work is done: its line goes."""
        self._line.end()
        self._what = ""


_progress = Progress()


def progress(what: str, state: str) -> None:
    """Tell how far some work has come; only commands tell it, and only if it takes more than two seconds.

    Args:
        what: The work; another word begins another line.
        state: Such as ``"3 of 64"``.
    """
    if _progress.is_told and are_shown():
        _progress.show(what, state)


def progress_ends() -> None:
    """The work is done: its line goes."""
    _progress.end()


@contextmanager
def working(what: str) -> Iterator[None]:
    """Meanwhile it is told that work goes on which cannot say how far it has come; as ``progress`` otherwise.

    Another line that is shown meanwhile, such as that of compiling, tells enough until it ends.

    Args:
        what: The work.
    """
    if not (_progress.is_told and are_shown()):
        yield
        return
    is_over, begun = threading.Event(), time.monotonic()

    def tell() -> None:
        line, wait = Line(), WAIT_SECONDS
        while not is_over.wait(wait):
            if Line.latest is None or Line.latest is line or not Line.latest.is_told:
                line.show(f"{what}: {time.monotonic() - begun:.0f} s")
            wait = RENEW_SECONDS
        line.end()

    teller = threading.Thread(target=tell, name="softwarp-working", daemon=True)
    teller.start()
    try:
        yield
    finally:
        is_over.set()
        teller.join()


@contextmanager
def telling(is_told: bool = True) -> Iterator[None]:
    """Meanwhile ``progress`` is told, or not, as where another line tells it already."""
    before, _progress.is_told = _progress.is_told, is_told
    try:
        yield
    finally:
        _progress.end()
        _progress.is_told = before


def _is_terminal() -> bool:
    try:
        return sys.stderr.isatty()
    except (AttributeError, ValueError):  # there is none, or it is closed
        return False


def _write(text: str) -> None:
    try:
        sys.stderr.write(text)
        sys.stderr.flush()
    except (AttributeError, ValueError, OSError):  # nobody can be told
        return
