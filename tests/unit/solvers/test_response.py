"""Response of static rows and contacts against dense linear algebra and the laws of Signorini and Coulomb."""

import itertools

import numpy as np
import pytest
import warp as wp

from softwarp.kernels.algebra.lanes import Variant, variant
from softwarp.kernels.rows import contact as contact_kernels
from softwarp.kernels.rows import contact_force, contact_strips
from softwarp.plan.ordering import analyze
from softwarp.solvers.collision.contact_list import SLOTS
from softwarp.solvers.linear import strips
from softwarp.solvers.sides import PanelSides, longest_path
from softwarp.solvers.workspace.rows import Rows
from tests.response_cases import (
    HALF,
    INFINITE,
    SOLVERS,
    STEP,
    VARIANTS,
    Case,
    Contact,
    boxes,
    fill_contacts,
    get,
    put,
    random_axes,
    random_case,
    random_contacts,
    random_matrix,
    random_structure,
    variant_of,
)


def test_slots_agree() -> None:
    """The kernels, which may not import the solvers, count the same slots as the contact list."""
    assert contact_kernels.SLOTS == SLOTS
    assert SLOTS % contact_force.CHUNK == 0


def test_longest_path_bounds_every_union(rng: np.random.Generator) -> None:
    """The bound equals the best of all pairs and is reached."""
    symbolic = random_structure(rng)
    above = []
    for row in range(symbolic.size):
        path = {row}
        while symbolic.parent[row] >= 0:
            row = int(symbolic.parent[row])
            path.add(row)
        above.append(path)
    for dofs in (1, 2, 3):
        best = max(len(set().union(*chosen)) for chosen in itertools.combinations(above, dofs))
        assert longest_path(symbolic.parent, dofs) == best
        assert longest_path(symbolic.parent, dofs, np.full(symbolic.size, 3)) == 3 * best


@pytest.mark.parametrize(("name", "precision", "tolerance"), VARIANTS)
def test_matrix_equals_dense(name: str, precision: str, tolerance: float, rng: np.random.Generator) -> None:
    """W = s f P H A^-1 H' P with static rows, prescribed scalars, repeated dofs, and lists of different length."""
    case = random_case(rng, name, precision, static=3)
    case.build()
    for world in range(case.worlds):
        expected = case.reference(world)
        order, used = case.response.order, len(expected)
        found = get(case.response.matrix, world).reshape(order, order)[:used, :used]
        np.testing.assert_allclose(found, expected, atol=tolerance * np.abs(expected).max())


def test_many_contacts_go_down_wide_strips(rng: np.random.Generator) -> None:
    """W of worlds in lanes as above, with more pairs of contacts than go together, an odd one, and wide strips.

    All dofs of a block of 26 are neighbours, so that its columns are strips of eight and one of two, and paths begin
    anywhere in them; below hang the chains of ``random_structure``.
    """
    block = np.array(list(itertools.combinations(range(20, 46), 2)))
    chains = np.array([[i, i + 1] for i in range(19) if i != 9] + [[9, 20], [19, 21]])
    symbolic = analyze(np.concatenate([chains, block]).astype(np.int32), 46)
    case = random_case(rng, "lanes", "float32", static=2, counts=(37, 4, 31), symbolic=symbolic)
    strip = np.diff(strips.starts(symbolic, contact_strips.WIDTH))
    assert strip.max() == contact_strips.WIDTH and 2 * contact_strips.AT_ONCE < 37
    case.build()
    for world in range(case.worlds):
        expected = case.reference(world)
        order, used = case.response.order, len(expected)
        found = get(case.response.matrix, world).reshape(order, order)[:used, :used]
        np.testing.assert_allclose(found, expected, atol=2e-4 * np.abs(expected).max())


def test_dofs_that_gather_forces_have_the_same_bits(rng: np.random.Generator) -> None:
    """Whether a thread adds the forces of a world, one for each dof, or one for some, as in small scenes on a GPU."""
    case = random_case(rng, "scalar", "float64")
    response, n = case.response, 3 * case.n
    put(case.contacts.multiplier, list(rng.standard_normal((case.worlds, 3 * case.contacts.capacity))))
    start, found = rng.standard_normal((case.worlds, n)), []
    c = response.contacts
    rows = [c.dof.real, c.weight.real, c.lever.real, c.axes.real, c.multiplier.real]
    counted, asked = [response.dof_free, c.count.real, *rows], [response.dof_free, c.count.real, c.idle.real, *rows]
    kernels, (packs, _, lanes) = response.k_force, case.u.real.shape
    for kernel, dim, given in (
        (kernels.add_force, (packs, lanes), counted),
        (kernels.gather_force, (packs, case.n, lanes), asked),
        (kernels.share_force, (packs, lanes, 4), [4, *asked]),
    ):
        put(case.u, list(start))
        wp.launch(kernel, dim=dim, inputs=[*given, 0.3], outputs=[case.u.real], device="cpu")
        found.append(np.stack([get(case.u, world) for world in range(case.worlds)]))
    for other in found[1:]:
        np.testing.assert_array_equal(found[0], other)
    assert np.abs(found[0] - start).max() > 0.1


@pytest.mark.parametrize(("name", "precision", "tolerance"), VARIANTS)
def test_gaps_and_forces_equal_dense(name: str, precision: str, tolerance: float, rng: np.random.Generator) -> None:
    """Free gaps from velocities known so far, forces on the right-hand side, recovery of hard contacts, restitution.

    What a late contact penetrates at the start is extrapolated, and nothing to recover from slowly.
    """
    case = random_case(rng, name, precision)
    n = case.n
    v, u, v0 = rng.standard_normal((3, case.worlds, 3 * n))
    for target, value in ((case.v, v), (case.u, u), (case.v0, v0)):
        put(target, list(value))
    for contacts in case.contacts_data:
        for i, c in enumerate(contacts):
            c.restitution = 0.5 * (i % 2)
            c.is_late = i == len(contacts) - 1
    fill_contacts(case.contacts, case.contacts_data)
    case.build()
    case.gaps(recovery=0.1, bounce_speed=0.2, share=0.7)
    for world in range(case.worlds):
        right = case.right(world)
        free = np.linalg.solve(case.dense[world], right) + v[world] + u[world]
        # A prescribed scalar moves as v + u say, and the half-solved side adds nothing to it: its b is zero.
        found = get(case.response.gap, world)
        for i, c in enumerate(case.contacts_data[world]):
            h = c.jacobian(n)
            expected = case.x_scale * h @ free
            before = h[0] @ v0[world]
            target = c.gap
            if c.gap < 0.0 and c.compliance == 0.0 and not c.is_late:
                target = max(0.7 * c.gap, -0.1 * case.x_scale)
            if c.restitution and before < -0.2 and c.gap + case.x_scale * before <= 0.0:
                target = case.x_scale * c.restitution * before
            expected[0] += target
            np.testing.assert_allclose(found[3 * i : 3 * i + 3], expected, atol=30 * tolerance)


@pytest.mark.parametrize(("name", "precision", "tolerance"), VARIANTS)
def test_measured_ends_count_beyond_rounding(
    name: str, precision: str, tolerance: float, rng: np.random.Generator
) -> None:
    """A distance measured at the end of the step tightens a gap by what it lacks beyond 4 eps of the place."""
    case, place = random_case(rng, name, precision), 0.5
    capacity, unit = case.contacts.capacity, 4 * place * float(np.finfo(precision).eps)
    points = np.zeros((capacity, 3))
    points[np.arange(capacity), np.arange(capacity) % 3] = place * (-1.0) ** np.arange(capacity)
    put(case.contacts.point, [points] * case.worlds)
    for contacts in case.contacts_data:
        for i, c in enumerate(contacts):
            c.gap, c.slots = 1e-3 * (-1.0) ** i, [(d, 0.0, 0.0 * r) for d, _, r in c.slots]
    fill_contacts(case.contacts, case.contacts_data)
    case.build()
    lacks = np.resize([-100.0, 0.0, 0.9, 10.0], capacity) * unit
    ends = [np.resize([1e-3, -1e-3], capacity) - lacks] * case.worlds
    case.gaps(share=0.1, end=ends)
    for world, contacts in enumerate(case.contacts_data):
        found = get(case.response.gap, world)
        for i, c in enumerate(contacts):
            target = c.gap if c.gap > 0.0 or c.compliance or c.is_late else 0.1 * c.gap
            expected = target - max(0.0, lacks[i] - unit)
            assert found[3 * i] == pytest.approx(expected, abs=1e-2 * unit)


@pytest.mark.parametrize(("name", "precision", "tolerance"), VARIANTS)
@pytest.mark.parametrize("static", [0, 4])
def test_solution_obeys_the_laws(
    static: int, name: str, precision: str, tolerance: float, rng: np.random.Generator
) -> None:
    """Random systems with bounded rows, of which one has a compliance, and contacts of all kinds."""
    case = random_case(rng, name, precision, static=static)
    if static:
        put(case.lower, [np.array([0.0, -INFINITE, -0.2, 0.3])] * 3)
        put(case.upper, [np.array([INFINITE, INFINITE, 0.2, 0.3])] * 3)
        put(case.response.compliance, [np.array([0.0, 0.5, 0.0, 0.0])] * 3)
        case.static_gap = list(rng.standard_normal((3, static)))
    case.check_laws(case.solve(), tolerance)


@pytest.mark.parametrize(("name", "precision", "tolerance"), VARIANTS)
def test_unbounded_rows_are_exact(name: str, precision: str, tolerance: float, rng: np.random.Generator) -> None:
    """Elimination gives what sweeps over the same rows converge to; a repeated row stays finite."""
    case = random_case(rng, name, precision, static=7, unbounded=(0, 2, 3, 4, 6))
    for h in case.h_static:
        h[4] = h[0] - 2.0 * h[3]
    gaps = rng.standard_normal((3, 7))
    gaps[:, 4] = gaps[:, 0] - 2.0 * gaps[:, 3]
    case.static_gap = list(gaps)
    put(case.lower, [np.array([-INFINITE, 0.0, -INFINITE, -INFINITE, -INFINITE, -0.3, -INFINITE])] * 3)
    put(case.upper, [np.array([INFINITE, INFINITE, INFINITE, INFINITE, INFINITE, 0.3, INFINITE])] * 3)
    put(case.response.compliance, [np.array([0.0, 0.0, 0.1, 0.0, 0.0, 0.1, 0.0])] * 3)
    case.static_start = list(rng.uniform(0.0, 0.3, (3, 7)))
    solution = case.solve()
    case.check_laws(solution, tolerance)


@pytest.mark.parametrize(("name", "precision", "tolerance"), VARIANTS)
def test_frictionless_contacts_equal_enumeration(
    name: str, precision: str, tolerance: float, rng: np.random.Generator
) -> None:
    """Without friction the normal forces are the one solution of an LCP; all active sets are tried."""
    chosen, symbolic = variant_of(name, precision), random_structure(rng)
    n = symbolic.size
    contacts = []
    for dof in rng.permutation(n)[:7]:
        axes = random_axes(rng)
        contacts.append(Contact([(int(dof), 1.0, np.zeros(3))], axes, gap=0.2 * rng.normal(), mu=0.0))
    case = Case(chosen, symbolic, [random_matrix(symbolic, rng)], [rng.standard_normal(3 * n)], [contacts])
    case.solve()
    h = case.jacobian(0)[::3]
    w = h @ np.linalg.solve(case.dense[0], h.T)
    g = h @ np.linalg.solve(case.dense[0], case.forces[0]) + [c.gap for c in contacts]
    solutions = []
    for active in itertools.product((False, True), repeat=len(contacts)):
        a = np.array(active)
        force = np.zeros(len(contacts))
        force[a] = np.linalg.solve(w[np.ix_(a, a)], -g[a]) if a.any() else 0.0
        if (force >= 0.0).all() and (w @ force + g)[~a].min(initial=0.0) >= -1e-12:
            solutions.append(force)
    assert len(solutions) == 1
    assert 0 < np.count_nonzero(solutions[0]) < len(contacts)
    found = get(case.contacts.multiplier, 0)[: 3 * len(contacts)].reshape(-1, 3)
    np.testing.assert_allclose(found[:, 0], solutions[0], atol=10 * tolerance)
    assert (found[:, 1:] == 0.0).all()


@pytest.mark.parametrize("chosen", SOLVERS)
@pytest.mark.parametrize("ratio", [1.0, 0.5, 100.0])
def test_stack_of_ten_boxes(ratio: float, chosen: Variant) -> None:
    """From no forces at all: penetration < 1e-4 of the size, bottom force n m g; ``ratio`` to the last box, or each."""
    masses = {1.0: [0.1] * 10, 0.5: [0.1 * 0.5**i for i in range(10)], 100.0: [0.1] * 9 + [10.0]}[ratio]
    case = boxes(masses, chosen)
    u = case.solve(sweeps=200)[0]
    gaps = STEP * case.jacobian(0)[::3] @ u
    assert gaps.min() > -1e-4 * 2 * HALF
    bottom = get(case.contacts.multiplier, 0)[:12:3].sum()
    np.testing.assert_allclose(bottom, 9.81 * sum(masses), rtol=5e-3 if ratio > 1.0 else 1e-3)


@pytest.mark.parametrize("chosen", SOLVERS)
@pytest.mark.parametrize("angle", [0.0, 20.0, 45.0, 77.0])
def test_block_on_a_slope(angle: float, chosen: Variant) -> None:
    """Sticks iff tan(theta) <= mu; slides with g (sin - mu cos) down the slope whatever its direction: a round cone."""
    direction = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle)), 0.0])
    exact = chosen.real is wp.float64
    for mu in (0.4, 0.5):
        for theta in (np.arctan(mu) * 0.998, np.arctan(mu) * 1.002, 0.8):
            gravity = 9.81 * (np.sin(theta) * direction - np.array([0.0, 0.0, np.cos(theta)]))
            case = boxes([0.3], chosen, mu=mu, gravity=tuple(gravity))
            u = case.solve(sweeps=300)[0][case.linear.symbolic.position[0] * 3 :][:3]
            speed = max(0.0, np.sin(theta) - mu * np.cos(theta)) * 9.81 * STEP
            np.testing.assert_allclose(u, speed * direction, atol=1e-12 if exact else 2e-6)


@pytest.mark.parametrize("chosen", SOLVERS)
def test_chain_of_joints_needs_no_sweeps(chosen: Variant) -> None:
    """Twenty hanging bodies, ball joints above and below: the top carries all; rows are solved by elimination alone."""
    count = 20
    symbolic = analyze(np.array([[2 * i, 2 * i + 1] for i in range(count)], dtype=np.int32), 2 * count)
    place = symbolic.position
    matrix, force = np.zeros((2 * count, 2 * count, 3, 3)), np.zeros((2 * count, 3))
    h = np.zeros((count, 3, 2 * count, 3))
    for i in range(count):
        t, r = int(place[2 * i]), int(place[2 * i + 1])
        matrix[t, t], matrix[r, r] = 0.2 * np.eye(3), 1e-4 * np.eye(3)
        force[t, 2] = -0.2 * 9.81 * STEP
        lever = np.array([0.01, 0.0, 0.05])
        h[i, :, t] = np.eye(3)
        h[i, :, r] = np.cross(lever, np.eye(3))
        if i:
            h[i, :, place[2 * i - 2]] = -np.eye(3)
            h[i, :, place[2 * i - 1]] = np.cross(lever, np.eye(3))
    rows_h = h.reshape(3 * count, -1)
    options = {"rows_h": [rows_h], "unbounded": tuple(range(3 * count)), "capacity": 0}
    case = Case(chosen, symbolic, [matrix], [force.ravel()], [[]], f_scale=STEP, x_scale=STEP, **options)
    u = case.solve(sweeps=1)[0]
    exact = chosen.real is wp.float64
    assert np.abs(rows_h @ u).max() < (1e-12 if exact else 1e-5)
    dense = STEP * rows_h @ np.linalg.solve(case.dense[0], rows_h.T)
    free = rows_h @ np.linalg.solve(case.dense[0], case.forces[0])
    expected = np.linalg.solve(dense, -free)
    found = get(case.multiplier, 0)
    np.testing.assert_allclose(found, expected, atol=1e-9 if exact else 0.05)


@pytest.mark.parametrize("chosen", SOLVERS)
def test_contact_feels_the_joint_behind_it(chosen: Variant, rng: np.random.Generator) -> None:
    """A box welded to the ground by six rows does not move, and contacts that the weld locks stay harmless."""
    for _ in range(5):
        h = random_axes(rng) @ np.eye(3), random_axes(rng)
        rows_h = np.zeros((6, 6))
        rows_h[:3, :3], rows_h[3:, 3:] = h
        rows_h[:3, 3:] = 0.02 * rng.standard_normal((3, 3))
        case = boxes([0.3], chosen, rows_h=rows_h)
        u = case.solve(sweeps=50)[0]
        force = get(case.contacts.multiplier, 0)[:12]
        exact = chosen.real is wp.float64
        np.testing.assert_allclose(u, 0.0, atol=1e-9 if exact else 1e-4)
        assert np.abs(force).max() < 10.0 * 0.3 * 9.81


def test_contact_that_nothing_can_move_keeps_its_force(rng: np.random.Generator) -> None:
    """Between prescribed bodies W is zero: no force appears, nothing becomes infinite."""
    symbolic, chosen = random_structure(rng), variant("lanes")
    n = symbolic.size
    free = np.ones((n, 3))
    free[[2, 5]] = 0.0
    slots = [(2, 1.0, np.zeros(3)), (5, -1.0, np.zeros(3))]
    contacts = [[Contact(slots, random_axes(rng), gap=-0.1), *random_contacts(rng, n, 3)]]
    case = Case(chosen, symbolic, [random_matrix(symbolic, rng)], [rng.standard_normal(3 * n)], contacts, dof_free=free)
    solution = case.solve()[0]
    force = get(case.contacts.multiplier, 0)
    assert np.isfinite(solution).all()
    assert (force[:3] == 0.0).all()
    assert np.abs(force[3:12]).max() > 0.0


@pytest.mark.parametrize("chosen", SOLVERS[1:])
@pytest.mark.parametrize("tolerance", [0.0, 1e-3, 0.1])
def test_worlds_do_not_feel_each_other(tolerance: float, chosen: Variant, rng: np.random.Generator) -> None:
    """A world gives the same bits alone and beside worlds with other contacts that need more or fewer sweeps."""
    symbolic = random_structure(rng)
    n = symbolic.size
    worlds = [
        (random_matrix(symbolic, rng), rng.standard_normal(3 * n), random_contacts(rng, n, count))
        for count in (5, 1, 0, 9, 3)
    ]

    def run(chosen_worlds: list[tuple[np.ndarray, np.ndarray, list[Contact]]]) -> list[tuple[np.ndarray, np.ndarray]]:
        case = Case(chosen, symbolic, *(list(part) for part in zip(*chosen_worlds, strict=True)))
        solution = case.solve(sweeps=60, tolerance=tolerance)
        return [(u, get(case.contacts.multiplier, world)) for world, u in enumerate(solution)]

    together = run(worlds)
    for world, (u, force) in zip(worlds, together, strict=True):
        alone_u, alone_force = run([world])[0]
        np.testing.assert_array_equal(u, alone_u)
        np.testing.assert_array_equal(force, alone_force)


@pytest.mark.parametrize("chosen", SOLVERS[:2])
def test_contacts_that_move_nearly_as_one(chosen: Variant, rng: np.random.Generator) -> None:
    """Contacts of one node, told apart by a tenth of others: twenty sweeps are enough for a third of such worlds.

    Newton's method between them solves nine of ten; some with friction stay hard.
    """
    symbolic, worlds = random_structure(rng), 32
    n = symbolic.size
    nowhere, contacts = np.zeros(3), []
    for _ in range(worlds):
        slots = [[(0, 1.0, nowhere), (1 + i, 0.1 * rng.uniform(0.5, 1.5), nowhere)] for i in range(6)]
        contacts.append([Contact(slot, random_axes(rng) if i % 2 else np.eye(3)) for i, slot in enumerate(slots)])
    matrices = [random_matrix(symbolic, rng) for _ in range(worlds)]
    forces = [rng.standard_normal(3 * n) - np.repeat(np.arange(n) == 0, 3) for _ in range(worlds)]
    case = Case(chosen, symbolic, matrices, forces, contacts)
    tolerance = 1e-9 if chosen.real is wp.float64 else 1e-5
    case.solve(sweeps=20, tolerance=tolerance)
    residual = np.array([get(case.response.residual, world)[0] for world in range(worlds)])
    assert np.mean(residual <= tolerance) > 0.85


@pytest.mark.parametrize("chosen", SOLVERS)
def test_workspace_carries_nothing_over(chosen: Variant, rng: np.random.Generator) -> None:
    """Any garbage in the workspace, such as that of a step with more contacts, leaves the result as it is."""
    symbolic = random_structure(rng)
    n = symbolic.size
    matrix, force = random_matrix(symbolic, rng), rng.standard_normal(3 * n)
    contacts, h = random_contacts(rng, n, 6), rng.standard_normal((4, 3 * n))
    results = []
    for garbage in (False, True):
        case = Case(chosen, symbolic, [matrix], [force], [contacts], rows_h=[h], unbounded=(1, 2))
        put(case.upper, [np.full(4, INFINITE)])
        if garbage:
            for name, value in vars(case.response).items():
                if isinstance(value, Rows) and name not in ("compliance", "everyone", "skipped"):  # not given
                    value.real.fill_(12345 if value.real.dtype is wp.int32 else np.nan)
            put(case.response.gap, [np.zeros(4)])
        results.append(np.concatenate([case.solve(sweeps=30)[0], get(case.multiplier, 0)]))
    np.testing.assert_array_equal(*results)


def test_laws_hold_before_convergence(rng: np.random.Generator) -> None:
    """However few sweeps and however much friction: compression only, inside the cone, finite."""
    chosen, symbolic = variant("scalar", "float32"), random_structure(rng)
    contacts = random_contacts(rng, symbolic.size, 10)
    for c in contacts:
        c.mu = 5.0
    for sweeps in (1, 2, 7, 20):
        force = rng.standard_normal(3 * symbolic.size)
        case = Case(chosen, symbolic, [random_matrix(symbolic, rng)], [force], [contacts])
        case.solve(sweeps=sweeps)
        found = get(case.contacts.multiplier, 0)[:30].reshape(-1, 3)
        assert np.isfinite(found).all()
        assert (found[:, 0] >= 0.0).all()
        assert (np.linalg.norm(found[:, 1:], axis=1) <= 5.0 * found[:, 0] * (1.0 + 1e-6)).all()


def test_unknown_unbounded_row_is_named() -> None:
    """A row that does not exist."""
    with pytest.raises(ValueError, match=r"0 \.\. 2, got 1 \.\. 3"):
        Case(
            variant("scalar"),
            analyze(np.zeros((0, 2), dtype=np.int32), 1),
            [np.eye(3).reshape(1, 1, 3, 3)],
            [np.zeros(3)],
            [[]],
            rows_h=[np.eye(3)],
            unbounded=(1, 3),
        )


@pytest.mark.parametrize("precision", [pytest.param("float32", marks=pytest.mark.slow), "float64"])
def test_kernels_for_contacts_on_many_modes(
    monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator, precision: str
) -> None:
    """Threads that take all three axes, and products from shared memory, run on a CPU: the W that others find."""
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)
    state, found = rng.bit_generator.state, []
    for wide in (False, True):
        monkeypatch.setattr(PanelSides, "is_wide", wide)
        rng.bit_generator.state = state
        case = random_case(rng, "panels", precision, static=2)
        case.build()
        found.append(case.response.contact_sides.side.S.numpy())
        for world in range(case.worlds):
            expected = case.reference(world)
            order, used = case.response.order, len(expected)
            matrix = get(case.response.matrix, world).reshape(order, order)[:used, :used]
            fine = 1.0e-10 if precision == "float64" else 2.0e-4
            np.testing.assert_allclose(matrix, expected, atol=fine * np.abs(expected).max())
    np.testing.assert_array_equal(*found)
