"""CartStemContact: inverse control stops at the obstacle, a planner finds the way round, from the same starts.

    python -m experiments.obstacle_study FOLDER [--starts 100] [--planned 100]

Inverse control is the quadratic program of ``softwarp.control`` with contacts as complementary unknowns, asked before
every action for the place of the cart that brings the tip nearest to its goal, as in ``softwarp eval
env=cart_stem_contact policy=inverse``. The planner is CEM. Both have the episode's 30 actions of 0.3 s; success is the
environment's own flag. ``obstacle.json``, ``obstacle.md`` and ``obstacle.png`` are written; the picture shows the named
benchmark case.
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict

from softwarp.control import InversePolicy, Outcome
from softwarp.envs import registry
from softwarp.io.atomic import atomic_path, prove_writable, write_text
from softwarp.planning.cem import CEM, CEMConfig
from softwarp.planning.env_model import EnvModel
from softwarp.planning.execution import execute

NAME = "CartStemContact"
SEED = 2_000_003


@dataclass(frozen=True, kw_only=True)
class Run:
    """A method's episode.

    Attributes:
        method: "QP" or "CEM".
        start: Number of the start.
        behind: Whether the upright stem cannot reach the goal.
        success: The environment's own flag at the end.
        distance: Of the tip from the goal at the end [m].
        outcome: What inverse control says at the end; "" of a planner.
        actions: Taken.
        way: Cart and tip after every action [m].
    """

    method: str
    start: int
    behind: bool
    success: bool
    distance: float
    outcome: str
    actions: int
    way: list[tuple[float, float]]


def places(env: Any) -> tuple[float, float]:
    """Cart and tip of the one world along x [m]."""
    scene = env.scene
    return float(env.sim.body_pose[0, scene.cart, 0]), float(env.sim.rod_x[0, -1, 0])


def follow_inverse(env: Any, policy: InversePolicy, start: int) -> Run:
    """An episode of inverse control from the present state."""
    behind, way, done = bool(env.is_behind()), [places(env)], False
    while not done:
        data = policy(TensorDict({}, batch_size=env.batch_size))
        done = bool(env.step(data)["next"]["done"])
        way.append(places(env))
    assert policy.solution is not None
    return result(env, "QP", start, behind, Outcome(int(policy.solution.outcome)).name, way)


def follow_planner(env: Any, model: EnvModel, planner: CEM, start: int) -> Run:
    """An episode of the planner from the present state."""
    behind, way = bool(env.is_behind()), [places(env)]
    begin = env.snapshot(0)
    done = execute(env, model, planner)
    env.restore(begin)
    for action in done.actions:  # again, to see the way
        env.step(TensorDict({"action": torch.tensor([action])}, batch_size=env.batch_size))
        way.append(places(env))
    return result(env, "CEM", start, behind, "", way)


def result(env: Any, method: str, start: int, behind: bool, outcome: str, way: list[tuple[float, float]]) -> Run:
    """How the episode of the one world ended."""
    return Run(
        method=method,
        start=start,
        behind=behind,
        success=bool(env.world_state["success"]),
        distance=float(env.distance),
        outcome=outcome,
        actions=len(way) - 1,
        way=way,
    )


def compare(starts: int, planned: int, **options: Any) -> list[Run]:
    """Inverse control from all starts, the planner from the first ``planned`` of them."""
    env = registry.make(NAME, seed=SEED, solver_path="lanes", **options)
    policy, planner = InversePolicy(env), CEM(CEMConfig(until_success=True))
    model = EnvModel(env, worlds=planner.config.population)
    runs = []
    for start in range(starts):
        env.reset()
        begin = env.snapshot(0)
        runs.append(follow_inverse(env, policy, start))
        if start < planned:
            env.restore(begin)
            runs.append(follow_planner(env, model, planner, start))
    return runs


def table(runs: list[Run]) -> str:
    """Goals met, and where those that were not are left, as Markdown."""
    lines = ["| method | goals in the open | goals behind an obstacle | left at [mm], median | told unreachable |"]
    lines.append("|---|---|---|---|---|")
    for method in dict.fromkeys(run.method for run in runs):
        own = [run for run in runs if run.method == method]
        cells = [method]
        for behind in (False, True):
            some = [run.success for run in own if run.behind == behind]
            cells.append(f"{sum(some)} of {len(some)}")
        missed = [run for run in own if not run.success]
        cells.append(f"{1e3 * np.median([run.distance for run in missed]):.1f}" if missed else "")
        told = sum(run.outcome == Outcome.UNREACHABLE.name for run in missed)
        cells.append(f"{told} of {len(missed)}" if method == "QP" else "")
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def draw(file: Path, runs: list[Run], env: Any) -> None:
    """Cart and tip of the benchmark case over time, a panel for each method."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, panels = plt.subplots(1, len(runs), figsize=(9.0, 3.4), layout="constrained", sharey=True, squeeze=False)
    goal, (left, right) = 1e3 * float(env.goal_x), (1e3 * env.obstacles[0]).tolist()
    reach = 1e3 * env.config.reach
    for axes, run in zip(panels[0], runs, strict=True):
        way = 1e3 * np.array(run.way)
        time = env.control_dt * np.arange(len(way))
        for centre in (left, right):
            label = "no place for an upright stem" if centre == left else None
            axes.axhspan(centre - reach, centre + reach, color="0.9", label=label)
        axes.axhline(goal, color="C2", label="goal")
        axes.plot(time, way[:, 1], color="C3", marker="o", markersize=3, label="tip")
        axes.plot(time, way[:, 0], color="C0", linestyle="--", label="cart")
        axes.set(xlabel="time [s]", title=f"{run.method}: {1e3 * run.distance:.1f} mm from the goal at the end")
    panels[0, 0].set_ylabel("x [mm]")
    panels[0, 0].legend(fontsize=8)
    with atomic_path(file) as scratch:
        figure.savefig(scratch, dpi=80)
    plt.close(figure)


def main(argv: Sequence[str] | None = None) -> list[Run]:
    """Run the study and write its files; returns all runs but those of the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--starts", type=int, default=100, help="random starts and goals")
    parser.add_argument("--planned", type=int, help="so many of them for the planner too; default: all")
    given = parser.parse_args(argv)
    if given.starts < 1 or not 0 <= (given.planned or 0) <= given.starts:
        parser.error(
            f"--starts must be at least 1, --planned in 0 ... --starts; got {given.starts} and {given.planned}"
        )
    prove_writable(given.folder / "obstacle.json")
    runs = compare(given.starts, given.starts if given.planned is None else given.planned)
    env = registry.make(NAME, seed=SEED, goals="benchmark")
    env.reset()
    draw(given.folder / "obstacle.png", compare(1, 1, goals="benchmark"), env)
    text = table(runs)
    for name, content in (("json", json.dumps([asdict(run) for run in runs]) + "\n"), ("md", text)):
        write_text(given.folder / f"obstacle.{name}", content)
    print(text)
    return runs


if __name__ == "__main__":
    main()
