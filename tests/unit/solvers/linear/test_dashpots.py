"""Dashpots in bodies with flat or inverted elements. Theory: docs/theory/corotational.md, "Upright elements"."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

import softwarp as sw
from softwarp import meshing
from softwarp.kernels.algebra import lanes
from softwarp.kernels.linear import dashpots
from softwarp.solvers.system import System
from softwarp.solvers.workspace import rows


def crushed(worlds: int, precision: str = "float32") -> sw.Simulation:
    """A very light cube, in whose last world a node has been pushed through its neighbours; about to take a step."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    material = sw.Corotational(1.0e5, 0.4, method="large", inversion_guard=0.4)
    builder.add_tets(meshing.box((0.1,) * 3, (4,) * 3), material=material, density=1e-3)
    sim = sw.Simulation(builder.finalize(worlds, "cpu", precision), 0.01)
    middle = int(np.linalg.norm(sim.model.node_rest - 0.05, axis=1).argmin())
    sim.node_x[worlds - 1, middle, 0] += 0.04
    sim.compression[worlds - 1] = 1.4  # which the step that led there would have told
    return sim


def of_worlds(system: System, values: wp.array) -> np.ndarray:
    """Rows of the workspace, (world, row)."""
    found = values.numpy()
    return found.swapaxes(1, 2).reshape(-1, found.shape[1])[: system.world_count].copy()


def matrices(system: System, h: float, *, dampened: bool) -> np.ndarray:
    """Blocks of A of the next step, (world, block, 3, 3)."""
    assert system.inversion is not None
    held = system.inversion.dashpots
    if not dampened:
        system.inversion.dashpots = None
    system.load()
    system.scale(h)
    system.forces()
    system.tangent()
    system.right_hand_side(h, inertia=True, moving=False)
    system.inversion.dashpots = held
    return of_worlds(system, system.work.a.real).reshape(system.world_count, -1, 3, 3)


@pytest.mark.parametrize("worlds", [1, 9])
def test_matrix(worlds: int) -> None:
    """A grows by a Laplacian of the edges in inverted worlds alone, and no force on a body comes of it."""
    sim = crushed(worlds)
    system = sim.systems[-1]
    plain, found = (matrices(system, sim.dt, dampened=each) for each in (False, True))
    np.testing.assert_array_equal(found[:-1], plain[:-1])
    m, symbolic = sim.model, sim.model.symbolic
    diagonal = plain[-1, : symbolic.size][:, range(3), range(3)]
    mass = float(of_worlds(system, system.work.node_mass.real)[-1, m.dof_node.numpy()].sum())
    strength = (diagonal.max() - dashpots.BEARABLE * mass) * dashpots.SHARE
    assert strength > mass
    expected = np.zeros_like(plain[-1])
    for block, (row, column) in enumerate(zip(symbolic.a_row, symbolic.a_col, strict=True)):
        if row != column:
            expected[block] -= strength * np.eye(3)
            for end in (row, column):
                expected[end] += strength * np.eye(3)
    tolerance = 1e-5 * strength + 2e-7 * diagonal.max()
    np.testing.assert_allclose(found[-1].astype(np.float64) - plain[-1], expected, atol=tolerance)


def test_kernels_of_a_gpu() -> None:
    """They do the same; a CPU runs them here on arrays that have the world fastest."""
    sim = crushed(3)
    count = sim.systems[-1].world_count
    system = sim.systems[-1]
    plain, found = (matrices(system, sim.dt, dampened=each) for each in (False, True))
    assert system.inversion is not None and system.inversion.dashpots is not None
    d, m, w = system.inversion.dashpots, sim.model, system.work
    chosen = lanes.variant("cuda", "float32")
    k = dashpots.kernels(chosen)

    def send(values: np.ndarray) -> rows.Rows:
        sent = rows.allocate(chosen, count, values.shape[1], "cpu")
        sent.real.assign(values.T[None])
        return sent

    a = send(plain.reshape(count, -1))
    scale, mass = (send(of_worlds(system, each.real)) for each in (w.body_mass, w.node_mass))
    strength, held = rows.allocate(chosen, count, d.count, "cpu"), wp.zeros((1, 1, count), dtype=wp.int32, device="cpu")
    inputs = [count, d.part_start, d.part_dof, m.dof_node, m.node_body, system.state.compression]
    wp.launch(
        k.gauge, (1, d.count, count), [*inputs, scale.real, mass.real, a.real], [strength.real, held], device="cpu"
    )
    inputs = [d.dof_part, m.neighbour_start, m.neighbour, m.neighbour_block, strength.real]
    wp.launch(k.dampen, (1, m.dof_count, count), inputs, [a.real], device="cpu")
    assert held.numpy().ravel().tolist() == [0] * (count - 1) + [1]
    np.testing.assert_array_equal(a.real.numpy()[0].T.reshape(found.shape), found)


def test_none_in_float64() -> None:
    """Its rounding leaves all pivots what they are."""
    inversion = crushed(1, precision="float64")._systems[0].inversion
    assert inversion is not None and inversion.dashpots is None and inversion.held is not None


def test_held_body_goes_on() -> None:
    """A trunk with a node pushed through its neighbours fails without, and rights itself with them, still crushed."""
    env = sw.make("Trunk", num_worlds=1, seed=0, mesh="coarse")
    inversion, ends = env.sim.systems[0].inversion, []
    assert inversion is not None
    kept = inversion.dashpots
    for inversion.dashpots in (None, kept):
        env.reset()
        env.sim.dt = env.sim.dt  # steps are recorded anew
        x = env.sim.node_x[0]
        x[int((x - x.mean(dim=0)).norm(dim=1).argmin()), 0] += 0.025
        for _ in range(90):
            env.sim.step()
        ends.append((int(env.sim.status), float(env.sim.compression)))
    assert ends[0][0] == sw.Status.NONFINITE
    assert ends[1][0] == sw.Status.OK
    assert ends[1][1] < 0.95
