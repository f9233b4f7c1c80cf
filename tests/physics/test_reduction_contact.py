"""Modes for contact: what contact forces of recorded motion bring about, beside what moves most."""

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import reduction
from softwarp.reduction import contact
from softwarp.reduction.elements import Elements
from tests.reduction_cases import SLAB, scene


def test_stiffness_from_forces_is_that_of_the_system():
    """Differences of elements' forces give K at rest, tets and membrane, to the differences' own error."""
    sim = sw.Simulation(scene(held=True, contact=False, lone=True).finalize(6, precision="float64"), 0.01)
    K = Elements(sim, 0, slice(0, len(SLAB.nodes))).stiffness()
    free = np.flatnonzero(np.repeat(~sim.model.node_fixed, 3))
    sim.node_x.copy_(torch.as_tensor(SLAB.nodes))
    wanted = sim.stiffness_matrix().tocsr()[free][:, free]
    assert abs(K[free][:, free] - wanted).max() < 1e-5 * abs(wanted).max()


def test_responses_balance_their_loads():
    """A free body: K u = f - inertia relief, u without rigid motion; a held one: K u = f where it is free."""
    sim = sw.Simulation(scene(held=True, contact=False, lone=True).finalize(6, precision="float64"), 0.01)
    K = Elements(sim, 0, slice(0, len(SLAB.nodes))).stiffness()
    mass, draws = np.random.default_rng(0).uniform(0.5, 1.5, len(SLAB.nodes)) * 1e-4, np.random.default_rng(1)
    load = np.zeros((2, len(SLAB.nodes), 3))
    load[:, ::7] = draws.normal(size=load[:, ::7].shape)
    u = contact.responses(K, mass, SLAB.nodes, np.zeros(len(SLAB.nodes), bool), load)
    arm = SLAB.nodes - mass @ SLAB.nodes / mass.sum()
    for state, given in zip(u, load, strict=True):
        np.testing.assert_allclose(mass @ state, 0.0, atol=1e-12)
        np.testing.assert_allclose(mass @ np.cross(arm, state), 0.0, atol=1e-12)
        left = given - (K @ state.ravel()).reshape(-1, 3)  # inertia: masses times a rigid acceleration
        squares = np.einsum("n,ni,nj->ij", mass, arm, arm)
        inertia = np.trace(squares) * np.eye(3) - squares
        spin = np.linalg.solve(inertia, np.cross(arm, given).sum(axis=0))
        wanted = mass[:, None] * (given.sum(axis=0) / mass.sum() + np.cross(spin, arm))
        np.testing.assert_allclose(left, wanted, atol=1e-4 * np.abs(given).max())
    held = SLAB.nodes[:, 0] < 1e-9
    u = contact.responses(K, mass, SLAB.nodes, held, load)
    assert not u[:, held].any()
    left = (load - (K @ u.reshape(2, -1).T).T.reshape(load.shape))[:, ~held]
    assert np.abs(left).max() < 1e-4 * np.abs(load).max()


@pytest.fixture(scope="module")
def motion():
    """A slab that writhes on a floor, and its simulation."""
    sim = sw.Simulation(scene(held=False, contact=True).finalize(4, precision="float64"), 0.01)
    rest = float(sim.model.cavities.rest_volume[0])

    def drive(sim, step):
        phase = torch.linspace(0.0, 3.0, 4) + 0.1 * step
        sim.control.cavity_volume[:, 0] = rest * (1.0 + 0.3 * torch.sin(phase) ** 2).to(sim.node_x)
        sim.control.cable_displacement[:, 0] = (2e-3 * torch.cos(phase) ** 2).to(sim.node_x)

    return sim, reduction.record(sim, drive, steps=60, every=3)


def test_contact_forces_are_recorded(motion):
    """They are on the body's lower side, and bear about its weight while it rests."""
    sim, told = motion
    assert told.touch is not None and told.touch.shape == told.positions.shape
    weight = 9.81 * float(sim.mass[0].sum())
    assert told.touch[-4:, :, 2].sum(axis=1) == pytest.approx(np.full(4, weight), rel=0.3)
    pressed = np.abs(told.touch).max(axis=(0, 2)) > 0.0
    assert SLAB.nodes[pressed, 2].max() < 0.007
    joined = told.joined(told.chosen(5))
    assert len(joined) == len(told) + 5 and joined.touch.shape == joined.positions.shape


def test_modes_for_contact(motion):
    """They are orthonormal to the others, and hold what contact does better than as many modes of the motion."""
    sim, told = motion
    kept = {"element_tolerance": None, "membrane_tolerance": None}
    plain = reduction.train(sim, told, modes=12, **kept)
    rich = reduction.train(sim, told, modes=6, contact_modes=6, **kept)
    assert len(rich.modes) == len(plain.modes) == 15
    mass = sim.mass[0].numpy()
    flat = rich.modes.reshape(15, -1)
    np.testing.assert_allclose((flat * np.repeat(mass, 3)) @ flat.T / mass.sum(), np.eye(15), atol=1e-10)
    np.testing.assert_allclose(np.abs(rich.modes[:9]), np.abs(plain.modes[:9]), atol=1e-9)
    K = Elements(sim, 0, slice(0, len(SLAB.nodes))).stiffness()
    held = np.zeros(len(SLAB.nodes), bool)
    u = contact.responses(K, mass, SLAB.nodes, held, told.touch[::7].astype(float)).reshape(-1, flat.shape[1])

    def missing(modes):
        weighted = modes.reshape(len(modes), -1)
        q = u * np.repeat(mass, 3) @ weighted.T / mass.sum()
        return np.linalg.norm(u - q @ weighted)

    assert missing(rich.modes) < 0.5 * missing(plain.modes)
    with pytest.raises(ValueError, match="nothing touches body"):
        reduction.train(sim, reduction.Motion(told.positions, told.travel), modes=6, contact_modes=6)
    with pytest.raises(ValueError, match="contact modes"):
        reduction.train(sim, told, modes=6, contact_modes=2000, **kept)


def test_symmetric_motion():
    """States are their own mirror images, and those that were stay; a mesh without a mirror is refused."""
    rest = SLAB.nodes - (0.0, 0.015, 0.0)
    draws = np.random.default_rng(0)
    x = (rest + 1e-3 * draws.normal(size=(5, *rest.shape))).astype(np.float32)
    found = reduction.Motion(x, touch=x).symmetric(rest)
    image = np.abs(rest[:, None] - rest * (1.0, -1.0, 1.0)).sum(axis=2).argmin(axis=0)
    np.testing.assert_allclose(found.positions[:, image] * (1.0, -1.0, 1.0), found.positions, atol=1e-8)
    np.testing.assert_array_equal(found.touch, found.positions)
    np.testing.assert_allclose(found.symmetric(rest).positions, found.positions, atol=1e-8)
    with pytest.raises(ValueError, match="has no mirror image"):
        reduction.Motion(x).symmetric(SLAB.nodes)
