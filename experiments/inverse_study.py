"""Inverse control of Diamond and Trunk: placement at reachable points, its time, and a circle followed for a minute.

    python -m experiments.inverse_study inverse.png --json inverse.json

Placement: goals that were seen in equilibrium, the first ones of the evaluation split; the distance at the end of an
episode of the task, through its actions, and after twice that time, the largest of the last second.
Time: of the processor, for one world and control period. Circle: the commands are renewed every period; the distance is
that to the moving target at the end of each period.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from softwarp.control import InversePolicy
from softwarp.envs import registry
from softwarp.io.atomic import atomic_path, prove_writable, write_text

SEED = 2_000_003
REACHED = 0.5e-3  # m
TURN = 10.0  # s, for one circle
CIRCLES = {
    "Diamond": ((0.0, 0.0, 0.138), 0.008, (0, 1)),
    "Trunk": ((0.0, -0.100, 0.120), 0.020, (0, 2)),
}  # centre [m], radius [m], axes of its plane
WORLDS = 32


@dataclass(frozen=True)
class Placement:
    """Distances at the ends of episodes, and the time that control takes.

    Attributes:
        goals: How many.
        reached: Part of them within half a millimetre at the end of an episode.
        settled: Part of them within it all through the last second of twice that time.
        median, worst: Of the distances of that second [m].
        control_ms, simulation_ms: Processor time of one period of one world.
        period_ms: What real time allows for both.
    """

    goals: int
    reached: float
    settled: float
    median: float
    worst: float
    control_ms: float
    simulation_ms: float
    period_ms: float


def placement(name: str, goals: int) -> Placement:
    """Bring the tip to the first goals of the evaluation split.

    Raises:
        ValueError: If it has fewer.
    """
    worlds = min(goals, WORLDS)
    env = registry.make(name, num_worlds=worlds, seed=SEED, goal_split="eval", goal_jitter=0.0)
    steps = env.max_episode_steps
    env.max_episode_steps = 2 * steps
    table, policy = env.goal_table(), InversePolicy(env)
    if not 0 < goals <= len(table):
        raise ValueError(
            f"inverse study: {name} has {len(table)} goals for evaluation, give 1 to {len(table)}, got {goals}"
        )
    ends, largest = [], []
    for first in range(0, goals, worlds):
        state = env.reset()
        env.goal.copy_(table[(first + torch.arange(worlds)) % goals])
        way = []
        for _ in range(env.max_episode_steps):
            state = env.step_mdp(env.step(policy(state)))
            way.append((env.tip() - env.goal).norm(dim=-1).double())
        ends.append(way[steps - 1])
        largest.append(torch.stack(way[-round(1.0 / env.control_dt) :]).amax(dim=0))
    end, last = torch.cat(ends)[:goals].numpy(), torch.cat(largest)[:goals].numpy()
    reached, settled = float((end < REACHED).mean()), float((last < REACHED).mean())
    return Placement(goals, reached, settled, float(np.median(last)), float(last.max()), *timing(name))


def timing(name: str, periods: int = 40) -> tuple[float, float, float]:
    """Median processor times [ms] of a solve and of the steps of a period, for one world, and the period."""
    env = registry.make(name, num_worlds=1, seed=SEED, goal_split="eval")
    env.reset()
    policy = InversePolicy(env)
    spent: dict[str, list[float]] = {"control": [], "simulation": []}
    for _ in range(periods):
        begin = time.process_time()
        policy.controller.solve(env.goal)
        middle = time.process_time()
        for _ in range(env.action_repeat):
            env.sim.step()
        spent["control"].append(middle - begin)
        spent["simulation"].append(time.process_time() - middle)
    control, simulation = (1e3 * float(np.median(values[5:])) for values in spent.values())
    return control, simulation, 1e3 * env.control_dt


def circle(name: str, seconds: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Times [s], and distances [m] to a target that moves on a circle, ramped up in the first two seconds."""
    env = registry.make(name, num_worlds=1, seed=SEED)
    env.reset()
    centre, radius, axes = CIRCLES[name]
    controller = InversePolicy(env).controller
    start, times, distances = controller.positions()[0, 0].clone(), [], []
    for k in range(round(seconds / env.control_dt)):
        now = (k + 1) * env.control_dt
        target = torch.tensor(centre)
        target[axes[0]] += radius * math.cos(2.0 * math.pi * now / TURN)
        target[axes[1]] += radius * math.sin(2.0 * math.pi * now / TURN)
        target = torch.lerp(start, target, min(1.0, now / 2.0))
        controller.solve(target[None])
        for _ in range(env.action_repeat):
            env.sim.step()
        times.append(now)
        distances.append(float((controller.positions()[0, 0] - target).norm()))
    return np.array(times), np.array(distances)


def draw(file: Path, curves: dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]) -> None:
    """Distances over time, one line per robot."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(7.0, 3.0), layout="constrained")
    for name, (times, distances) in curves.items():
        axes.semilogy(times, 1e3 * distances, label=name, linewidth=1.0)
    axes.set(xlabel="time [s]", ylabel="distance to the moving target [mm]", xlim=(0.0, None))
    axes.grid(alpha=0.3)
    axes.legend()
    with atomic_path(file) as scratch:
        figure.savefig(scratch, dpi=110)
    plt.close(figure)


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    """Run, print the tables, write the picture and the numbers; returns the numbers."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("picture", type=Path)
    parser.add_argument("--goals", type=int, default=100)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--tasks", nargs="+", default=list(CIRCLES), choices=list(CIRCLES))
    parser.add_argument("--json", type=Path)
    given = parser.parse_args(arguments)
    for path in (given.picture, given.json):
        if path:
            prove_writable(path)
    result: dict[str, Any] = {}
    curves = {}
    for name in given.tasks:
        placed = placement(name, given.goals)
        curves[name] = circle(name, given.seconds)
        steady = curves[name][1][curves[name][0] > 4.0]
        root = float(np.sqrt(np.mean(steady**2)))
        result[name] = {"placement": asdict(placed), "circle": {"rms": root, "largest": float(steady.max())}}
        share, settled = 100.0 * placed.reached, 100.0 * placed.settled
        median, worst = 1e3 * placed.median, 1e3 * placed.worst
        print(
            f"{name}: {share:.4g}% of {placed.goals} goals within {1e3 * REACHED:g} mm, {settled:.4g}% for good, "
            f"median {median:.4f} mm, "
            f"worst {worst:.2f} mm; {placed.control_ms:.1f} ms of control and {placed.simulation_ms:.1f} ms of "
            f"simulation per {placed.period_ms:.0f} ms; circle {1e3 * root:.2f} mm rms, "
            f"{1e3 * steady.max():.2f} mm at most",
            flush=True,
        )
    draw(given.picture, curves)
    if given.json:
        write_text(given.json, json.dumps(result, indent=2) + "\n")
    return result


if __name__ == "__main__":
    main()
