"""Scenes, laws and small geometry that several tests share. SI units, z up.

The box meshes are the Kuhn meshes of the validation catalogue, section 0 (docs/validation.md): node
``i + (nx + 1)(j + (ny + 1) k)``, six tets per cell around the diagonal from its lowest to its highest corner.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import meshing

# The catalogue's names of the energies. "large" is no law of its own: it is corot's force with another rotation.
LAWS: dict[str, Callable[[float, float], Any]] = {
    "corot": partial(sw.Corotational, method="polar"),
    "stvk": sw.StVenantKirchhoff,
    "nh_log": sw.NeoHookean,
    "snh": sw.StableNeoHookean,
}


def _yeoh(youngs: float, nu: float) -> Any:
    """With a negative c20, near the bound of stability -sqrt(3 c10 c30) = -0.095 c10."""
    c10 = 0.5 * lame(youngs, nu)[0]
    return sw.Yeoh.with_nu(nu, c10=c10, c20=-0.02 * c10, c30=0.003 * c10)


def _mooney_rivlin(youngs: float, nu: float) -> Any:
    """A quarter of the shear modulus from the second invariant."""
    half = 0.5 * lame(youngs, nu)[0]
    return sw.MooneyRivlin.with_nu(nu, c10=0.75 * half, c01=0.25 * half)


def _ogden(youngs: float, nu: float) -> Any:
    """Three terms, one with a negative exponent."""
    mu = lame(youngs, nu)[0]
    terms = {"mu_1": 0.75 * mu, "alpha_1": 1.3, "mu_2": 0.15 * mu, "alpha_2": 5.0, "mu_3": 0.1 * mu, "alpha_3": -2.0}
    return sw.Ogden.with_nu(nu, **terms)


# Laws with parameters of their own, scaled so that their moduli at small strain are the given ones.
FITTED: dict[str, Callable[[float, float], Any]] = {"yeoh": _yeoh, "mooney_rivlin": _mooney_rivlin, "ogden": _ogden}


def in_both_precisions(laws: Iterable[str], double: float, single: float) -> list[Any]:
    """Laws with a precision and its tolerance: float64 proves every law, float32 the variant with one; others are slow.

    A law takes the compiler two seconds in float32.
    """
    quick = [(law, "float64", double) for law in laws]
    return [
        *quick,
        *(pytest.param(law, "float32", single, marks=() if law == "nh_log" else pytest.mark.slow) for law, *_ in quick),
    ]


def quick(combinations: Iterable[tuple[Any, ...]], is_quick: Callable[..., bool]) -> list[Any]:
    """Cases of a test, of which those are slow that ``is_quick`` denies."""
    return [pytest.param(*values, marks=() if is_quick(*values) else pytest.mark.slow) for values in combinations]


def in_float64(names: str, values: Iterable[Any], single: int = 0) -> pytest.MarkDecorator:
    """Cases of a law in float64, whose tolerance is sharper, and one of them in float32 too; the others there are slow.

    Args:
        names: Of the values, as ``parametrize`` takes them; ``precision`` comes behind them.
        values: Of each case.
        single: Case that is quick in float32, too.
    """
    rows = [value if isinstance(value, tuple) else (value,) for value in values]
    pairs = [(*row, precision) for row in rows for precision in ("float64", "float32")]
    return pytest.mark.parametrize(
        f"{names}, precision", quick(pairs, lambda *pair: pair[-1] == "float64" or pair[:-1] == rows[single])
    )


def lame(youngs: float, nu: float) -> tuple[float, float]:
    """Shear modulus and first Lame constant [Pa]."""
    return youngs / (2.0 * (1.0 + nu)), youngs * nu / ((1.0 + nu) * (1.0 - 2.0 * nu))


def material(law: str, youngs: float, nu: float) -> Any:
    """A law by its catalogue name, or a ``method`` of the corotational law: ``large`` or ``warped``."""
    if law in ("large", "warped"):
        return sw.Corotational(youngs, nu, method=law)
    return (LAWS | FITTED)[law](youngs, nu)


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    """A rotation matrix, uniform enough: Q of the QR factorisation with its determinant made +1."""
    Q, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    return Q * np.linalg.det(Q)


@dataclass
class Case:
    """A simulation of one meshed body, with its rest geometry in float64."""

    sim: sw.Simulation
    mesh: meshing.TetMesh

    def node(self, point: tuple[float, float, float]) -> int:
        """The node nearest to a rest position [m]."""
        return int(np.argmin(np.linalg.norm(self.mesh.nodes - np.asarray(point), axis=1)))

    def positions(self, world: int = 0) -> np.ndarray:
        """Node positions [m], (node, 3), float64 copy."""
        return self.sim.node_x[world].double().cpu().numpy().copy()

    def displacements(self, world: int = 0) -> np.ndarray:
        """Node displacements from rest [m], (node, 3)."""
        return self.positions(world) - self.mesh.nodes

    def move(self, positions: np.ndarray) -> None:
        """Put every world's nodes, fixed ones included, to ``positions`` [m], at rest."""
        self.sim.node_x.copy_(tensor(self.sim, positions).expand_as(self.sim.node_x))
        self.sim.node_v.zero_()
        self.sim.refresh()

    def load(self, forces: np.ndarray) -> None:
        """Dead nodal forces [N], (node, 3), in every world."""
        self.sim.control.node_force.copy_(tensor(self.sim, forces).expand_as(self.sim.control.node_force))

    def internal_force(self) -> np.ndarray:
        """dE/dx [N] of world 0, (node, 3)."""
        return self.sim.internal_force()[0].double().cpu().numpy()

    @property
    def free(self) -> np.ndarray:
        """Nodes that move, bool (node,)."""
        return ~np.asarray(self.sim.model.node_fixed)


def tensor(sim: sw.Simulation, values: np.ndarray) -> torch.Tensor:
    """An array in the simulation's precision and on its device."""
    return torch.as_tensor(np.ascontiguousarray(values), dtype=sim.node_x.dtype, device=sim.node_x.device)


def body(
    mesh: Any,
    law: str,
    youngs: float,
    nu: float,
    *,
    density: float = 1000.0,
    gravity: tuple[float, float, float] = (0.0, 0.0, 0.0),
    fixed: np.ndarray | None = None,
    rayleigh: tuple[float, float] = (0.0, 0.0),
    num_worlds: int = 1,
    precision: str = "float64",
    device: str = "cpu",
    **options: Any,
) -> Case:
    """One body, its nodes ``fixed`` (indices or mask) held, ``options`` passed to ``Simulation``.

    ``mesh`` is a ``TetMesh`` or a ``QuadraticMesh``; of the latter the case keeps the linear tets between its nodes.
    """
    builder = sw.ModelBuilder(gravity=gravity)
    tets = builder.add_tets(mesh, material=material(law, youngs, nu), density=density, rayleigh=rayleigh)
    if fixed is not None:
        nodes = np.asarray(fixed)
        builder.fix(tets, nodes=np.flatnonzero(nodes) if nodes.dtype == bool else nodes)
    model = builder.finalize(num_worlds=num_worlds, device=device, precision=precision)
    return Case(sw.Simulation(model, **options), builder.bodies[tets].mesh)


def on_plane(mesh: Any, axis: int, value: float) -> np.ndarray:
    """Nodes on the plane ``x_axis = value``, bool (node,)."""
    return np.abs(mesh.nodes[:, axis] - value) < 1e-9


def boundary(mesh: meshing.TetMesh) -> np.ndarray:
    """Nodes of the surface, bool (node,)."""
    mask = np.zeros(len(mesh.nodes), dtype=bool)
    mask[mesh.surface()] = True
    return mask


def area_vectors(mesh: meshing.TetMesh, on: np.ndarray | None = None) -> np.ndarray:
    """Integral of N_a n dA over the rest surface, (node, 3) [m^2]: a third of each incident triangle's area vector.

    With ``on`` (bool, node) only triangles with all three corners in it count. A dead traction t = P n gives the
    consistent nodal forces P times this.
    """
    triangles = mesh.surface()
    if on is not None:
        triangles = triangles[on[triangles].all(axis=1)]
    corner = mesh.nodes[triangles]
    area = 0.5 * np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    vectors = np.zeros_like(mesh.nodes)
    np.add.at(vectors, triangles.ravel(), np.repeat(area / 3.0, 3, axis=0))
    return vectors


def traction(mesh: meshing.TetMesh, on: np.ndarray, force: tuple[float, float, float]) -> np.ndarray:
    """A dead total ``force`` [N] spread evenly over the area of the flat face ``on``, (node, 3)."""
    weight = np.linalg.norm(area_vectors(mesh, on), axis=1)
    return np.outer(weight / weight.sum(), force)


def jittered(mesh: meshing.TetMesh, amount: float, rng: np.random.Generator) -> meshing.TetMesh:
    """The mesh with its inner nodes moved by up to ``amount`` [m] along each axis."""
    shift = rng.uniform(-amount, amount, mesh.nodes.shape)
    shift[boundary(mesh)] = 0.0
    return meshing.TetMesh(mesh.nodes + shift, mesh.tets, mesh.name)


def cantilever(
    cells: tuple[int, int, int], law: str, *, youngs: float = 1.0e6, nu: float = 0.3, **options: Any
) -> Case:
    """Box 1.0 x 0.1 x 0.1 m along x, clamped at x = 0 (catalogue 2.1)."""
    mesh = meshing.box((1.0, 0.1, 0.1), cells)
    return body(mesh, law, youngs, nu, fixed=on_plane(mesh, 0, 0.0), **options)


def end_loaded_cantilever(cells: tuple[int, int, int], law: str, force: float, **options: Any) -> Case:
    """The cantilever with a dead end load (0, 0, -force) [N], a uniform traction on the face x = 1 m."""
    case = cantilever(cells, law, **options)
    case.load(traction(case.mesh, on_plane(case.mesh, 0, 1.0), (0.0, 0.0, -force)))
    return case


TIP = (1.0, 0.05, 0.05)
