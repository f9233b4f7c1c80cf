"""Panels of the factor: schedule, numbers against dense linear algebra, and a whole step against the other solver.

The kernels are those of the GPU. On a CPU they run with one thread per block, which shows everything but races.
"""

from typing import Any

import numpy as np
import pytest
import warp as wp

import softwarp
from softwarp import meshing
from softwarp.kernels.algebra.lanes import variant
from softwarp.kernels.rows import cable_block
from softwarp.kernels.rows.contact_panel import MOST_PANELS
from softwarp.model.codes import PANEL_IDENTITY, PANEL_UPDATE
from softwarp.model.structure import Symbolic
from softwarp.plan.ordering import analyze
from softwarp.solvers.linear import cholesky, panels
from softwarp.solvers.linear.cholesky import LinearSolver, PanelSolver, substitution_threads, upload
from softwarp.solvers.workspace.rows import allocate
from tests.matrix_cases import dense, random_blocks

KINDS = [
    pytest.param("scalar", "float64", 1e-11, id="cpu-float64"),
    pytest.param("scalar", "float32", 1e-4, id="cpu-float32"),
    pytest.param("cuda", "float64", 1e-11, id="cuda-float64", marks=pytest.mark.cuda),
    pytest.param("cuda", "float32", 1e-4, id="cuda-float32", marks=pytest.mark.cuda),
]


def bar(cells: tuple[int, int, int]) -> Symbolic:
    mesh = meshing.box((1.0, 0.4, 0.3), cells)
    pairs = [(a, b) for a in range(4) for b in range(a)]
    return analyze(np.concatenate([mesh.tets[:, pair] for pair in pairs]), len(mesh.nodes), mesh.nodes)


@pytest.fixture(params=["bar", "random", "isolated"])
def symbolic(request: pytest.FixtureRequest, rng: np.random.Generator) -> Symbolic:
    if request.param == "bar":
        return bar((8, 3, 2))
    if request.param == "random":
        return analyze(rng.integers(0, 60, (150, 2)).astype(np.int32), 60)
    return analyze(np.array([[0, 2]], dtype=np.int32), 4)


LIMITS = [
    pytest.param(panels.Limits(1536, 640, 1280), id="wide"),
    pytest.param(panels.Limits(500, 100, 200), id="narrow"),
    pytest.param(panels.Limits(40, 30, 40), id="late-updates"),
]


@pytest.mark.parametrize("limits", LIMITS)
def test_rounds_keep_their_limits(limits: panels.Limits) -> None:
    """Every column and every block of A has its place, whatever a round can hold."""
    structure = bar((8, 3, 2))
    plan = panels.schedule(structure, limits)
    assert panels.schedule(structure, limits) is plan
    assert np.diff(plan.round_item).max() <= limits.items
    assert np.diff(plan.turn_lower).max() <= 9 * limits.stage
    assert plan.item_place[:, :2].max() < limits.slots
    assert (len(plan.late_row) > 0) == (limits.items == 40)
    assert sorted(plan.column[:, 0]) == list(range(structure.size))
    source = plan.item_source[:, 2]
    assert sorted(source[source >= 0]) == list(range(len(structure.a_row)))
    assert (source == PANEL_IDENTITY).sum() == structure.size


@pytest.mark.parametrize("limits", LIMITS)
def test_rounds_read_what_earlier_ones_wrote(symbolic: Symbolic, limits: panels.Limits) -> None:
    """Updates are read once, by the round of the panel above, before their memory serves others."""
    plan = panels.schedule(symbolic, limits)
    entry = np.arange(9)
    is_fresh = np.zeros(plan.update_rows, dtype=bool)
    lower = np.zeros(plan.lower_rows, dtype=bool)
    for turn in range(plan.round_count):
        items = slice(plan.round_item[turn], plan.round_item[turn + 1])
        sources, places = plan.item_source[items], plan.item_place[items]
        for begin, end, _, _ in sources:
            for place, stride in plan.child[begin:end]:
                assert is_fresh[place + stride * entry].all()
                is_fresh[place + stride * entry] = False
        for _, place, rows, columns in plan.late_row[plan.round_late[turn] : plan.round_late[turn + 1]]:
            assert lower[place + rows * np.arange(9 * columns)].all()
        for (_, _, _, target), (_, _, order, stride) in zip(sources, places, strict=True):
            written = is_fresh if order >= PANEL_UPDATE else lower
            if target >= 0:
                assert not written[target + stride * entry].any()
                written[target + stride * entry] = True
    assert lower.sum() == 9 * (plan.item_source[:, 3] >= 0).sum() - 9 * (plan.item_place[:, 2] >= PANEL_UPDATE).sum()
    assert not is_fresh.any()


def test_columns_bound_what_fits() -> None:
    """A structure with a column that no round can hold has no schedule."""
    clique = analyze(np.array([[i, j] for i in range(30) for j in range(i)], dtype=np.int32), 30)
    assert panels.fits(clique, panels.Limits(31, 32, 30))
    assert not panels.fits(clique, panels.Limits(30, 32, 30))
    assert not panels.fits(clique, panels.Limits(31, 31, 30))
    assert not panels.fits(clique, panels.Limits(31, 32, 29))


@pytest.mark.parametrize(("name", "precision", "tolerance"), KINDS)
@pytest.mark.parametrize(("sides", "limits"), [(1, None), (5, None), (2, panels.Limits(40, 40, 40))])
def test_solution_equals_dense(
    symbolic: Symbolic,
    name: str,
    precision: str,
    tolerance: float,
    sides: int,
    limits: panels.Limits | None,
    rng: np.random.Generator,
) -> None:
    """Every world has its own matrix; forward substitution of all sides and the full solve of the first."""
    chosen, worlds, n = variant(name, precision), 3, symbolic.size
    device = "cuda:0" if chosen.world_fastest else "cpu"
    a = allocate(chosen, worlds, 9 * len(symbolic.a_row), device)
    y = allocate(chosen, worlds, 3 * n * sides, device)
    solver = PanelSolver(symbolic, chosen, worlds, sides, y, device, limits)
    blocks = [random_blocks(symbolic, rng) for _ in range(worlds)]
    right = rng.standard_normal((worlds, sides * 3 * n))

    def fill(target: wp.array, values: np.ndarray) -> None:
        target.assign(values.T[None] if chosen.world_fastest else values[:, :, None])

    def values(source: wp.array) -> np.ndarray:
        data = source.numpy().astype(np.float64)
        return data[0].T if chosen.world_fastest else data[:, :, 0]

    fill(a.real, np.array(blocks).reshape(worlds, -1))
    fill(y.real, right)
    solver.factor(a)
    solver.forward(sides)
    halves = values(y.real).reshape(worlds, sides, -1)
    solver.backward()
    solutions = values(y.real)[:, : 3 * n]
    for world in range(worlds):
        matrix = dense(symbolic, blocks[world])
        lower = np.linalg.cholesky(matrix)
        expected = np.linalg.solve(lower, right[world].reshape(sides, -1).T).T
        np.testing.assert_allclose(halves[world], expected, atol=tolerance)
        np.testing.assert_allclose(matrix @ solutions[world], right[world, : 3 * n], atol=100 * tolerance)


def test_large_batches_substitute_in_small_blocks() -> None:
    """From the first world on that has to wait for a block: 132 multiprocessors have 264 at a time."""
    assert [substitution_threads(worlds, 132) for worlds in (1, 264, 265, 1024)] == [512, 512, 256, 256]


@pytest.mark.cuda
@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_blocks_of_both_sizes_give_the_same_bits(precision: str, rng: np.random.Generator) -> None:
    """The half-solved sides, the solution, and a whole step with rows."""
    structure, chosen, worlds, sides = bar((12, 4, 3)), variant("cuda", precision), 5, 4
    blocks = np.array([random_blocks(structure, rng) for _ in range(worlds)]).reshape(worlds, -1)
    right = rng.standard_normal((worlds, 3 * structure.size * sides))
    results = []
    for threads in (512, 256):
        a, y = (allocate(chosen, worlds, values.shape[1], "cuda:0") for values in (blocks, right))
        a.real.assign(blocks.T[None])
        y.real.assign(right.T[None])
        solver = PanelSolver(structure, chosen, worlds, sides, y, "cuda:0")
        solver.threads = threads
        solver.factor(a)
        solver.forward(sides)
        halves = y.real.numpy().copy()
        solver.backward()
        sim = pulled_beam("cuda:0", worlds, "panels", precision)
        sim._systems[0].linear.panels.threads = threads
        sim.control.cable_displacement[:] = 0.002
        sim.step()
        results.append([halves, y.real.numpy(), sim.node_x.cpu().numpy(), sim.cable_tension.cpu().numpy()])
    for one, two in zip(*results, strict=True):
        assert one.tobytes() == two.tobytes()


@pytest.mark.cuda
@pytest.mark.parametrize("path", ["auto", "panels", "levels"])
def test_solvers_of_the_gpu_agree_with_the_cpu(path: str, rng: np.random.Generator) -> None:
    """Panels, and the levels that large batches take, solve to what one thread on a CPU does."""
    structure, worlds = bar((8, 3, 2)), 5
    blocks = random_blocks(structure, rng).reshape(-1)
    right = rng.standard_normal(3 * structure.size)
    results = []
    for name, device in (("scalar", "cpu"), ("cuda", "cuda:0")):
        chosen = variant(name, "float64")
        solver = LinearSolver(structure, upload(structure, device), chosen, worlds, 1, device, path)
        assert (solver.panels is None) == (name == "scalar" or path == "levels")
        a = allocate(chosen, worlds, blocks.size, device)
        for target, value in ((a, blocks), (solver.y, right)):
            data = target.real.numpy()
            data[:] = value[None, :, None]
            target.real.assign(data)
        solver.factor(a)
        solver.forward(1)
        solver.backward()
        results.append(solver.y.real.numpy().reshape(-1, 3 * structure.size if name == "scalar" else worlds))
    np.testing.assert_allclose(results[1], np.broadcast_to(results[0][0][:, None], results[1].shape), atol=1e-12)


@pytest.mark.parametrize("most", [0, MOST_PANELS])
def test_contacts_do_without_panels_that_are_too_many(most: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Their search marks panels in a fixed piece of memory; without contacts any number will do."""
    monkeypatch.setattr(cholesky, "MOST_PANELS", most)
    structure = bar((8, 3, 2))
    for touching in (False, True):
        index, chosen = upload(structure, "cpu"), variant("cuda", "float32")
        solver = LinearSolver(structure, index, chosen, 2, 1, "cpu", contacts=24 if touching else 0)
        assert (solver.panels is None) == (touching and most == 0)


def test_who_takes_panels(monkeypatch: pytest.MonkeyPatch) -> None:
    """Many contacts do in every batch, few in large scenes up to some worlds, scenes without contacts up to fewer."""
    structure = bar((8, 3, 2))
    assert cholesky.panel_worlds(structure, 24) == np.inf  # small
    monkeypatch.setattr(cholesky, "LEAST_SIZE", structure.size)
    few, many = cholesky.MOST_CONTACTS, cholesky.MOST_CONTACTS + 1
    ends = [cholesky.panel_worlds(structure, room) for room in (0, few, many)]
    assert ends == [cholesky.PANEL_WORLDS, cholesky.CONTACT_WORLDS, np.inf]


def pulled_beam(
    device: str = "cpu", worlds: int = 2, path: Any = "auto", precision: Any = "float64"
) -> softwarp.Simulation:
    """A beam with two cables, clamped at one end."""
    builder = softwarp.ModelBuilder()
    beam = builder.add_tets(
        meshing.box((0.1, 0.02, 0.02), (8, 2, 2)), material=softwarp.Corotational(5e5, 0.45), density=1100.0
    )
    builder.fix(beam, box=((-1.0, -1.0, -1.0), (1e-6, 1.0, 1.0)))
    for z in (0.004, 0.016):
        builder.add_cable(beam, [(0.02, 0.01, z), (0.06, 0.01, z), (0.1, 0.01, z)], (0.0, 0.01, z))
    model = builder.finalize(worlds, device, precision)
    return softwarp.Simulation(model, refinement=1, threads=1, solver_path=path)


@pytest.mark.parametrize("most_rows", [1, 48])
def test_step_equals_that_of_the_other_solver(most_rows: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Steps with cables give the same motion: with W, sweeps and correction by one thread block per world, or not."""
    monkeypatch.setattr(cable_block, "MOST_ROWS", most_rows)
    motions = []
    for use in (False, True):
        sim = pulled_beam()
        system = sim._systems[0]
        if use:
            old = system.linear
            old.panels = PanelSolver(old.symbolic, old.variant, old.world_count, 3, old.y, "cpu")
        for step in range(5):
            sim.control.cable_displacement[:, 0] = 0.001 * step
            sim.control.cable_displacement[1, 1] = -0.0005
            sim.step()
        motions.append((sim.node_x.numpy().copy(), sim.cable_tension.numpy().copy(), sim.residual.numpy().copy()))
    np.testing.assert_allclose(motions[1][0], motions[0][0], atol=1e-12)
    np.testing.assert_allclose(motions[1][1], motions[0][1], atol=1e-8)
    assert motions[0][1].max() > 0.1
    assert motions[1][2].max() < 1e-9


def test_paths_of_a_gpu_are_refused_on_a_cpu() -> None:
    """The message says what to choose instead."""
    with pytest.raises(ValueError, match="'panels' is for a GPU; for device 'cpu' choose auto"):
        pulled_beam(path="panels")
    with pytest.raises(ValueError, match="must be one of auto, scalar, lanes, panels, levels, got 'rows'"):
        pulled_beam(path="rows")


@pytest.mark.cuda
@pytest.mark.parametrize(("precision", "tolerance"), [("float64", 1e-10), ("float32", 1e-5)])
def test_worlds_of_a_gpu_do_not_depend_on_the_batch(precision: str, tolerance: float) -> None:
    """World 0 moves alike, to the bit, in batches of all sizes on one path; paths agree to rounding."""
    motions = {}
    for path in ("panels", "levels"):
        for worlds in (1, 5, 600):
            sim = pulled_beam("cuda:0", worlds, path, precision)
            for step in range(4):
                sim.control.cable_displacement[:, 0] = 0.001 * step
                sim.control.cable_displacement[1:, 1] = 0.0005
                sim.step()
            motions[path, worlds] = sim.node_x[0].cpu().numpy()
    for path in ("panels", "levels"):
        np.testing.assert_array_equal(motions[path, 5], motions[path, 1])
        np.testing.assert_array_equal(motions[path, 600], motions[path, 1])
    np.testing.assert_allclose(motions["panels", 1], motions["levels", 1], atol=tolerance)
