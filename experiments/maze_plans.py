"""OPD in mazes: to the four corners of the serpentine, as in SofaGym's paper, and to random goals of random mazes.

    python -m experiments.maze_plans
    python -m experiments.maze_plans --mazes 20 --goals 5 --output maze_plans.json

A plan counts if the ball comes within 5 mm of the goal when it is carried out in an environment of one world. Corners
are planned for as in the paper, 2 s per action, and with the environment's own 0.5 s; in random mazes, where the way
leads past other openings, a tilt lasts 0.2 s (``--repeat`` 20 sub-steps).
"""

import argparse
import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import mean, median

from softwarp.envs import registry
from softwarp.envs.base import SoftEnv
from softwarp.envs.options.simple_maze import SimpleMazeConfig
from softwarp.io.atomic import write_text
from softwarp.planning import plans
from softwarp.planning.env_model import EnvModel
from softwarp.planning.opd import OPD
from softwarp.planning.options import ModelConfig, OPDConfig

WORLDS = 32  # that expand the tree together
EXPANSIONS = 1000  # of a plan at most, four tilts each


@dataclass(frozen=True)
class Found:
    """One plan."""

    maze: int  # seed, -1 for the serpentine
    goal: int
    way: float  # m, from start to goal
    success: bool  # of the plan carried out in an environment of one world
    actions: int
    expansions: int
    seconds: float  # of planning


def main(argv: Sequence[str] | None = None) -> dict[str, list[Found]]:
    """Plan, print and return what was found, study by study."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--mazes", type=int, default=20, help="random ones")
    parser.add_argument("--goals", type=int, default=5, help="of each")
    parser.add_argument("--repeat", type=int, default=20, help="sub-steps of an action in random mazes")
    parser.add_argument("--first", type=int, default=0, help="seed of the first random maze")
    parser.add_argument("--output", type=Path, help="JSON of all plans")
    given = parser.parse_args(argv)
    studies = {
        "corners, paper": corners(SimpleMazeConfig.paper(solver_path="lanes")),
        "corners, 0.5 s": corners(SimpleMazeConfig(solver_path="lanes")),
        "random mazes": random_goals(range(given.first, given.first + given.mazes), given.goals, given.repeat),
    }
    told, kept = {}, {}
    for name, study in studies.items():
        found = []
        for entry in study:
            found.append(entry)
            print(f"{name}: maze {entry.maze} goal {entry.goal}: {_line(entry)}", flush=True)
        if found:
            print(f"{name}: {summary(found)}", flush=True)
        kept[name] = found
        told[name] = [asdict(entry) for entry in found]
        if given.output is not None:
            write_text(given.output, json.dumps(told, indent=1) + "\n")
    return kept


def corners(config: SimpleMazeConfig) -> Iterator[Found]:
    """Plans to the corners of the serpentine."""
    maze = config.make_maze(0)
    for goal, cell in enumerate(maze.corners()):
        x, y = maze.centres[cell]
        env = registry.make("SimpleMaze", seed=0, config=config, goal_place=(float(x), float(y)))
        env.reset()
        yield plan(env, EnvModel(env, ModelConfig(), worlds=WORLDS), -1, goal)


def random_goals(seeds: range, goals: int, repeat: int) -> Iterator[Found]:
    """Plans to goals anywhere, from starts anywhere, in random mazes."""
    for seed in seeds:
        options = {"maze": "random", "goal": "any", "solver_path": "lanes", "action_repeat": repeat}
        config = SimpleMazeConfig(maze_seed=seed, **options)
        env = registry.make("SimpleMaze", seed=seed, config=config)
        model = EnvModel(env, ModelConfig(), worlds=WORLDS)
        for goal in range(goals):
            env.reset()
            yield plan(env, model, seed, goal)


def plan(env: SoftEnv, model: EnvModel, maze: int, goal: int) -> Found:
    """A plan from the present state of an environment of one world, and what comes of it there."""
    way = float(env.world_state["way"][0])
    start = env.snapshot([0])
    begun = time.perf_counter()
    model.start(start)
    search = OPD(OPDConfig(until_success=True, expansions=EXPANSIONS)).plan(model)
    seconds = time.perf_counter() - begun
    steps = plans.follow(env, start, model.commands(search.actions))
    return Found(
        maze,
        goal,
        way,
        bool(steps) and steps[-1].success,
        len(search.actions),
        search.expansions,
        seconds,
    )


def summary(found: list[Found]) -> str:
    """One line."""
    seconds = [entry.seconds for entry in found]
    met = sum(entry.success for entry in found)
    return (
        f"{met} of {len(found)} goals met ({met / len(found):.0%}); {median(seconds):.1f} s per plan (mean "
        f"{mean(seconds):.1f}, longest {max(seconds):.1f}), {median(entry.actions for entry in found):.0f} actions"
    )


def _line(entry: Found) -> str:
    met, way = "met" if entry.success else "missed", 1e3 * entry.way
    return f"{way:.0f} mm, {met}, {entry.actions} actions, {entry.expansions} expansions, {entry.seconds:.1f} s"


if __name__ == "__main__":
    main()
