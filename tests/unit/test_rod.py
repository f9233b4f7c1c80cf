"""Rod segments: energy, forces, stiffness, invariance, precision; and the geometry of rods.

Reference: docs/theory/rod.md and the rod section of the validation catalogue (docs/validation.md).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from softwarp import meshing
from softwarp.kernels import rod
from softwarp.kernels.lanes import variant
from softwarp.meshing import RodGeometry
from softwarp.solvers.rows import allocate

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
    ) -> None:
        self.variant = variant(name, precision)
        self.kernels = rod.kernels(self.variant, project)
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
        self.pose = self.rows(7 * (count + 1))

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
        inputs = [0, *model, self.youngs.S, self.nu.S, self.pose.S]
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
        self.launch(self.kernels.strain, [self.frame, self.length, self.pose.S], [strain.S])
        model = [self.rod, self.length, self.section, self.scale, self.rest]
        self.launch(self.kernels.resultant, [*model, self.youngs.S, self.nu.S, strain.S], [resultant.S, energy.S])
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
