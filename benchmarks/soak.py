"""Environments under random, extreme and adversarial actions for many world-steps: failures, numbers, memory, latency.

    softwarp bench soak --world-steps 100000
    softwarp bench soak --world-steps 5e6 --worlds 4096 --device cuda:0 --json soak.json
    softwarp bench soak --envs TrunkCup --styles random --world-steps 1e7 --worlds 4096 --device cuda --overlap-every 50

Random actions are uniform. Extreme ones take one end of their range each and hold it for half a second on average.
Adversarial ones are extreme too, and every second the eighth of the worlds in the worst state, by compressed elements
and by speed in turns, is copied over the least bad eighth: a search for states that break the simulation, by what
finds rare events (Kahn, Harris 1951, Estimation of particle transmission by random sampling: splitting). A world-step
is one simulated sub-step of one world. Every number that an environment gives out is looked at, and of those robots
that touch what they move (Gripper, TrunkCup, BubbleMotion) how deep parts lie in each other after every action, from
their exact geometry, of tubes in vessels how deep their centre line lies in the wall (``overlap.py``).
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp

from softwarp import notices
from softwarp.envs import registry
from softwarp.envs.base import SoftEnv
from softwarp.envs.snapshot import EnvSnapshot
from softwarp.io.atomic import atomic_path, write_text
from softwarp.model.codes import Status

from . import overlap
from .timing import machine

STYLES = ("random", "extreme", "adversarial")
HOLD = 0.1  # probability that an action of one end is drawn anew: held for ten actions, half a second, on average
MOST_KEPT = 64
COPIED = 8  # the share of worlds that are copied, and of those that make room, is 1 / COPIED
PERIOD = 20  # actions between copies
PERCENTILES = (50.0, 99.0, 99.9, 100.0)  # of the deepest overlap of a world after an action
LOOK = 10  # actions between two looks at the numbers on the host


@dataclass
class Tally:
    """What a run has met.

    Attributes:
        world_steps: Simulated sub-steps of all worlds.
        status: How many actions of one world ended with each code.
        compression: Largest 1 - J of an element.
        nonfinite: Numbers given out that were not finite.
        penetration: ``PERCENTILES`` of the deepest overlap after an action, in sizes of what is moved; empty where
            nothing is measured.
        size: Of what is moved [m].
        milliseconds: Median, 99th percentile and largest time of an action of all worlds.
        world_steps_per_s: Of the whole run, resets and searches included.
        memory: Bytes of the process [resident], and of the device, after a tenth of the run and at its end.
    """

    world_steps: int = 0
    status: dict[str, int] = field(default_factory=dict)
    compression: float = 0.0
    nonfinite: int = 0
    penetration: tuple[float, ...] = ()
    size: float = 0.0
    milliseconds: tuple[float, float, float] = (0.0, 0.0, 0.0)
    world_steps_per_s: float = 0.0
    memory: list[dict[str, int]] = field(default_factory=list)

    @property
    def failed_per_million(self) -> float:
        """Actions that ended in a failed world, per million world-steps."""
        failed = sum(count for name, count in self.status.items() if Status[name].failed)
        return 1e6 * failed / max(self.world_steps, 1)


class Soak:
    """One environment under one style of actions.

    Args:
        env: Fresh; its episodes end and begin anew as they do in training.
        style: Of ``STYLES``.
        seed: Of the actions.
        overlap_every: Actions from one look at the overlaps to the next; 0 for none. Their trees are built world by
            world, which on a GPU takes longer than the action.
        keep: File for what failed, ``MOST_KEPT`` at most: a list of ``{"status", "action", "snapshot"}`` of single
            worlds before the action that they failed in, ``EnvSnapshot.from_state_dict`` of the last.
    """

    def __init__(
        self, env: SoftEnv, style: str, seed: int, *, overlap_every: int = 1, keep: Path | None = None
    ) -> None:
        self.env, self.style, self.tally = env, style, Tally()
        self.generator = torch.Generator(device=env.device).manual_seed(seed)
        size = (env.num_worlds,) if env.action_count else (env.num_worlds, env.action_size)
        self.action = torch.zeros(size, dtype=torch.int64 if env.action_count else torch.float32, device=env.device)
        self.counts = torch.zeros(len(Status), dtype=torch.int64, device=env.device)
        self.nonfinite = torch.zeros((), dtype=torch.int64, device=env.device)
        self.compression = torch.zeros((), dtype=torch.float64, device=env.device)
        self.gauge = overlap.gauge(env) if overlap_every else None
        self.overlap_every = overlap_every
        self.keep, self.kept = keep, list[dict[str, Any]]()
        self.depths: list[torch.Tensor] = []  # m, (world,) after each action

    def run(self, world_steps: float, time_limit: float = math.inf) -> Tally:
        """At least so many world-steps, or as many as are done in ``time_limit`` [s]."""
        env, times = self.env, []
        per_action = env.num_worlds * env.action_repeat
        actions = max(int(-(-world_steps // per_action)), 1)
        done = 0
        env.reset()
        begin = time.perf_counter()
        for number in range(actions):
            self._choose()
            before = env.snapshot() if self.keep is not None and len(self.kept) < MOST_KEPT else None
            start = time.perf_counter()
            after, _ = env.step_and_reset(self.action.clone())
            if number % LOOK == 0:
                wp.synchronize_device(env.sim.device)
                times.append(1e3 * (time.perf_counter() - start))
            self._look(after, number)
            if before is not None:
                self._keep_failed(before, after["world_status"].flatten())
            if self.style == "adversarial" and number % PERIOD == PERIOD - 1:
                self._copy_worst(number // PERIOD)
            done, spent = number + 1, time.perf_counter() - begin
            notices.progress(type(env).__name__, f"{done * per_action:.3g} of {actions * per_action:.3g} world-steps")
            if number == actions // 10:
                self.tally.memory.append(memory(env))
            if spent > time_limit:
                break
        wp.synchronize_device(env.sim.device)
        seconds = time.perf_counter() - begin
        notices.progress_ends()
        self.tally.memory.append(memory(env))
        return self._finish(done * per_action, seconds, times[1:] or times)

    def _choose(self) -> None:
        env, generator = self.env, self.generator
        shape = (env.num_worlds, 1)
        if env.action_count:
            drawn = torch.randint(env.action_count, (env.num_worlds,), generator=generator, device=env.device)
        else:
            drawn = 2.0 * torch.rand(self.action.shape, generator=generator, device=env.device) - 1.0
        if self.style == "random":
            self.action = drawn
            return
        drawn = drawn if env.action_count else drawn.sign()
        change = torch.rand(shape, generator=generator, device=env.device) < HOLD
        self.action = torch.where(change.squeeze(1) if env.action_count else change, drawn, self.action)

    def _look(self, after: Any, number: int) -> None:
        """Counts on the device; nothing waits for it."""
        sim = self.env.sim
        status = after["world_status"].flatten().long()
        self.counts += torch.bincount(status - min(Status), minlength=len(Status))
        told = [value for value in after.values() if value.is_floating_point()]
        for value in (*told, sim.node_x, sim.node_v, sim.frame_pose, sim.frame_twist):
            self.nonfinite += (~torch.isfinite(value)).sum()
        torch.maximum(self.compression, sim.compression.max().double(), out=self.compression)
        if self.gauge is not None and number % self.overlap_every == 0:
            self.depths.append(self.gauge())

    def _keep_failed(self, before: EnvSnapshot, status: torch.Tensor) -> None:
        """Write the states before the action that worlds failed in, if any did."""
        failed = (status >= int(Status.NONFINITE)).nonzero().flatten().tolist()
        for world in failed[: MOST_KEPT - len(self.kept)]:
            snapshot = before.of_worlds([world]).state_dict()
            self.kept.append({"status": int(status[world]), "action": self.action[world].cpu(), "snapshot": snapshot})
        if failed and self.keep is not None:
            with atomic_path(self.keep) as path:
                torch.save(self.kept, path)

    def _copy_worst(self, turn: int) -> None:
        sim, count = self.env.sim, self.env.num_worlds // COPIED
        if count == 0:
            return
        parts = [part.square().sum(dim=2).amax(dim=1) for part in (sim.node_v, sim.frame_twist) if part.numel()]
        speed = torch.stack(parts).amax(dim=0)
        badness = sim.compression if turn % 2 == 0 and bool(sim.compression.any()) else speed
        order = badness.argsort()
        worst, least = order[-count:].tolist(), order[:count].tolist()
        self.env.restore(self.env.snapshot(worst), least, keep_streams=True)
        self.action[least] = self.action[worst]

    def _finish(self, world_steps: int, seconds: float, times: list[float]) -> Tally:
        tally = self.tally
        tally.world_steps, tally.world_steps_per_s = world_steps, world_steps / seconds
        counts = self.counts.tolist()
        tally.status = {Status(code + min(Status)).name: n for code, n in enumerate(counts) if n}
        tally.nonfinite, tally.compression = int(self.nonfinite), float(self.compression)
        if self.gauge is not None:
            tally.size = self.gauge.size
            shares = torch.cat(self.depths).cpu().numpy() / tally.size
            tally.penetration = tuple(float(share) for share in np.percentile(shares, PERCENTILES))
        middle, high = np.percentile(times, (50.0, 99.0))
        tally.milliseconds = (float(middle), float(high), max(times))
        return tally


def memory(env: SoftEnv) -> dict[str, int]:
    """Bytes: most that the process has been, and what of a GPU is in use."""
    found = {"resident": 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss}
    if env.device.type == "cuda":
        free, total = torch.cuda.mem_get_info(env.device)
        found["device"] = total - free
    return found


def show(name: str, style: str, tally: Tally) -> None:
    """Print a run as one line."""
    samples = max(sum(tally.status.values()), 1)
    growth = [max(later.values()) - max(first.values()) for first, later in [(tally.memory[0], tally.memory[-1])]]
    codes = ", ".join(f"{code} {count}" for code, count in tally.status.items() if code != "OK") or "all OK"
    told = (f"p{at:g} {100.0 * share:.3g} %" for at, share in zip(PERCENTILES, tally.penetration, strict=False))
    depth = f"; penetration {', '.join(told)} of {1e3 * tally.size:.3g} mm" if tally.penetration else ""
    print(
        f"{name:16s}{style:12s}{tally.world_steps:12.3g} world-steps {tally.world_steps_per_s:10.0f}/s  {codes}; "
        f"failed {tally.failed_per_million:.3g} per million, not finite {tally.nonfinite}, inverted "
        f"{100.0 * tally.status.get('INVERTED', 0) / samples:.3g} %, most compressed {tally.compression:.3f}; action "
        f"{tally.milliseconds[0]:.1f} ms, p99 {tally.milliseconds[1]:.1f}; memory +{growth[0] / 2**20:.1f} MiB{depth}",
        flush=True,
    )


def main(arguments: Sequence[str]) -> int:
    """Soak, print and record; exit code 1 where a number was not finite."""
    parser = argparse.ArgumentParser(
        prog="softwarp bench soak", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--envs", nargs="+", default=registry.names(), choices=registry.names())
    parser.add_argument("--styles", nargs="+", default=list(STYLES), choices=STYLES)
    parser.add_argument("--worlds", type=int, default=64)
    parser.add_argument("--world-steps", type=float, default=20_000, help="of each environment and style")
    parser.add_argument("--time-limit", type=float, default=math.inf, help="seconds of each environment and style")
    parser.add_argument("--overlap-every", type=int, default=1, help="actions between looks at overlaps; 0 for none")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--precision", default=None, choices=["float32", "float64"], help="instead of each one's own")
    parser.add_argument("--keep", type=Path, metavar="FILE", help="write the states that failed, of each run anew")
    parser.add_argument("--json", type=Path, default=None)
    args = parser.parse_args(arguments)
    records: list[dict[str, Any]] = []
    for name in args.envs:
        for style in args.styles:
            own = {} if args.precision is None else {"precision": args.precision}
            env = registry.make(name, num_worlds=args.worlds, device=args.device, seed=args.seed, **own)
            soak = Soak(env, style, args.seed, overlap_every=args.overlap_every, keep=args.keep)
            tally = soak.run(args.world_steps, args.time_limit)
            show(name, style, tally)
            records.append({"env": name, "style": style, "worlds": args.worlds} | asdict(tally) | machine(args.device))
            if args.json:
                write_text(args.json, json.dumps(records, indent=1))
    return int(any(record["nonfinite"] for record in records))
