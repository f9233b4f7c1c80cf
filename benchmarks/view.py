"""Pictures per second of ``softwarp view`` while it steps in real time, with a browser that looks or without one.

    softwarp bench view                          # Trunk, half a minute, seen by a Chromium without a window
    softwarp bench view --env Gripper --worlds 4 --color stress
    softwarp bench view --no-browser             # what the simulation and its pictures cost alone

The browser (``pip install playwright``, ``apt install chromium``) draws in software, on the cores that simulate.
For every interval: pictures sent and frames that the browser drew, simulated time over that of the clock, and the
processor time of the simulation with its pictures, of the browser, and of everything else on this machine, all in
cores. Where that last one is not small, the machine was busy with something else.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import threading
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import softwarp
from softwarp import cli
from softwarp.io.atomic import write_text
from softwarp.policies.baselines.table import RULES, rule
from softwarp.view import Viewer

from .timing import machine

INTERVAL = 3.0  # s
WARM_UP = 6.0  # s
_BUSY = 0.2  # cores of other programs, from which on an interval is left out of the medians
_TICK = 1.0 / os.sysconf("SC_CLK_TCK")


@dataclass
class Interval:
    """What happened in some seconds.

    Attributes:
        pictures: Sent per second.
        frames: Drawn by the browser per second.
        speed: Simulated time over that of the clock.
        own: Processor time of the simulation and its pictures [cores].
        browser: Processor time of the browser [cores].
        others: Processor time of everything else [cores].
    """

    pictures: float
    frames: float
    speed: float
    own: float
    browser: float
    others: float


class Watched:
    """A browser that looks at an address, in a thread of its own."""

    def __init__(self, url: str, size: tuple[int, int]) -> None:
        self.frames = 0
        self.errors: list[str] = []
        self.trouble: Exception | None = None
        self._ends = threading.Event()
        self.has_begun = threading.Event()
        self._thread = threading.Thread(target=self._look, args=(url, size), daemon=True)
        self._thread.start()

    def _look(self, url: str, size: tuple[int, int]) -> None:
        browsing: Any = cli.experiment("browser")
        try:
            with browsing.chromium() as browser:
                page = browsing.opened(browser, url, *size, self.errors)
                self.has_begun.set()
                while not self._ends.is_set():
                    self.frames = page.evaluate("window.drawn")
                    page.wait_for_timeout(100)
        except Exception as error:  # noqa: BLE001 - raised by whoever waits for it
            self.trouble = error
        finally:
            self.has_begun.set()

    def close(self) -> None:
        """End it."""
        self._ends.set()
        self._thread.join(30.0)


def processor_seconds() -> tuple[float, float, float]:
    """Processor time so far of this process, of its children that live, and of the whole machine [s]."""
    parents, used = {}, {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                words = (entry / "stat").read_text().rpartition(")")[2].split()
            except OSError:  # it has ended
                continue
            parents[int(entry.name)], used[int(entry.name)] = int(words[1]), int(words[11]) + int(words[12])
    own = os.getpid()
    children = 0
    for process in used:
        above = parents[process]
        while above in parents and above != own:
            above = parents[above]
        children += used[process] if above == own else 0
    fields = [int(word) for word in Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:9]]
    busy = sum(fields) - fields[3] - fields[4]  # but idle and waiting
    return used[own] * _TICK, children * _TICK, busy * _TICK


def measure(viewer: Viewer, watched: Watched | None, seconds: float) -> list[Interval]:
    """Run a viewer; an entry for each interval."""
    found = []
    for _ in range(max(1, round(seconds / INTERVAL))):
        before = _now(viewer, watched)
        viewer.run(INTERVAL)
        clock, pictures, frames, simulated, own, browser, busy = (
            b - a for a, b in zip(before, _now(viewer, watched), strict=True)
        )
        rates = (pictures, frames, simulated, own, browser, max(busy - own - browser, 0.0))
        found.append(Interval(*(value / clock for value in rates)))
        print("| " + " | ".join(f"{value:.2f}" for value in asdict(found[-1]).values()) + " |", flush=True)
    return found


def _now(viewer: Viewer, watched: Watched | None) -> tuple[float, ...]:
    frames = watched.frames if watched else 0
    return time.monotonic(), viewer.pictures, frames, viewer.simulated, *processor_seconds()


def main(arguments: Sequence[str]) -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        prog="softwarp bench view", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--env", default="Trunk", help="whose hand-written policy acts, or nobody")
    parser.add_argument("--worlds", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--fps", type=float, default=60.0, help="pictures per second, at most")
    parser.add_argument("--size", type=int, nargs=2, default=(640, 480), metavar="PIXELS", help="of the page")
    parser.add_argument("--color", default="plain", choices=("plain", "stress", "strain", "contact"))
    parser.add_argument("--no-browser", action="store_true", help="nobody looks")
    parser.add_argument("--json", type=Path, default=None)
    args = parser.parse_args(arguments)
    about = machine("cpu")
    env = softwarp.make(args.env, num_worlds=args.worlds, seed=0)
    policies = {"scripted": rule(env, args.env)} if args.env in RULES else {}
    with Viewer(env, policies, fps=args.fps, port=8400) as viewer:
        viewer.panel._color.value = args.color
        watched = None if args.no_browser else Watched(viewer.url, tuple(args.size))
        try:
            while watched is not None and not watched.has_begun.is_set():
                viewer.run(0.2)
            if watched is not None and watched.trouble is not None:
                raise watched.trouble
            viewer.run(WARM_UP)
            print("| pictures/s | drawn/s | x real time | cores | browser's | others' |\n|---|---|---|---|---|---|")
            found = measure(viewer, watched, args.seconds)
        finally:
            if watched is not None:
                watched.close()
    quiet = [one for one in found if one.others < _BUSY] or found
    columns = zip(*(asdict(one).values() for one in quiet), strict=True)
    middle = Interval(*(statistics.median(column) for column in columns))
    print(
        f"{args.env}, {args.worlds} world(s), median of {len(quiet)} of {len(found)} intervals: "
        f"{middle.pictures:.1f} pictures/s, {middle.frames:.1f} drawn, {middle.speed:.2f} x real time; "
        f"{1e3 * middle.own / middle.pictures:.1f} ms of processor per picture with its steps, "
        f"{middle.browser:.2f} cores for the browser"
    )
    if watched is not None and watched.errors:
        print("\n".join(["the page told errors:", *watched.errors]))
        return 1
    if args.json:
        told = about | {"env": args.env, "worlds": args.worlds, "intervals": [asdict(one) for one in found]}
        write_text(args.json, json.dumps(told, indent=1))
    return 0
