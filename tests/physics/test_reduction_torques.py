"""Elements chosen for a body that stands on a floor: torques about its centre, which decide on what it leans."""

import numpy as np
import pytest

import softwarp as sw
from softwarp import reduction
from softwarp.reduction import training
from softwarp.reduction.basis import Basis
from softwarp.reduction.elements import elements_of
from tests.reduction_cases import SLAB, every_node, scene, smooth_modes


def simulation(worlds=1, precision="float64", held=False):
    return sw.Simulation(scene(held=held, contact=True).finalize(worlds, precision=precision), dt=0.01)


def forces_of(sim, modes, rigid):
    return training._Forces(elements_of(sim, 0, slice(0, len(SLAB.nodes))), Basis(modes, np.ones(1), rigid))


def test_no_element_has_a_torque_where_modes_hold_every_turning():
    """A turning leaves elements as they are: 1e-6 of the torques that their forces have each, as tables are float32."""
    sim = simulation()
    mass = np.full(len(SLAB.nodes), 0.01)
    modes = every_node(False)
    gram = modes.reshape(len(modes), -1) @ modes.reshape(len(modes), -1).T / len(SLAB.nodes)
    modes = np.einsum("ij,jnc->inc", np.linalg.inv(np.linalg.cholesky(gram)), modes)
    forces = forces_of(sim, modes, 0)
    bent = np.random.default_rng(0).normal(size=(2, *SLAB.nodes.shape)) * 1e-4
    q = training._amplitudes(forces.basis, mass, bent)
    tets, thin = forces.torques(q, mass)
    size = max(np.abs(part).max() for parts in forces.elements.at(SLAB.nodes + bent) for part in parts)
    length = np.ptp(SLAB.nodes, axis=0).max()
    assert size > 1e-4
    assert max(np.abs(tets).max(), np.abs(thin).max()) < 1e-6 * size * length


def test_torques_are_work_of_forces_on_what_the_modes_turn():
    """Eleven modes that hold a part of a turning only: rows are the work of the forces on that part."""
    sim = simulation()
    mass = np.random.default_rng(2).uniform(0.5, 1.5, len(SLAB.nodes))
    modes = reduction.pod(smooth_modes(held=False), mass, SLAB.nodes, count=6, rigid="translations").modes
    forces = forces_of(sim, modes, 3)
    q = 1e-3 * np.random.default_rng(3).normal(size=(2, len(modes)))
    tets, _ = forces.torques(q, mass, scale=np.sqrt(2.0))
    share = mass / mass.sum()
    for state, row in enumerate(q):
        x = SLAB.nodes + np.einsum("k,knc->nc", row, modes)
        parts = next(forces.elements.at(x[None]))[0].reshape(len(SLAB.tets), 4, 3)
        total = np.zeros_like(x)
        np.add.at(total, SLAB.tets, parts)
        for axis in range(3):
            arm = np.cross(np.eye(3)[axis], x - share @ x)
            onto = np.einsum("knc,n,nc->k", modes, share, arm)
            work = (np.einsum("k,knc->nc", onto, modes) * total).sum()
            assert tets[3 * state + axis].sum() == pytest.approx(work, rel=1e-4, abs=1e-7 * np.abs(total).max())


def test_chosen_elements_keep_torques(monkeypatch):
    """Errors at unseen states, of weight times length, at most 0.4 % (0.13), and without rows for them 3 % (3.6).

    A held body has no such rows: its elements are the same to the bit.
    """
    sim = simulation(16, "float32")
    air = float(sim.cavity_volume[0, 0])
    ranges = {"cables": {"cable": (0.0, 0.004)}, "cavities": {"air": (air, 2.0 * air)}}
    motion = reduction.record(sim, reduction.sweep(sim, **ranges, hold=40), 160, every=8)
    exact, held = simulation(8), simulation(8, held=True)
    found = {}
    for weight in (training.TORQUES, 1e-6):
        monkeypatch.setattr(training, "TORQUES", weight)
        found[weight] = reduction.train(exact, motion, modes=12, element_tolerance=0.02, membrane_tolerance=0.02)
        found[weight, "held"] = reduction.train(held, motion, modes=12, states=8)
    few, before = found[10.0], found[1e-6]
    assert max(few.report["unseen_torques"].values()) < 0.004
    assert before.report["unseen_torques"]["tets"] > 0.03
    assert few.singles[0] < 1.3 * before.singles[0]
    assert found[10.0, "held"].report["unseen_torques"] == {}
    np.testing.assert_array_equal(found[10.0, "held"].tet_weight, found[1e-6, "held"].tet_weight)
