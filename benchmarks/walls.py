"""Lines of CatheterBeam in the wall of their vessel, in every step of those that come nearest to it, and of a metre.

    softwarp bench walls
    softwarp bench walls --cases aorta --keep starts.pt
    softwarp bench walls --cases aorta --starts starts.pt --tries 6
    softwarp bench walls --cases metre --seeds 0 1 2 3 4 5 6 7 8

``aorta``: random actions that lean inwards, each seed with a vessel of its own, the reference's for seed 0. The ten
lines, of all seeds, that come nearest to the wall or lie deepest in it go back by two actions, take these and the one
in which they came there again, and then others, which are drawn anew in each of some tries: 15 actions of 10 steps.
``--keep`` writes where the ten begin, ``--starts`` takes them from there, so that versions can be compared.
``metre``: three instruments are pushed into a vessel of 12 mm, all turned all the time, until a metre is out, and drawn
back. Actions in the wall are those of all four worlds of a seed after which a line's middle is in it.

After every step the middle of the line, its nodes and halfway between them, is measured against the wall's own
distance, independent of contacts; told are steps with any of it in the wall, how deep, the largest sum of wall forces,
its percentiles over actions and the share of steps taken again.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from softwarp.envs import registry
from softwarp.envs.snapshot import EnvSnapshot
from softwarp.model.codes import Status
from softwarp.solvers.repeats import RepeatingEuler

from .overlap import VesselGauge
from .timing import machine, save

CASES = ("aorta", "metre")
WORLDS, ACTIONS = 32, 90  # that are searched for lines, of each seed
LINES, BACK, OTHERS = 10, 2, 12  # lines that are followed; actions before that they begin with; other ones behind
LEAN = 0.6  # by which insertions are greater than in the mean of all
METRE = (0.8, 0.1, 1.0, 0.3, 0.9, -0.2)  # of an action that pushes and turns all instruments
NARROW = {"vessel_radius": 0.006, "outlet_radius": 0.006, "grid": 0.0025, "max_episode_steps": 200}
PUSHES, PULLS = 50, 52  # actions of the metre


@dataclass
class Tally:
    """What was met.

    Attributes:
        steps: World-steps.
        inside: Of these, with a line's middle in the wall.
        actions_inside: Actions after which one was, of all worlds together.
        again: World-steps that were taken again.
        failed: Worlds that failed, action by action.
        seconds: Processor time of all steps.
        depth: The largest of a line's middle in the wall, negative where all were clear of it [m].
        forces: The largest sum of wall forces of each action of each world [N].
    """

    steps: int = 0
    inside: int = 0
    actions_inside: int = 0
    again: int = 0
    failed: int = 0
    seconds: float = 0.0
    depth: float = -np.inf
    forces: list[float] = field(default_factory=list)

    def add(self, other: Tally) -> None:
        """Join what another one has met."""
        for name, value in vars(other).items():
            mine = getattr(self, name)
            setattr(self, name, max(mine, value) if name == "depth" else mine + value)

    def record(self) -> dict[str, Any]:
        """Numbers by name."""
        share = np.percentile(self.forces, (50.0, 99.0, 100.0))
        return {
            "steps": self.steps,
            "inside": self.inside,
            "actions_inside": self.actions_inside,
            "depth_mm": 1e3 * self.depth,
            "force_p50": share[0],
            "force_p99": share[1],
            "force": share[2],
            "taken_again": self.again / max(self.steps, 1),
            "failed": self.failed,
            "cpu_ms_per_step": 1e3 * self.seconds / max(self.steps, 1),
        }


class Watch:
    """Looks at all worlds of an environment after every step.

    Attributes:
        deepest: Of a line's middle in the wall in the present action, negative where it is clear [m], (world,).
    """

    def __init__(self, env: Any) -> None:
        self.env, self.tally, self.gauge = env, Tally(), VesselGauge(env)
        self.deepest = torch.full((env.num_worlds,), -np.inf)
        self.step, env.sim.step = env.sim.step, self._step

    def act(self, action: Tensor) -> None:
        """Take an action in all worlds."""
        self.deepest.fill_(-np.inf)
        after = self.env.step(self.env.full_action_spec.zero().set("action", action))["next"]
        tally = self.tally
        tally.failed += int((after["world_status"] >= int(Status.NONFINITE)).sum())
        tally.actions_inside += bool((self.gauge.signed() > 0.0).any())
        tally.forces += after["wall_force"][:, 0].tolist()

    def _step(self, count: int = 1) -> None:
        tally = self.tally
        for _ in range(count):
            begin = time.process_time()
            self.step()
            tally.seconds += time.process_time() - begin
            depth = self.gauge.signed().cpu()
            self.deepest = torch.maximum(self.deepest, depth)
            tally.steps += len(depth)
            tally.inside += int((depth > 0.0).sum())
            tally.depth = max(tally.depth, float(depth.max()))
            for stepper in self.env.sim._steppers:
                tally.again += int(stepper.progress.numpy()[0]) if isinstance(stepper, RepeatingEuler) else 0


def make(worlds: int, seed: int, device: str, **options: Any) -> Any:
    """An environment whose episodes do not end in a goal, and whose steps are not recorded."""
    own = {"end_on_success": False, "capture": False, "max_episode_steps": 1000} | options
    return registry.make("CatheterBeam", num_worlds=worlds, seed=seed, device=device, **own)


def anatomy(seed: int) -> dict[str, Any]:
    """Options of the vessel of a seed."""
    return {} if seed == 0 else {"anatomy": "random", "anatomy_seed": seed}


def leaning(generator: torch.Generator, worlds: int) -> Tensor:
    """Random actions that push more than they draw, (world, 6)."""
    action = 2.0 * torch.rand((worlds, 6), generator=generator) - 1.0
    action[:, ::2] += LEAN
    return action.clamp(-1.0, 1.0)


def find(seeds: Sequence[int], worlds: int, actions: int, device: str) -> list[dict[str, Any]]:
    """The lines that come nearest to the wall: depth, seed, where they begin, and the actions that lead there."""
    found: list[dict[str, Any]] = []
    for seed in seeds:
        env = make(worlds, seed, device, **anatomy(seed))
        env.reset()
        watch, generator = Watch(env), torch.Generator().manual_seed(seed)
        before, taken = list[EnvSnapshot](), list[Tensor]()
        lines: dict[int, dict[str, Any]] = {}
        for number in range(actions):
            before, taken = [*before, env.snapshot()][-BACK - 1 :], [*taken, leaning(generator, worlds)][-BACK - 1 :]
            watch.act(taken[-1].to(device))
            if number < BACK:
                continue
            for world in range(worlds):
                depth = float(watch.deepest[world])
                if world not in lines or depth > lines[world]["depth"]:
                    start = before[0].of_worlds([world]).state_dict()
                    led = torch.stack([action[world] for action in taken])
                    lines[world] = {"depth": depth, "seed": seed, "start": start, "actions": led}
        show("search", {"seed": seed} | watch.tally.record())
        found += lines.values()
    return sorted(found, key=lambda line: -float(line["depth"]))[:LINES]


def follow(lines: list[dict[str, Any]], tries: int, device: str) -> dict[str, Any]:
    """Lines again, with other actions behind those that led to the wall."""
    tally = Tally()
    for seed in sorted({line["seed"] for line in lines}):
        mine = [line for line in lines if line["seed"] == seed]
        env = make(tries * len(mine), seed, device, **anatomy(seed))
        env.reset()
        for number, line in enumerate(mine):
            rows = range(number * tries, (number + 1) * tries)
            env.restore(EnvSnapshot.from_state_dict(line["start"]), rows)
        watch, generator = Watch(env), torch.Generator().manual_seed(1000 + seed)
        led = torch.stack([line["actions"] for line in mine]).repeat_interleave(tries, dim=0)
        for number in range(BACK + 1 + OTHERS):
            other = leaning(generator, env.num_worlds)
            watch.act((led[:, number] if number <= BACK else other).to(device))
        tally.add(watch.tally)
    return tally.record()


def metre(seed: int, device: str) -> dict[str, Any]:
    """A metre of instruments in 12 mm: pushed in, all turned, and drawn back; how far its tips came and went."""
    env = make(4, seed, device, **NARROW)
    env.reset()
    watch = Watch(env)
    push = torch.tensor(METRE, device=device).expand(4, 6)
    pull = push * torch.tensor((0.0, 1.0) * 3, device=device) - torch.tensor((1.0, 0.0) * 3, device=device)
    for _ in range(PUSHES):
        watch.act(push.clone())
    out, pushed = float(env.sim.tube_length.amax(dim=1).min()), watch.tally.record()
    for _ in range(PULLS):
        watch.act(pull.clone())
    left = float(env.sim.tube_length.max())
    own = {"seed": seed, "out_m": out, "left_m": left, "pull_force": max(watch.tally.forces[4 * PUSHES :])}
    return own | pushed | {"pull_inside": watch.tally.inside - pushed["inside"], "failed": watch.tally.failed}


def show(case: str, record: dict[str, Any]) -> None:
    """One record on one line."""
    told = ", ".join(f"{key} {value:.4g}" for key, value in record.items())
    print(f"{case:8s} {told}", flush=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print and record; exit code 1 where a line was in the wall or a world failed."""
    parser = argparse.ArgumentParser(
        prog="softwarp bench walls", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cases", nargs="+", default=list(CASES), choices=CASES)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--worlds", type=int, default=WORLDS, help="searched for lines, of each seed")
    parser.add_argument("--actions", type=int, default=ACTIONS, help="of the search")
    parser.add_argument("--tries", type=int, default=3, help="times that each line goes on with other actions")
    parser.add_argument("--starts", type=Path, metavar="FILE", help="take the lines from here instead of a search")
    parser.add_argument("--keep", type=Path, metavar="FILE", help="write them")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args(arguments)
    records: list[dict[str, Any]] = []
    if "aorta" in args.cases:
        if args.starts is not None:
            lines = torch.load(args.starts, weights_only=True)
        else:
            lines = find(args.seeds, args.worlds, args.actions, args.device)
        if args.keep is not None:
            torch.save(lines, args.keep)
        records.append({"case": "aorta"} | follow(lines, args.tries, args.device) | machine(args.device))
        show("aorta", {key: value for key, value in records[-1].items() if isinstance(value, (int, float))})
    for seed in args.seeds if "metre" in args.cases else ():
        record = metre(seed, args.device)
        show("metre", record)
        records.append({"case": "metre"} | record | machine(args.device))
    save(records, args.json)
    return int(any(record["inside"] or record["failed"] for record in records))
