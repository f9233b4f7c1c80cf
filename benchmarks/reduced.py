"""The quadruped node by node and in its modes: the same gait on both models, timed, and how far apart they end.

    softwarp bench reduced                                          # a cycle of the gait, one world, all cores
    softwarp bench reduced --worlds 1 64 --cores 1
    softwarp bench reduced --worlds 4096 --models reduced --device cuda:0
    softwarp bench reduced --worlds 256 --models full --mesh fine --repeat 15 --device cuda:0
    softwarp bench reduced --mesh fine --file fine.npz --actions 2  # of assets/multi_gait/reduce.py --mesh fine

MultiGaitFull and MultiGaitReduced carry out the hand-written gait (fill rear, centre, front, then empty them), 60 steps
of 10 ms each action, with contact. The first action compiles and is not timed, and is not of the gait: it empties what
is empty. Told are the median time of a step over the actions, the way along x after each action, and between models
how much faster the reduced one is and how far its robot is from the full one: mean distance of all nodes, per way of
their mean place, and the gap of the final distance.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import warp as wp

from softwarp.envs import registry
from softwarp.policies.baselines.multi_gait import GAIT

from .timing import array_bytes, limited_cores, machine, save, summary

MODELS = {"full": "MultiGaitFull", "reduced": "MultiGaitReduced"}
EMPTY = 3  # action that changes nothing at the start


@dataclass(frozen=True)
class Walk:
    """One model's gait.

    Attributes:
        times: Seconds of a step, in the mean of every action.
        busy: Seconds that processors worked on it, summed over cores.
        nodes: Of the first world after each action, the start first [m], (action + 1, node, 3).
        failed: Worlds that failed.
        bytes: Memory of all worlds.
    """

    times: list[float]
    busy: list[float]
    nodes: torch.Tensor
    failed: int
    bytes: int

    @property
    def way(self) -> torch.Tensor:
        """Mean place after each action, from the start [m], (action + 1, 3)."""
        place = self.nodes.mean(dim=1)
        return place - place[:1]


@torch.no_grad()
def walk(name: str, worlds: int, device: str, actions: int, options: dict[str, Any]) -> Walk:
    """Let one model carry out the gait in all worlds; options are those of its environment."""
    env = registry.make(
        MODELS[name], num_worlds=worlds, device=device, seed=1, max_episode_steps=actions + 2, **options
    )
    env.reset()
    times, busy, nodes, failed = [], [], [], torch.zeros(worlds, dtype=torch.bool, device=env.device)
    for choice in (EMPTY, *(GAIT[number % len(GAIT)] for number in range(actions))):
        action = torch.full((worlds,), choice, device=env.device)
        wp.synchronize_device(env.sim.device)
        begun, worked = time.perf_counter(), time.process_time()
        for substep in range(env.action_repeat):
            env.apply_action(action, substep)
            env.sim.step()
        wp.synchronize_device(env.sim.device)
        times.append((time.perf_counter() - begun) / env.action_repeat)
        busy.append((time.process_time() - worked) / env.action_repeat)
        nodes.append(env.sim.node_x[0].double().cpu())
        failed |= env.sim.status > 0
    return Walk(times[1:], busy[1:], torch.stack(nodes), int(failed.sum()), array_bytes(env.sim))


def middle(values: Sequence[float]) -> float:
    """The one in the middle, of two the larger."""
    return sorted(values)[len(values) // 2]


def apart(full: Walk, reduced: Walk) -> dict[str, float]:
    """How far the reduced robot is from the full one, after all actions."""
    ways = full.way
    length = float((ways[1:] - ways[:-1]).norm(dim=-1).sum())
    nodes = float((full.nodes - reduced.nodes)[1:].norm(dim=-1).mean())
    ends = [float(w.way[-1, 0]) for w in (full, reduced)]
    return {
        "faster": middle(full.times) / middle(reduced.times),
        "faster_busy": middle(full.busy) / middle(reduced.busy),
        "nodes_apart": nodes,
        "way": length,
        "nodes_apart_per_way": nodes / length,
        "gap": abs(ends[1] - ends[0]) / abs(ends[0]),
    }


def told_of(found: Walk, worlds: int) -> dict[str, Any]:
    """What a record holds of a gait."""
    return summary(found.times, worlds) | {
        "busy_ms_per_step": 1e3 * middle(found.busy),
        "way_mm": (1e3 * found.way[1:, 0]).tolist(),
        "failed": found.failed,
        "memory_mb_per_world": found.bytes / worlds / 1e6,
    }


def line_of(record: dict[str, Any]) -> str:
    """A record in words."""
    ways = ", ".join(f"{way:.2f}" for way in record["way_mm"])
    return (
        f"{record['ms_per_step']:.3f} ms a step ({record['busy_ms_per_step']:.3f} of the processor), "
        f"{record['world_steps_per_s']:.0f} world-steps/s, {record['memory_mb_per_world']:.2f} MB a world, "
        f"{record['failed']} failed; x after each action [mm]: {ways}"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Time every number of worlds on every model."""
    parser = argparse.ArgumentParser(
        prog="softwarp bench reduced", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--worlds", type=int, nargs="+", default=[1])
    parser.add_argument("--models", nargs="+", choices=list(MODELS), default=list(MODELS))
    parser.add_argument("--actions", type=int, default=len(GAIT), help="of the gait; default 6, a cycle")
    parser.add_argument("--repeat", type=int, default=60, help="sub-steps of an action; fewer for a time alone")
    parser.add_argument("--mesh", choices=["coarse", "fine"], default="coarse", help="fine modes need --file")
    parser.add_argument("--file", type=Path, help="modes of softwarp reduce, for those that come with softwarp")
    parser.add_argument("--device", default="cpu", help="Warp device")
    parser.add_argument("--cores", type=int, help="cores of a CPU to run on")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all numbers here")
    args = parser.parse_args(arguments)
    options: dict[str, Any] = {"mesh": args.mesh, "action_repeat": args.repeat, "ramp": min(15, args.repeat)}
    modes = {} if args.file is None else {"reduced": str(args.file)}
    records: list[dict[str, Any]] = []
    with limited_cores(args.cores) as cores:
        about = machine(args.device, cores)
        for worlds in args.worlds:
            walks = {
                name: walk(name, worlds, args.device, args.actions, options | (modes if name == "reduced" else {}))
                for name in args.models
            }
            for name, found in walks.items():
                records.append(about | {"case": f"quadruped, {name}, {args.mesh}"} | told_of(found, worlds))
                print(f"{name}, {worlds} worlds: {line_of(records[-1])}", flush=True)
            if len(walks) == len(MODELS):
                told = apart(walks["full"], walks["reduced"])
                away, part = 1e3 * told["nodes_apart"], 100.0 * told["nodes_apart_per_way"]
                records[-1] |= told
                print(
                    f"the reduced model is {told['faster']:.1f} times faster, {told['faster_busy']:.1f} in time of the "
                    f"processor; nodes are {away:.3f} mm apart, {part:.2f} % of a way of {1e3 * told['way']:.1f} mm; "
                    f"the final distance is {100.0 * told['gap']:.1f} % off",
                    flush=True,
                )
            save(records, args.json)
    return 1 if any(record["failed"] for record in records) else 0
