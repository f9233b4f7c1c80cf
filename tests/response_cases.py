"""Problems of static rows and contacts that tests solve densely and with the kernels."""

import itertools
from dataclasses import dataclass, field

import numpy as np
import pytest
import warp as wp

from softwarp.kernels.algebra.lanes import Variant, variant
from softwarp.model.structure import Symbolic
from softwarp.plan.ordering import analyze
from softwarp.solvers.collision import contact_list
from softwarp.solvers.collision.contact_list import SLOTS, ContactList
from softwarp.solvers.linear.cholesky import LinearSolver, PanelSolver, upload
from softwarp.solvers.response import ContactResponse
from softwarp.solvers.workspace.rows import Rows, allocate

VARIANTS = [
    ("scalar", "float64", 1e-10),
    ("scalar", "float32", 2e-4),
    ("lanes", "float32", 2e-4),
    ("panels", "float64", 1e-10),  # the kernels of the GPU, with one thread per block
    pytest.param("cuda", "float64", 1e-10, marks=pytest.mark.cuda),
    pytest.param("cuda", "float32", 2e-4, marks=pytest.mark.cuda),
]
SOLVERS = [
    pytest.param(variant("scalar", "float64"), id="float64"),
    pytest.param(variant("lanes"), id="lanes"),
    pytest.param(variant("cuda"), id="cuda", marks=pytest.mark.cuda),
]
INFINITE = 1e30


def put(target: Rows, worlds: list[np.ndarray]) -> None:
    """Write one vector per world; lanes past the last world keep zeros."""
    data = target.real.numpy()
    lanes = data.shape[2]
    for world, value in enumerate(worlds):
        value = np.asarray(value).ravel()
        data[world // lanes, : value.size, world % lanes] = value
    target.real.assign(data)


def get(source: Rows, world: int) -> np.ndarray:
    """All rows of one world."""
    data = source.real.numpy()
    return data[world // data.shape[2], :, world % data.shape[2]].astype(np.float64)


@dataclass
class Contact:
    """One contact in terms of dofs: ``slots`` are (dof, weight, lever)."""

    slots: list[tuple[int, float, np.ndarray]]
    axes: np.ndarray
    gap: float = 0.0
    mu: float = 0.5
    restitution: float = 0.0
    compliance: float = 0.0
    force: np.ndarray = field(default_factory=lambda: np.zeros(3))
    is_late: bool = False  # behind all others: found where the step leads to

    def jacobian(self, size: int) -> np.ndarray:
        """Rows of H, (3, 3 dofs)."""
        result = np.zeros((3, size, 3))
        for dof, weight, lever in self.slots:
            result[:, dof] += weight * self.axes + np.cross(lever, self.axes)
        return result.reshape(3, -1)


def random_axes(rng: np.random.Generator) -> np.ndarray:
    q, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    return q.T * np.sign(np.linalg.det(q))


def fill_contacts(target: ContactList, worlds: list[list[Contact]]) -> None:
    """Write contact lists, neutral past their ends."""
    capacity = target.capacity
    arrays = {name: [] for name in ("listed", "count", "dof", "weight", "lever", "axes", "gap", "mu", "restitution")}
    arrays |= {"compliance": [], "multiplier": []}
    for contacts in worlds:
        dof, weight, lever = np.full((capacity, SLOTS), -1), np.zeros((capacity, SLOTS)), np.zeros((capacity, SLOTS, 3))
        axes, force, gap = np.zeros((capacity, 3, 3)), np.zeros((capacity, 3)), np.ones(capacity)
        numbers = {name: np.zeros(capacity) for name in ("mu", "restitution", "compliance")}
        for i, c in enumerate(contacts):
            for k, (d, a, r) in enumerate(c.slots):
                dof[i, k], weight[i, k], lever[i, k] = d, a, r
            axes[i], force[i], gap[i] = c.axes, c.force, c.gap
            for name, values in numbers.items():
                values[i] = getattr(c, name)
        values = {"listed": [sum(not c.is_late for c in contacts)], "count": [len(contacts)]}
        values |= {"dof": dof, "weight": weight, "lever": lever, "axes": axes}
        values |= {"gap": gap, "multiplier": force, **numbers}
        for name, value in values.items():
            arrays[name].append(value)
    for name, values in arrays.items():
        put(getattr(target, name), values)


class Case:
    """Some worlds with random matrices, static rows and contacts on one structure, and their dense counterparts."""

    def __init__(
        self,
        chosen: Variant,
        symbolic: Symbolic,
        matrices: list[np.ndarray],
        forces: list[np.ndarray],
        contacts: list[list[Contact]],
        *,
        rows_h: list[np.ndarray] | None = None,
        unbounded: tuple[int, ...] = (),
        dof_free: np.ndarray | None = None,
        capacity: int = 12,
        f_scale: float = 1.0,
        x_scale: float = 1.0,
        in_panels: bool = False,
    ) -> None:
        n, worlds = symbolic.size, len(matrices)
        self.n, self.worlds, self.variant = n, worlds, chosen
        self.f_scale, self.x_scale, self.contacts_data = f_scale, x_scale, contacts
        self.free = np.ones((n, 3)) if dof_free is None else dof_free
        self.static = 0 if rows_h is None else rows_h[0].shape[0]
        self.dense = [m.transpose(0, 2, 1, 3).reshape(3 * n, 3 * n) for m in matrices]
        mask = self.free.ravel()
        self.dense = [np.diag(mask) @ m @ np.diag(mask) + np.diag(1.0 - mask) for m in self.dense]
        self.forces = [f * mask for f in forces]
        self.h_static = rows_h or [np.zeros((0, 3 * n))] * worlds
        device = "cuda:0" if chosen.world_fastest else "cpu"
        index = upload(symbolic, device)
        self.linear = LinearSolver(symbolic, index, chosen, worlds, 1 + self.static, device)
        if in_panels:
            self.linear.panels = PanelSolver(symbolic, chosen, worlds, 1 + self.static, self.linear.y, device)
        self.contacts = contact_list.allocate(chosen, worlds, capacity, device)
        fill_contacts(self.contacts, contacts)
        free = wp.array(self.free, dtype=chosen.real, device=device)
        self.response = ContactResponse(
            symbolic,
            index,
            free,
            chosen,
            worlds,
            self.static,
            self.contacts,
            device,
            unbounded=unbounded,
            panels=self.linear.panels,
        )
        self.a = allocate(chosen, worlds, 9 * len(symbolic.a_row), device)
        blocks = []
        for m in self.dense:
            m4 = m.reshape(n, 3, n, 3).transpose(0, 2, 1, 3)
            blocks.append(m4[symbolic.a_row, symbolic.a_col])
        put(self.a, blocks)
        count = max(self.static, 1)
        self.u, self.v, self.v0 = (allocate(chosen, worlds, 3 * n, device) for _ in range(3))
        self.lower, self.upper, self.multiplier = (allocate(chosen, worlds, count, device) for _ in range(3))
        self.static_gap = [np.zeros(self.static)] * worlds
        self.static_start = [np.zeros(self.static)] * worlds

    def jacobian(self, world: int) -> np.ndarray:
        """Unmasked H of all rows."""
        parts = [self.h_static[world]] + [c.jacobian(self.n) for c in self.contacts_data[world]]
        return np.concatenate(parts)

    def reference(self, world: int) -> np.ndarray:
        """Dense W of static rows and contacts."""
        h = self.jacobian(world) * self.free.ravel()
        return self.f_scale * self.x_scale * h @ np.linalg.solve(self.dense[world], h.T)

    def build(self) -> None:
        """Factor, half-solve, W."""
        self.linear.factor(self.a)
        self.response.sides(self.linear)
        put(self.multiplier, self.static_start)
        sides = []
        for b, h, start in zip(self.forces, self.h_static, self.static_start, strict=True):
            h = h * self.free.ravel()
            sides.append(np.concatenate([b + self.f_scale * h.T @ start, *h]))
        put(self.linear.y, sides)
        self.response.add_forces(self.linear.y, self.f_scale)
        self.linear.forward(1 + self.static)
        self.response.delassus(self.linear.y, self.f_scale * self.x_scale)

    def gaps(
        self,
        recovery: float = INFINITE,
        bounce_speed: float = 0.0,
        share: float = 1.0,
        end: list[np.ndarray] | None = None,
    ) -> None:
        """Free gaps of contacts; those of static rows from dense algebra with the multipliers at hand."""
        measured = None
        if end is not None:
            measured = allocate(self.variant, self.worlds, self.contacts.capacity, self.response.device)
            put(measured, end)
        self.response.gaps(
            self.linear.y,
            u=self.u,
            v=self.v,
            v0=self.v0,
            x_scale=self.x_scale,
            recovery=recovery,
            bounce_speed=bounce_speed,
            share=share,
            end=measured,
        )
        data = self.response.gap.real.numpy()
        for world in range(self.worlds):
            right = self.right(world)
            free = self.h_static[world] @ np.linalg.solve(self.dense[world], right)
            lanes = data.shape[2]
            data[world // lanes, : self.static, world % lanes] = self.static_gap[world] + self.x_scale * free
        self.response.gap.real.assign(data)

    def right(self, world: int) -> np.ndarray:
        """b + f P H' of the multipliers that the solution starts with."""
        total = self.forces[world] + self.f_scale * self.free.ravel() * (
            self.h_static[world].T @ self.static_start[world]
        )
        for c in self.contacts_data[world]:
            total += self.f_scale * self.free.ravel() * (c.jacobian(self.n).T @ c.force)
        return total

    def solve(self, sweeps: int = 2000, tolerance: float = 0.0) -> list[np.ndarray]:
        """Everything; returns u of every world."""
        self.build()
        self.gaps()
        self.response.solve(self.lower, self.upper, self.multiplier, sweeps=sweeps, tolerance=tolerance)
        self.response.add_change(self.linear.y, self.f_scale)
        self.linear.backward()
        return [get(self.linear.y, world)[: 3 * self.n] for world in range(self.worlds)]

    def check_laws(self, solution: list[np.ndarray], tolerance: float) -> None:
        """Signorini, Coulomb with maximal dissipation, bounds of static rows, and A u = b + f H' multiplier."""
        for world, u in enumerate(solution):
            force = get(self.contacts.multiplier, world)
            static = get(self.multiplier, world)[: self.static]
            contacts = self.contacts_data[world]
            force = force[: 3 * len(contacts)]
            h = self.jacobian(world)
            right = self.forces[world] + self.f_scale * self.free.ravel() * (h.T @ np.concatenate([static, force]))
            scale = max(1.0, np.abs(right).max())
            np.testing.assert_allclose(self.dense[world] @ u, right, atol=20 * tolerance * scale)
            motion = self.x_scale * h @ u
            gap = self.static_gap[world] + motion[: self.static]
            gap = gap + get(self.response.compliance, world)[: self.static] * static
            lower, upper = get(self.lower, world)[: self.static], get(self.upper, world)[: self.static]
            clamped = np.clip(static - gap, lower, upper)
            np.testing.assert_allclose(static, clamped, atol=20 * tolerance * scale)
            for i, c in enumerate(contacts):
                n, t = force[3 * i], force[3 * i + 1 : 3 * i + 3]
                slip = motion[self.static + 3 * i :][:3]
                normal = c.gap + slip[0] + c.compliance * n
                assert n >= 0.0
                np.testing.assert_allclose(max(n - normal, 0.0), n, atol=20 * tolerance * scale)
                trial = t - slip[1:]
                length = np.linalg.norm(trial)
                expected = trial * min(1.0, c.mu * n / max(length, 1e-300))
                np.testing.assert_allclose(t, expected, atol=20 * tolerance * scale)


def random_matrix(symbolic: Symbolic, rng: np.random.Generator) -> np.ndarray:
    """Symmetric positive definite on the structure, (n, n, 3, 3), poorly conditioned."""
    n = symbolic.size
    matrix = np.zeros((n, n, 3, 3))
    for i, j in zip(symbolic.a_row[n:], symbolic.a_col[n:], strict=True):
        d = rng.standard_normal(3)
        k = np.outer(d, d) + 0.1 * np.eye(3)
        matrix[i, i] += k
        matrix[j, j] += k
        matrix[i, j] -= k
        matrix[j, i] -= k
    matrix[np.arange(n), np.arange(n)] += 0.3 * np.eye(3)
    return matrix


def random_structure(rng: np.random.Generator, n: int = 20) -> Symbolic:
    """Two bodies: a chain with chords, and another one."""
    first = np.array([[i, i + 1] for i in range(n // 2 - 1)])
    chords = rng.integers(0, n // 2, (6, 2))
    second = np.array([[i, i + 1] for i in range(n // 2, n - 1)])
    return analyze(np.concatenate([first, chords, second]).astype(np.int32), n)


def random_contacts(rng: np.random.Generator, n: int, count: int) -> list[Contact]:
    """Contacts between up to six dofs, some of them repeated, translations and rotations."""
    result = []
    for _ in range(count):
        slots = []
        for dof in rng.integers(0, n, rng.integers(1, 7)):
            if rng.random() < 0.7:
                slots.append((int(dof), float(rng.normal()), np.zeros(3)))
            else:
                slots.append((int(dof), 0.0, rng.standard_normal(3)))
        contact = Contact(slots, random_axes(rng), gap=0.3 * rng.normal(), mu=rng.choice([0.0, 0.3, 1.0]))
        contact.compliance = float(rng.choice([0.0, 0.2]))
        contact.force = np.array([abs(rng.normal()), 0.0, 0.0])
        result.append(contact)
    return result


def variant_of(name: str, precision: str) -> Variant:
    """The kernels of panels run with those of one thread."""
    return variant("scalar" if name == "panels" else name, precision)


def random_case(
    rng: np.random.Generator,
    name: str,
    precision: str,
    *,
    static: int = 0,
    unbounded: tuple[int, ...] = (),
    counts: tuple[int, int, int] = (5, 0, 8),
    symbolic: Symbolic | None = None,
) -> Case:
    """Three worlds with ``counts`` contacts, on a random structure if none is given."""
    chosen = variant_of(name, precision)
    symbolic = random_structure(rng) if symbolic is None else symbolic
    n, worlds = symbolic.size, 3
    free = np.ones((n, 3))
    free[4] = 0.0
    free[7, 1] = 0.0
    matrices = [random_matrix(symbolic, rng) for _ in range(worlds)]
    forces = [rng.standard_normal(3 * n) for _ in range(worlds)]
    contacts = [random_contacts(rng, n, count) for count in counts]
    h = [rng.standard_normal((static, 3 * n)) for _ in range(worlds)] if static else None
    options = {"f_scale": 0.5, "x_scale": 0.8, "dof_free": free, "rows_h": h, "unbounded": unbounded}
    options["capacity"] = max(12, *counts)
    options["in_panels"] = name == "panels"
    return Case(chosen, symbolic, matrices, forces, contacts, **options)


HALF = 0.05  # half edge of a box [m]
STEP = 0.01  # [s]


def boxes(
    masses: list[float],
    chosen: Variant,
    *,
    mu: float = 0.5,
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81),
    rows_h: np.ndarray | None = None,
) -> Case:
    """Rigid boxes stacked on the ground, each on four corners: one step from rest; unknowns are velocities."""
    count = len(masses)
    symbolic = analyze(np.array([[2 * i, 2 * i + 1] for i in range(count)], dtype=np.int32), 2 * count)
    place = symbolic.position
    matrix, force = np.zeros((2 * count, 2 * count, 3, 3)), np.zeros((2 * count, 3))
    contacts = []
    for i, mass in enumerate(masses):
        t, r = int(place[2 * i]), int(place[2 * i + 1])
        matrix[t, t], matrix[r, r] = mass * np.eye(3), mass * (2 * HALF) ** 2 / 6 * np.eye(3)
        force[t] = mass * STEP * np.array(gravity)
        for x, y in itertools.product((-HALF, HALF), repeat=2):
            slots = [(t, 1.0, np.zeros(3)), (r, 0.0, np.array([x, y, -HALF]))]
            if i:
                slots += [(int(place[2 * i - 2]), -1.0, np.zeros(3))]
                slots += [(int(place[2 * i - 1]), 0.0, -np.array([x, y, HALF]))]
            contacts.append(Contact(slots, np.roll(np.eye(3), 1, axis=0), mu=mu))
    options = {"capacity": len(contacts), "f_scale": STEP, "x_scale": STEP}
    if rows_h is not None:
        options |= {"rows_h": [rows_h], "unbounded": tuple(range(len(rows_h)))}
    return Case(chosen, symbolic, [matrix], [force.ravel()], [contacts], **options)
