"""Elimination orders turned towards contacts: the same fill, shorter ways for contacts, and digests as before."""

from collections.abc import Callable

import numpy as np
import pytest

import softwarp as sw
from softwarp import meshing
from softwarp.model.structure import IntArray, Symbolic
from softwarp.plan import compile as compiling
from softwarp.plan import ordering, turning
from softwarp.plan.ordering import analyze

CONTACTS = 24


def bar(count: int = 1) -> tuple[IntArray, int, np.ndarray]:
    """Pattern of some bars that nothing couples: edges, blocks and their places."""
    mesh = meshing.box((3.0, 0.4, 0.4), (30, 3, 3))
    pairs = [(a, b) for a in range(4) for b in range(a)]
    edges = np.concatenate([mesh.tets[:, pair] for pair in pairs])
    n = len(mesh.nodes)
    nodes = [mesh.nodes + [0.0, 5.0 * k, 0.0] for k in range(count)]
    return np.concatenate([edges + k * n for k in range(count)]), count * n, np.concatenate(nodes)


def at_the_end(nodes: np.ndarray) -> np.ndarray:
    """Contacts at the far end of the first bar."""
    near = (nodes[:, 0] > 2.75) & (nodes[:, 1] < 1.0)
    return near / near.sum()


def products(symbolic: Symbolic) -> int:
    below = np.diff(symbolic.col_start).astype(np.int64)
    return int((below * (below + 1) // 2).sum())


def paths(symbolic: Symbolic) -> tuple[np.ndarray, np.ndarray]:
    """Columns, and blocks below their diagonals, from every row of A to its root."""
    steps, blocks = np.ones(symbolic.size), np.diff(symbolic.col_start).astype(np.float64)
    for column in range(symbolic.size - 1, -1, -1):
        above = symbolic.parent[column]
        if above >= 0:
            steps[column] += steps[above]
            blocks[column] += blocks[above]
    return steps[symbolic.position], blocks[symbolic.position]


@pytest.mark.parametrize("count", [1, 2])
def test_contacts_come_late_and_nothing_else_is_filled(count: int) -> None:
    """Cliques of a chordal graph can be eliminated towards any of them; all of their products are its triangles."""
    edges, blocks, nodes = bar(count)
    touch = at_the_end(nodes)
    plain, turned = (analyze(edges, blocks, nodes, CONTACTS, at) for at in (None, touch))
    assert turned.col_start[-1] == plain.col_start[-1]
    assert products(turned) == products(plain)
    (steps, ways), (steps_before, ways_before) = paths(turned), paths(plain)
    assert touch @ ways < 0.5 * touch @ ways_before
    assert touch @ steps < 0.5 * touch @ steps_before
    if count == 2:  # the other bar has no contacts
        other = nodes[:, 1] > 1.0
        assert steps[other].sum() == steps_before[other].sum()


def test_costs_are_those_of_the_new_structure() -> None:
    """What is compared are the ways that a new analysis of the pattern in this order finds."""
    edges, blocks, nodes = bar()
    edges = ordering._unique_edges(edges)
    order = ordering._nested_dissection(edges, nodes, 24, is_large=False)
    structure, touch = ordering._factor_pattern(edges, order), at_the_end(nodes)[order]
    forest = turning._forest(structure, touch)
    root = forest.above.index(-1)
    for clique in turning._candidates(forest, root):
        followed = turning._Order(forest, touch).follow(clique)
        columns = followed.columns()
        np.testing.assert_array_equal(np.sort(columns), np.arange(blocks))
        kept = turning._Order(forest, touch)
        kept.keep(ordering._factor_pattern(edges, order[columns]))
        np.testing.assert_array_equal(kept.steps, followed.steps[columns])
        np.testing.assert_array_equal(kept.blocks, followed.blocks[columns])


def test_orders_stay_where_little_is_gained() -> None:
    """Contacts all over a bar, none at all, few blocks, and a GPU, whose models give no places."""
    edges, blocks, nodes = bar()
    plain = analyze(edges, blocks, nodes, CONTACTS)
    for touch in (np.full(blocks, 1.0 / blocks), np.zeros(blocks)):
        np.testing.assert_array_equal(analyze(edges, blocks, nodes, CONTACTS, touch).order, plain.order)
    chain = np.array([(k, k + 1) for k in range(turning.FEW - 1)], dtype=np.int32)
    structure = ordering._factor_pattern(chain, np.arange(turning.FEW, dtype=np.int32))
    assert turning.turn(structure, np.eye(turning.FEW)[0], CONTACTS) is None


def chamber(law: str) -> sw.ModelBuilder:
    """A bar with a chamber above the ground."""
    builder = scene(sw.Corotational(1e5, 0.4, method="large") if law == "large" else sw.NeoHookean(1e5, 0.4))
    mesh = builder.bodies[0].mesh
    inside = meshing.box((0.1, 0.02, 0.02), (1, 1, 1))
    triangles = meshing.tet_surface(inside.tets)
    builder.add_cavity(0, inside.nodes + mesh.nodes.mean(axis=0) - inside.nodes.mean(axis=0), triangles)
    return builder


def scene(material: sw.Material | None = None) -> sw.ModelBuilder:
    """A bar, held at one end, whose other end hangs just above a block."""
    builder = sw.ModelBuilder()
    material = material or sw.Corotational(1e5, 0.4, method="large")
    body = builder.add_tets(meshing.box((0.6, 0.06, 0.06), (20, 2, 2)), material=material, density=1000.0)
    builder.fix(body, box=((-1.0, -1.0, -1.0), (1e-6, 1.0, 1.0)))
    block = builder.add_rigid(sw.Box((0.1, 0.1, 0.1)), kinematic=True, pose=(0.57, 0.03, -0.051))
    builder.add_contact(body, block, mu=0.5)
    return builder


def both_ways(make: Callable[[], sw.ModelBuilder], monkeypatch: pytest.MonkeyPatch) -> list[sw.Model]:
    """The model of a scene on a CPU, and with the order that a GPU has."""
    models = [make().finalize(precision="float64")]
    plain_structure = compiling._structure
    monkeypatch.setattr(compiling, "_structure", lambda *given, is_cpu: plain_structure(*given, is_cpu=False))
    return [*models, make().finalize(precision="float64")]


@pytest.mark.parametrize(
    ("make", "is_turned"), [(scene, True), (lambda: chamber("large"), True), (lambda: chamber("neo_hookean"), False)]
)
def test_digests_do_not_depend_on_it(
    make: Callable[[], sw.ModelBuilder], is_turned: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Snapshots serve every device, of which only CPUs turn; lists of some chambers' tangents are in the digest."""
    turned, plain = both_ways(make, monkeypatch)
    assert turned.fingerprint == plain.fingerprint
    assert np.array_equal(turned.symbolic.order, plain.symbolic.order) != is_turned


def test_motion_does_not_depend_on_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """The end of a bar falls on a block; up to rounding it goes the same way."""
    ways = []
    for model in both_ways(scene, monkeypatch):
        sim = sw.Simulation(model, dt=0.01)
        for _ in range(30):
            sim.step()
        assert sim.contact_load.norm() > 0.01  # N
        ways.append(sim.node_x.numpy())
    np.testing.assert_allclose(ways[0], ways[1], atol=1e-10)
