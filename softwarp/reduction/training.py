"""From recorded motion to a reduction: modes, then elements that stand for all. Theory: docs/theory/reduction.md."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softwarp import checks, notices
from softwarp.reduction import contact
from softwarp.reduction.basis import NORMS, Basis, Norm, Rigid, pod
from softwarp.reduction.elements import Elements, elements_of
from softwarp.reduction.file import FRAMES, Element, Frame, Reduction
from softwarp.reduction.floating import unturned
from softwarp.reduction.motion import Motion
from softwarp.reduction.packing import halves
from softwarp.reduction.sampling import Sampling, sample_elements
from softwarp.scene import SoftBody
from softwarp.simulation import Simulation

FloatArray = NDArray[np.float64]
ROOM = 1.2e9  # bytes of contributions; more rows are mixed at random into fewer, which keeps lengths
STILL = 1e-12  # m or m^3: an actuator that went less far in training was not moved
MIXED_ROWS = 3000
TOGETHER = 1024  # elements whose forces are projected at a time
SHARES = 4  # of the fewer rows that a row is mixed into
PRESSED = 400  # states whose contact forces modes for contact come from
SMALL = 0.5  # of a mode's root mean square in the motion: what is added of it to see its stiffness
HALVINGS = 12
SOFTEST = 1e-9  # of the largest stiffness: softer combinations of modes are rigid
TORQUES = 10.0  # how much more a torque per weight and length counts than an amplitude per that of the state


def train(
    sim: Simulation,
    motion: Motion,
    body: SoftBody | int = 0,
    *,
    modes: int | None = None,
    tolerance: float = 1e-3,
    rigid: Rigid | None = None,
    frame: Frame = "fixed",
    contact_modes: int = 0,
    norm: Norm = "mass",
    mirrored: bool = False,
    element_tolerance: float | None = 0.03,
    membrane_tolerance: float | None = 0.03,
    states: int = 96,
    still: tuple[str, ...] = (),
    seed: int = 0,
) -> Reduction:
    """Reduce a soft body to modes, and its elements to a few with weights.

    Args:
        sim: The full model; its state is put back afterwards. Best in float64.
        motion: How the body moves, of this scene: ``record``.
        body: From ``add_tets``.
        modes: Modes besides rigid ones; None takes as few as ``tolerance`` allows.
        tolerance: Largest part of the motion that the modes may leave out.
        rigid: Modes that come first, as of ``pod``; None takes ``translations`` for a body that nothing holds.
        frame: ``floating`` for a body that nothing holds and that turns: its modes then are those of deformation
            alone, in axes that move and turn with it. In a ``fixed`` frame it turns as far as the motion does, at best.
        contact_modes: Modes besides, for what the motion's contact forces bring about and the others leave out.
        norm: Lengths of displacements that modes are chosen by: those of ``mass``, or those that a ``step`` of the
            simulation sees, of mass and stiffness at rest.
        mirrored: Whether every mode is to be its own mirror image in the plane y = 0, or that turned round, for a robot
            that is its own: modes are of the even and the odd halves of the motion. A compact file holds half of each.
        element_tolerance: Error of the tets' forces, as a part of the displacements that they go with; None keeps all.
        membrane_tolerance: Likewise of the membranes' triangles.
        states: States that elements are chosen by, drawn from the motion.
        still: Names of actuators that are not meant to move.
        seed: Of the draws.

    Raises:
        ValueError: If the motion belongs to another scene, an actuator of the body did not move in it, nothing moved,
            modes for contact are asked for and nothing touched, a tolerance would keep no element, or a floating frame
            is asked for and the body is held or has rigid modes, or modes that mirror a mesh that does not.
    """
    number, model = _body(sim, body), sim.model
    if motion.positions.shape[1:] != (model.node_count, 3):
        raise ValueError(
            f"motion: it has {motion.positions.shape[1]} nodes, and the scene has {model.node_count}; record it with "
            "this scene"
        )
    checks.count(states, "states")
    checks.count(contact_modes, "contact_modes", low=0)
    seed, mirrored = checks.seed(seed), checks.flag(mirrored, "mirrored")
    _refuse_still(sim, number, motion, still)
    if model.hexes is not None and (model.hexes.layout.body == number).any():
        name = model.body_names[number]
        raise ValueError(f"reduction.train: body {name!r} has hexahedra, which cannot be reduced yet; take tetrahedra")
    nodes = slice(int(model.body_node_start[number]), int(model.body_node_start[number + 1]))
    rest, held = model.node_rest[nodes], model.node_fixed[nodes]
    mass = sim.mass[0, nodes].double().cpu().numpy()
    element: Element = "p1" if (model.tet_body.numpy() == number).any() else "p2"
    if checks.choice(frame, "frame", FRAMES) == "floating":
        if element == "p2":
            raise ValueError(
                f"frame='floating': body {model.body_names[number]!r} has quadratic tets, which a fixed frame alone "
                "takes; use frame='fixed', or linear ones ('p1')"
            )
        _refuse_tied(model.body_names[number], held, rigid)
        motion, rigid = unturned(motion, nodes, rest, mass), "none"
    learned, unseen = motion.split(seed=seed)
    first: Rigid = ("none" if held.any() else "translations") if rigid is None else rigid
    moved = np.where(held[None, :, None], 0.0, learned.positions[:, nodes].astype(np.float64) - rest)
    with _kept(sim):
        by_step = checks.choice(norm, "norm", NORMS) == "step"
        K = elements_of(sim, number, nodes).stiffness() if by_step or contact_modes else None
    pressed = _pressed(sim, number, nodes, learned, mass, held, K, seed) if contact_modes else None
    if mirrored:
        pressed = None if pressed is None else halves(pressed, rest)
    basis = pod(
        halves(moved, rest) if mirrored else moved,
        mass,
        rest,
        count=modes,
        tolerance=tolerance,
        rigid=first,
        contact=pressed,
        contact_count=contact_modes,
        metric=_seen_by_steps(sim, number, mass, K) if by_step else None,
    )
    if held.any() and basis.rigid:
        raise ValueError(f"rigid={first!r}: body {model.body_names[number]!r} is held, so that it cannot move rigidly")
    chosen = learned.chosen(states, seed).positions[:, nodes].astype(np.float64) - rest
    away = unseen.positions[:, nodes].astype(np.float64) - rest
    with _kept(sim):
        forces = _Forces(elements_of(sim, number, nodes), basis)
        stands = frame == "fixed" and not held.any()
        moment = _weight(sim, mass) * float(np.ptp(rest, axis=0).max()) if stands else 0.0
        tets, thin = forces.contributions(_states(forces, _amplitudes(basis, mass, chosen), seed))
        if moment:
            turning = forces.torques(_amplitudes(basis, mass, chosen), mass, TORQUES / moment)
            tets = np.concatenate([tets, turning[0]])
            thin = {k: np.concatenate([part, more]) for (k, part), more in zip(thin.items(), turning[1:], strict=True)}
        sampled = {"tets": _sample(tets, element_tolerance, "tets")}
        sampled |= {name: _sample(part, membrane_tolerance, f"membrane {name!r}") for name, part in thin.items()}
        unseen_residuals = _unseen(forces, sampled, _amplitudes(basis, mass, away[:states]))
        unseen_torques = _torques(forces, sampled, _amplitudes(basis, mass, away[:states]), mass, moment)
    report: dict[str, Any] = {
        "snapshots": len(motion),
        "states": len(chosen),
        "missing": basis.missing,
        "amplitudes": np.sqrt((_amplitudes(basis, mass, moved) ** 2).mean(axis=0)).tolist(),
        "unseen_error": _left_out(basis, mass, away),
        "unseen_motion": float(np.linalg.norm(away, axis=-1).mean()),
        "residuals": {name: part.residual for name, part in sampled.items()},
        "unseen_residuals": unseen_residuals,
        "unseen_torques": unseen_torques,
    }
    return Reduction(
        name=model.body_names[number],
        nodes=rest,
        tets=forces.elements.tets.astype(np.int32),
        modes=basis.modes,
        rigid=basis.rigid,
        singular_values=basis.singular_values,
        tet_weight=sampled["tets"].weight,
        membrane_weight={name: part.weight for name, part in sampled.items() if name != "tets"},
        report=report,
        share=mass / mass.sum(),
        frame=frame,
        element=element,
    )


def _refuse_tied(name: str, held: NDArray[np.bool_], rigid: Rigid | None) -> None:
    """Refuse a floating frame of a body that cannot move as a whole, or whose modes would move it too."""
    if held.any():
        raise ValueError(
            f"frame='floating': {int(held.sum())} nodes of body {name!r} are fixed, so that it cannot move as a whole; "
            "use frame='fixed'"
        )
    if rigid not in (None, "none"):
        raise ValueError(
            f"rigid={rigid!r}: a floating frame moves body {name!r} rigidly itself; leave rigid out, or use "
            "frame='fixed'"
        )


def _pressed(
    sim: Simulation,
    number: int,
    nodes: slice,
    motion: Motion,
    mass: FloatArray,
    held: NDArray[np.bool_],
    K: Any,
    seed: int,
) -> FloatArray:
    """What contact forces of some states of the motion do to the body at rest [m], (state, node, 3)."""
    touched = np.zeros(0, dtype=np.int64)
    if motion.touch is not None:
        touched = np.flatnonzero(motion.touch[:, nodes].any(axis=(1, 2)))
    if touched.size == 0:
        raise ValueError(
            f"contact_modes: nothing touches body {sim.model.body_names[number]!r} in the motion; leave them out, or "
            "record motion with contact"
        )
    assert motion.touch is not None
    draws = np.random.default_rng(seed)
    chosen = np.sort(draws.permutation(touched)[:PRESSED])
    rest = sim.model.node_rest[nodes]
    return contact.responses(K, mass, rest, held, motion.touch[chosen][:, nodes].astype(np.float64))


def _seen_by_steps(sim: Simulation, number: int, mass: FloatArray, K: Any) -> Any:
    """M + (h^2 + h b) K per whole mass: what implicit Euler solves with, b the Rayleigh factor of stiffness."""
    from scipy.sparse import diags_array

    damping = float(sim.params.rayleigh_stiffness[0, number])
    scale = sim.dt * (sim.dt + damping)
    return ((diags_array(np.repeat(mass, 3)) + scale * K) / mass.sum()).tocsr()


def _weight(sim: Simulation, mass: FloatArray) -> float:
    """Weight of a body in the first world [N]."""
    return float(mass.sum() * np.linalg.norm(sim.params.gravity[0].double().cpu().numpy()))


@contextmanager
def _kept(sim: Simulation) -> Iterator[None]:
    """Positions as they were, once it is over."""
    before = sim.node_x.clone()
    try:
        yield
    finally:
        sim.node_x.copy_(before)
        sim.refresh()


def _body(sim: Simulation, body: SoftBody | int) -> int:
    """Number of a soft body that moves node by node."""
    number = checks.count(int(body), f"body of {sim.model.body_count}", low=0, high=sim.model.body_count - 1)
    if sim.model.reduction is not None:
        raise ValueError("train needs the full model, and this scene has reduced bodies")
    return number


def _refuse_still(sim: Simulation, body: int, motion: Motion, still: tuple[str, ...]) -> None:
    """Refuse motion in which an actuator stood still: the modes would not know what it does."""
    cavities = sim.model.cavities
    held: Sequence[int] = [] if cavities is None else cavities.body.tolist()
    own = [name for name, b in zip(sim.model.cavity_names, held, strict=True) if b == body]
    names = (*sim.model.cable_names, *sim.model.cavity_names)
    unknown = [name for name in still if name not in names] if isinstance(still, (tuple, list)) else [still]
    if unknown:
        raise ValueError(f"still: the scene has no actuator {unknown[0]!r}; give names of {', '.join(names) or 'none'}")
    for name in (*sim.model.cable_names, *own):
        if name not in still and motion.travel.get(name, np.inf) <= STILL:
            raise ValueError(
                f"motion: {name!r} did not move in it, so that the modes would not know what it does; excite it, or "
                f"name it in still=({name!r},)"
            )


def _amplitudes(basis: Basis, mass: FloatArray, displacements: FloatArray) -> FloatArray:
    """Nearest amplitudes in mass, (state, mode)."""
    weighted = basis.modes * (mass / mass.sum())[None, :, None]
    q: FloatArray = np.einsum("knc,snc->sk", weighted, displacements, optimize=True)
    return q


def _left_out(basis: Basis, mass: FloatArray, displacements: FloatArray) -> float:
    """Mean distance of nodes from the nearest state of the modes [m]."""
    q = _amplitudes(basis, mass, displacements)
    nearest = np.einsum("sk,knc->snc", q, basis.modes, optimize=True)
    return float(np.linalg.norm(displacements - nearest, axis=-1).mean())


def _states(forces: _Forces, q: FloatArray, seed: int) -> list[_State]:
    """States whose forces the chosen elements must have: of the motion, and what a little of each mode adds to them.

    Forces of the motion alone leave stiffness open in directions that it hardly pushes into; a mode is therefore added
    to the rest and to one state of the motion, as large as it occurs.
    """
    draws = np.random.default_rng(seed)
    size = SMALL * np.sqrt((q**2).mean(axis=0)).clip(min=1e-9 * np.abs(q).max())
    rest, steps = np.zeros(q.shape[1]), np.diag(size)
    steps = forces.bearable(np.zeros_like(steps), steps)
    forces.measure(steps, size)
    steps = steps[forces.basis.rigid :]
    bases = q[draws.integers(len(q), size=len(steps))]
    found = [_State(state, rest) for state in q] + [_State(step, rest) for step in steps]
    return found + [_State(base + step, base) for base, step in zip(bases, forces.bearable(bases, steps), strict=True)]


@dataclass(frozen=True)
class _State:
    """Amplitudes, and others whose forces are taken away."""

    q: FloatArray
    base: FloatArray


class _Forces:
    """Forces of single elements on modes, at given amplitudes.

    Args:
        elements: Of a body.
        basis: Modes.

    Attributes:
        metric: From forces on modes to the amplitudes that they bring about at rest, each per root of how large it
            occurs: halfway between absolute and relative errors, (mode, mode); a unit matrix before ``measure``.
    """

    def __init__(self, elements: Elements, basis: Basis) -> None:
        self.elements, self.basis = elements, basis
        self.metric = np.eye(len(basis.modes))
        self.tables = elements.tables(basis.modes)

    def bearable(self, bases: FloatArray, steps: FloatArray) -> FloatArray:
        """Steps from some amplitudes, each halved until all elements have finite forces, (state, mode).

        A law may have none where a mode alone turns an element inside out.

        Raises:
            ValueError: If one is still too large after many halvings.
        """
        steps = steps.copy()
        for _ in range(HALVINGS):
            bad = [
                not all(np.isfinite(f).all() for f in parts) for parts in self.elements.at(self._moved(bases + steps))
            ]
            if not any(bad):
                return steps
            steps[bad] *= 0.5
        raise ValueError(
            f"train: {sum(bad)} states of the motion, projected on the modes, turn elements inside out, where their "
            "law has no force; take more modes"
        )

    def measure(self, steps: FloatArray, size: FloatArray) -> None:
        """The metric, from forces at small multiples of every mode, and from how large each occurs."""
        forces = np.stack([sum(part.sum(axis=1) for part in parts) for parts in self._on_modes(steps)])
        stiffness = forces / np.diag(steps)[:, None]
        values, vectors = np.linalg.eigh(0.5 * (stiffness + stiffness.T))
        strong = values > SOFTEST * values.max()
        compliance = (vectors[:, strong] / values[strong]) @ vectors[:, strong].T
        self.metric = compliance / np.sqrt(size / size.max())[:, None]

    def contributions(self, states: Sequence[_State]) -> tuple[FloatArray, dict[str, FloatArray]]:
        """Contributions of the tets and of every membrane's triangles, (row, element).

        They are amplitudes, and those of all elements together have the length 1, to which every state adds the same.
        """
        sizes = [len(table) for table in self.tables]
        each, rows = len(self.metric), len(states) * len(self.metric)
        mixing = _Mixing(rows) if rows * sum(sizes) * 8 > ROOM and rows > MIXED_ROWS else None
        found = [np.zeros((rows if mixing is None else MIXED_ROWS, size)) for size in sizes]
        at, base = (self._on_modes(np.array([getattr(s, name) for s in states])) for name in ("q", "base"))
        for state, (parts, others) in enumerate(zip(at, base, strict=True)):
            span = slice(state * each, (state + 1) * each)
            changes = [self.metric @ (part - other) for part, other in zip(parts, others, strict=True)]
            size = np.linalg.norm(np.sum([change.sum(axis=1) for change in changes], axis=0))
            for change, whole in zip(changes, found, strict=True):
                change *= 1.0 / (np.sqrt(len(states)) * size) if size > 0.0 else 0.0
                if mixing is None:
                    whole[span] = change
                else:
                    mixing.add(change, state * each, whole)
            notices.progress("forces of elements", f"state {state + 1} of {len(states)}")
        notices.progress_ends()
        return found[0], dict(zip(self.elements.thin, found[1:], strict=True))

    def torques(self, q: FloatArray, mass: FloatArray, scale: float = 1.0) -> list[FloatArray]:
        """Torques [N m] of the elements of every kind about the centre of mass, as far as the modes can turn the body.

        A turning leaves every element as it is, but modes hold only so much of one: of what they turn along with it
        elements have torques, whose sum is that of all of them, and small beside each.

        Args:
            q: Amplitudes, (state, mode).
            mass: Of the nodes [kg].
            scale: Factor, beside one that makes squares of all states a mean.

        Returns:
            (3 state, element) of every kind.
        """
        share = mass / mass.sum()
        found: list[list[FloatArray]] = [[] for _ in self.tables]
        for x, parts in zip(self._moved(q), self._on_modes(q), strict=True):
            turned = np.array([np.cross(axis, x - share @ x) for axis in np.eye(3)])
            onto = _amplitudes(self.basis, mass, turned) * (scale / np.sqrt(len(q)))
            for rows, part in zip(found, parts, strict=True):
                rows.append(onto @ part)
        return [np.concatenate(rows) for rows in found]

    def _moved(self, q: FloatArray) -> FloatArray:
        """Nodes at some amplitudes [m], (state, node, 3)."""
        moved: FloatArray = np.einsum("sk,knc->snc", q, self.basis.modes, optimize=True) + self.elements.at_rest
        return moved

    def _on_modes(self, q: FloatArray) -> Iterator[list[FloatArray]]:
        """Forces of single elements on modes, at one state after the other, (mode, element) of every kind."""
        for forces in self.elements.at(self._moved(q)):
            yield [_projected(table, f) for table, f in zip(self.tables, forces, strict=True)]


def _projected(table: NDArray[np.float32], forces: FloatArray) -> FloatArray:
    """Forces of elements, (element, 3 corners), on modes, (mode, element), some elements at a time.

    Of a fine mesh the table in double precision, which all at once would ask for at every state, takes half a gigabyte.
    """
    found = np.empty((table.shape[1], len(table)))
    for begin in range(0, len(table), TOGETHER):
        part = slice(begin, begin + TOGETHER)
        found[:, part] = np.matmul(table[part], forces[part, :, None])[:, :, 0].T
    return found


class _Mixing:
    """Rows mixed at random into fewer, which keeps lengths: each comes into some of them, with a sign.

    A dense mixture would take as many products as there are rows, for every row: minutes for a fine mesh.

    Args:
        rows: How many there are.

    Reference:
        Nelson & Nguyen (2013), OSNAP: faster numerical linear algebra algorithms via sparser subspace embeddings.
    """

    def __init__(self, rows: int) -> None:
        draws, each = np.random.default_rng(0), MIXED_ROWS // SHARES
        self.target = draws.integers(each, size=(rows, SHARES)) + each * np.arange(SHARES)
        self.factor = draws.choice([-1.0, 1.0], size=(rows, SHARES)) / np.sqrt(SHARES)

    def add(self, part: FloatArray, first: int, whole: FloatArray) -> None:
        """Add rows from ``first`` on, (row, element), to the mixed ones."""
        for row, (targets, factors) in zip(
            part, zip(self.target[first:], self.factor[first:], strict=True), strict=False
        ):
            for target, factor in zip(targets, factors, strict=True):
                whole[target] += factor * row


def _sample(contributions: FloatArray, tolerance: float | None, what: str) -> Sampling:
    """Elements that count, and how near their forces come."""
    if tolerance is None:
        return Sampling(np.ones(contributions.shape[1]), 0.0)

    def told(count: int, residual: float) -> None:
        notices.progress(f"choosing {what}", f"{count} of {contributions.shape[1]}, residual {residual:.3g}")

    found = sample_elements(contributions, tolerance, size=1.0, told=told)
    notices.progress_ends()
    if found.count == 0:
        raise ValueError(f"{what}: a tolerance of {tolerance:g} keeps no element; choose a smaller one, such as 0.03")
    return found


def _unseen(forces: _Forces, sampled: Mapping[str, Sampling], q: FloatArray) -> dict[str, float]:
    """Relative errors of the forces of the chosen elements at states that they were not chosen by."""
    tets, thin = forces.contributions([_State(state, np.zeros_like(state)) for state in q])
    return {
        name: float(np.linalg.norm(part @ (sampled[name].weight - 1.0)))
        for name, part in {"tets": tets, **thin}.items()
    }


def _torques(
    forces: _Forces, sampled: Mapping[str, Sampling], q: FloatArray, mass: FloatArray, moment: float
) -> dict[str, float]:
    """Errors of the chosen elements' torques, per weight and length, at states that they were not chosen by."""
    if not moment:
        return {}
    parts = forces.torques(q, mass, 1.0 / moment)
    return {
        name: float(np.linalg.norm(part @ (found.weight - 1.0)))
        for (name, found), part in zip(sampled.items(), parts, strict=True)
    }
