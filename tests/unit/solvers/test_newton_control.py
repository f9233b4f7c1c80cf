"""Per-world control of Newton's method: what a failed solve leaves, and what lies deep, is dropped in its world."""

import numpy as np
import pytest

import softwarp as sw
from softwarp import meshing
from softwarp.kernels.collision.geometry import DISTANCE, TOUCH_ROWS
from softwarp.kernels.step import newton
from softwarp.solvers.newton_control import NewtonControl
from softwarp.solvers.relaxation import Relaxation

GOOD, FAILED, LOST = range(3)  # worlds: a direction, none, and one that has lost its way


@pytest.fixture
def control() -> NewtonControl:
    """Worlds of a block with a chamber that rests on the ground, with an accepted iterate at hand."""
    builder = sw.ModelBuilder()
    ground = builder.add_rigid(sw.Plane(), kinematic=True)
    block = meshing.box((0.02, 0.02, 0.02), (2, 2, 2))
    body = builder.add_tets(block, material=sw.NeoHookean(1e5, 0.4), density=1000.0)
    inner = meshing.box((0.01, 0.01, 0.01), (1, 1, 1))
    builder.add_cavity(body, inner.nodes + 0.005, inner.surface())
    builder.add_contact(body, ground, mu=0.5)
    sim = sw.Simulation(builder.finalize(3, precision="float64"), dt=0.01, newton_iterations=4, threads=1)
    sim.control.cavity_pressure.fill_(1e3)
    sim.step(3)
    found = sim._steppers[0].control
    assert found is not None
    rows = found.system.work.control.real.numpy()
    rows[:, newton.ACCEPTED], rows[:, newton.STEP] = 1.0, 1.0
    rows[:, newton.FROZEN] = rows[:, newton.FAILED] = rows[:, newton.RETURNING] = 0.0
    rows[LOST, newton.RETURNING] = 1.0
    found.system.work.control.real.assign(rows)
    return found


def put(array, value: np.ndarray) -> np.ndarray:
    """Write a solver array of shape (world, row, 1)."""
    array.real.assign(value)
    return value


def test_a_failed_solve_leaves_nothing(control: NewtonControl, rng: np.random.Generator) -> None:
    """Velocities, multipliers and forces of contacts of a world whose direction is not finite are those before."""
    work = control.system.work
    shape = work.dof_v.real.shape
    reference, best = put(control.reference, rng.normal(size=shape)), put(control.best, rng.normal(size=shape))
    u = rng.normal(size=shape)
    u[FAILED, 7] = np.nan
    put(work.u, u)
    rows = work.multiplier.real.shape
    held, found = put(control.multiplier, rng.normal(size=rows)), rng.normal(size=rows)
    best_row = put(control.best_multiplier, rng.normal(size=rows))
    found[FAILED] = np.nan
    put(work.multiplier, found)
    (contact,) = control.system.multipliers.contact_forces
    force = rng.normal(size=contact.real.shape)
    force[FAILED] = np.nan
    put(contact, force)
    work.pressure_share.real.fill_(1.0)

    control.advance(0.01)

    v, forces, multiplier = (array.real.numpy() for array in (work.dof_v, contact, work.multiplier))
    np.testing.assert_array_equal(v[GOOD], reference[GOOD] + u[GOOD])
    np.testing.assert_array_equal(v[FAILED], reference[FAILED])
    np.testing.assert_array_equal(v[LOST], best[LOST])
    np.testing.assert_array_equal(forces[[GOOD, LOST]], force[[GOOD, LOST]])
    np.testing.assert_array_equal(forces[FAILED], 0.0)
    np.testing.assert_array_equal(multiplier[GOOD], found[GOOD])
    np.testing.assert_array_equal(multiplier[FAILED], held[FAILED])
    np.testing.assert_array_equal(multiplier[LOST], best_row[LOST])
    kept = control.multiplier.real.numpy()
    np.testing.assert_array_equal(kept, multiplier)


def test_forces_found_in_vain_at_a_rejected_iterate_are_dropped(control: NewtonControl) -> None:
    """A solve where coordinates overflow leaves no forces that are not finite for the next step to start from.

    A catheter in float32 (32 worlds, seed 11, the 148th action) ended a step with them: its motion was sound, its
    status OK, and the next step failed.
    """
    work = control.system.work
    rows = work.control.real.numpy()
    rows[FAILED, newton.ACCEPTED] = 0.0
    work.control.real.assign(rows)
    u = np.zeros(work.u.real.shape)
    u[FAILED] = np.nan
    put(work.u, u)
    (contact,) = control.system.multipliers.contact_forces
    force = np.ones(contact.real.shape)
    force[FAILED, :2, 0] = np.nan, np.inf
    put(contact, force)

    control.advance(0.01)

    assert np.isfinite(work.dof_v.real.numpy()).all()
    force[FAILED, :2] = 0.0
    np.testing.assert_array_equal(contact.real.numpy(), force)


def test_tangent_of_pressures_shrinks_where_solves_fail(control: NewtonControl) -> None:
    """Its share halves with every failed solve until none is left, and grows by a tenth otherwise, to 1 at most."""
    work = control.system.work
    u = np.zeros(work.u.real.shape)
    u[FAILED, 0] = np.inf
    put(work.u, u)
    work.pressure_share.real.assign(np.array([0.95, 1.0, 0.5]).reshape(3, 1, 1))
    shares = []
    for _ in range(4):
        control.advance(0.01)
        shares.append(work.pressure_share.real.numpy()[:, 0, 0].copy())
    np.testing.assert_allclose(np.array(shares)[:, FAILED], [0.5, 0.25, 0.125, 0.0])
    np.testing.assert_allclose(np.array(shares)[:, GOOD], [1.0, 1.0, 1.0, 1.0])
    np.testing.assert_allclose(np.array(shares)[:, LOST], 0.5 * 1.1 ** np.arange(1, 5))


def test_rounding_is_told_of_iterates_that_do_not_settle(control: NewtonControl) -> None:
    """Worlds by imbalance: of rounding, 0.7 of the forces that balance, which are rounding too; of real forces; less.

    Without loads the relative imbalance never falls, so that the second iterate of a world can only say so. What is
    rejected says nothing about the iterate that stays.
    """
    system, work = control.system, control.system.work
    control.begin()
    small = 0.5 * control.rounding_force
    norm = np.array([[small, small / 0.7], [1.0, 1.0 / 0.7], [1e-9, 1e3]])
    norm = np.broadcast_to(norm[:, :, None], work.norm.real.shape).copy()
    for first in (True, False):
        put(work.norm, norm)
        control.judge(first=first, tolerance=1e-13, f_scale=1.0)
    relaxation = Relaxation(system)
    np.testing.assert_array_equal(relaxation.frozen(), [False, False, False])
    np.testing.assert_array_equal(relaxation.balanced(), [True, False, True])
    put(work.norm, 1e6 * norm)
    for _ in range(6):
        control.judge(first=False, tolerance=1e-13, f_scale=1.0)
    assert not relaxation.balanced()[1]


def lie(control: NewtonControl, depths: list[float]) -> None:
    """Place contacts of each world in parts of the deepest that they may lie."""
    contact, deepest = control.system.contact, control.deepest
    assert contact is not None and deepest is not None
    distance = contact.pairs.distance.real.numpy()[:, :1, :] - np.array(depths)[:, None, None] * deepest.numpy()[0]
    touch = contact.detector.touch.real.numpy()
    touch[:, DISTANCE::TOUCH_ROWS] = distance
    put(contact.detector.touch, touch)


def test_what_lies_deep_is_worse_by_that(control: NewtonControl) -> None:
    """Forces may balance there: it has not converged, and is not the best where another has a little more imbalance.

    Worlds: one that comes out of the wall with such a one, one with far more, one that began as deep.
    """
    system, work = control.system, control.system.work
    control = NewtonControl(system, deepest=[1e-3])
    control.begin()
    runs = (
        ([0.0, 0.0, 3.0], [1.0, 1.0, 1.0]),  # depths and relative imbalances
        ([3.0, 3.0, 2.9], [1e-4, 1e-4, 0.5]),
        ([0.9, 0.9, 2.9], [0.1, 0.4, 1e-4]),
    )
    told = []
    for number, (depths, imbalances) in enumerate(runs):
        lie(control, depths)
        norm = np.broadcast_to(np.array([(value, 1.0) for value in imbalances])[:, :, None], work.norm.real.shape)
        put(work.norm, norm.copy())
        control.judge(first=number == 0, tolerance=1e-3, f_scale=1.0)
        rows = work.control.real.numpy()[:, :, 0]
        told.append(rows[:, [newton.IMPROVED, newton.ACCEPTED, newton.FROZEN]].astype(bool).T.tolist())
    improved, accepted, frozen = zip(*told, strict=True)
    assert improved[1:] == ([True, True, True], [True, False, True])
    assert accepted == ([True] * 3,) * 3
    assert frozen == ([False] * 3, [False] * 3, [False, False, True])
