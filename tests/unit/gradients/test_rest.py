"""Gradients by the rest shape against central differences in float64, in which scenes are built anew."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch.autograd import forward_ad

import softwarp as sw
from softwarp import meshing
from softwarp.gradients import Equilibrium, Rollout, States, jvp
from tests.cases import material
from tests.gradient_cases import cube
from tests.unit.gradients.test_equilibrium import beam

MESH = meshing.box((0.1, 0.04, 0.04), (3, 1, 1))
SKIN = meshing.box((0.04, 0.02, 0.02), (1, 1, 1))
RNG = np.random.default_rng(0)
REST = MESH.nodes + 1e-3 * RNG.standard_normal(MESH.nodes.shape)
CHANGE = 2e-7 * RNG.standard_normal(REST.shape)  # stress-free elements are a switch: differences stay on one side
START = torch.tensor(REST + 3e-4 * RNG.standard_normal(REST.shape))[None]
SPEED = torch.tensor(0.05 * RNG.standard_normal(REST.shape))[None]
WEIGHT = torch.tensor(RNG.standard_normal(REST.shape))[None]
NEWTON: dict[str, Any] = {"newton_iterations": 60, "newton_tolerance": 1e-13}
SLOW = pytest.mark.slow
LAWS = ["large", "nh_log", *(pytest.param(law, marks=pytest.mark.slow) for law in ("warped", "corot", "ogden"))]


def shares(points: np.ndarray) -> np.ndarray:
    """Shares of the nodes in places of the undeformed mesh, (point, node)."""
    found = np.zeros((len(points), len(MESH.nodes)))
    for row, point in zip(found, points, strict=True):
        systems = [np.vstack([MESH.nodes[tet].T, np.ones(4)]) for tet in MESH.tets]
        parts = [np.linalg.solve(system, [*point, 1.0]) for system in systems]
        best = int(np.argmax([part.min() for part in parts]))
        row[MESH.tets[best]] = parts[best]
    return found


SKIN_SHARES = shares(SKIN.nodes + (0.03, 0.01, 0.01))
CABLE_SHARES = shares(np.array([(0.0, 0.01, 0.035), (0.05, 0.01, 0.035), (0.1, 0.01, 0.035)]))


def scene(law: str, rest: np.ndarray, **options: Any) -> sw.Simulation:
    """A beam with a cable and a chamber, which are of its material."""
    builder = sw.ModelBuilder(gravity=(0.5, 1.0, -9.81))
    mesh = replace(MESH, nodes=rest)
    body = builder.add_tets(mesh, material=material(law, 1e5, 0.4), density=1000.0, rayleigh=(0.5, 0.01))
    builder.fix(body, box=((-1.0, -1.0, -1.0), (0.01, 1.0, 1.0)))
    builder.add_cable(body, CABLE_SHARES @ rest)
    builder.add_cavity(body, SKIN_SHARES @ rest, SKIN.surface())
    sim = sw.Simulation(builder.finalize(num_worlds=1, precision="float64"), dt=0.01, **options)
    sim.control.cable_displacement[...] = 0.004
    sim.control.cavity_pressure[...] = 4000.0
    return sim


def rested(law: str, rest: np.ndarray, leaf: torch.Tensor | None) -> torch.Tensor:
    """A loss of the equilibrium."""
    equilibrium = Equilibrium(scene(law, rest), rest=leaf is not None)
    pose = equilibrium(parameters=None if leaf is None else {"rest_x": leaf}, tolerance=1e-13)
    return (pose.node_x * WEIGHT).sum() + 0.01 * pose.cable_tension.sum()


def moved(law: str, rest: np.ndarray, leaf: torch.Tensor | None) -> torch.Tensor:
    """A loss of three steps from a given start."""
    return stepped(scene(law, rest), START, leaf)


def stepped(sim: sw.Simulation, start: torch.Tensor, leaf: torch.Tensor | None) -> torch.Tensor:
    """A loss of three steps from ``start``."""
    rollout = Rollout(sim, rest=leaf is not None)
    parameters = None if leaf is None else {"rest_x": leaf}
    states = rollout({"node_x": start, "node_v": SPEED}, parameters=parameters, steps=3)
    return ((states.node_x + states.node_v) * WEIGHT).sum() + 0.01 * states.cable_tension.sum()


def solved(law: str, rest: np.ndarray, leaf: torch.Tensor | None) -> torch.Tensor:
    """The same of steps that Newton's method solves; from further off, where fewer tangents are about to switch."""
    return stepped(scene(law, rest, **NEWTON), torch.tensor(REST) + 10.0 * (START - torch.tensor(REST)), leaf)


@pytest.mark.parametrize("loss", [rested, moved, solved])
@pytest.mark.parametrize("law", LAWS)
def test_gradients_are_those_of_differences(law: str, loss: Callable[..., torch.Tensor]) -> None:
    """Elements, masses, lengths of cables and fixed nodes all follow the rest shape."""
    leaf = torch.tensor(REST).requires_grad_()
    loss(law, REST, leaf).backward()
    assert leaf.grad is not None
    derivative = float((leaf.grad * torch.tensor(CHANGE)).sum())
    values = [float(loss(law, REST + factor * CHANGE, None)) for factor in (1.0, -1.0, 2.0, -2.0)]
    expected = (8.0 * (values[0] - values[1]) - (values[2] - values[3])) / 12.0
    assert abs(derivative - expected) <= 1e-6 * abs(expected)


@pytest.mark.parametrize(
    ("beside", "integrator", "options"),
    [
        pytest.param("cable", "bdf2", {}, id="bdf2"),
        pytest.param("cable", "bdf2", NEWTON, id="bdf2, solved", marks=pytest.mark.slow),
        pytest.param("branch", "bdf2", {}, id="memory"),
        pytest.param("nothing", "trapezoidal", {}, id="trapezoidal"),
        pytest.param("nothing", "trapezoidal", NEWTON, id="trapezoidal, solved", marks=pytest.mark.slow),
        pytest.param("ball", "bdf2", {"contact_passes": 0}, id="contact"),
        pytest.param("box", "euler", {}, id="a box on it"),
        pytest.param("stem", "euler", {}, id="a rod on it", marks=pytest.mark.slow),
        pytest.param("finger", "euler", {}, id="links on it"),
        pytest.param("arm", "euler", {"contact_passes": 0}, id="joints", marks=pytest.mark.slow),
        pytest.param("arm", "bdf2", {"contact_passes": 0}, id="joints, bdf2", marks=pytest.mark.slow),
        pytest.param("arm", "euler", NEWTON, id="joints, solved", marks=pytest.mark.slow),
        pytest.param("free ball", "euler", {}, id="a free ball, euler"),
        pytest.param("free ball", "bdf2", {"contact_passes": 1}, id="a free ball"),
        pytest.param("free ball", "euler", NEWTON, id="a free ball, solved", marks=pytest.mark.slow),
        pytest.param("ball", "bdf2", {"contact_passes": 1}, id="a look"),
        pytest.param("ball", "bdf2", NEWTON, id="contact, solved", marks=pytest.mark.slow),
    ],
)
def test_beside_other_parts(beside: str, integrator: str, options: dict[str, Any]) -> None:
    """In steps of second order every stage adds its own; beside contact they are rough ones."""

    def found(rest: np.ndarray, leaf: torch.Tensor | None) -> torch.Tensor:
        return stepped(beam_beside(beside, False, rest, integrator=integrator, **options), START, leaf)

    leaf = torch.tensor(REST).requires_grad_()
    found(REST, leaf).backward()
    assert leaf.grad is not None
    derivative = float((leaf.grad * torch.tensor(CHANGE)).sum())
    ahead, back = (float(found(REST + way * CHANGE, None)) for way in (1.0, -1.0))
    assert abs(derivative - 0.5 * (ahead - back)) <= 1e-6 * abs(derivative)


@pytest.mark.parametrize(
    ("beside", "options"),
    [
        ("cable", {}),
        ("ball", {}),
        ("free ball", {}),
        pytest.param("arm", {"contact_passes": 0}, marks=[SLOW]),
        ("box", {}),
        ("cable", {"integrator": "bdf2"}),
        pytest.param("cable", NEWTON, marks=[SLOW]),
    ],
)
def test_both_modes_agree(beside: str, options: dict[str, Any]) -> None:
    """To rounding, by two directions at once, one of them of moduli and velocities too, and by dual tensors."""
    sim = beam_beside(beside, False, REST, **options)
    rollout, shape = Rollout(sim, rest=True), torch.tensor(REST)
    leaves = [shape.clone(), sim.params.youngs.clone(), SPEED.clone()]
    for leaf in leaves:
        leaf.requires_grad_()

    def run(rest: torch.Tensor, youngs: torch.Tensor, v: torch.Tensor) -> States:
        return rollout({"node_x": START, "node_v": v}, parameters={"rest_x": rest, "youngs": youngs}, steps=3)

    def weighed(states: States) -> torch.Tensor:
        return ((states.node_x + states.node_v) * WEIGHT).sum() + 0.01 * states.cable_tension.sum()

    weighed(run(*leaves)).backward()
    along = torch.stack([torch.tensor(CHANGE), 3.0 * torch.tensor(CHANGE).roll(1, 0)])
    others = torch.tensor([0.0, 1.0]).reshape(2, 1, 1).double()
    directions = [along, others, others[..., None] * SPEED]
    _, slopes = jvp(
        rollout,
        {"parameters": dict(zip(("rest_x", "youngs"), directions, strict=False)), "state": {"node_v": directions[2]}},
        {"node_x": START, "node_v": SPEED},
        parameters={"rest_x": shape},
        steps=3,
    )
    for number in range(2):
        terms = [(leaf.grad * way[number]).flatten() for leaf, way in zip(leaves, directions, strict=True)]
        backward, scale = sum(term.sum() for term in terms), sum(term.abs().sum() for term in terms)
        one = replace(slopes, **{name: getattr(slopes, name)[number] for name in ("node_x", "node_v", "cable_tension")})
        assert abs(float(weighed(one)) - float(backward)) <= 1e-10 * float(scale)
    with forward_ad.dual_level():
        dual = forward_ad.make_dual(shape, along[0])
        found = run(dual, sim.params.youngs, SPEED)
        assert torch.equal(forward_ad.unpack_dual(found.node_x).tangent, slopes.node_x[0])


@pytest.mark.parametrize("newton", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize("beside", ["ball", "branch", "graded"])
def test_contacts_and_memories(beside: str, newton: bool) -> None:
    """Beside contact with a ball, with a Maxwell branch, and with factors of moduli, which masses are without."""
    leaf = torch.tensor(REST).requires_grad_()
    stepped(beam_beside(beside, newton, REST), START, leaf).backward()
    assert leaf.grad is not None
    derivative = float((leaf.grad * torch.tensor(CHANGE)).sum())
    ahead, back = (float(stepped(beam_beside(beside, newton, REST + way * CHANGE), START, None)) for way in (1.0, -1.0))
    assert abs(derivative - 0.5 * (ahead - back)) <= 1e-6 * abs(derivative)


def beam_beside(beside: str, newton: bool, rest: np.ndarray, num_worlds: int = 1, **more: Any) -> sw.Simulation:
    """The beam with one elastic cable, with a memory or on a ball, or with neither; or with ``nothing`` at all."""
    builder = sw.ModelBuilder(gravity=(0.5, 1.0, -9.81))
    memory = (0.3, 0.05) if beside == "branch" else (0.0, 0.0)
    mesh, stuff = replace(MESH, nodes=rest), material("large", 1e5, 0.4)
    factors = np.random.default_rng(3).uniform(0.7, 1.5, len(mesh.tets)) if beside == "graded" else None
    body = builder.add_tets(
        mesh, material=stuff, density=1000.0, rayleigh=(0.5, 0.01), relaxation=memory, stiffness=factors
    )
    builder.fix(body, box=((-1.0, -1.0, -1.0), (0.01, 1.0, 1.0)))
    if beside != "nothing":
        builder.add_cable(body, CABLE_SHARES @ rest, stiffness=200.0, damping=1.0)
    if beside in ("ball", "free ball"):
        how: dict[str, Any] = {"kinematic": True} if beside == "ball" else {"mass": 0.03, "damping": 0.2}
        ball = builder.add_rigid(sw.Sphere(0.02), pose=(0.09, 0.02, -0.0195), **how)
        builder.add_contact(body, ball, mu=0.4)
    if beside in ("box", "stem", "finger"):
        box = builder.add_rigid(sw.Box((0.02, 0.06, 0.05)), mass=0.03, pose=(0.11, 0.02, 0.02, 0.0, 0.6, 0.0, 0.8))
        tip = np.flatnonzero(MESH.nodes[:, 0] > 0.0999)
        builder.attach(body, nodes=tip, to=box)
        if beside == "stem":
            rod = builder.add_rod([[0.11, 0.02, 0.02], [0.14, 0.02, 0.02], [0.17, 0.02, 0.03]], radius=0.01, youngs=1e6)
            builder.attach(box, to=rod, node=0)
        if beside == "finger":
            lower = builder.add_rigid(sw.Box((0.03, 0.03, 0.03)), mass=0.02, pose=(0.14, 0.02, 0.02))
            builder.add_joint(box, lower, "hinge", axis=(0.0, 1.0, 0.2), control="position", stiffness=0.2)
    if beside == "arm":
        base = builder.add_rigid(sw.Box((0.01, 0.01, 0.01)), mass=0.05, pose=(0.15, 0.02, 0.02))
        arm = builder.add_rigid(sw.Sphere(0.015), mass=0.03, damping=0.2, pose=(0.09, 0.02, -0.0145))
        builder.add_joint(None, base, "hinge", axis=(0.0, 1.0, 0.0))
        builder.add_joint(
            base, arm, "hinge", axis=(0.0, 1.0, 0.0), anchor=(0.13, 0.02, 0.0), control="position", stiffness=0.2
        )
        builder.add_contact(body, arm, mu=0.4)
    if beside == "free ball":
        rod = builder.add_rod([[0.2, 0.0, 0.0], [0.25, 0.0, 0.0]], radius=0.01, youngs=1e6, density=1e3)
        link = builder.add_rigid(sw.Box((0.02, 0.02, 0.02)), mass=0.02, pose=(0.26, 0.0, 0.0))
        builder.attach(link, to=rod, node=1)
    found = {"gauss_seidel_iterations": 3000, "gauss_seidel_tolerance": 1e-14}
    options = {**found, **(NEWTON if newton else {}), **more}
    sim = sw.Simulation(builder.finalize(num_worlds=num_worlds, precision="float64"), dt=0.01, **options)
    sim.control.cable_displacement[...] = 0.004
    return sim


@pytest.mark.parametrize("options", [{}, {"integrator": "bdf2"}], ids=["euler", "bdf2"])
def test_worlds_beside_change_no_bit(options: dict[str, Any]) -> None:
    """World i of a batch has the gradient, and the slopes, of that world alone."""
    speeds = torch.tensor(0.05 * np.random.default_rng(1).standard_normal((3, *REST.shape)))
    shape, along = torch.tensor(REST), torch.tensor(CHANGE)[None]

    def found(some: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        sim = beam_beside("cable", False, REST, num_worlds=len(some), **options)
        rollout = Rollout(sim, rest=True)
        leaf = shape.expand(len(some), *shape.shape).clone().requires_grad_()
        state = {"node_x": START.expand(len(some), *shape.shape), "node_v": some}
        states = rollout(state, parameters={"rest_x": leaf}, steps=2)
        by_rest = torch.autograd.grad((states.node_x * WEIGHT).sum(), leaf)[0]
        _, slopes = jvp(rollout, {"parameters": {"rest_x": along}}, state, parameters={"rest_x": shape}, steps=2)
        return by_rest, slopes.node_x[0, -1]

    batch = found(speeds)
    for world in range(3):
        for several, single in zip(batch, found(speeds[world : world + 1]), strict=True):
            assert torch.equal(several[world], single[0])


@pytest.mark.parametrize("without", [torch.no_grad, torch.inference_mode])
def test_made_where_nothing_is_followed(without: Callable[[], Any]) -> None:
    """As where a fit measures its loss alone; cables know how their lengths depend on the rest shape all the same."""
    sim = scene("large", MESH.nodes)
    with without():
        pose = Equilibrium(sim, rest=True)()
    assert torch.equal(pose.node_x, Equilibrium(sim)().node_x)


def test_refusals() -> None:
    """Another shape than the model's, and one that nobody asked for."""
    sim = beam()
    shape = torch.as_tensor(sim.model.node_rest)
    with pytest.raises(ValueError, match="build the scene from the new positions"):
        Equilibrium(sim, rest=True)(parameters={"rest_x": 1.1 * shape})
    with pytest.raises(ValueError, match="'rest_x' has no gradient"):
        Equilibrium(sim)(parameters={"rest_x": shape})
    with pytest.raises(ValueError, match="membrane 'membrane0' has no gradient by the rest shape yet"):
        Rollout(cube(covered=True), rest=True)
    with pytest.raises(ValueError, match="equilibria with membrane 'membrane0' have no gradient yet"):
        Equilibrium(cube(covered=True))


def carried(rest: np.ndarray, base: str, num_worlds: int = 1, beside: str = "", **options: Any) -> sw.Simulation:
    """The beam on a base that moves, with a box at its end that a cable pulls at, whose waypoint is the last node.

    Args:
        rest: Rest positions, the waypoint's last.
        base: "fixed" nodes, or a "moved" body that carries them.
        num_worlds: Of the model.
        beside: A "branch", a "joint" at the box, a "ball" under what a moved base carries, or under the one node that
            the box carries then, "no cable", or nothing.
        **options: Of the simulation.
    """
    builder = sw.ModelBuilder(gravity=(0.5, 1.0, -9.81))
    mesh, stuff = replace(MESH, nodes=rest[:-1]), material("large", 1e5, 0.4)
    memory = (0.3, 0.05) if beside == "branch" else (0.0, 0.0)
    body = builder.add_tets(mesh, material=stuff, density=1000.0, rayleigh=(0.5, 0.01), relaxation=memory)
    root, tip = (np.flatnonzero(MESH.nodes[:, 0] == x) for x in (0.0, 0.1))
    if base == "moved":
        held = builder.add_rigid(sw.Box((0.02, 0.04, 0.04)), pose=(-0.01, 0.02, 0.02), kinematic=True)
        builder.attach(body, nodes=root, to=held)
    else:
        builder.fix(body, nodes=root)
    box = builder.add_rigid(sw.Box((0.02, 0.06, 0.05)), mass=0.03, pose=(0.11, 0.02, 0.02, 0.0, 0.6, 0.0, 0.8))
    if beside == "ball":
        tip, corner = tip[: int(base == "fixed")], MESH.nodes[tip[0]] + 0.0194 * np.array([0.5, -0.5, -0.7]) / 0.99**0.5
        place = (0.005, 0.02, -0.0195) if base == "moved" else tuple(corner)
        builder.add_contact(body, builder.add_rigid(sw.Sphere(0.02), kinematic=True, pose=place), mu=0.4)
    if tip.size:
        builder.attach(body, nodes=tip, to=box)
    if beside == "joint":
        lower = builder.add_rigid(sw.Box((0.03, 0.03, 0.03)), mass=0.02, pose=(0.14, 0.02, 0.02))
        builder.add_joint(box, lower, "hinge", axis=(0.0, 1.0, 0.2), control="position", stiffness=0.2)
    if beside != "no cable":
        path = np.vstack([CABLE_SHARES[:2] @ rest[:-1], rest[-1:]])
        builder.add_cable([body, body, box], path, stiffness=200.0, damping=1.0 if beside else 0.0)
    found = {"gauss_seidel_iterations": 3000, "gauss_seidel_tolerance": 1e-14, **options}
    sim = sw.Simulation(builder.finalize(num_worlds=num_worlds, precision="float64"), dt=0.01, **found)
    sim.control.cable_displacement[...] = 0.004
    if base == "moved":
        sim.control.body_velocity[:, 0] = torch.tensor([0.1, 0.0, 0.05, 0.3, 0.5, -1.0])
    return sim


CARRIED = np.vstack([REST, [0.12, 0.01, 0.04]])


def tumbled(sim: sw.Simulation, leaf: torch.Tensor | None, seed: int = 4, share: float = 1.0) -> torch.Tensor:
    """A number for every world after three steps in which the box turns fast, or with a share of these velocities."""
    rng, worlds, nodes = np.random.default_rng(seed), *sim.node_x.shape[:2]
    start = torch.tensor((CARRIED + 3e-4 * rng.standard_normal(CARRIED.shape))[:nodes])
    state = {"node_x": start.expand(worlds, *start.shape)}
    state["node_v"] = share * 0.05 * torch.tensor(rng.standard_normal((worlds, *CARRIED.shape))[:, :nodes])
    if not sim.model.has_kinematic and sim.model.joints is None:
        spins = torch.tensor([0.3, -0.2, 0.1, 6.0, -4.0, 5.0]).double()
        state["body_twist"] = share * spins.expand(worlds, 1, 6)
    rollout = Rollout(sim, rest=leaf is not None)
    states = rollout(state, parameters=None if leaf is None else {"rest_x": leaf}, steps=3)
    weight = torch.tensor(np.random.default_rng(5).standard_normal(CARRIED.shape)[:nodes])
    found = ((states.node_x + states.node_v) * weight).flatten(2).sum(dim=(0, 2))
    return found + states.body_twist.flatten(2).sum(dim=(0, 2)) + 0.01 * states.cable_tension.sum(dim=(0, 2))


def proved(which: str, base: str, share: float = 1.0, **options: Any) -> None:
    """Compare the gradient by the rest positions of carried nodes and waypoints, or by all, with differences."""
    nodes = len(CARRIED) - int(options.get("beside") == "no cable")
    change = 2e-7 * np.random.default_rng(6).standard_normal(CARRIED.shape)
    if which == "tip":
        change[CARRIED[:, 0] < 0.09] = 0.0
    leaf = torch.tensor(CARRIED[:nodes]).requires_grad_()
    tumbled(carried(CARRIED, base, **options), leaf, share=share).sum().backward()
    assert leaf.grad is not None
    derivative = float((leaf.grad * torch.tensor(change[:nodes])).sum())
    ways = (1.0, -1.0, 2.0, -2.0)
    values = [float(tumbled(carried(CARRIED + way * change, base, **options), None, share=share)) for way in ways]
    expected = (8.0 * (values[0] - values[1]) - (values[2] - values[3])) / 12.0
    assert abs(derivative - expected) <= 1e-6 * abs(expected)


@pytest.mark.parametrize("base", ["fixed", pytest.param("moved", marks=SLOW)])
@pytest.mark.parametrize("which", [pytest.param("tip", marks=SLOW), "all"])
def test_what_something_carries(base: str, which: str) -> None:
    """Levers, masses that turn and waypoints on bodies follow the rest shape, by carried nodes alone and by all."""
    proved(which, base)


OTHER_STEPS = [
    pytest.param("fixed", {"integrator": "bdf2", "beside": "branch"}, id="smooth"),
    pytest.param("moved", {"integrator": "bdf2"}, marks=SLOW, id="rough"),
    pytest.param("fixed", {"integrator": "trapezoidal", "beside": "no cable"}, id="trapezoidal"),
    pytest.param("moved", {"integrator": "trapezoidal", "beside": "no cable"}, marks=SLOW, id="trapezoidal, moved"),
    pytest.param("fixed", {"beside": "branch"}, marks=SLOW, id="branch"),
    pytest.param("moved", NEWTON, id="solved"),
    pytest.param("fixed", {"beside": "branch", "integrator": "bdf2", **NEWTON}, marks=SLOW, id="solved, branch"),
    pytest.param("fixed", {"beside": "joint", "integrator": "bdf2"}, marks=SLOW, id="joint"),
    pytest.param("fixed", {"beside": "joint", **NEWTON}, marks=SLOW, id="solved, joint"),
    pytest.param("moved", {"beside": "ball"}, id="ball"),
    pytest.param("fixed", {"beside": "ball"}, marks=SLOW, id="ball at the box"),
    pytest.param("fixed", {"beside": "ball", "integrator": "bdf2"}, marks=SLOW, id="ball, second order"),
    pytest.param("moved", {"beside": "ball", **NEWTON}, marks=SLOW, id="ball, solved"),
]


@pytest.mark.parametrize(("base", "options"), OTHER_STEPS)
@pytest.mark.parametrize("which", [pytest.param("tip", marks=SLOW), "all"])
def test_what_something_carries_in_other_steps(which: str, base: str, options: dict[str, Any]) -> None:
    """In steps of second order, of several iterations, with memories, beside joints and contact."""
    is_smooth = options.get("integrator") in ("bdf2", "trapezoidal") and base == "fixed"
    proved(which, base, 0.1 if is_smooth and options["beside"] in ("branch", "no cable") else 1.0, **options)


@pytest.mark.parametrize(
    ("base", "options"),
    [("fixed", {}), ("moved", {"beside": "ball", "integrator": "bdf2"}), ("fixed", {"beside": "branch", **NEWTON})],
    ids=["one solution", "stages", "solved"],
)
def test_worlds_of_what_something_carries_change_no_bit(base: str, options: dict[str, Any]) -> None:
    """Three worlds with their own velocities, and the first of them alone."""
    found = []
    for count in (3, 1):
        leaf = torch.tensor(CARRIED).expand(count, *CARRIED.shape).clone().requires_grad_()
        tumbled(carried(CARRIED, base, count, **options), leaf).sum().backward()
        assert leaf.grad is not None
        found.append(leaf.grad[0])
    assert torch.equal(*found)
