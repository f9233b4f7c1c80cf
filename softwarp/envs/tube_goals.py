"""Goals in a lumen that tubes reach without touching its wall: tips of their closed form whose whole line is clear.

Lengths and angles are drawn at random; of those whose line keeps its distance from the wall at most a few per cube of
3 mm are kept, so that regions that many lead to do not crowd out the rest. This takes seconds for any lumen.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from softwarp import checks, notices
from softwarp.envs.tube_line import TubeLine
from softwarp.shapes import Vessel

AT_ONCE, ROUNDS = 8000, 40  # draws
VAIN, FEW = 10, 20  # rounds without a goal after which FEW, the least, are not to be expected of all: at most 12 (95 %)
PIECES = 24  # of a line, between points that have to be clear
FEW_PIECES = 4  # that are looked at first: their points are among those of all, as PIECES + 1 is a multiple of this + 1
CUBE, PER_CUBE = 0.003, 4  # m, goals in each


@dataclass(frozen=True)
class GoalTable:
    """Goals and how they are reached, in random order.

    Attributes:
        tip: [m], float32 (goal, 3).
        length: Deployed lengths [m], float32 (goal, tube).
        angle: At the base [rad], float32 (goal, tube).
    """

    tip: Tensor
    length: Tensor
    angle: Tensor


@functools.lru_cache(maxsize=16)
def goal_table(
    vessel: Vessel,
    line: TubeLine,
    most: tuple[float, ...],
    *,
    clear: float,
    turn: float,
    depth: float,
    count: int,
    seed: int = 0,
) -> GoalTable:
    """Goals that are reached by free lines.

    Args:
        vessel: The wall.
        line: The tubes; equal tables come from the same object.
        most: Largest deployed length of each tube [m].
        clear: Least distance of the line from the wall [m].
        turn: Largest angle [rad].
        depth: Least distance of a goal from the port [m], and least length of the innermost tube.
        count: Goals at most.
        seed: Of the draws.

    Raises:
        ValueError: If hardly any line is clear of the wall.
    """
    rng = np.random.default_rng(checks.seed(seed))
    found: list[tuple[np.ndarray, ...]] = []
    cubes: dict[tuple[int, ...], int] = {}
    if (room := float(vessel.clearance(np.zeros(3))[0])) < clear:
        raise ValueError(
            f"goals: lines begin {1e3 * room:.3g} mm from the wall, and have to be {1e3 * clear:g} mm clear of it; "
            "take a smaller goal_margin, a wider vessel or goals='list'"
        )
    for done in range(1, ROUNDS + 1):
        notices.progress("seeking goals", f"{len(found)} of {count} after {done - 1} of at most {ROUNDS} draws")
        length, angle = _draws(rng, most, depth, turn)
        for pieces in (FEW_PIECES, PIECES):
            _, points = line.points(torch.as_tensor(length), torch.as_tensor(angle), pieces)
            x = points.numpy()
            is_clear = (np.linalg.norm(x[:, -1], axis=1) >= depth) & (x[:, :, 2].min(axis=1, initial=np.inf) >= 0.0)
            for some in (x[:, -1:], x[:, 1:-1]):  # most lines that touch the wall end in it
                is_clear[is_clear] = _room(vessel, some[is_clear]) >= clear
            length, angle, end = length[is_clear], angle[is_clear], x[is_clear, -1]
        for k, tip in enumerate(end):
            cube = tuple(np.floor(tip / CUBE).astype(int).tolist())
            cubes[cube] = cubes.get(cube, 0) + 1
            if cubes[cube] <= PER_CUBE:
                found.append((tip, length[k], angle[k]))
        if len(found) >= count or (done == VAIN and not found and count >= FEW):
            break
    notices.progress_ends()
    if len(found) < min(count, FEW):
        raise ValueError(
            f"goals: only {len(found)} lines of {AT_ONCE * done} are {1e3 * clear:g} mm clear of the wall; "
            "take a smaller goal_margin, a wider vessel or goals='list'"
        )
    rows = [found[k] for k in rng.permutation(len(found))[:count]]
    return GoalTable(*(torch.as_tensor(np.array(part), dtype=torch.float32) for part in zip(*rows, strict=True)))


def _room(vessel: Vessel, points: np.ndarray) -> np.ndarray:
    """Least distance of each line's points, (line, point, 3), from the wall [m], (line,)."""
    room: np.ndarray = vessel.clearance(points.reshape(-1, 3)).reshape(points.shape[:2]).min(axis=1, initial=np.inf)
    return room


def _draws(
    rng: np.random.Generator, most: tuple[float, ...], depth: float, turn: float
) -> tuple[np.ndarray, np.ndarray]:
    """Lengths of nested tubes [m] and angles [rad], (AT_ONCE, tube) each."""
    length = [rng.uniform(depth, most[0], AT_ONCE)]
    for largest in most[1:]:
        length.append(rng.uniform(0.0, 1.0, AT_ONCE) * np.minimum(length[-1], largest))
    return np.stack(length, axis=1), rng.uniform(-turn, turn, (AT_ONCE, len(most)))
