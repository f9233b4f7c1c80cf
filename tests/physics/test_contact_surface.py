"""A contact surface apart from the elements: coarser or finer skins, and points, against what the boundary gives."""

import itertools
from typing import Any

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import meshing
from softwarp.meshing import MeshError, SurfaceMesh, TetMesh
from tests import cases

SIZE = (0.04, 0.04, 0.02)  # m
SOFT: dict[str, Any] = {
    "material": sw.Corotational(1e5, 0.3, method="large"),
    "density": 1000.0,
    "rayleigh": (2.0, 0.01),
}
WEIGHT = 1000.0 * 0.04 * 0.04 * 0.02 * 9.81


def block(cells: int) -> TetMesh:
    return meshing.box(SIZE, (cells, cells, cells // 2))


def skin(cells: int) -> SurfaceMesh:
    """Boundary of a block of so many cells, above z = 0."""
    mesh = block(cells)
    triangles = meshing.tet_surface(mesh.tets)
    used, corner = np.unique(triangles, return_inverse=True)
    return SurfaceMesh(mesh.nodes[used], corner.reshape(-1, 3))


def lifted(surface: Any, height: float) -> Any:
    if isinstance(surface, SurfaceMesh):
        return SurfaceMesh(surface.nodes + (0.0, 0.0, height), surface.triangles)
    return None if surface is None else surface + (0.0, 0.0, height)


def rest(
    surface: Any, on: str, height: float = 1e-4, precision: str = "float32", below: Any = None, **options: Any
) -> tuple[sw.Simulation, Any, Any]:
    """A block of 4 cells with a contact surface that falls on a plane, a box or another block, after one second."""
    builder = sw.ModelBuilder()
    if on == "soft":
        under: Any = builder.add_tets(block(4), contact_surface=below, **SOFT)
        builder.fix(under, box=((-1, -1, -1), (1, 1, 1e-6)))
        height += SIZE[2]
    elif on == "box":
        under = builder.add_rigid(sw.Box((0.1, 0.1, 0.02)), kinematic=True, pose=(0.02, 0.02, -0.01))
    else:
        under = builder.add_rigid(sw.Plane(), kinematic=True)
    mesh = block(4)
    upper = TetMesh(mesh.nodes + (0.0, 0.0, height), mesh.tets)
    body = builder.add_tets(upper, contact_surface=lifted(surface, height), **SOFT)
    builder.add_contact(body, under, mu=0.5)
    sim = sw.Simulation(builder.finalize(2, precision=precision, contact_capacity=220), dt=0.01, **options)
    for _ in range(100):
        sim.step()
    assert bool((sim.status == sw.Status.OK).all())
    return sim, body, under


@pytest.mark.parametrize(
    ("on", "path"),
    cases.quick(
        itertools.product(("plane", "box", "soft"), ("scalar", "lanes")),
        lambda on, path: path == "scalar" or on == "plane",
    ),
)
def test_the_boundary_as_a_surface_of_its_own_changes_nothing(on: str, path: str) -> None:
    """The skin of the same mesh has one carrier a point: places and forces are those of the boundary."""
    plain, body, under = rest(None, on, solver_path=path)
    own, _, _ = rest(skin(4), on, solver_path=path)
    assert torch.equal(plain.contact_count, own.contact_count)
    torch.testing.assert_close(own.node_x, plain.node_x, rtol=0.0, atol=2e-7)
    forces = [sim.contact_force(body, under)[:, 2] for sim in (plain, own)]
    np.testing.assert_allclose(torch.stack(forces), WEIGHT, rtol=2e-3)


@pytest.mark.parametrize(
    ("on", "cells"),
    cases.quick(itertools.product(("plane", "soft"), (2, 8)), lambda on, cells: (on, cells) != ("soft", 8)),
)
def test_coarser_and_finer_skins_carry_the_weight(cells: int, on: str) -> None:
    """Flat faces stay flat whatever the spacing: height, weight and moments agree, contacts are fewer or more."""
    plain, body, under = rest(None, on)
    own, _, _ = rest(skin(cells), on)
    count = [int(sim.contact_count[0]) for sim in (plain, own)]
    assert count[1] < count[0] if cells < 4 else count[1] > count[0]
    np.testing.assert_allclose(own.contact_force(body, under)[:, 2], WEIGHT, rtol=2e-3)
    top = own.node_x[0].amax(dim=0)[2] - plain.node_x[0].amax(dim=0)[2]
    assert abs(float(top)) < 2e-5
    there = own.contact_pair[0] >= 0
    centre = (own.contact_point[0, there] * own.contact_load[0, there, 2:]).sum(dim=0) / WEIGHT
    np.testing.assert_allclose(centre[:2], [0.02, 0.02], atol=1e-4)


def test_two_skins_on_each_other() -> None:
    """Both bodies with skins of their own, 12 carriers a face."""
    own, body, under = rest(skin(2), "soft", below=skin(2))
    np.testing.assert_allclose(own.contact_force(body, under)[:, 2], WEIGHT, rtol=2e-3)
    assert int(own.contact_count[0]) < 60


@pytest.mark.parametrize("on", ["plane", "box", "soft"])
def test_three_points_carry_the_body_as_statics_demand(on: str) -> None:
    """Three feet between nodes: three contacts, whose loads balance force and moments about the centre of mass."""
    feet = np.array([[0.007, 0.009, 0.0], [0.033, 0.012, 0.0], [0.019, 0.034, 0.0]])
    own, body, under = rest(feet, on, precision="float64")
    there = own.contact_pair[0] >= 0
    loads = own.contact_load[0, there, 2].numpy()
    assert (loads > 1e-4).sum() == 3
    shares = np.linalg.solve(np.vstack([feet[:, :2].T, np.ones(3)]), [0.02, 0.02, 1.0])
    np.testing.assert_allclose(loads[loads > 1e-4] / WEIGHT, shares, atol=0.01)
    np.testing.assert_allclose(own.contact_force(body, under)[0, 2], WEIGHT, rtol=1e-3)


def test_state_and_fingerprint_know_the_surface() -> None:
    """A snapshot fits the same surface only."""
    own, _, _ = rest(skin(2), "plane")
    again, _, _ = rest(skin(2), "plane")
    again.restore(own.snapshot())
    other, _, _ = rest(skin(4), "plane")
    with pytest.raises(ValueError, match="another scene"):
        other.restore(own.snapshot())


@pytest.mark.parametrize(
    ("surface", "message"),
    [
        (np.zeros((3, 2)), r"contact_surface: points must have shape \(point, 3\)"),
        (np.zeros((0, 3)), "contact_surface: has no points"),
        (np.full((2, 3), np.nan), "contact_surface: point 0 is not finite"),
        (np.full((2, 3), 1.0), "contact_surface: point 0 .* outside the mesh"),
        (SurfaceMesh(skin(2).nodes, skin(2).triangles[:, ::-1]), "look inwards; swap two corners"),
        ((np.zeros((3, 3)), np.zeros((0, 3), dtype=int)), "contact_surface.*triangle"),
        ("nowhere.stl", "nowhere.stl"),
        (7, "contact_surface"),
    ],
)
def test_refusals(surface: Any, message: str) -> None:
    with pytest.raises((MeshError, TypeError, FileNotFoundError), match=message):
        sw.ModelBuilder().add_tets(block(2), contact_surface=surface, **SOFT)
