"""Telescopes against the theory of concentric tubes: closed forms, an own boundary value problem, and the snap.

References: Dupont, Lock, Itkowitz, Butler (2010), Design and control of concentric-tube robots; Rucker, Jones, Webster
(2010), A geometrically exact model for externally loaded concentric-tube continuum robots; Webster, Jones (2010).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.optimize import root
from scipy.spatial.transform import Rotation

import softwarp as sw
from softwarp import Tube, TubeSection

Floats = NDArray[np.float64]
YOUNGS = 50.0e9
THREE = (
    Tube([TubeSection(0.40), TubeSection(0.10, (5.6, 0.0, 0.0))], radius=0.4e-3, youngs=YOUNGS),
    Tube([TubeSection(0.25), TubeSection(0.08, (3.6, 1.2, 0.0))], radius=0.7e-3, inner_radius=0.5e-3, youngs=YOUNGS),
    Tube([TubeSection(0.12), TubeSection(0.06, (2.0, 0.0, 0.0))], radius=1.2e-3, inner_radius=0.8e-3, youngs=YOUNGS),
)


def simulation(
    tubes: Sequence[Tube],
    worlds: int = 1,
    *,
    gravity: Sequence[float] = (0.0, 0.0, 0.0),
    precision: str = "float64",
    dt: float = 0.01,
    **options: object,
) -> sw.Simulation:
    """One telescope at the origin."""
    builder = sw.ModelBuilder(gravity=gravity)
    builder.add_telescope(tubes, **options)
    return sw.Simulation(builder.finalize(num_worlds=worlds, precision=precision), dt=dt)


def pair(length: float) -> tuple[Tube, Tube]:
    """The two curved tubes of the tables, inner first."""
    inner = Tube([TubeSection(length, (15.0, 0.0, 0.0))], radius=0.8e-3, inner_radius=0.4e-3, youngs=60.0e9)
    outer = Tube([TubeSection(length, (8.0, 0.0, 0.0))], radius=1.2e-3, inner_radius=1.0e-3, youngs=60.0e9)
    return inner, outer


def second_moment(tube: Tube) -> float:
    """Second moment of area [m^4]."""
    return 0.25 * np.pi * (tube.radius**4 - tube.inner_radius**4)


def reference(
    tubes: Sequence[Tube], length: Floats, angle: Floats, force: Floats, moment: Floats, guess: Floats
) -> tuple[Floats, Floats]:
    """Angles of the tubes at the tip, and the tip, by shooting from there; bending without shear and stretch.

    Args:
        tubes: Tubes, all of which twist behind the port.
        length: Deployed lengths [m]; the first tube reaches farthest.
        angle: Angles at the bases [rad].
        force: On the tip [N], world.
        moment: On the tip [N m], world.
        guess: Angles of the tubes and rotation vector of a frame without twist at the tip.
    """
    n, whole = len(tubes), np.array([tube.length for tube in tubes])
    stiff = np.array([tube.youngs * second_moment(tube) for tube in tubes])
    twist = stiff / np.array([1.0 + tube.nu for tube in tubes])
    ends = [np.cumsum([part.length for part in tube.sections]) for tube in tubes]
    stops = {0.0, *length, *np.concatenate([end - whole[i] + length[i] for i, end in enumerate(ends)])}
    knots = np.array(sorted(s for s in stops if 0.0 <= s <= length.max()))

    def back(unknown: Floats) -> Floats:
        """Angles, torques, way from the tip and frame at the port."""
        frame = Rotation.from_rotvec(unknown[n:]).as_matrix()
        y = np.concatenate([unknown[:n], np.zeros(n + 3), frame.ravel()])
        y[n] = (frame.T @ moment)[2]
        for end, begin in zip(knots[::-1][:-1], knots[::-1][1:], strict=True):
            there = [i for i in range(n) if length[i] > 0.5 * (begin + end)]
            place = [0.5 * (begin + end) + whole[i] - length[i] for i in there]
            parts = [int(np.searchsorted(ends[i], s)) for i, s in zip(there, place, strict=True)]
            k = np.array([tubes[i].sections[j].curvature for i, j in zip(there, parts, strict=True)])

            def rates(_: float, y: Floats, there: list[int] = there, k: Floats = k) -> Floats:
                psi, torque, way, R = y[there], y[n : 2 * n][there], y[2 * n : 2 * n + 3], y[2 * n + 3 :].reshape(3, 3)
                bent = R.T @ (np.cross(-way, force) + moment)
                c, s = np.cos(psi), np.sin(psi)
                own = np.stack([c * k[:, 0] - s * k[:, 1], s * k[:, 0] + c * k[:, 1]])
                u = (own @ stiff[there] + bent[:2]) / stiff[there].sum()
                rate = np.zeros_like(y)
                rate[there] = torque / twist[there] + k[:, 2]
                rate[[n + i for i in there]] = stiff[there] * (u[0] * own[1] - u[1] * own[0])
                rate[2 * n : 2 * n + 3] = R[:, 2]
                spin = np.array([[0.0, 0.0, u[1]], [0.0, 0.0, -u[0]], [-u[1], u[0], 0.0]])
                rate[2 * n + 3 :] = (R @ spin).ravel()
                return rate

            y = solve_ivp(rates, (end, begin), y, rtol=1e-9, atol=1e-11).y[:, -1]
        return np.asarray(y)

    hidden = (whole - length) / twist

    def missed(unknown: Floats) -> Floats:
        y = back(unknown)
        turn = Rotation.from_matrix(y[2 * n + 3 :].reshape(3, 3)).as_rotvec()
        return np.concatenate([y[:n] - hidden * y[n : 2 * n] - angle, turn])

    found = root(missed, guess, tol=1e-10)
    assert np.abs(found.fun).max() < 1e-9
    return found.x[:n], -back(found.x)[2 * n : 2 * n + 3]


def tip_state(sim: sw.Simulation, world: int) -> Floats:
    """Angles of the tubes at the tip and rotation vector of a frame there that has not twisted along the line."""
    turns = [Rotation.from_quat(q) for q in sim.rod_q[world].double().numpy()]
    twist = sum(float((a.inv() * b).as_rotvec()[2]) for a, b in itertools.pairwise(turns))
    carrier = float(sim.base_angle[world, 0]) + twist
    windup = sim.windup[world].double().numpy().reshape(len(sim.tube_length[world]), -1)
    untwisted = turns[-1] * Rotation.from_rotvec([0.0, 0.0, -carrier])
    return np.concatenate([carrier + windup[:, -1], untwisted.as_rotvec()])


@pytest.mark.parametrize("precision", ["float32", pytest.param("float64", marks=pytest.mark.slow)])
def test_two_overlapping_tubes(precision: str) -> None:
    """Angle and place of the tip of a torsionally compliant pair: Dupont's equations, solved to 1e-9 elsewhere."""
    table = {
        np.pi / 4: (0.425173, (0.0123461, -0.0418585, 0.0858144)),
        np.pi / 2: (0.912418, (0.0203461, -0.0322038, 0.0892821)),
        0.75 * np.pi: (1.593988, (0.0193734, -0.0192010, 0.0945480)),
        0.95 * np.pi: (2.671254, (0.0063446, -0.0103582, 0.0989673)),
    }
    sim = simulation(pair(0.1), 4, precision=precision, segments=50, lengths=(0.1, 0.1), windup=False)
    sim.control.tube_angle[:, 0] = torch.tensor(list(table))
    sim.step(300)
    assert not sim.status.any()
    for world, (at_tip, tip) in enumerate(table.values()):
        windup = sim.windup[world].reshape(2, -1)
        assert float(windup[0, -1] - windup[1, -1]) == pytest.approx(at_tip, abs=3e-4)
        np.testing.assert_allclose(sim.rod_x[world, -1].double().numpy(), tip, atol=5e-6)


def test_all_relative_angles_of_stiff_tubes() -> None:
    """A pair too short to twist has the curvature |sum E I k| / sum E I at every relative angle."""
    angles = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
    tubes = pair(0.004)
    sim = simulation(tubes, len(angles), segments=4, lengths=(0.004, 0.004), windup=False)
    sim.control.tube_angle[:, 0] = torch.tensor(angles)
    sim.step(150)
    k = np.array([second_moment(tube) * tube.sections[0].curvature[0] for tube in tubes])
    total = sum(second_moment(tube) for tube in tubes)
    curvature = np.sqrt(k[0] ** 2 + k[1] ** 2 + 2.0 * k[0] * k[1] * np.cos(angles)) / total
    turned = [Rotation.from_quat(q[0]).inv() * Rotation.from_quat(q[-1]) for q in sim.rod_q.numpy()]
    found = np.array([np.linalg.norm(turn.as_rotvec()[:2]) for turn in turned]) / 0.004
    np.testing.assert_allclose(found, curvature, rtol=3e-3)


def test_snap() -> None:
    """Beyond L sqrt(c) = pi / 2 the inner tube snaps where the angle at the base has a maximum over that at the tip."""
    c, length, step = 1.3 * 8.0 * 15.0, 0.15, 0.02

    def at_base(at_tip: float) -> float:
        """Angle at the base of a pair with one at the tip: theta'' = c sin theta, theta'(L) = 0."""
        path = solve_ivp(lambda _, y: [y[1], c * np.sin(y[0])], (length, 0.0), [at_tip, 0.0], rtol=1e-9, atol=1e-11)
        return float(path.y[0, -1])

    fold = max(at_base(angle) for angle in np.linspace(1.8, 2.6, 81))
    sim = simulation(pair(length), segments=50, lengths=(length, length), windup=False)
    jumps = []
    for way in (np.arange(2.7, 3.6, step), np.arange(3.6, 2.7, -step)):
        sim.control.tube_angle[:, 0] = float(way[0])
        sim.step(150)
        last = None
        for angle in way:
            sim.control.tube_angle[:, 0] = float(angle)
            sim.step(60)
            at_tip = -float(sim.windup[0].reshape(2, -1)[1, -1])
            if last is not None and abs(at_tip - last) > 1.0:
                jumps.append((float(angle), last, at_tip))
            last = at_tip
    assert not sim.status.any()
    assert len(jumps) == 2  # one up, one down
    assert jumps[0][0] == pytest.approx(fold, rel=0.01)
    assert jumps[1][0] == pytest.approx(2.0 * np.pi - fold, rel=0.01)  # hysteresis, by symmetry
    assert jumps[0][1] < 2.3 and jumps[0][2] > 4.0


@pytest.mark.parametrize(
    "force, moment", [*(pytest.param(force, 0.0, marks=pytest.mark.slow) for force in (0.0, 0.05)), (0.05, 0.002)]
)
def test_three_tubes_with_loads(force: float, moment: float) -> None:
    """The tip of three tubes that twist behind the port as well, within a thousandth of their length."""
    random, worlds = np.random.default_rng(1), 3
    low, high = (0.12, 0.06, 0.0), (0.25, 0.12, 0.06)
    length, angle = random.uniform(low, high, (worlds, 3)), random.uniform(-1.0, 1.0, (worlds, 3))
    forces, moments = (scale * random.uniform(-1.0, 1.0, (worlds, 3)) for scale in (force, moment))
    sim = simulation(THREE, worlds, segments=40)
    sim.control.tube_length.copy_(torch.as_tensor(length))
    sim.control.tube_angle.copy_(torch.as_tensor(angle))
    sim.control.rod_force[:, -1, :3] = torch.as_tensor(forces)
    sim.control.rod_force[:, -1, 3:] = torch.as_tensor(moments)
    sim.step(500)
    assert not sim.status.any()
    np.testing.assert_allclose(sim.tube_length.numpy(), length)
    for w in range(worlds):
        _, tip = reference(THREE, length[w], angle[w], forces[w], moments[w], tip_state(sim, w))
        away = np.linalg.norm(sim.rod_x[w, -1].numpy() - tip)
        assert away < 1e-3 * length[w, 0], f"world {w}: {away / length[w, 0]:.2e} of the length"


WAYS = {
    "once": ("float64", 0.01, "direct"),
    "finer": ("float64", 0.004, "direct"),
    "float32": ("float32", 0.01, "direct"),
    "slow": ("float64", 0.01, "slow"),
    "round": ("float64", 0.01, "round"),
}


@pytest.mark.parametrize("ways", [("once", "float32", "round"), pytest.param(tuple(WAYS), marks=pytest.mark.slow)])
def test_settled_states_have_no_history(ways: tuple[str, ...]) -> None:
    """Speed of insertion, time step, precision, withdrawal and a tube that overtakes the carrier leave no trace."""
    goal, turn = torch.tensor([[0.18, 0.09, 0.04]]), torch.tensor([[0.4, -0.3, 0.2]])
    tips = []
    for precision, dt, path in (WAYS[way] for way in ways):
        sim = simulation(THREE, gravity=(0.0, 0.0, -9.81), precision=precision, dt=dt)
        sim.control.tube_angle.copy_(turn)
        if path == "slow":
            for share in np.linspace(0.0, 1.0, 150):
                sim.control.tube_length.copy_(share * goal)
                sim.step(2)
        elif path == "round":
            for lengths in ((0.1, 0.2, 0.15), (0.0, 0.0, 0.0), (0.1, 0.1, 0.1)):
                sim.control.tube_length.copy_(torch.tensor([lengths]))
                sim.step(150)
        sim.control.tube_length.copy_(goal)
        sim.step(int(4.0 / dt))
        assert not sim.status.any()
        tips.append(sim.rod_x[0, -1].double().numpy())
    assert np.abs(np.array(tips) - tips[0]).max() < 1e-6


@pytest.mark.parametrize("precision", ["float32", pytest.param("float64", marks=pytest.mark.slow)])
def test_tips_that_pass_each_other(precision: str) -> None:
    """Tubes that end at the same point to rounding, and no tube at all, in every order."""
    worlds = 24
    sim = simulation(THREE, worlds, precision=precision, segments=20, windup=False)
    goal = torch.as_tensor(np.random.default_rng(0).uniform(0.0, 0.03, (worlds, 1))).to(sim.tube_length)
    for number in range(60):
        nearly = goal * (1.0 + 1e-7 * torch.tensor([(0, 1, -1), (2, 0, 1), (-1, 1, 0)][number % 3]).to(goal))
        sim.control.tube_length.copy_(nearly if number % 4 else 0.5 * nearly)
        sim.step(4)
        assert not sim.status.any()
    sim.control.tube_length.zero_()
    sim.step(60)
    assert not sim.status.any()
    assert torch.isfinite(sim.rod_x).all()
    np.testing.assert_allclose(sim.rod_x[:, -1].double(), [[0.0, 0.0, 0.0005]] * worlds, atol=2e-5)


def test_weight_of_overlapping_tubes() -> None:
    """A straight pair half overlapping sags as a stepped cantilever under its weight."""
    tubes = (
        Tube([TubeSection(0.2)], radius=0.4e-3, youngs=YOUNGS, density=6000.0),
        Tube([TubeSection(0.2)], radius=0.8e-3, inner_radius=0.5e-3, youngs=YOUNGS, density=6000.0),
    )
    sim = simulation(tubes, gravity=(-0.5, 0.0, 0.0), lengths=(0.12, 0.06), segments=48)
    sim.step(400)
    weight = [6000.0 * 0.5 * np.pi * (tube.radius**2 - tube.inner_radius**2) for tube in tubes]
    stiff = np.array([tube.youngs * second_moment(tube) for tube in tubes])
    s = np.linspace(0.0, 0.12, 4001)
    w = np.where(s < 0.06, sum(weight), weight[0])
    shear = np.trapezoid(w, s) - np.concatenate([[0.0], np.cumsum(0.5 * (w[1:] + w[:-1]) * np.diff(s))])
    moment = shear[::-1].cumsum()[::-1] * (s[1] - s[0])
    curvature = moment / np.where(s < 0.06, stiff.sum(), stiff[0])
    sag = np.trapezoid(np.cumsum(curvature) * (s[1] - s[0]), s)
    assert -float(sim.rod_x[0, -1, 0]) == pytest.approx(sag, rel=5e-3)


def test_helix_without_load() -> None:
    """A helical wire keeps the radius and pitch that it was made with, whatever its nodes."""
    wire = Tube([TubeSection.helix(0.06, 3.5e-3, 5.0e-3)], radius=0.1e-3, youngs=YOUNGS)
    sim = simulation((wire,), lengths=(0.06,), segments=30)
    sim.step(50)
    c = 5.0e-3 / (2.0 * np.pi)
    turn = 0.06 / np.hypot(3.5e-3, c)
    chord = np.hypot(2.0 * 3.5e-3 * np.sin(0.5 * turn), c * turn)
    assert float(torch.linalg.vector_norm(sim.rod_x[0, -1] - sim.rod_x[0, 0])) == pytest.approx(chord, rel=1e-6)


def test_curls_that_segments_are_too_long_for() -> None:
    """Segments of 10 mm bend by 2 rad at rest for a radius of 5 mm, as it is, and by 2.5 rad for one of 2 mm, not by 5.

    Such a turn would be one of 1.3 rad to the other side; where a curl comes out of a tube it would flip there.
    """
    for curvature, turn in ((200.0, 2.0), (500.0, 2.5)):
        tube = Tube([TubeSection(0.1, (curvature, 0.0, 0.0))], radius=1e-4, youngs=1e9)
        builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
        builder.add_telescope([tube], segments=4, lengths=(0.04,), windup=False)
        law = sw.Simulation(builder.finalize(1, precision="float64"), dt=0.01).segment_law[0]
        np.testing.assert_allclose(law[:, 0] * law[:, 10], turn, rtol=1e-12)
        np.testing.assert_allclose(law[:, 7:10], [[0.0, 0.0, 1.0]] * 4, atol=1e-12)


def test_a_world_of_many_is_that_world_alone() -> None:
    """Bit for bit on one path; a command that is no number stops its own world only, and it goes on afterwards."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    builder.add_telescope(THREE, segments=24, lengths=(0.02, 0.01, 0.0))
    goals = torch.tensor([[0.15, 0.08, 0.03], [0.05, 0.09, 0.01], [0.0, 0.0, 0.0], [0.2, 0.1, 0.05]])

    def run(worlds: slice, broken: int | None = None) -> sw.Simulation:
        count = len(goals[worlds])
        sim = sw.Simulation(builder.finalize(num_worlds=count), dt=0.01, solver_path="lanes")
        sim.control.tube_length.copy_(goals[worlds])
        sim.control.tube_angle.copy_(goals[worlds] * 5.0)
        for step in range(60):
            if broken is not None and step == 20:
                sim.control.tube_length[broken, 1] = float("nan")
            sim.step()
        return sim

    together, alone, poisoned = run(slice(0, 4)), run(slice(1, 2)), run(slice(0, 4), broken=2)
    for name in ("rod_x", "rod_q", "rod_v", "windup", "tube_length", "segment_law"):
        whole, one, other = (getattr(sim, name) for sim in (together, alone, poisoned))
        assert torch.equal(whole[1], one[0]), name
        assert torch.equal(whole[[0, 1, 3]], other[[0, 1, 3]]), name
        assert torch.isfinite(other).all()
    assert int(poisoned.status[2]) and not poisoned.status[[0, 1, 3]].any()
    poisoned.control.tube_length[2] = goals[2]
    poisoned.step(5)
    assert not poisoned.status.any()


def test_snapshot_and_reset() -> None:
    """A restored state goes on bit for bit; a reset starts where the builder said."""
    sim = simulation(THREE, 2, lengths=(0.05, 0.02, 0.0), segments=20)
    start = sim.rod_x.clone()
    sim.control.tube_length[:] = 0.1
    sim.step(10)
    kept = sim.snapshot()
    sim.step(15)
    after = sim.rod_x.clone(), sim.windup.clone()
    sim.restore(kept)
    sim.step(15)
    assert torch.equal(sim.rod_x, after[0])
    assert torch.equal(sim.windup, after[1])
    sim.reset()
    torch.testing.assert_close(sim.rod_x, start)
    np.testing.assert_allclose(sim.tube_length.numpy(), [[0.05, 0.02, 0.0]] * 2)


def test_energy_and_resultants() -> None:
    """Energy of a pair that is held apart from its own curvature, and the moment of a tip load at the port."""
    sim = simulation(THREE[:1], lengths=(0.1,), segments=40)
    sim.control.rod_force[:, -1, 0] = 0.002
    sim.step(300)
    moment = sim.rod_resultants()[0, 0, 3:]
    lever = sim.rod_x[0, -1] - 0.5 * (sim.rod_x[0, 0] + sim.rod_x[0, 1])
    expected = torch.linalg.cross(lever, torch.tensor([0.002, 0.0, 0.0], dtype=lever.dtype))
    assert float(torch.linalg.vector_norm(moment)) == pytest.approx(float(torch.linalg.vector_norm(expected)), rel=1e-3)
    assert float(sim.elastic_energy()[0]) > 0.0


class TestRefusals:
    """Tubes, nodes and integrators that cannot be; messages name what is allowed."""

    def test_tubes_that_do_not_fit(self) -> None:
        """The order is from the innermost to the outermost."""
        with pytest.raises(ValueError, match="does not fit"):
            sw.ModelBuilder().add_telescope(THREE[::-1])

    @pytest.mark.parametrize("lengths", [(0.6, 0.0, 0.0), (-0.1, 0.0, 0.0), (float("nan"), 0.0, 0.0), (0.1, 0.1)])
    def test_lengths(self, lengths: tuple[float, ...]) -> None:
        """A start outside a tube's length."""
        with pytest.raises(ValueError, match="telescope"):
            sw.ModelBuilder().add_telescope(THREE, lengths=lengths)

    @pytest.mark.parametrize("wrong", [{"radius": 0.0}, {"inner_radius": 1.0}, {"youngs": -1.0}, {"density": 0.0}])
    def test_numbers(self, wrong: dict[str, float]) -> None:
        """Numbers of a tube outside their range."""
        with pytest.raises(ValueError, match="tube"):
            Tube([TubeSection(0.1)], **({"radius": 1.0e-3} | wrong))

    def test_no_sections(self) -> None:
        """A tube without length."""
        with pytest.raises(ValueError, match="sections"):
            Tube([], radius=1.0e-3)

    def test_parts_on_nodes_that_slide(self) -> None:
        """Only the last node keeps its place on a tube."""
        builder = sw.ModelBuilder()
        telescope = builder.add_telescope(THREE)
        ball = builder.add_rigid(sw.Sphere(0.001), mass=0.001)
        builder.attach(ball, to=telescope, node=3)
        with pytest.raises(ValueError, match="last node"):
            builder.finalize()

    def test_second_order(self) -> None:
        """Nodes that slide have no history."""
        builder = sw.ModelBuilder()
        builder.add_telescope(THREE)
        with pytest.raises(ValueError, match="euler"):
            sw.Simulation(builder.finalize(), integrator="bdf2")
