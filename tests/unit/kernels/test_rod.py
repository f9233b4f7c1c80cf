"""Rod segments: energy, forces, stiffness, invariance, precision; and the geometry of rods.

Reference: docs/theory/rod.md and the rod section of the validation catalogue (docs/validation.md).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import warp as wp
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from softwarp import meshing
from softwarp.kernels.algebra.lanes import variant
from softwarp.kernels.elements import rod
from softwarp.meshing import RodGeometry
from softwarp.solvers.workspace.rows import allocate

YOUNGS, NU = 2.0e5, 0.3


class Rod:
    """The rod kernels on one rod, in any number of worlds."""

    def __init__(
        self,
        geometry: RodGeometry,
        name: str = "scalar",
        precision: str = "float64",
        worlds: int = 1,
        nu: float = NU,
        project: bool = True,
        varying: bool = False,
    ) -> None:
        self.variant = variant(name, precision)
        self.kernels = rod.kernels(self.variant, project, varying)
        self.geometry, self.worlds = geometry, worlds
        self.count = count = len(geometry.length)
        frames = np.stack([np.arange(count), np.arange(1, count + 1)], axis=1)
        self.frame = wp.array(frames, dtype=wp.int32, device="cpu")
        self.rod = wp.zeros(count, dtype=wp.int32, device="cpu")
        self.length, self.section, self.rest = (
            wp.array(a, dtype=self.variant.real, device="cpu")
            for a in (geometry.length, geometry.section, geometry.rest)
        )
        self.scale = wp.full(count, 1.0, dtype=self.variant.real, device="cpu")
        self.youngs, self.nu = self.rows(1), self.rows(1)
        self.youngs.real.fill_(YOUNGS)
        self.nu.real.fill_(nu)
        self.pose, self.law = self.rows(7 * (count + 1)), self.rows(13 * count)
        if varying:
            plain = wp.array(np.arange(count), dtype=wp.int32, device="cpu")
            model = [plain, self.rod, self.length, self.section, self.scale, self.rest]
            self.launch(self.kernels.plain_law, [*model, self.youngs.S, self.nu.S], [self.law.S])
            self.section = wp.zeros_like(self.section)  # nothing else is read

    def rows(self, count: int) -> Any:
        return allocate(self.variant, self.worlds, count, "cpu")

    def set(self, pose: np.ndarray) -> None:
        """Poses of all frames, shape (n, 7) or (world, n, 7)."""
        flat = np.broadcast_to(pose.reshape(-1, pose.shape[-2] * 7), (self.worlds, pose.shape[-2] * 7))
        packs, count, lanes = self.pose.real.shape
        padded = np.resize(flat, (packs * lanes, count))
        self.pose.real.assign(
            padded.reshape(packs, lanes, count).transpose(0, 2, 1).astype(self.pose.real.numpy().dtype)
        )

    def get(self, rows: Any) -> np.ndarray:
        packs, count, lanes = rows.real.shape
        return rows.real.numpy().transpose(0, 2, 1).reshape(packs * lanes, count)[: self.worlds]

    def launch(self, kernel: Any, inputs: list[Any], outputs: list[Any]) -> None:
        dim = self.variant.dim(self.pose.S.shape[0], self.count)
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device="cpu")

    def element(self, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Forces (world, segment, 12) and symmetric stiffness (world, segment, 12, 12)."""
        self.set(pose)
        force, stiffness = self.rows(12 * self.count), self.rows(90 * self.count)
        model = [self.frame, self.rod, self.length, self.section, self.scale, self.rest]
        inputs = [0, *model, self.youngs.S, self.nu.S, self.law.S, self.pose.S]
        self.launch(self.kernels.element, inputs, [force.S, stiffness.S])
        blocks = self.get(stiffness).reshape(self.worlds, self.count, 10, 3, 3)
        matrix = np.zeros((self.worlds, self.count, 4, 3, 4, 3), dtype=blocks.dtype)
        for k, (a, b) in enumerate((i, j) for i in range(4) for j in range(i + 1)):
            matrix[:, :, a, :, b, :] = blocks[:, :, k]
            matrix[:, :, b, :, a, :] = blocks[:, :, k].swapaxes(-1, -2)
        shape = (self.worlds, self.count, 12)
        return self.get(force).reshape(shape), matrix.reshape(*shape, 12)

    def response(self, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Strain (world, segment, 6), inner force and moment (world, segment, 6), energy (world, segment)."""
        self.set(pose)
        strain, resultant, energy = self.rows(6 * self.count), self.rows(6 * self.count), self.rows(self.count)
        self.launch(self.kernels.strain, [self.frame, self.length, self.law.S, self.pose.S], [strain.S])
        model = [self.rod, self.length, self.section, self.scale, self.rest]
        inputs = [*model, self.youngs.S, self.nu.S, self.law.S, strain.S]
        self.launch(self.kernels.resultant, inputs, [resultant.S, energy.S])
        shape = (self.worlds, self.count, 6)
        return self.get(strain).reshape(shape), self.get(resultant).reshape(shape), self.get(energy)


def start(geometry: RodGeometry) -> np.ndarray:
    return np.concatenate([geometry.positions, geometry.quaternions], axis=1)


def moved(pose: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Poses after translations and world rotation vectors, step (..., n, 6)."""
    turn = Rotation.from_rotvec(step[:, 3:]) * Rotation.from_quat(pose[:, 3:])
    return np.concatenate([pose[:, :3] + step[:, :3], turn.as_quat()], axis=1)


def central_difference(function: Any, pose: np.ndarray, step: float) -> np.ndarray:
    """Derivative of a function with respect to all translations and rotations, last axis."""
    columns = []
    for i in range(6 * len(pose)):
        change = np.zeros(6 * len(pose))
        change[i] = step
        change = change.reshape(-1, 6)
        columns.append((function(moved(pose, change)) - function(moved(pose, -change))) / (2.0 * step))
    return np.stack(columns, axis=-1)


def single(section: Any = None) -> RodGeometry:
    """A thick segment with unlike stiffnesses and a strain at rest."""
    chosen = np.array([0.9, 0.7, 0.05, 0.08, 0.1]) if section is None else section
    return meshing.rod_geometry(meshing.straight(0.8, 1), radius=0.5, section=chosen, curvature=[0.3, -0.2, 0.4])


def sample(rng: np.random.Generator, angle: float) -> np.ndarray:
    """Two frames with a relative rotation of an angle and a general strain, far from the axes."""
    axis = rng.standard_normal(3)
    first = Rotation.random(random_state=int(rng.integers(1 << 30)))
    second = first * Rotation.from_rotvec(angle * axis / np.linalg.norm(axis))
    x1 = rng.standard_normal(3)
    x2 = x1 + first.apply([0.0, 0.0, 0.8] + 0.3 * rng.standard_normal(3))
    return np.stack([np.append(x1, first.as_quat()), np.append(x2, second.as_quat())])


@pytest.mark.parametrize("angle", [0.0, 1e-6, 1e-3, 0.3, 1.0, 2.0, 2.5, 3.0])
def test_force_is_energy_gradient(angle: float, rng: np.random.Generator) -> None:
    """dE/dq with respect to translations and world rotation vectors; central differences in float64, step 1e-5."""
    element = Rod(single())
    pose = sample(rng, angle)
    expected = central_difference(lambda p: element.response(p)[2][0, 0], pose, 1e-5)
    force = element.element(pose)[0][0, 0]
    np.testing.assert_allclose(force, expected, atol=1e-7 * np.abs(expected).max())


@pytest.mark.parametrize("angle", [0.0, 1e-6, 1e-3, 0.3, 1.0, 2.0, 2.5, 3.0])
def test_exact_stiffness_is_second_derivative(angle: float, rng: np.random.Generator) -> None:
    """H = sym(d/dq dE/dq): the antisymmetric part of spin derivatives is half the moment, which the Hessian lacks."""
    element = Rod(single(), project=False)
    pose = sample(rng, angle)
    expected = central_difference(lambda p: element.element(p)[0][0, 0], pose, 1e-5)
    stiffness = element.element(pose)[1][0, 0]
    np.testing.assert_allclose(stiffness, 0.5 * (expected + expected.T), atol=1e-7 * np.abs(expected).max())


def unstressed(pose: np.ndarray) -> RodGeometry:
    """The segment of ``single`` with the strain of a pose at rest."""
    geometry = single()
    return replace(geometry, rest=Rod(geometry).response(pose)[0][0])


@pytest.mark.parametrize("project", [True, False])
@pytest.mark.parametrize("angle", [0.0, 1e-4, 0.7, 2.5])
def test_stiffness_without_stress(angle: float, project: bool, rng: np.random.Generator) -> None:
    """Without inner forces B' C B is the derivative of the forces; differences in float64, step 1e-5."""
    pose = sample(rng, angle)
    element = Rod(unstressed(pose), project=project)
    force, stiffness = element.element(pose)
    expected = central_difference(lambda p: element.element(p)[0][0, 0], pose, 1e-5)
    np.testing.assert_allclose(force, 0.0, atol=1e-9 * YOUNGS)
    np.testing.assert_allclose(stiffness[0, 0], expected, atol=1e-8 * np.abs(expected).max())


@pytest.mark.parametrize("angle", [0.0, 0.3, 1.5, 2.5])
def test_stiffness_of_steps_is_semidefinite(angle: float, rng: np.random.Generator) -> None:
    """No negative eigenvalue under any strain, and a rigid translation meets no resistance."""
    element = Rod(single())
    for _ in range(10):
        stiffness = element.element(sample(rng, angle))[1][0, 0]
        values = np.linalg.eigvalsh(stiffness)
        assert values[0] > -1e-13 * values[-1]
        shift = np.tile(np.eye(3, 6), (1, 2)).T
        np.testing.assert_allclose(stiffness @ shift, 0.0, atol=1e-12 * values[-1])


def test_tension_stiffens() -> None:
    """A straight segment of length l under tension N: N / l against transverse shifts beside the shear's GA / L.

    The exact Hessian has the same where frames do not turn, since N / l acts on the direction of the span and the force
    of the section turns with the frames: together -N L gamma^2, dropped in the semidefinite one.
    """
    geometry = meshing.rod_geometry(meshing.straight(0.8, 1), radius=0.5, section=[0.9, 0.7, 0.05, 0.08, 0.1])
    stretch = 1.25
    element = Rod(geometry)
    pose = start(geometry)
    pose[1, 2] *= stretch
    force, stiffness = element.element(pose)
    tension = YOUNGS * 0.9 * (stretch - 1.0)
    shear = YOUNGS / (2.0 + 2.0 * NU) * 0.7
    np.testing.assert_allclose(force[0, 0, 6:9], [0.0, 0.0, tension], rtol=1e-12)
    side = shear / 0.8 + tension / (0.8 * stretch)
    np.testing.assert_allclose(np.diag(stiffness[0, 0])[:3], [side, side, YOUNGS * 0.9 / 0.8], rtol=1e-12)
    pose[1, 2] = 0.8 * 0.9
    np.testing.assert_allclose(np.diag(element.element(pose)[1][0, 0])[:2], shear / 0.8, rtol=1e-12)


@pytest.mark.parametrize("project", [True, False])
def test_sections_that_vary_are_those_that_do_not(project: bool, rng: np.random.Generator) -> None:
    """Read from the law of every world, the section of a plain rod gives the same forces, stiffness and energy."""
    plain, varying = (Rod(single(), project=project, varying=flag) for flag in (False, True))
    pose = sample(rng, 1.2)
    for one, other in zip(plain.element(pose), varying.element(pose), strict=True):
        np.testing.assert_allclose(other, one, rtol=1e-13, atol=1e-13 * np.abs(one).max())
    for one, other in zip(plain.response(pose), varying.response(pose), strict=True):
        np.testing.assert_allclose(other, one, rtol=1e-13)


@pytest.mark.parametrize("project", [True, False])
def test_frame_invariance(project: bool, rng: np.random.Generator) -> None:
    """A rigid motion of the whole turns forces, moments and stiffness with it and leaves strain and energy alone."""
    element = Rod(single(), project=project)
    pose = sample(rng, 1.2)
    turn, shift = Rotation.random(random_state=7), np.array([3.0, -2.0, 5.0])
    there = np.concatenate(
        [turn.apply(pose[:, :3]) + shift, (turn * Rotation.from_quat(pose[:, 3:])).as_quat()], axis=1
    )
    force, stiffness = element.element(pose)
    turned_force, turned_stiffness = element.element(there)
    Q = np.kron(np.eye(4), turn.as_matrix())
    scale = np.abs(stiffness).max()
    np.testing.assert_allclose(turned_force[0, 0], Q @ force[0, 0], atol=1e-13 * scale)
    np.testing.assert_allclose(turned_stiffness[0, 0], Q @ stiffness[0, 0] @ Q.T, atol=1e-13 * scale)
    for here, moved_there in zip(element.response(pose), element.response(there), strict=True):
        np.testing.assert_allclose(moved_there, here, rtol=1e-11)


def test_forces_balance(rng: np.random.Generator) -> None:
    """Forces of a segment add to zero, and so do moments about any point."""
    pose = sample(rng, 1.7)
    f1, m1, f2, m2 = Rod(single()).element(pose)[0][0, 0].reshape(4, 3)
    size = np.abs([f1, m1, f2, m2]).max()
    np.testing.assert_allclose(f1 + f2, 0.0, atol=1e-14 * size)
    np.testing.assert_allclose(m1 + m2 + np.cross(pose[1, :3] - pose[0, :3], f2), 0.0, atol=1e-13 * size)


def test_sign_of_quaternions_is_irrelevant(rng: np.random.Generator) -> None:
    """q and -q are one rotation."""
    pose = sample(rng, 2.0)
    flipped = pose * [[1.0] * 3 + [-1.0] * 4, [1.0] * 7]
    element = Rod(single())
    np.testing.assert_array_equal(element.element(flipped)[0], element.element(pose)[0])


def test_section_stiffness() -> None:
    """N = EA e, Q = GA_s g, M_1 = EI_1 k_1, M_2 = EI_2 k_2, M_3 = GJ k_3, energy L/2 (...)^2, all scaled."""
    length, section = 0.8, np.array([0.9, 0.7, 0.05, 0.08, 0.1])
    geometry = meshing.rod_geometry(meshing.straight(length, 1), radius=0.5, section=section)
    element = Rod(geometry)
    element.scale.fill_(0.5)
    shear = YOUNGS / (2.0 + 2.0 * NU)
    stiffness = 0.5 * np.array([shear * 0.7, shear * 0.7, YOUNGS * 0.9, YOUNGS * 0.05, YOUNGS * 0.08, shear * 0.1])
    pose = start(geometry)
    for i, strain in enumerate([0.1, -0.2, 0.05, 0.6, -0.7, 0.9]):
        here = pose.copy()
        if i < 3:
            here[1, i] += strain * length
        else:  # turn about an axis of the section, with the chord of the arc
            axis = np.eye(3)[i - 3]
            here[1, 3:] = Rotation.from_rotvec(strain * length * axis).as_quat()
            if i < 5:
                here[1] = arc_pose(strain, length, i - 3)
        measured, resultant, energy = element.response(here)
        expected = np.eye(6)[i] * strain
        np.testing.assert_allclose(measured[0, 0], expected + geometry.rest[0], atol=1e-14)
        np.testing.assert_allclose(resultant[0, 0], stiffness * expected, atol=1e-13 * YOUNGS)
        np.testing.assert_allclose(energy[0, 0], 0.5 * length * stiffness[i] * strain**2, rtol=1e-12)


def arc_pose(curvature: float, length: float, axis: int) -> np.ndarray:
    """End of an arc that starts along z and turns about local x (0) or y (1)."""
    angle = curvature * length
    side = (1.0 - np.cos(angle)) / curvature
    x = [side, 0.0, np.sin(angle) / curvature] if axis else [0.0, -side, np.sin(angle) / curvature]
    return np.append(x, Rotation.from_rotvec(angle * np.eye(3)[axis]).as_quat())


def chain(strain: np.ndarray, length: float, count: int) -> np.ndarray:
    """Exact poses of a rod of constant strain (Gamma, kappa), from the matrix exponential of its rigid motion."""
    gamma, kappa = strain[:3], strain[3:]
    twist = np.zeros((4, 4))
    twist[:3, :3] = np.cross(np.eye(3), kappa)
    twist[:3, 3] = gamma
    motions = [expm(twist * s) for s in np.linspace(0.0, length, count + 1)]
    return np.stack([np.append(g[:3, 3], Rotation.from_matrix(g[:3, :3]).as_quat()) for g in motions])


@pytest.mark.parametrize(("turns", "count"), [(1.0, 3), (1.0, 20), (2.0, 20)])
def test_roll_up_is_exact(turns: float, count: int) -> None:
    """M = 2 pi turns EI / L bends a rod into closed circles: constant moment, no force, at any number of segments."""
    length, radius = 1.0, 0.01
    geometry = meshing.rod_geometry(meshing.straight(length, count), radius=radius)
    curvature = 2.0 * np.pi * turns / length
    pose = chain(np.array([0.0, 0.0, 1.0, 0.0, curvature, 0.0]), length, count)
    np.testing.assert_allclose(pose[-1, :3], 0.0, atol=1e-14)
    element = Rod(geometry)
    moment = YOUNGS * np.pi / 4.0 * radius**4 * curvature
    force = element.element(pose)[0][0]
    scale = YOUNGS * np.pi * radius**2
    np.testing.assert_allclose(force[:, :3], 0.0, atol=1e-12 * scale)
    np.testing.assert_allclose(force[:, 9:], np.tile([0.0, moment, 0.0], (count, 1)), atol=1e-13 * scale)


def test_helix_of_intrinsic_curvature_rests() -> None:
    """Strain u = (u1, u2, u3): radius k / (k^2 + u3^2), pitch 2 pi u3 / (k^2 + u3^2), k^2 = u1^2 + u2^2; no force."""
    u, length, count = np.array([12.0, -5.0, 8.0]), 0.6, 12
    pose = chain(np.concatenate([[0.0, 0.0, 1.0], u]), length, count)
    square = float(u @ u)
    radius, pitch = 13.0 / square, 2.0 * np.pi * 8.0 / square
    axis = Rotation.from_quat(pose[0, 3:]).apply(u) / np.sqrt(square)
    rise = np.ptp((pose[:, :3] - pose[0, :3]) @ axis)
    assert rise == pytest.approx(pitch * length * np.sqrt(square) / (2.0 * np.pi), rel=1e-12)
    across = pose[:, :3] - np.outer(pose[:, :3] @ axis, axis)
    centre = circle_centre(across, axis)
    np.testing.assert_allclose(np.linalg.norm(across - centre, axis=1), radius, rtol=1e-10)
    geometry = meshing.rod_geometry(meshing.straight(length, count), radius=0.002, curvature=u)
    force = Rod(geometry).element(pose)[0]
    np.testing.assert_allclose(force, 0.0, atol=1e-13 * YOUNGS * np.pi * 0.002**2)


def circle_centre(points: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Centre of the circle through points of a plane, by least squares."""
    rows = np.append(2.0 * (points[1:] - points[0]), [normal], axis=0)
    rhs = np.append((points[1:] ** 2).sum(axis=1) - (points[0] ** 2).sum(), normal @ points[0])
    return np.linalg.lstsq(rows, rhs, rcond=None)[0]


def test_curved_rods_rest_where_they_are_made() -> None:
    """Without intrinsic curvature the given points are free of stress, and frames do not turn about the tangent."""
    geometry = meshing.rod_geometry(meshing.helix(0.05, 0.03, 2.0, 40), radius=0.004)
    force = Rod(geometry).element(start(geometry))[0]
    np.testing.assert_allclose(force, 0.0, atol=1e-12 * YOUNGS * np.pi * 0.004**2)
    arc_length = 2.0 * 2.0 * np.pi * np.hypot(0.05, 0.03 / (2.0 * np.pi))
    assert geometry.length.sum() == pytest.approx(arc_length, rel=2e-4)
    np.testing.assert_allclose(geometry.rest[:, 5], 0.0, atol=0.2)  # 1/m; the torsion of the centre line is 1.9


def many(rng: np.random.Generator, worlds: int) -> tuple[RodGeometry, np.ndarray]:
    """A curved rod and poses near it in many worlds."""
    geometry = meshing.rod_geometry(meshing.helix(0.5, 0.3, 0.7, 6), radius=0.1, inner_radius=0.05)
    pose = start(geometry)
    size = [0.02] * 3 + [0.3] * 3
    return geometry, np.stack([moved(pose, size * rng.standard_normal((7, 6))) for _ in range(worlds)])


@pytest.mark.parametrize(
    ("name", "project"),
    [
        ("scalar", False),
        ("lanes", True),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in (("scalar", True), ("lanes", False))),
    ],
)
def test_float32_and_lanes_agree_with_float64(name: str, project: bool, rng: np.random.Generator) -> None:
    """Differences are those of rounding poses and arithmetic to float32: 1e-7, times a few."""
    geometry, pose = many(rng, 11)
    pose = pose.astype(np.float32)
    reference = Rod(geometry, worlds=11, project=project)
    element = Rod(geometry, name, "float32", worlds=11, project=project)
    for found, expected in zip(element.element(pose), reference.element(pose), strict=True):
        np.testing.assert_allclose(found, expected, atol=3e-6 * np.abs(expected).max())
    strain, resultant, energy = element.response(pose)
    strain64, resultant64, energy64 = reference.response(pose)
    np.testing.assert_allclose(strain, strain64, atol=1e-5)
    np.testing.assert_allclose(resultant, resultant64, atol=1e-5 * np.abs(resultant64).max())
    np.testing.assert_allclose(energy, energy64, rtol=1e-4)


@pytest.mark.parametrize("name", ["scalar", "lanes"])
def test_worlds_do_not_touch(name: str, rng: np.random.Generator) -> None:
    """A world has the same bits whatever its neighbours hold."""
    geometry, pose = many(rng, 9)
    together = Rod(geometry, name, "float32", worlds=9).element(pose)
    pose[:3] = np.nan
    pose[4:] = pose[3]
    alone = Rod(geometry, name, "float32", worlds=9).element(pose)
    for a, b in zip(together, alone, strict=True):
        np.testing.assert_array_equal(a[3], b[3])
        np.testing.assert_array_equal(b[8], b[3])


@pytest.mark.parametrize("angle", [0.0, 1e-7, 1e-5, 1e-3, 0.1, 1.0, 2.5])
@pytest.mark.parametrize("name", ["scalar", "lanes"])
def test_float32_is_accurate_at_small_angles(name: str, angle: float) -> None:
    """From the unturned frame kappa L has the relative error of float32, however small, and a turned pair 2e-7 rad."""
    geometry = single()
    element = Rod(geometry, name, "float32")
    axis = np.array([2.0, -1.0, 2.0]) / 3.0
    pose = start(geometry)
    pose[1, 3:] = Rotation.from_rotvec(angle * axis).as_quat()
    pose = pose.astype(np.float32)
    exact = Rotation.from_quat(pose[1, 3:].astype(np.float64)).as_rotvec()
    strain = element.response(pose)[0][0, 0]
    np.testing.assert_allclose(strain[3:] * 0.8, exact, rtol=5e-7, atol=0.0)
    turned = moved(pose.astype(np.float64), np.tile([0.0, 0.0, 0.0, 0.4, 1.1, -0.8], (2, 1)))
    np.testing.assert_allclose(element.response(turned)[0][0, 0, 3:] * 0.8, angle * axis, atol=3e-7)


def assemble(element: Rod, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Force (6 n) and stiffness (6 n, 6 n) of a rod."""
    forces, matrices = (part[0] for part in element.element(pose))
    total, matrix = np.zeros(6 * len(pose)), np.zeros((6 * len(pose),) * 2)
    for e, (force, stiffness) in enumerate(zip(forces, matrices, strict=True)):
        span = slice(6 * e, 6 * e + 12)
        total[span] += force
        matrix[span, span] += stiffness
    return total, matrix


def equilibrium(element: Rod, load: np.ndarray, steps: int) -> tuple[np.ndarray, int]:
    """Poses under a dead load (6,) on the last node, the first clamped, and the Newton iterations they took."""
    pose = start(element.geometry)
    iterations = 0
    for k in range(1, steps + 1):
        for _ in range(40):
            force, matrix = assemble(element, pose)
            rest = -force
            rest[-6:] += load * k / steps
            if np.linalg.norm(rest[6:]) < 1e-7 * np.linalg.norm(load):
                break
            change = np.append(np.zeros(6), np.linalg.solve(matrix[6:, 6:], rest[6:]))
            pose = moved(pose, change.reshape(-1, 6))
            iterations += 1
        else:
            raise AssertionError(f"no equilibrium at load step {k} of {steps}")
    return pose, iterations


def stiff_section(rigidity: np.ndarray) -> np.ndarray:
    """Section with the stiffnesses EA, GA_s, EI_1, EI_2, GJ at nu = 0."""
    shear = YOUNGS / 2.0
    return rigidity / [YOUNGS, shear, YOUNGS, YOUNGS, shear]


@pytest.mark.parametrize("project", [True, False])
@pytest.mark.parametrize(("alpha", "drop"), [(1.0, 0.301721), (10.0, 0.810609)])
def test_elastica(alpha: float, drop: float, project: bool) -> None:
    """Tip of a cantilever under a dead transverse load alpha EI / L^2 (Bisshopp, Drucker, 1945); 20 segments, 1e-3."""
    section = stiff_section(np.array([1e5, 1e5, 1.0, 1.0, 1.0]))
    geometry = meshing.rod_geometry(meshing.straight(1.0, 20), radius=0.01, section=section)
    pose, _ = equilibrium(Rod(geometry, nu=0.0, project=project), np.array([alpha, 0.0, 0.0, 0.0, 0.0, 0.0]), 10)
    assert pose[-1, 0] == pytest.approx(drop, rel=1e-3)


def test_bend_of_45_degrees() -> None:
    """Bathe and Bolourchi (1979), converged tips of the validation catalogue (4.3); second order, 0.15 % at 8."""
    reference = np.array([47.15044, 15.68480, 53.47486])
    section = stiff_section(np.array([1e7, 5e6, 1e7 / 12.0, 1e7 / 12.0, 5e6 / 6.0]))
    errors = []
    for count in (8, 16):
        points = meshing.arc(100.0, np.pi / 4.0, count, tangent=(1.0, 0.0, 0.0), normal=(0.0, 1.0, 0.0))
        element = Rod(meshing.rod_geometry(points, radius=0.5, section=section), nu=0.0, project=False)
        pose, iterations = equilibrium(element, np.array([0.0, 0.0, 600.0, 0.0, 0.0, 0.0]), 10)
        assert iterations <= 70  # quadratic convergence: at most seven per load step
        errors.append(np.abs(pose[-1, :3] - reference).max() / 100.0)
    assert errors[0] < 2e-3
    assert errors[1] < 0.3 * errors[0]
