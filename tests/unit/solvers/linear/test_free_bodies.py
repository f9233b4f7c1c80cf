"""Free soft bodies keep their mass in a float32 factor, however stiff their elements get. docs/theory/cholesky.md."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import warp as wp

import softwarp as sw
from softwarp import meshing
from softwarp.kernels.algebra import lanes
from softwarp.kernels.linear import free_bodies
from softwarp.solvers.linear.cholesky import PanelSolver
from softwarp.solvers.linear.free_bodies import free_parts
from softwarp.solvers.system import System
from softwarp.solvers.workspace import rows

WAYS = [
    pytest.param("auto", 1, False, id="wide"),
    pytest.param("auto", 9, False, id="lanes"),
    pytest.param("scalar", 2, False, id="scalar"),
    pytest.param("scalar", 2, True, id="panels"),
]
CUDA = [pytest.param(path, 5, False, id=f"cuda-{path}", marks=pytest.mark.cuda) for path in ("panels", "levels")]


def cube(worlds: int = 1, path: str = "auto", device: str = "cpu", *, held: bool = False) -> sw.Simulation:
    """A light silicone cube of 0.1 m and 1 g that falls; its elements are 10^3 times as stiff as it weighs."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    mesh = meshing.box((0.1, 0.1, 0.1), (4, 4, 4))
    body = builder.add_tets(mesh, material=sw.Corotational(1.0e5, 0.4, method="large"), density=1.0)
    if held:
        builder.fix(body, box=((-1.0, -1.0, -1.0), (1.0, 1.0, 1e-9)))
    return sw.Simulation(builder.finalize(worlds, device, "float32"), 0.01, threads=1, solver_path=path)


def crushed(worlds: int, path: str, *, panels: bool = False, device: str = "cpu") -> sw.Simulation:
    """Cubes after a step; in the last one a corner went through its neighbours, with elements 2000 times stiffer."""
    sim = cube(worlds, path, device)
    linear = sim._systems[0].linear
    if panels:
        linear.panels = PanelSolver(linear.symbolic, linear.variant, worlds, 3, linear.y, "cpu")
    middle = int(np.linalg.norm(sim.model.node_rest - 0.05, axis=1).argmin())
    sim.node_x[worlds - 1, middle, 0] += 0.04
    sim.step()
    return sim


def world_of(system: System, world: int, name: str) -> np.ndarray:
    """Rows of a workspace array of one world."""
    values = getattr(system.work, name).real.numpy()
    lanes = values.shape[2]
    return values[world // lanes, :, world % lanes].copy()


def exact_matrix(system: System, world: int) -> tuple[np.ndarray, np.ndarray]:
    """A in float64 with rows that sum up to the masses, and these, by dof."""
    m, symbolic = system.model, system.model.symbolic
    blocks = world_of(system, world, "a")[: 9 * len(symbolic.a_row)].reshape(-1, 3, 3).astype(np.float64)
    A = np.zeros((symbolic.size, 3, symbolic.size, 3))
    for row, col, block in zip(symbolic.a_row, symbolic.a_col, blocks, strict=True):
        A[row, :, col] = block
        A[col, :, row] = block.T
    mass = world_of(system, world, "node_mass")[m.dof_node.numpy()].astype(np.float64)
    mass *= float(world_of(system, world, "body_mass")[0])
    for i in range(symbolic.size):
        A[i, :, i] += mass[i] * np.eye(3) - A[i].sum(axis=1)
    return A.reshape(3 * symbolic.size, -1), mass


@pytest.mark.parametrize(("path", "worlds", "panels"), [*WAYS, *CUDA])
def test_solution_of_a_crushed_body(path: str, worlds: int, panels: bool, request: pytest.FixtureRequest) -> None:
    """A u = b with one correction, against dense float64, for pushes that move and pairs that squeeze the cube."""
    device = "cuda:0" if "cuda" in request.node.callspec.id else "cpu"
    sim, world = crushed(worlds, path, panels=panels, device=device), worlds - 1
    system = sim._systems[0]
    assert system.free is not None
    A, mass = exact_matrix(system, world)
    size = mass.size
    pair = np.zeros((size, 3))
    pair[3], pair[size - 5] = [1e-5, 0.0, 0.0], [-1e-5, 0.0, 0.0]
    for push in (np.outer(mass, [0.3, 0.1, -0.2]), np.outer(mass, [0.3, 0.0, 0.0]) + pair):
        b = system.work.b.real.numpy()
        lanes = b.shape[2]
        b[world // lanes, : 3 * size, world % lanes] = push.reshape(-1)
        system.work.b.real.assign(b)
        system.solve(system.h, system.h)
        u = world_of(system, world, "u")[: 3 * size]
        exact = np.linalg.solve(A, push.reshape(-1))
        moved, expected = (mass @ value.reshape(-1, 3) / mass.sum() for value in (u, exact))
        assert np.abs(u - exact).max() < 2e-3 * np.abs(exact).max()
        assert np.abs(moved - expected).max() < 1e-3 * np.abs(exact).max()


@pytest.mark.parametrize(("path", "worlds", "panels"), WAYS[1:])
def test_other_worlds_keep_their_bits(path: str, worlds: int, panels: bool) -> None:
    """Nothing happens to a world without crushed elements, whatever others of its pack do."""
    ends = []
    for cared in (False, True):
        sim = cube(worlds, path)
        system = sim._systems[0]
        if panels:
            linear = system.linear
            linear.panels = PanelSolver(linear.symbolic, linear.variant, worlds, 3, linear.y, "cpu")
        if not cared:
            system.free = None
        sim.node_x[worlds - 1, 62, 0] += 0.04
        sim.node_x[0] *= 0.9
        for _ in range(3):
            sim.step()
        ends.append(sim.node_x.clone())
    assert torch.equal(ends[0][:-1], ends[1][:-1]) and not torch.equal(ends[0][-1], ends[1][-1])


@pytest.mark.parametrize(("path", "worlds", "panels"), WAYS)
def test_matrix_stays(path: str, worlds: int, panels: bool) -> None:
    """What the last block is given for the time of the factorisation is taken back to the bit."""
    system = crushed(worlds, path, panels=panels)._systems[0]
    assert system.free is not None
    system.tangent()
    before = system.work.a.real.numpy().copy()
    system.free.mark(system.work.a)
    assert (system.work.a.real.numpy() != before).any()
    system.linear.factor(system.work.a)
    system.free.mend(system.work.a)
    np.testing.assert_array_equal(system.work.a.real.numpy(), before)
    marked = system.free.excess.real.numpy().transpose(0, 2, 1).reshape(-1)[:worlds] > 0.0
    assert marked.tolist() == [world == worlds - 1 for world in range(worlds)]


def test_shares_of_a_gpu() -> None:
    """Threads that share the dofs of a body find what one thread finds, but for the order in which masses are summed.

    A CPU runs the kernels of a GPU here, whose arrays have the world fastest.
    """
    system = crushed(3, "scalar")._systems[0]
    free, m, w = system.free, system.model, system.work
    assert free is not None
    system.tangent()
    a = w.a.real.numpy().copy()
    free.mark(w.a)
    chosen = lanes.variant("cuda", "float32")
    k = free_bodies.kernels(chosen)

    def send(values: np.ndarray) -> rows.Rows:
        sent = rows.allocate(chosen, 3, values.shape[1], "cpu")
        sent.real.assign(values[:, :, 0].T[None])
        return sent

    def empty(count: int) -> rows.Rows:
        return rows.allocate(chosen, 3, count, "cpu")

    scale, mass, blocks = send(w.body_mass.real.numpy()), send(w.node_mass.real.numpy()), send(a)
    share, excess, root = empty(2 * free_bodies.SHARES), empty(1), empty(3)
    inputs = [free.part_start, free.part_dof, m.dof_node, m.node_body, scale.S, mass.S]
    wp.launch(k.gauge_shares, (free_bodies.SHARES, 3), [*inputs, blocks.S], [share.S], device="cpu")
    wp.launch(k.mark, (1, 3), [*inputs, share.S], [blocks.S, excess.S, root.S], device="cpu")
    expected = free.excess.real.numpy()[:, :, 0].T
    assert (expected > 0.0).tolist() == [[False, False, True]]
    np.testing.assert_allclose(excess.real.numpy()[0], expected, rtol=1e-6)
    np.testing.assert_array_equal(root.real.numpy()[0], free.root.real.numpy()[:, :, 0].T)
    np.testing.assert_allclose(blocks.real.numpy()[0], w.a.real.numpy()[:, :, 0].T, rtol=1e-6)
    np.testing.assert_array_equal(blocks.real.numpy()[0, :, :2], a[:2, :, 0].T)


@pytest.mark.parametrize("world", [0, 4])
def test_falling_body_gains_gravity_alone(world: int) -> None:
    """Elements that push each other apart with a thousand newtons do not move the centre of a cube of a gram.

    Their forces sum up to zero but for rounding, 10^-2 m/s here; without care it was up to 0.07 m/s in a step.
    """
    sim = cube(5)
    sim.node_x[world, int(np.linalg.norm(sim.model.node_rest - 0.05, axis=1).argmin()), 0] += 0.04
    mass = torch.as_tensor(sim.model.node_volume.numpy()).double()
    mass /= mass.sum()
    for _ in range(3):
        before = sim.node_v[world].double().clone()
        sim.step()
        gained = mass @ (sim.node_v[world].double() - before)
        assert float((gained - torch.tensor([0.0, 0.0, -0.0981])).abs().max()) < 0.015


def test_which_bodies_are_free() -> None:
    """A body that nothing holds is a part of its own; one with a fixed node is none."""
    free = cube().model
    (part,) = free_parts(free)
    assert part.tolist() == list(range(free.dof_count))
    assert free_parts(cube(held=True).model) == []
