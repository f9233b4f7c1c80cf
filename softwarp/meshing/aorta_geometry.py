"""Branching vessels: centre lines with radii as a tree, and an aorta with outlets, the reference's or random ones.

Frame: the inlet's middle is the origin, blood flows along +z. Dimensions of the default [m] are those of the phantom of
SofaGym's CatheterBeam scene as far as they are listed in assets/aorta/README.md; the ways between inlet and outlets are
our own: a tree that forks in two again and again, each half taking the outlets on its side.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softwarp import checks
from softwarp.meshing.tets import FloatArray, MeshError

IntArray = NDArray[np.int64]

RADIUS = 0.0066  # of inlet and outlets
OUTLETS = (  # middles of the phantom's outlets
    (0.0306, -0.0862, 1.0085),
    (0.0848, -0.0412, 1.0043),
    (0.0246, -0.0075, 1.0090),
    (0.0668, 0.0112, 1.0057),
    (0.0286, 0.0937, 1.0087),
    (0.0909, 0.1275, 1.0038),
    (0.0567, 0.1800, 1.0065),
)
FORKS = (0.10, 0.43, 0.80, 0.89)  # heights of forks per height of the outlets, from the inlet on; later ones halve
HALF_ANGLE = 0.55  # rad, between a branch and its parent where they part
INLET, BEYOND = 0.02, 0.04  # by which a vessel goes on before its inlet and behind its outlets
STEP = 0.004  # between points of the centre lines
MOST_OUTLETS = 16
FARTHEST = 3.0  # m, coordinates of an outlet
WINDING = 0.006  # how far branches of random vessels wind aside
TRIES = 200
_PULL = 0.75  # share of the way from the axis to the middle of its outlets that a fork stands aside


@dataclass(frozen=True, eq=False)
class VesselTree:
    """Centre lines of a branching vessel as points, each of which follows another one.

    Args:
        points: Positions [m], shape (n, 3); the first is where the vessel begins.
        radius: Of the lumen at the points [m], shape (n,).
        parent: The point before each, lower than its own number; -1 for the first, shape (n,).
        inlet: Number of the point from which ways are counted.
        outlets: Numbers of the points that are outlets, shape (k,); the vessel may go on behind them.
        name: What messages call it.

    Raises:
        MeshError: If the arrays do not fit each other, numbers are not finite, or points are no tree.
    """

    points: FloatArray
    radius: FloatArray
    parent: IntArray
    inlet: int
    outlets: IntArray
    name: str = "vessel"

    def __post_init__(self) -> None:
        x, r, parent = np.asarray(self.points, float), np.asarray(self.radius, float), np.asarray(self.parent)
        n = len(x)
        if x.shape != (n, 3) or n < 2 or r.shape != (n,) or parent.shape != (n,):
            raise MeshError(
                f"{self.name}: points (n, 3), radius (n,) and parent (n,) must fit each other, got {x.shape}, "
                f"{r.shape} and {parent.shape}"
            )
        if not np.isfinite(x).all() or not np.isfinite(r).all() or r.min() <= 0.0:
            raise MeshError(f"{self.name}: positions must be finite and radii positive")
        if parent[0] != -1 or (parent[1:] < 0).any() or (parent[1:] >= np.arange(1, n)).any():
            raise MeshError(f"{self.name}: every point but the first must follow one with a lower number")
        marks = np.append(np.asarray(self.outlets, dtype=np.int64), self.inlet)
        if marks.ndim != 1 or len(marks) < 2 or marks.min() < 0 or marks.max() >= n:
            raise MeshError(f"{self.name}: inlet and outlets must be numbers of points, 0 to {n - 1}, got {marks}")
        for key, value in (("points", x), ("radius", r), ("parent", parent.astype(np.int64)), ("outlets", marks[:-1])):
            object.__setattr__(self, key, value)

    @cached_property
    def length(self) -> FloatArray:
        """Way of every point from the inlet [m], negative before it, shape (n,)."""
        way = np.zeros(len(self.points))
        for i in range(1, len(way)):
            before = self.parent[i]
            way[i] = way[before] + np.linalg.norm(self.points[i] - self.points[before])
        return np.asarray(way - way[self.inlet])

    @cached_property
    def direction(self) -> FloatArray:
        """Unit vectors along which the vessel goes on from the point before, shape (n, 3)."""
        along = self.points - self.points[self.parent]
        along[0] = self.points[int(np.flatnonzero(self.parent == 0)[0])] - self.points[0]
        return np.asarray(along / np.linalg.norm(along, axis=1, keepdims=True))

    def route(self, outlet: int) -> IntArray:
        """Points from the first one to an outlet, in order."""
        return np.array(self._back_from(int(self.outlets[outlet]))[::-1])

    @cached_property
    def ways(self) -> FloatArray:
        """Way from every outlet to every point along the centre lines [m], shape (k, n)."""
        found = np.empty((len(self.outlets), len(self.points)))
        for k, outlet in enumerate(self.outlets):
            on_route = np.zeros(len(self.points), dtype=bool)
            on_route[self.route(k)] = True
            meeting = np.zeros(len(self.points))  # way of the last point that the routes share
            for i in range(len(self.points)):
                meeting[i] = self.length[i] if on_route[i] else meeting[self.parent[i]]
            found[k] = self.length + self.length[outlet] - 2.0 * meeting
        return found

    @cached_property
    def towards(self) -> IntArray:
        """Next point on the way from every point to every outlet, itself at the outlet, shape (k, n)."""
        found = np.tile(self.parent, (len(self.outlets), 1))
        for k, outlet in enumerate(self.outlets):
            route = self.route(k)
            found[k, route[:-1]] = route[1:]
            found[k, outlet] = outlet
        return found

    def ahead(self, way: float) -> IntArray:
        """Point about ``way`` [m] farther on the way from every point to every outlet, the outlet at most, (k, n)."""
        mean = float(np.mean(np.linalg.norm(self.points[1:] - self.points[self.parent[1:]], axis=1)))
        rows = np.arange(len(self.outlets))[:, None]
        found = np.tile(np.arange(len(self.points)), (len(self.outlets), 1))
        for _ in range(max(round(way / mean), 1)):
            found = self.towards[rows, found]
        return found

    @cached_property
    def choices(self) -> tuple[IntArray, FloatArray]:
        """Where the way from every point to every outlet next takes one of several branches, and to which side.

        Returns:
            The fork, or the outlet where there is none left, (k, n), and unit vectors across the vessel from the mean
            of its other branches to the one to take, zero where there is none left, (k, n, 3).
        """
        count = (len(self.outlets), len(self.points))
        fork, side = np.empty(count, dtype=np.int64), np.zeros((*count, 3))
        forks = {int(i): np.flatnonzero(self.parent == i) for i in self.forks}
        for k in range(len(self.outlets)):
            route = self.route(k)
            taken, after = np.full(len(self.points), -1), np.zeros((len(self.points), 3))
            here, way = int(route[-1]), np.zeros(3)
            for i, following in zip(route[::-1], [int(route[-1]), *route[:0:-1]], strict=True):
                if int(i) in forks:
                    across = self._turn(int(i), int(following), forks[int(i)])
                    here, way = int(i), across
                taken[i], after[i] = here, way
            for i in range(len(self.points)):
                if taken[i] < 0:  # back to where it left the route: beyond the outlet there is nothing to choose
                    before = self.parent[i]
                    taken[i], after[i] = taken[before], after[before]
            fork[k], side[k] = taken, after
        return fork, side

    def _turn(self, fork: int, taken: int, branches: IntArray) -> FloatArray:
        """Unit vector across the vessel from the other branches of a fork to the one that is taken."""
        ends = {int(i): self._on_from(int(i), 5) for i in branches}
        others = np.mean([self.points[end] for i, end in ends.items() if i != taken], axis=0)
        way = self.points[ends[taken]] - others
        along = self.direction[fork]
        way = way - (way @ along) * along
        return np.asarray(way / max(float(np.linalg.norm(way)), 1e-9))

    def _on_from(self, point: int, steps: int) -> int:
        """A point some steps behind another one, the first of several that follow each."""
        for _ in range(steps):
            following = np.flatnonzero(self.parent == point)
            if not len(following):
                break
            point = int(following[0])
        return point

    @property
    def forks(self) -> IntArray:
        """Points that more than one follow."""
        number, count = np.unique(self.parent[1:], return_counts=True)
        return np.asarray(number[count > 1])

    def tubes(self) -> list[tuple[FloatArray, FloatArray]]:
        """Centre lines and radii of stem and branches, as ``shapes.Vessel.from_tubes`` takes them."""
        followed = np.zeros(len(self.points), dtype=bool)
        followed[self.parent[1:]] = True
        taken, found = np.zeros(len(self.points), dtype=bool), []
        for leaf in np.flatnonzero(~followed):
            line, i = [], int(leaf)
            while i >= 0:
                line.append(i)
                if taken[i]:
                    break
                taken[i] = True
                i = int(self.parent[i])
            order = np.array(line[::-1])
            found.append((self.points[order], self.radius[order]))
        return found

    def clearance(self) -> float:
        """Least wall between branches [m]: of any two points whose way to each other is much longer than straight."""
        least = np.inf
        x, r = self.points, self.radius
        lineage = [set(self._back_from(i)) for i in range(len(x))]
        forks = x[self.forks]
        reach = 2.5 * float(r.max()) / np.sin(HALF_ANGLE)
        apart = np.linalg.norm(x[:, None] - forks[None], axis=2).min(axis=1) > reach if len(forks) else np.ones(len(x))
        for i in np.flatnonzero(apart):
            other = np.array([j for j in np.flatnonzero(apart[:i]) if j not in lineage[i]], dtype=np.int64)
            other = other[np.abs(self.length[other] - self.length[i]) < 0.2]
            if len(other):
                least = min(least, float((np.linalg.norm(x[other] - x[i], axis=1) - r[other] - r[i]).min()))
        return least

    def _back_from(self, point: int) -> list[int]:
        """Points from one back to the first."""
        found, i = [], point
        while i >= 0:
            found.append(i)
            i = int(self.parent[i])
        return found


def _check_outlets(outlets: FloatArray, radius: float, name: str) -> None:
    """Refuse outlets that no vessel has, before one is grown."""
    low = int(outlets[:, 2].argmin())
    if outlets[low, 2] <= STEP:
        need = f"be more than {STEP:g} m above the inlet, z = 0"
        raise ValueError(checks.refusal(f"{name}: outlets: the place of outlet {low}", need, outlets[low].tolist()))
    for i in range(1, len(outlets)):
        apart = np.linalg.norm(outlets[:i] - outlets[i], axis=1)
        near = int(apart.argmin())
        if apart[near] <= 2.0 * radius:
            raise ValueError(
                f"{name}: outlets {near} and {i} must be more than two radii, {2.0 * radius:g} m, apart, got "
                f"{apart[near]:g} m; move one, or make outlet_radius smaller"
            )


@dataclass
class _Growth:
    """Points of a tree while it grows."""

    points: list[FloatArray] = field(default_factory=list)
    parent: list[int] = field(default_factory=list)
    leaf: dict[int, int] = field(default_factory=dict)  # outlet -> its point

    def line(self, points: FloatArray, after: int) -> int:
        """Add points one after the other; the number of the last."""
        for x in points:
            self.points.append(x)
            self.parent.append(after)
            after = len(self.points) - 1
        return after


def aorta(
    outlets: int | ArrayLike | None = None,
    *,
    radius: float = RADIUS,
    outlet_radius: float | None = None,
    seed: int | None = None,
    tortuosity: float | None = None,
    name: str = "aorta",
) -> VesselTree:
    """A vessel of about a metre that forks again and again to its outlets.

    Args:
        outlets: Positions of the outlets' middles [m], shape (k, 3), within 3 m and above the inlet, z = 0, apart from
            each other; or how many to draw; None takes the seven of the reference, or with a seed draws seven.
        radius: Of the inlet [m].
        outlet_radius: Of the outlets [m]; between them it changes with the way. None: as the inlet.
        seed: Draws outlets, heights of forks and windings; None draws nothing.
        tortuosity: How far stem and branches wind aside [m]; None takes 6 mm with a seed and nothing without.
        name: What messages call it.

    Returns:
        Its tree; the stem begins 2 cm before the inlet, branches go on 4 cm behind the outlets.

    Raises:
        MeshError: For numbers out of range, and if branches come too near to each other, for random ones in all tries.
        ValueError: If the name is no text.
    """
    name = checks.label(name, "aorta")
    try:
        r = checks.number(radius, f"{name}: radius [m]", above=0.0, high=1.0)
        end = r if outlet_radius is None else checks.number(outlet_radius, f"{name}: outlet_radius [m]", above=0.0)
        wind = (0.0 if seed is None else WINDING) if tortuosity is None else tortuosity
        wind = checks.number(wind, f"{name}: tortuosity [m]", low=0.0, high=0.05)
        count = None
        if isinstance(outlets, int):
            count = checks.count(outlets, f"{name}: outlets", high=MOST_OUTLETS)
        seed = None if seed is None else checks.seed(seed)
        given = np.array(OUTLETS) if outlets is None else np.zeros((0, 3))
        if outlets is not None and not count:
            need = f"be finite positions within {FARTHEST:g} m, of shape (k, 3), or how many"
            given = checks.array(outlets, f"{name}: outlets", (None, 3), low=-FARTHEST, high=FARTHEST, need=need)
            if not len(given):
                raise ValueError(checks.refusal(f"{name}: outlets", need, outlets))
            _check_outlets(given, end, name)
    except ValueError as error:
        raise MeshError(str(error)) from None
    if not count and len(given) > MOST_OUTLETS:
        raise MeshError(f"{name}: at most {MOST_OUTLETS} outlets, got {len(given)}")
    if seed is None and count:
        given = _spread(count, np.random.default_rng(0), 0.0)
    if seed is None:
        tree = _grown(given, r, end, wind, None, name)
        if tree.clearance() < 0.1 * r:
            raise MeshError(f"{name}: branches come within {tree.clearance():.4g} m of each other; move its outlets")
        return tree
    rng = np.random.default_rng(seed)
    many = count or len(OUTLETS)
    for _ in range(TRIES):
        places = given if len(given) and outlets is not None else _spread(many, rng, 1.0)
        tree = _grown(places, r, end, wind, rng, name)
        if tree.clearance() >= 0.3 * r:
            return tree
    raise MeshError(f"{name}: no vessel of seed {seed} with branches apart in {TRIES} tries; ask for fewer outlets")


def _spread(count: int, rng: np.random.Generator, chance: float) -> FloatArray:
    """Outlets side by side along y, alternately near and far along x."""
    y = np.linspace(-0.09, 0.18, count) if count > 1 else np.array([0.04])
    x = np.where(np.arange(count) % 2, 0.083, 0.030)
    z = np.full(count, 1.006)
    jitter = rng.uniform(-1.0, 1.0, (count, 3)) * np.array([0.012, 0.3 * 0.27 / max(count - 1, 1), 0.003])
    return np.asarray(np.stack([x, y, z], axis=1) + chance * jitter)


def _grown(
    outlets: FloatArray, radius: float, end: float, wind: float, rng: np.random.Generator | None, name: str
) -> VesselTree:
    """Stem and branches to outlets."""
    growth = _Growth()
    growth.points.append(np.array([0.0, 0.0, -INLET]))
    growth.parent.append(-1)
    before = growth.line(np.array([(0.0, 0.0, z) for z in np.arange(-INLET + STEP, 1e-9, STEP)]), 0)
    inlet = before
    numbers = np.argsort(outlets[:, 1], kind="stable")
    _branch(growth, outlets, numbers, before, np.array([0.0, 0.0, 1.0]), 0, wind, rng)
    leaves = np.array([growth.leaf[k] for k in range(len(outlets))])
    tree = VesselTree(
        np.array(growth.points), np.full(len(growth.points), radius), np.array(growth.parent), inlet, leaves, name
    )
    share = np.clip(tree.length / tree.length[leaves].min(), 0.0, 1.0)
    return VesselTree(tree.points, radius + share * (end - radius), tree.parent, inlet, leaves, name)


def _branch(
    growth: _Growth,
    outlets: FloatArray,
    group: IntArray,
    start: int,
    direction: FloatArray,
    level: int,
    wind: float,
    rng: np.random.Generator | None,
) -> None:
    """Grow from a point along a direction to an outlet, or to a fork and from there on."""
    x = growth.points[start]
    up = np.array([0.0, 0.0, 1.0])
    if len(group) == 1:
        goal = outlets[group[0]]
        last = growth.line(_curve(x, direction, goal, up, wind, rng), start)
        growth.leaf[int(group[0])] = last
        beyond = goal + up * np.arange(STEP, BEYOND + 1e-9, STEP)[:, None]
        growth.line(beyond, last)
        return
    height = float(outlets[:, 2].min())
    share = FORKS[level] if level < len(FORKS) else 1.0 - 0.5 ** (level - len(FORKS) + 1) * (1.0 - FORKS[-1])
    if rng is not None:
        share += rng.uniform(-0.04, 0.04) * min(1.0, 4.0 * (1.0 - share))
    fork = np.append(_PULL * outlets[group, :2].mean(axis=0) if level else np.zeros(2), share * height)
    last = growth.line(_curve(x, direction, fork, up, wind, rng), start)
    half = (len(group)) // 2
    halves = group[:half], group[half:]
    aside = outlets[halves[1]].mean(axis=0) - outlets[halves[0]].mean(axis=0)
    aside[2] = 0.0
    aside = aside / max(float(np.linalg.norm(aside)), 1e-9)
    for side, part in zip((-1.0, 1.0), halves, strict=True):
        turned = np.cos(HALF_ANGLE) * up + side * np.sin(HALF_ANGLE) * aside
        _branch(growth, outlets, part, last, turned, level + 1, wind, rng)


def _curve(
    start: FloatArray,
    first: FloatArray,
    end: FloatArray,
    last: FloatArray,
    wind: float,
    rng: np.random.Generator | None,
) -> FloatArray:
    """Points behind ``start`` on a cubic with given directions at its ends, winding aside in between."""
    reach = float(np.linalg.norm(end - start))
    a = np.linspace(0.0, 1.0, 400)[:, None]
    pull = min(reach, 0.12)
    hermite = (
        (2 * a**3 - 3 * a**2 + 1) * start
        + (a**3 - 2 * a**2 + a) * pull * 2.0 * first
        + (-2 * a**3 + 3 * a**2) * end
        + (a**3 - a**2) * pull * 2.0 * last
    )
    if wind > 0.0 and reach > 0.15:
        turn = rng.uniform(0.0, 2.0 * np.pi, 2) if rng is not None else np.array([0.4, 1.9])
        turns = max(1, round(reach / 0.25))
        aside = np.concatenate(
            [np.cos(turn[0] + np.pi * turns * a), np.sin(turn[1] + np.pi * turns * a), 0 * a], axis=1
        )
        hermite = hermite + wind * np.sin(np.pi * a) ** 2 * aside
    way = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(hermite, axis=0), axis=1)))
    count = max(int(np.ceil(way[-1] / STEP)), 1)
    at = np.linspace(0.0, way[-1], count + 1)[1:]
    return np.stack([np.interp(at, way, hermite[:, c]) for c in range(3)], axis=1)
