"""Tractions, and the stress, strain and reaction that they lead to, against closed forms."""

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import meshing
from tests import cases

YOUNGS, NU = 1e5, 0.3
LAWS = [*cases.LAWS, *cases.FITTED, "warped"]  # "large" turns elements by their edges: its stress is polar only at rest


def skewed(element: str) -> meshing.TetMesh:
    """A cube whose inner node is moved; edges of quadratic elements stay straight."""
    mesh = meshing.box((0.1, 0.1, 0.1), (2, 2, 2))
    nodes = mesh.nodes.copy()
    nodes[13] += (0.011, -0.007, 0.009)
    return meshing.TetMesh(nodes, mesh.tets)


def block(law: str, element: str, worlds: int = 1) -> sw.Simulation:
    """A cube on three planes of symmetry with a traction of 2 kPa along x on its far face."""
    mesh = skewed(element)
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    material = cases.material(law, YOUNGS, NU)
    body = builder.add_tets(mesh, material=material, element=element, density=1000.0)
    x = builder.bodies[body].mesh.nodes
    for axis in range(3):
        builder.fix(body, nodes=np.flatnonzero(x[:, axis] < 1e-9), axes="xyz"[axis])
    builder.add_traction(body, (2e3, 0.0, 0.0), box=((0.0999, -1.0, -1.0), (1.0, 1.0, 1.0)))
    return sw.Simulation(builder.finalize(worlds, precision="float64"))


@pytest.mark.parametrize(("law", "element"), [(law, "p1") for law in LAWS] + [("yeoh", "p2"), ("warped", "p2")])
def test_uniaxial_patch(law, element):
    """One stress in all elements of an irregular mesh: t A / a along x with the deformed area a, and 0 across.

    Strains are (s^2 - 1) / 2 with the stretches s of the block's sides. With 1 Pa, Hooke's law: t / E and -nu t / E.
    """
    sim = block(law, element)
    for load in (2e3, 1.0):
        sim.control.traction[0, 0, 0] = load
        assert bool(sim.solve_static(1e-11).converged.all())
        stretch = sim.node_x[0].amax(dim=0) / 0.1
        stress, strain = sim.element_stress()[0], sim.element_strain()[0]
        expected = torch.zeros(3, 3, dtype=torch.float64)
        expected[0, 0] = load / (stretch[1] * stretch[2])
        np.testing.assert_allclose(stress, expected.expand_as(stress), atol=1e-6 * load)
        np.testing.assert_allclose(sw.von_mises(stress), float(expected[0, 0]), atol=1e-6 * load)
        np.testing.assert_allclose(strain, torch.diag(0.5 * (stretch**2 - 1.0)).expand_as(strain), atol=1e-9)
        np.testing.assert_allclose(sim.reactions().total()[0], [-load * 0.01, 0.0, 0.0], atol=1e-8 * load)
    hooke = torch.tensor([1.0, -NU, -NU], dtype=torch.float64) / YOUNGS
    np.testing.assert_allclose(strain, torch.diag(hooke).expand_as(strain), atol=1e-9)


@pytest.mark.parametrize(("law", "element"), [*((law, "p1") for law in cases.LAWS), ("stvk", "p2")])
def test_shear_and_pressure(law, element):
    """Stress [Pa] and strain in simple shear and hydrostatic compression, positions imposed.

    At small strain 2 mu e and 3 K e of Hooke; St. Venant-Kirchhoff's P = F (2 mu E + lam tr E) at large.
    """
    sim = block(law, element)
    rest, (mu, lam) = sim.node_x[0].clone(), cases.lame(YOUNGS, NU)
    one = torch.eye(3, dtype=torch.float64)
    shear = torch.zeros(3, 3, dtype=torch.float64)
    shear[0, 1] = 1.0
    for F in (one + 1e-6 * shear, (1.0 - 1e-6) * one, one + 0.4 * shear, 0.9 * one):
        sim.node_x[0] = rest @ F.T
        E = 0.5 * (F.T @ F - one)
        np.testing.assert_allclose(sim.element_strain()[0], E.expand_as(sim.element_strain()[0]), atol=1e-14)
        if law == "stvk" or float(E.abs().max()) < 1e-5:
            s = F @ (2.0 * mu * E + lam * E.trace() * one) @ F.T / torch.det(F)
            found = sim.element_stress(0)[0]
            np.testing.assert_allclose(found, s.expand_as(found), atol=1e-5 * float(s.abs().max()))


def test_shares_of_faces():
    """Linear: thirds. Flat quadratic: 0 and thirds. Curved: the sum is the area, here of a developed cylinder."""
    x = np.array([(0.0, 0.0, 0.0), (2.0, 0.0, 0.0), (0.0, 1.0, 0.0)])
    node, share = meshing.face_shares(x, [(0, 1, 2)])
    np.testing.assert_allclose(share, [1 / 3] * 3)
    six = np.concatenate([x, 0.5 * (x + x[[1, 2, 0]])])
    node, share = meshing.face_shares(six, [(0, 1, 2)], [(3, 4, 5)])
    assert node.tolist() == list(range(6))
    np.testing.assert_allclose(share, [0.0] * 3 + [1 / 3] * 3, atol=1e-15)
    angle = 0.2 * six[:, 0]
    rolled = np.stack([np.sin(angle), np.cos(angle), six[:, 1]], axis=1)
    assert meshing.face_shares(rolled, [(0, 1, 2)], [(3, 4, 5)])[1].sum() == pytest.approx(0.2, rel=1e-4)


def test_worlds_steps_and_resets():
    """Tractions differ between worlds, act in steps as the same nodal forces do, and return with a reset; nan fails."""
    sim, plain = block("nh_log", "p2", worlds=3), block("nh_log", "p2", worlds=3)
    sim.control.traction[1, 0] = torch.tensor([0.0, 1e3, -5e2])
    model = sim.model.tractions
    assert model.area[0] == pytest.approx(0.01)
    share = torch.as_tensor(model.entry_share.numpy())[:, None]
    nodes = torch.as_tensor(model.loaded_node.numpy()).long()
    for world in range(3):
        plain.control.node_force[world, nodes] = share * sim.control.traction[world, 0]
    plain.control.traction.zero_()
    saved = sim.snapshot()
    for other in (sim, plain):
        other.step(3)
    np.testing.assert_allclose(sim.node_x, plain.node_x, atol=1e-13)
    assert not torch.equal(sim.node_x[0], sim.node_x[1]) and torch.equal(sim.node_x[0], sim.node_x[2])
    x = sim.node_x.clone()
    sim.reset()
    assert sim.control.traction[:, 0, 0].tolist() == [2e3] * 3
    sim.restore(saved)
    sim.step(3)
    assert torch.equal(sim.node_x, x)
    sim.control.traction[1] = float("nan")
    sim.step()
    assert sim.status[:2].tolist() == [sw.Status.OK, sw.Status.NONFINITE]


BAD = [
    ({}, "give exactly one of box, where and triangles"),
    ({"box": ((5.0, 5.0, 5.0), (6.0, 6.0, 6.0))}, "no boundary face of body 'body0' lies in box"),
    ({"where": lambda x: x[:, 0] > 9.0}, "no boundary face of body 'body0' is chosen by where"),
    ({"where": lambda x: x}, r"what where returns must be flags of shape \(48,\)"),
    ({"where": 3}, "where must be a function"),
    ({"triangles": [(0, 1, 99)]}, r"triangles must be integers in \[0, 26\]"),
    ({"triangles": np.zeros((0, 3), dtype=int)}, "triangles are empty"),
    ({"triangles": [(0, 1, 13)]}, r"triangle 0, \[0, 1, 13\], must be a face on the boundary of body 'body0'"),
    ({"triangles": [(0, 1, 4), (4, 0, 1)]}, r"triangle 1, \[4, 0, 1\], is there twice"),
    ({"traction": (0.0, float("nan"), 0.0), "box": ((0, 0, 0), (1, 1, 1))}, r"traction \[Pa\] must be three finite"),
    ({"traction": 1.0, "box": ((0, 0, 0), (1, 1, 1))}, r"traction \[Pa\] must be three finite"),
]


@pytest.mark.parametrize(("given", "message"), BAD)
def test_bad_tractions(given, message):
    """Refused with the traction's name, the value and what is allowed."""
    builder = sw.ModelBuilder()
    body = builder.add_tets(meshing.box((0.1,) * 3, (2, 2, 2)), material=sw.NeoHookean(1e5, 0.3), density=1000.0)
    with pytest.raises(ValueError, match=f"traction 'traction0': {message}"):
        builder.add_traction(body, **given)
    with pytest.raises(ValueError, match="is no soft body"):
        builder.add_traction(5, box=((0, 0, 0), (1, 1, 1)))
