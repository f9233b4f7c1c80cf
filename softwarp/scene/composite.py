"""Tubes one in the other: their numbers, and the curve that they take together where torsion is rigid. Host only.

Where tubes overlap they share a centre line. With bending stiffness E I and stress-free curvature k of every tube,
turned by its angle, and no load, the curvature is sum(E I k) / sum(E I) (Webster and Jones, 2010, section 5).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softwarp.meshing.rods import round_section
from softwarp.shapes.base import quaternion_product

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int32]
Section = tuple[float, tuple[float, float, float], float | None]  # length [m], curvature [1/m], modulus [Pa]


@dataclass(frozen=True)
class TubeTable:
    """Numbers of the tubes of one telescope, innermost first.

    Attributes:
        length: Whole length [m], shape (tube,).
        radius: Outer radius [m], shape (tube,).
        youngs, nu, density: Material, shape (tube,).
        section_start: Ranges of sections, shape (tube + 1,).
        section_end: Where a section ends, from the tube's base [m], shape (section,).
        section_ratio: Modulus per that of the tube, shape (section,).
        curvature: Stress-free curvature and twist [1/m], shape (section, 3).
        area: Area, shear area [m^2], second moment of area and torsion constant [m^4], shape (tube, 4).
    """

    length: FloatArray
    radius: FloatArray
    youngs: FloatArray
    nu: FloatArray
    density: FloatArray
    section_start: IntArray
    section_end: FloatArray
    section_ratio: FloatArray
    curvature: FloatArray
    area: FloatArray

    @property
    def count(self) -> int:
        """Tubes."""
        return len(self.length)


def tube_table(
    sections: Sequence[Sequence[Section]],
    *,
    radius: Sequence[float],
    inner_radius: Sequence[float],
    youngs: Sequence[float],
    nu: Sequence[float],
    density: Sequence[float],
) -> TubeTable:
    """Collect tubes into arrays; each has sections (length, curvature, modulus or None for that of the tube)."""
    ends = [np.cumsum([length for length, _, _ in tube]) for tube in sections]
    area = []
    for outer, inner, poisson in zip(radius, inner_radius, nu, strict=True):
        whole = round_section(np.array([outer]), np.array([inner]), poisson)[0]
        area.append([whole[0], whole[1], whole[2], whole[4]])
    modulus = [
        [(youngs[i] if given is None else given) / youngs[i] for _, _, given in tube] for i, tube in enumerate(sections)
    ]
    return TubeTable(
        length=np.array([end[-1] for end in ends]),
        radius=np.array(radius, dtype=np.float64),
        youngs=np.array(youngs, dtype=np.float64),
        nu=np.array(nu, dtype=np.float64),
        density=np.array(density, dtype=np.float64),
        section_start=np.concatenate([[0], np.cumsum([len(end) for end in ends])]).astype(np.int32),
        section_end=np.concatenate(ends),
        section_ratio=np.array([ratio for tube in modulus for ratio in tube], dtype=np.float64),
        curvature=np.array([k for tube in sections for _, k, _ in tube], dtype=np.float64).reshape(-1, 3),
        area=np.array(area),
    )


def composite_curve(
    table: TubeTable, port: FloatArray, lengths: FloatArray, angles: FloatArray, segments: int, floor: float
) -> tuple[FloatArray, FloatArray]:
    """The curve that tubes take together without loads, if none of them twists.

    Args:
        table: Tubes.
        port: Position [m] and quaternion x y z w of the port; tubes leave it along its z axis.
        lengths: Deployed lengths [m], shape (tube,).
        angles: Angles at the base [rad], shape (tube,).
        segments: Equal segments that the longest deployed tube is cut into.
        floor: Shortest length of the curve [m].

    Returns:
        Positions [m], shape (segments + 1, 3), and quaternions of frames, shape (segments + 1, 4), whose d1 is that of
        the tube that reaches farthest, the innermost of equals.
    """
    carrier = int(np.argmax(lengths))
    shown = np.array(lengths, dtype=np.float64)
    whole = max(float(shown[carrier]), floor)
    shown[carrier] = whole
    stops = [0.0, whole, *np.linspace(0.0, whole, segments + 1)]
    for tube in range(table.count):
        hidden = table.length[tube] - shown[tube]
        ends = table.section_end[table.section_start[tube] : table.section_start[tube + 1]] - hidden
        stops += [float(s) for s in ends if 0.0 < s < whole]
    knots = np.unique(stops)
    nodes = np.linspace(0.0, whole, segments + 1)
    x, q = np.array(port[:3], dtype=np.float64), np.array(port[3:], dtype=np.float64)
    half = 0.5 * angles[carrier]
    q = quaternion_product(q, np.array([0.0, 0.0, np.sin(half), np.cos(half)]))
    positions, quaternions, node = [x], [q], 1
    for begin, end in itertools.pairwise(knots):
        kappa = _curvature(table, shown, angles - angles[carrier], carrier, 0.5 * (begin + end))
        x, q = _advance(x, q, kappa, end - begin)
        while node <= segments and abs(end - nodes[node]) <= 1e-12 * whole:
            positions.append(x)
            quaternions.append(q)
            node += 1
    return np.array(positions), np.array(quaternions)


def _curvature(table: TubeTable, lengths: FloatArray, turn: FloatArray, carrier: int, s: float) -> FloatArray:
    """Curvature and twist of all tubes together at a place, in the axes of the carrier."""
    stiff, total = 0.0, np.zeros(2)
    twist = 0.0
    for tube in range(table.count):
        if lengths[tube] <= s:
            continue
        first, last = table.section_start[tube], table.section_start[tube + 1]
        place = s + table.length[tube] - lengths[tube]
        part = first + min(int(np.searchsorted(table.section_end[first:last], place)), last - first - 1)
        weight = table.youngs[tube] * table.section_ratio[part] * table.area[tube, 2]
        c, d = np.cos(turn[tube]), np.sin(turn[tube])
        k = table.curvature[part]
        total += weight * np.array([c * k[0] - d * k[1], d * k[0] + c * k[1]])
        stiff += weight
        if tube == carrier:
            twist = float(k[2])
    return np.array([*(total / stiff), twist])


def _advance(x: FloatArray, q: FloatArray, kappa: FloatArray, length: float) -> tuple[FloatArray, FloatArray]:
    """Pose after a length of constant curvature."""
    turn = kappa * length
    angle = float(np.linalg.norm(turn))
    ahead = np.array([0.0, 0.0, length])
    across = np.cross(turn, ahead)
    b, c = (0.5, 1.0 / 6.0) if angle < 1e-6 else ((1 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3)
    way = ahead + b * across + c * np.cross(turn, across)
    part = 0.5 if angle < 1e-6 else np.sin(0.5 * angle) / angle
    step = np.array([*(part * turn), np.cos(0.5 * angle)])
    u, w = q[:3], q[3]
    t = 2.0 * np.cross(u, way)
    return x + way + w * t + np.cross(u, t), quaternion_product(q, step)
