"""Programs on a terminal of their own: what they write, and keys pressed meanwhile."""

import os
import pty
import re
import select
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
PATIENCE = 60.0  # s
RENEWED = "\r\x1b[K"  # begins a line that is renewed in place


class Terminal:
    """A Python program whose output goes to a pseudo-terminal; ``text`` is what it has written so far."""

    def __init__(self, *arguments: str, cwd: Path = ROOT, env: dict[str, str] | None = None) -> None:
        self._end, other = pty.openpty()
        environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "COLUMNS": "160"} | (env or {})
        streams: dict[str, Any] = dict.fromkeys(("stdin", "stdout", "stderr"), other)
        command = [sys.executable, *arguments]
        self.process = subprocess.Popen(command, **streams, env=environment, cwd=cwd, start_new_session=True)
        os.close(other)
        self.text = ""

    def read(self, wanted: str = "", patience: float = PATIENCE) -> str:
        """What it writes until a pattern has come or, without one, to its end."""
        end = time.monotonic() + patience
        while time.monotonic() < end and not (wanted and re.search(wanted, self.text)):
            if not select.select([self._end], [], [], 0.1)[0]:
                if self.process.poll() is not None:
                    break
                continue
            try:
                self.text += os.read(self._end, 65536).decode(errors="replace")
            except OSError:  # its other end is closed
                break
        assert not wanted or re.search(wanted, self.text), f"not within {patience:g} s: {wanted}\n{self.text}"
        return self.text

    def interrupt(self) -> float:
        """Press Ctrl-C; returns when."""
        self.process.send_signal(2)
        return time.monotonic()

    def wait(self) -> int:
        """Read on until it ends; its exit code."""
        self.read()
        return self.process.wait(PATIENCE)
