"""How far some actions can lead the quadruped at best: every sequence of them, or the best few of each length.

    python -m experiments.gait_search FOLDER                     # all sequences of six actions, reduced model
    python -m experiments.gait_search FOLDER --model full --device cuda:0 --worlds 1024
    python -m experiments.gait_search FOLDER --actions 18 --keep 32

Of six actions four differ in any state: three fill or empty a group of chambers, and all that fill what is full or
empty what is empty wait. So six actions make 4 096 sequences, and all of them can be tried: what no policy can exceed.
With ``--keep`` only those that have come farthest go on, so many for every set of full chambers: a lower bound.

Printed after each action are the farthest sequences and the hand-made gait; ``search.json`` has the farthest of every
length with their ways along x [mm]. ``experiments.gait_study --gaits`` compares sequences on both models.
"""

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from softwarp.envs import registry
from softwarp.io.atomic import prove_writable, write_text
from softwarp.planning.env_model import EnvModel
from softwarp.planning.model import PlanningModel
from softwarp.planning.options import ModelConfig
from softwarp.policies.baselines.multi_gait import GAIT

ROBOTS = {"reduced": "MultiGaitReduced", "full": "MultiGaitFull"}
SEED = 2_000_003
GROUPS = 3  # of chambers that are filled together: action k fills group k, GROUPS + k empties it
EVERY = sys.maxsize
SHOWN = 3  # sequences of a length that are printed
KEPT = 20  # that are written


@dataclass(frozen=True)
class Gait:
    """A sequence of actions from rest.

    Attributes:
        state: The planning model's name of where it leads.
        full: Groups that are full, bit k for group k.
        actions: What was done.
        way: Along x after each action [mm].
    """

    state: int
    full: int = 0
    actions: tuple[int, ...] = ()
    way: tuple[float, ...] = ()


def moves(full: int) -> list[tuple[int, int]]:
    """Actions that differ where some groups are full, each with the groups that are full then; the last one waits."""
    toggles = [(k + GROUPS * (full >> k & 1), full ^ 1 << k) for k in range(GROUPS)]
    return [*toggles, (0 if full & 1 else GROUPS, full)]


def hand_made(actions: int) -> tuple[int, ...]:
    """The first actions of the hand-made gait."""
    return tuple(GAIT[k % len(GAIT)] for k in range(actions))


def search(model: PlanningModel, actions: int, keep: int = EVERY) -> Iterator[list[Gait]]:
    """All gaits of one action, of two, and so on, the farthest first.

    Args:
        model: Whose ``distance`` [m] falls as the robot walks; started.
        actions: Length of the longest.
        keep: Gaits that go on for each set of full groups, the farthest ones, besides the hand-made one.
    """
    front, begin = [Gait(model.root)], float("nan")
    for count in range(1, actions + 1):
        tried = [(gait, *move) for gait in front for move in moves(gait.full)]
        told = model.step_many(np.array([gait.state for gait, _, _ in tried]), np.array([a for _, a, _ in tried]))
        if count == 1:
            begin = float(told.distance[-1])  # waiting, at rest
        gaits = [
            Gait(int(state), full, (*gait.actions, action), (*gait.way, 1e3 * (begin - float(distance))))
            for (gait, action, full), state, distance in zip(tried, told.states, told.distance, strict=True)
        ]
        gaits.sort(key=lambda gait: -gait.way[-1])
        yield gaits
        chosen: dict[int, list[Gait]] = {}
        for gait in gaits:
            others = chosen.setdefault(gait.full, [])
            if len(others) < keep or gait.actions == hand_made(count):
                others.append(gait)
        front = [gait for others in chosen.values() for gait in others]


def at_rest(robot: str, actions: int, device: str, worlds: int, memory: float) -> tuple[Tensor, EnvModel]:
    """First observation of a robot, and a planning model that starts there.

    Args:
        robot: "reduced" or "full".
        actions: That are to be tried, one after the other.
        device: Where.
        worlds: That are tried together.
        memory: For states [MiB].
    """
    options: dict[str, Any] = {"max_episode_steps": actions + 1, "solver_path": "lanes" if device == "cpu" else "auto"}
    env = registry.make(ROBOTS[robot], num_worlds=1, device=device, seed=SEED, **options)
    first = env.reset()["observation"][0].clone()
    model = EnvModel(env, ModelConfig(memory=memory), worlds=worlds)
    model.start(env.snapshot([0]))
    return first, model


def name(actions: Sequence[int]) -> str:
    """Actions as digits, as ``gait_study --gaits`` takes them."""
    return "".join(map(str, actions))


def main(argv: Sequence[str] | None = None) -> list[list[Gait]]:
    """Search, tell and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--model", choices=list(ROBOTS), default="reduced")
    parser.add_argument("--actions", type=int, default=len(GAIT), help="default 6, a cycle of the hand-made gait")
    parser.add_argument(
        "--keep", type=int, default=EVERY, help="gaits that go on per set of full chambers; default all"
    )
    parser.add_argument("--worlds", type=int, default=64)
    parser.add_argument("--memory", type=float, default=2000.0, help="MiB for states; what is lost is found anew")
    parser.add_argument("--device", default="cpu")
    given = parser.parse_args(argv)
    prove_writable(given.folder / "search.json")
    _, model = at_rest(given.model, given.actions, given.device, given.worlds, given.memory)
    lengths, written = [], []
    for gaits in search(model, given.actions, given.keep):
        hand = [gait for gait in gaits if gait.actions == hand_made(len(gait.actions))]
        told = ", ".join(f"{name(gait.actions)} {gait.way[-1]:.2f}" for gait in [*gaits[:SHOWN], *hand])
        print(f"{len(gaits)} gaits, farthest and hand-made [mm]: {told}", flush=True)
        lengths.append(gaits)
        kept = [{"actions": name(gait.actions), "way_mm": gait.way} for gait in [*gaits[:KEPT], *hand]]
        written.append({"tried": len(gaits), "model": given.model, "gaits": kept})
        write_text(given.folder / "search.json", json.dumps(written, indent=1) + "\n")
    return lengths


if __name__ == "__main__":
    main()
