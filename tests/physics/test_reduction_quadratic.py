"""Reduced bodies of quadratic elements: Gauss points that stand for all, the full model with all modes, files."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import meshing, reduction
from softwarp.meshing import quadratic
from softwarp.reduction.elements import elements_of

BOX = meshing.box((0.06, 0.03, 0.012), (2, 1, 1))
SLAB = quadratic.elevate(BOX)
BENT = quadratic.elevate(BOX, project=lambda x: x + np.outer(np.sin(60.0 * x[:, 0]), (0.0, 0.0, 5e-4)))
LONG = quadratic.elevate(meshing.box((0.06, 0.03, 0.012), (4, 2, 1)))  # of what is trained
AIR = meshing.box((0.04, 0.02, 0.006), (2, 2, 1))
WHOLE = {
    "held": ({"held": True}, "float64", 1, {}),
    "curved": ({"held": True, "mesh": BENT}, "float64", 1, {}),
    "contact": ({"held": False}, "float64", 1, {}),
    "one world": ({"held": False}, "float32", 1, {}),
    "lanes": ({"held": False, "law": sw.NeoHookean(1e5, 0.3)}, "float32", 8, {}),
    "polar": ({"held": True, "law": sw.Corotational(1e5, 0.3, method="polar")}, "float64", 1, {"integrator": "bdf2"}),
}
SLOW = {"lanes", "polar", "curved"}


def scene(*, held, law=None, mesh=SLAB):
    """A slab with a chamber and a cable, held at one end or free on a floor; not reduced yet."""
    builder = sw.ModelBuilder()
    slab = builder.add_tets(
        mesh,
        material=law or sw.Corotational(1e5, 0.3, method="large"),
        density=1000.0,
        rayleigh=(0.1, 0.01),
        name="slab",
    )
    if held:
        builder.fix(slab, nodes=np.flatnonzero(mesh.nodes[:, 0] < 1e-9))
    builder.add_cavity(slab, *meshing.compact(AIR.nodes + (0.01, 0.005, 0.003), AIR.surface()), control="volume")
    builder.add_cable(slab, [(x, 0.015, 0.009) for x in (0.06, 0.03, 0.0)], name="cable")
    builder.add_marker(slab, (0.06, 0.015, 0.006), name="tip")
    if not held:
        floor = builder.add_rigid(sw.Plane(), kinematic=True, pose=(0.0, 0.0, -0.002), name="floor")
        builder.add_contact(slab, floor, mu=0.7, alarm_distance=0.003, contact_distance=0.0005)
    return builder


def simulation(builder, worlds=1, precision="float64", **options):
    return sw.Simulation(builder.finalize(worlds, precision=precision), dt=0.01, **options)


def run(sim, steps):
    """The chamber grows and the cable shortens."""
    rest = float(sim.model.cavities.rest_volume[0])
    for step in range(steps):
        sim.control.cavity_volume.fill_(rest * 1.01 ** (step + 1))
        sim.control.cable_displacement.fill_(1e-4 * step)
        sim.step()


def reduced_by(modes, mesh=SLAB, weight=None):
    """A reduction of the slab to some modes, with all Gauss points unless weights are given."""
    return reduction.Reduction(
        name="slab",
        nodes=mesh.nodes,
        tets=quadratic.split(mesh.nodes, mesh.elements),
        modes=modes,
        rigid=0,
        singular_values=np.ones(len(modes)),
        tet_weight=np.ones(4 * len(mesh.elements)) if weight is None else weight,
        element="p2",
    )


def every_node(held, mesh=SLAB):
    """As many modes as the slab has unknowns: one node along one axis each."""
    free = np.flatnonzero(mesh.nodes[:, 0] > 1e-9) if held else np.arange(len(mesh.nodes))
    modes = np.zeros((3 * len(free), len(mesh.nodes), 3))
    modes[np.arange(3 * len(free)), np.repeat(free, 3), np.tile(np.arange(3), len(free))] = 1.0
    return modes


@pytest.mark.parametrize("case", [pytest.param(case, marks=pytest.mark.slow if case in SLOW else ()) for case in WHOLE])
def test_all_modes_give_the_full_model(case):
    """As many modes as unknowns, every Gauss point once: 20 steps of both models agree to rounding."""
    parts, precision, worlds, options = WHOLE[case]
    mesh = parts.get("mesh", SLAB)
    builders = [scene(**parts) for _ in range(2)]
    builders[1].reduce(0, reduced_by(every_node(parts["held"], mesh), mesh))
    full, small = (simulation(builder, worlds, precision, **options) for builder in builders)
    for sim in (full, small):
        run(sim, 20)
    tolerance, count = 2e-10 if precision == "float64" else 1e-6, len(mesh.nodes)
    assert float((full.node_x - full.node_x.new_tensor(mesh.nodes)).abs().max()) > 1e-3
    torch.testing.assert_close(small.node_x[:, :count], full.node_x, rtol=0.0, atol=tolerance)
    torch.testing.assert_close(small.marker_v, full.marker_v, rtol=0.0, atol=1e3 * tolerance)
    torch.testing.assert_close(small.cavity_pressure, full.cavity_pressure, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(small.mass[:, :count], full.mass)
    assert float(small.mass[:, count:].abs().max()) == 0.0  # corners of the points' tets, none on the surface
    if mesh is SLAB:
        inner = small.model.node_rest[count:]
        assert (np.minimum(inner, (0.06, 0.03, 0.012) - inner) > 1e-4).all()
    if not parts["held"]:
        assert torch.equal(small.contact_count, full.contact_count)
        assert int(full.contact_count.min()) > 0


@pytest.fixture(scope="module")
def trained():
    """Motion of the held slab under chamber and cable, and a reduction to a few Gauss points."""
    sim = simulation(scene(held=True, mesh=LONG), 4)
    rest = float(sim.model.cavities.rest_volume[0])
    ranges = {"cables": {"cable": (0.0, 0.004)}, "cavities": {sim.model.cavity_names[0]: (rest, 1.3 * rest)}}
    motion = reduction.record(sim, reduction.sweep(sim, hold=20, **ranges), 80, every=2)
    return motion, reduction.train(sim, motion, modes=8, element_tolerance=0.02, states=24, rigid="none"), ranges


def test_gauss_points_carry_the_forces_of_the_elements():
    """Forces of single points, by their corners' weights, sum up to the elements'; all on modes to the projection."""
    sim = simulation(scene(held=True))
    found = elements_of(sim, 0, slice(0, len(SLAB.nodes)))
    moved = SLAB.nodes + 2e-4 * np.random.default_rng(2).normal(size=SLAB.nodes.shape)
    (points,), (whole,) = next(found.at(moved[None])), next(found.whole(moved[None]))
    weights = quadratic.corner_weights()
    spread = np.einsum("qka,eqkc->eac", weights, points.reshape(-1, 4, 4, 3))
    np.testing.assert_allclose(spread, whole.reshape(-1, 10, 3), atol=1e-12 * np.abs(whole).max())
    modes = np.random.default_rng(3).normal(size=(5, *SLAB.nodes.shape))
    (table,) = found.tables(modes)
    on_modes = np.einsum("pmc,pc->m", table, points)
    np.testing.assert_allclose(
        on_modes, np.einsum("meac,eac->m", modes[:, SLAB.elements], whole.reshape(-1, 10, 3)), rtol=1e-5
    )


def test_training_chooses_gauss_points(trained, tmp_path):
    """Fewer than a third of the points follow unseen commands; a compact file holds them for this mesh alone."""
    _, small, ranges = trained
    points, _ = small.singles
    assert small.element == "p2" and 3 * points < small.element_count == 4 * len(LONG.elements)
    assert f"{points} of {small.element_count} Gauss points" in small.told()
    assert small.places.shape == (small.element_count, 3)
    small.save(tmp_path / "slab.npz", compact=True)
    mesh = LONG.linear()
    loaded = reduction.Reduction.load(tmp_path / "slab.npz", mesh)
    builders = [scene(held=True, mesh=LONG) for _ in range(2)]
    builders[1].reduce(0, loaded)
    full, reduced = (simulation(builder, 2) for builder in builders)
    drives = [reduction.sweep(sim, hold=15, seed=9, **ranges) for sim in (full, reduced)]
    found = reduction.deviation(full, reduced, *drives, 60)
    assert found.relative < 0.04
    assert float(found.travel[-1]) > 5e-4


def test_elements_must_be_those_of_the_scene(trained):
    """A reduction of linear tets, one of quadratic ones in a linear scene, a floating frame: refused by name."""
    _, small, _ = trained
    linear = sw.ModelBuilder()
    body = linear.add_tets(LONG.linear(), material=sw.NeoHookean(1e5, 0.3), density=1e3, name="slab")
    with pytest.raises(ValueError, match="body 'slab' has elements 'p1', and the reduction was made with 'p2'"):
        linear.reduce(body, small)
    with pytest.raises(ValueError, match=r"quadratic elements.*no floating frame"):
        replace(small, frame="floating")
    sim = simulation(scene(held=False, mesh=LONG))
    with pytest.raises(ValueError, match="quadratic tets, which a fixed frame alone takes"):
        reduction.train(sim, trained[0], frame="floating")


@pytest.mark.parametrize("element", ["p1", "p2"])
def test_a_ball_rests_on_a_reduced_body(element):
    """A free body gets all of the contact's force, also what the solver begins with: as on nodes, it carries 19.6 N."""
    box = meshing.box((0.04, 0.04, 0.006), (2, 2, 1))
    mesh = box if element == "p1" else quadratic.elevate(box)
    free = np.flatnonzero(mesh.nodes[:, 2] > 1e-9)
    modes = np.zeros((3 * len(free), len(mesh.nodes), 3))
    modes[np.arange(3 * len(free)), np.repeat(free, 3), np.tile(np.arange(3), len(free))] = 1.0
    given = reduction.Reduction(
        name="slab",
        nodes=mesh.nodes,
        tets=mesh.tets if element == "p1" else quadratic.split(mesh.nodes, mesh.elements),
        modes=modes,
        rigid=0,
        singular_values=np.ones(len(modes)),
        tet_weight=np.ones(len(box.tets) * (1 if element == "p1" else 4)),
        element=element,
    )
    heights = []
    for is_reduced in (False, True):
        builder = sw.ModelBuilder()
        slab = builder.add_tets(mesh, material=sw.Corotational(3e6, 0.3), density=1e3, name="slab")
        builder.fix(slab, nodes=np.flatnonzero(mesh.nodes[:, 2] < 1e-9))
        ball = builder.add_rigid(sw.Sphere(0.01), mass=2.0, pose=(0.021, 0.019, 0.0165), name="ball")
        builder.add_contact(ball, slab, mu=0.8)
        if is_reduced:
            builder.reduce(slab, given)
        sim = simulation(builder)
        for _ in range(16):
            sim.step()
        heights.append(float(sim.body_pose[0, ball, 2]))
        assert float(sim.contact_load[0, :, 2].sum()) == pytest.approx(2.0 * 9.81, rel=0.02)
    assert heights[1] == pytest.approx(heights[0], abs=1e-9)
