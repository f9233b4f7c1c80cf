"""Gradients through contact with shapes, meshes and soft bodies against central differences in float64."""

from collections.abc import Sequence

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import meshing, shapes
from softwarp.gradients import Rollout, States
from softwarp.scene import SoftBody
from tests.gradient_cases import CHANGES, SIDE, STEPS, Inputs, gradients
from tests.unit.gradients import test_contact
from tests.unit.gradients.test_contact import EXACT, OPEN, SLIPPING, STUCK
from tests.unit.gradients.test_rods import check

SIZES = {group: dict(sizes) for group, sizes in CHANGES.items()}
SIZES["state"] |= {"node_x": 1e-8, "node_v": 1e-6, "body_pose": 3e-8, "body_twist": 1e-5}
SIZES["controls"] |= {"node_force": 1e-5, "body_velocity": 1e-6}
SIZES["parameters"] |= {"gravity": 1e-4, "body_mass": 1e-5}
SIZES["parameters"]["youngs"] *= 3.0  # differences of less are rounding
FLAT = (0.05, 0.02, 0.03, 1.0)  # a tilt
LYING = (0.72, 0.03, 0.02, 0.7)  # turns the axis of a capsule or a cylinder from z to y
BLOCK = (0.06, 0.05, 0.04)


def mesh(size: tuple[float, float, float]) -> shapes.Mesh:
    """A box as a mesh of its own."""
    box = meshing.box(size, (1, 1, 1))
    return shapes.Mesh(box.nodes - 0.5 * np.array(size), box.surface())


UNDER = {  # what a soft cube falls on, its middle's height under the cube and its orientation
    "sphere": (sw.Sphere(0.08), 0.08, FLAT),
    "capsule": (sw.Capsule(0.03, 0.2), 0.03, LYING),
    "box": (sw.Box((0.3, 0.3, 0.05)), 0.025, FLAT),
    "edge": (sw.Box((0.06, 0.3, 0.05)), 0.025, FLAT),
    "cylinder": (sw.Cylinder(0.03, 0.2), 0.03, LYING),
    "mesh": (mesh((0.06, 0.3, 0.05)), 0.025, FLAT),
}
ABOVE = {  # what falls on a soft bed, the height of its middle and its orientation
    "sphere": (sw.Sphere(0.03), 0.029, (0.0, 0.0, 0.0, 1.0)),
    "capsule": (sw.Capsule(0.02, 0.06), 0.019, LYING),
    "box": (sw.Box(BLOCK), 0.0195, (0.03, 0.05, 0.1, 1.0)),
    "cylinder": (sw.Cylinder(0.03, 0.05), 0.0245, (0.03, 0.02, 0.1, 1.0)),
    "mesh": (mesh(BLOCK), 0.0195, (0.03, 0.05, 0.1, 1.0)),
}


def unit(q: Sequence[float]) -> tuple[float, ...]:
    """A quaternion of length 1."""
    return tuple(np.array(q) / np.linalg.norm(q))


def cube(builder: sw.ModelBuilder, lift: float = 0.0) -> SoftBody:
    """A soft cube over z = lift."""
    box = meshing.box((SIDE,) * 3, (2, 2, 2))
    nodes = box.nodes + (0.0, 0.0, lift)
    return builder.add_tets(nodes, box.tets, material=sw.Corotational(1e5, 0.4), density=1e3, rayleigh=(0.5, 0.01))


def bed(builder: sw.ModelBuilder, size: tuple[float, float, float], cells: tuple[int, int, int]) -> SoftBody:
    """A soft bed under z = 0, held at its bottom."""
    box = meshing.box(size, cells)
    nodes = box.nodes - (0.5 * size[0], 0.5 * size[1], size[2])
    body = builder.add_tets(nodes, box.tets, material=sw.Corotational(1e5, 0.4), density=1e3, rayleigh=(0.5, 0.01))
    builder.fix(body, box=((-1.0, -1.0, -1.0), (1.0, 1.0, 1e-6 - size[2])))
    return body


def made(builder: sw.ModelBuilder, num_worlds: int = 1, precision: str = "float64", passes: int = 0) -> sw.Simulation:
    """Its simulation, contacts solved exactly."""
    model = builder.finalize(num_worlds=num_worlds, precision=precision)
    return sw.Simulation(model, dt=0.01, contact_passes=passes, **(EXACT if precision == "float64" else {}))


def on_shape(
    kind: str, base: str, num_worlds: int = 1, precision: str = "float64", passes: int = 0, **laws: float
) -> sw.Simulation:
    """A soft cube on a shape that moves as it is told, or freely."""
    builder = sw.ModelBuilder(gravity=(0.3, 0.2, -9.81))
    body = cube(builder)
    shape, depth, turn = UNDER[kind]
    pose = (0.047, 0.053, 1.5e-3 - depth, *unit(turn))
    if base == "free":
        other = builder.add_rigid(shape, pose=pose, mass=0.5, inertia=(1e-3, 2e-3, 1.5e-3))
        builder.add_marker(other, (0.01, 0.0, 0.0))
    else:
        other = builder.add_rigid(shape, pose=pose, kinematic=True)
    builder.add_contact(body, other, mu=0.5, **laws)
    return made(builder, num_worlds, precision, passes)


def on_bed(kind: str, passes: int = 0) -> sw.Simulation:
    """A rigid body whose corners, edges or rims press into a soft bed."""
    builder = sw.ModelBuilder(gravity=(0.3, 0.2, -9.81))
    body = bed(builder, (0.2, 0.2, 0.1), (3, 3, 1))
    shape, height, turn = ABOVE[kind]
    pose = (0.01, 0.013, height, *unit(turn))
    other = builder.add_rigid(shape, mass=0.3, inertia=(1e-4, 2e-4, 1.5e-4), pose=pose)
    builder.add_contact(body, other, mu=0.4)
    builder.add_marker(other, (0.01, 0.0, 0.0))
    return made(builder, passes=passes)


def on_soft(lift: float = 0.0, passes: int = 0) -> sw.Simulation:
    """A soft cube on a soft bed whose grid is another one."""
    builder = sw.ModelBuilder(gravity=(0.3, 0.2, -9.81))
    body = cube(builder, lift)
    builder.add_contact(body, bed(builder, (0.25, 0.2, 0.06), (3, 2, 1)), mu=0.5)
    return made(builder, passes=passes)


def thrown(sim: sw.Simulation, along: float, down: float, seeds: Sequence[int] = (1,)) -> Inputs:
    """Nodes that are displaced and move, bodies that move and turn; world i has those of ``seeds[i]``."""
    worlds: dict[str, list[torch.Tensor]] = {"node_x": [], "node_v": [], "node_force": [], "body_twist": []}
    for seed in seeds:
        rng = np.random.default_rng(seed)
        shape = tuple(sim.node_x.shape[1:])
        x = sim.node_x[0].cpu().numpy() + 5e-4 * rng.standard_normal(shape)
        v = 0.02 * rng.standard_normal(shape) + (along, 0.3 * along, -down)
        twist = rng.uniform(0.5, 1.0, tuple(sim.body_twist.shape[1:])) * (0.1, 0.05, -0.1, 0.3, -0.2, 0.5)
        for name, value in zip(worlds, (x, v, 0.01 * rng.standard_normal(shape), twist), strict=True):
            worlds[name].append(torch.tensor(value).to(sim.node_x))
    stacked = {name: torch.stack(values) for name, values in worlds.items()}
    force = stacked.pop("node_force").expand(STEPS, *stacked["node_x"].shape).contiguous()
    twist = stacked.pop("body_twist")
    controls, names = {"node_force": force}, ["youngs", "density", "gravity", "pair_mu"]
    if sim.model.has_kinematic and sim.model.has_moving_frames:
        controls["body_velocity"] = twist.expand(STEPS, *twist.shape).contiguous()
    elif sim.model.rigid_count and not sim.model.has_kinematic:
        stacked |= {"body_pose": sim.body_pose.clone(), "body_twist": twist}
        names.append("body_mass")
    return {"state": stacked, "controls": controls, "parameters": {n: getattr(sim.params, n).clone() for n in names}}


def loss(states: States) -> torch.Tensor:
    """A weight for every result; (world,)."""
    total = test_contact.loss(states)
    if states.marker_x.shape[-2]:
        total = total + (states.marker_x * torch.tensor([10.0, -20.0, 15.0]).to(total)).sum(dim=(0, 2, 3))
    if states.body_twist.shape[-2]:
        weight = torch.tensor([1.0, 2.0, 3.0, -0.1, 0.2, 0.3]).to(total)
        total = total + (states.body_twist * weight).sum(dim=(0, 2, 3))
    return total


def modes(sim: sw.Simulation, given: Inputs) -> set[int]:
    """States of contacts in the steps that a rollout takes."""
    for name, value in given["state"].items():
        getattr(sim, name)[...] = value
    found: set[int] = set()
    for _ in range(STEPS):
        sim.step()
        pressure = (sim.contact_load * sim.contact_normal).sum(dim=-1)
        friction = (sim.contact_load - pressure[..., None] * sim.contact_normal).norm(dim=-1)
        slips = friction >= (1.0 - 1e-8) * sim.params.pair_mu * pressure
        mode = torch.where(pressure == 0.0, OPEN, torch.where(slips, SLIPPING, STUCK))
        found |= set(mode[sim.contact_pair >= 0].tolist())
    return found


@pytest.mark.parametrize("base", ["kinematic", "free"])
@pytest.mark.parametrize(
    "kind", ["capsule", *(pytest.param(kind, marks=pytest.mark.slow) for kind in UNDER if kind != "capsule")]
)
def test_a_soft_cube_on_a_shape(kind: str, base: str) -> None:
    """Nodes and edges on round parts, faces, edges and corners, that stand, are moved or move freely."""
    sim = on_shape(kind, base)
    given = thrown(sim, 0.2, 0.3)
    check(Rollout(sim), given, loss, SIZES)
    assert modes(sim, given) & {STUCK, SLIPPING}


@pytest.mark.parametrize("kind", [pytest.param(kind, marks=pytest.mark.slow) for kind in ABOVE])
def test_a_rigid_body_on_a_soft_bed(kind: str) -> None:
    """Balls, corners, edges and rims on the faces, edges and nodes of a soft body."""
    sim = on_bed(kind)
    given = thrown(sim, 0.0, 0.0)
    check(Rollout(sim), given, loss, SIZES)
    assert modes(sim, given) & {STUCK, SLIPPING}


def test_a_box_that_is_wedged() -> None:
    """Forces of two near edges, between which guesses between sweeps went round and round for ever."""
    sim = on_bed("box")
    check(Rollout(sim), thrown(sim, 0.0, 0.0, (46,)), loss, SIZES)


@pytest.mark.parametrize(("lift", "along", "down"), [(-5e-4, 0.6, 0.1), (1e-3, 0.0, 0.2)])
def test_soft_on_soft(lift: float, along: float, down: float) -> None:
    """Contacts of nodes with faces and of edges with edges, whose weights depend on where both are."""
    sim = on_soft(lift)
    given = thrown(sim, along, down, (2,))
    given["state"]["node_v"][:, 27:] = 0.0
    check(Rollout(sim), given, loss, SIZES)
    assert modes(sim, given) >= {OPEN, SLIPPING}


@pytest.mark.parametrize("other", ["bed", pytest.param("box", marks=pytest.mark.slow)])
def test_a_finger_on_a_base(other: str) -> None:
    """A soft cube whose side a moving base carries, with carried nodes, faces and edges among those that touch."""
    builder = sw.ModelBuilder(gravity=(0.3, 0.2, -9.81))
    body = cube(builder, 5e-4)
    base = builder.add_rigid(pose=(-0.02, 0.05, 0.05), kinematic=True)
    builder.attach(body, box=((-1.0, -1.0, -1.0), (1e-6, 1.0, 1.0)), to=base)
    if other == "bed":
        builder.add_contact(body, bed(builder, (0.25, 0.25, 0.06), (3, 2, 1)), mu=0.5)
    else:
        pose = (0.047, 0.053, -0.0245, *unit(FLAT))
        block = builder.add_rigid(sw.Box((0.3, 0.3, 0.05)), mass=0.5, inertia=(1e-3, 2e-3, 1.5e-3), pose=pose)
        builder.add_contact(body, block, mu=0.5)
    builder.add_marker(base, (0.01, 0.0, 0.0))
    sim = made(builder)
    given = thrown(sim, 0.0, 0.1, (2,))
    velocity = torch.tensor([[0.1, 0.02, -0.15, 0.3, -0.4, 0.2], [0.0] * 6]).to(sim.node_x)[: sim.model.rigid_count]
    given["controls"]["body_velocity"] = velocity.expand(STEPS, 1, *velocity.shape).contiguous()
    check(Rollout(sim), given, loss, SIZES)
    assert modes(sim, {"state": given["state"]}) & {STUCK, SLIPPING}


def hit_block(base: str, **laws: float) -> tuple[sw.Simulation, Inputs]:
    """A soft cube on one side of a block, and another one that hits the other side."""
    builder = sw.ModelBuilder(gravity=(0.3, 0.2, -9.81))
    body = cube(builder)
    how = {"kinematic": True} if base == "kinematic" else {"mass": 0.2, "inertia": (2e-4, 3e-4, 4e-4)}
    block = builder.add_rigid(sw.Box((0.03, 0.1, 0.04)), pose=(-0.0151, 0.05, 0.05), **how)
    builder.attach(body, box=((-1.0, -1.0, -1.0), (1e-6, 1.0, 1.0)), to=block)
    small = meshing.box((0.05,) * 3, (1, 1, 1))
    thrown_one = builder.add_tets(
        small.nodes + (-0.08, 0.03, 0.03), small.tets, material=sw.Corotational(1e5, 0.4), density=1e3
    )
    builder.add_contact(thrown_one, block, mu=0.5, **laws)
    builder.add_marker(block, (0.01, 0.0, 0.0))
    sim = made(builder)
    given = thrown(sim, 0.0, 0.1, (2,))
    given["state"]["node_v"][:, 27:, 0] = 0.3
    return sim, given


@pytest.mark.parametrize("base", ["kinematic", pytest.param("free", marks=pytest.mark.slow)])
def test_a_body_that_carries_something_and_is_touched(base: str) -> None:
    """What a block carries, and what hits it."""
    sim, given = hit_block(base)
    check(Rollout(sim), given, loss, SIZES)
    assert modes(sim, given) & {STUCK, SLIPPING}


@pytest.mark.parametrize("passes", [0, 1])
def test_a_ball_on_a_slope_and_a_wall(passes: int) -> None:
    """A rigid ball that rolls on rigid shapes, which move."""
    builder = sw.ModelBuilder(gravity=(0.3, 0.2, -9.81))
    floor = builder.add_rigid(sw.Plane(), kinematic=True, pose=(0.0, 0.0, 0.0, *unit((0.02, 0.03, 0.0, 1.0))))
    turn = unit((0.1, 0.1, 0.3, 1.0))
    wall = builder.add_rigid(sw.Box((0.05, 0.05, 0.05)), kinematic=True, pose=(0.06, 0.0, 0.02, *turn))
    ball = builder.add_rigid(sw.Sphere(0.03), mass=0.2, pose=(0.0, 0.0, 0.0299))
    builder.add_contact(floor, ball, mu=0.4)
    builder.add_contact(wall, ball, mu=0.3)
    builder.add_marker(ball, (0.01, 0.0, 0.02))
    sim = made(builder, passes=passes)
    sim.body_twist[0, ball] = torch.tensor([0.6, 0.1, -0.1, 0.2, 3.0, 0.5])
    rng = np.random.default_rng(1)
    force, push, weight = (torch.tensor(rng.standard_normal((STEPS, 1, 3, 6))) for _ in range(3))
    given: Inputs = {
        "state": {},
        "controls": {"body_force": 0.01 * force, "body_velocity": 0.02 * push * torch.tensor([[1.0], [1.0], [0.0]])},
        "parameters": {name: getattr(sim.params, name).clone() for name in ("gravity", "pair_mu", "body_mass")},
    }

    def told(states: States) -> torch.Tensor:
        total = (states.body_pose[..., :6] * 10.0 * weight + states.body_twist * weight.flip(0)).sum(dim=(0, 2, 3))
        return total + (states.marker_x * torch.tensor([10.0, -20.0, 15.0])).sum(dim=(0, 2, 3))

    check(Rollout(sim), given, told, SIZES | {"controls": SIZES["controls"] | {"body_force": 1e-6}})
    assert modes(sim, given) & {STUCK, SLIPPING}


@pytest.mark.parametrize("kind", ["edge", pytest.param("cylinder", marks=pytest.mark.slow)])
def test_worlds_beside_and_kept_factors_change_no_bit(kind: str) -> None:
    """A world of a batch has the gradient of that world alone, and kept factors lead to the same."""
    seeds = (1, 2, 3)
    batch, single = on_shape(kind, "free", len(seeds)), on_shape(kind, "free")
    rollout, alone, given = Rollout(batch), Rollout(single), thrown(batch, 0.2, 0.3, seeds)
    plain, kept = gradients(rollout, given, loss), gradients(rollout, given, loss, factors=True)
    for world, seed in enumerate(seeds):
        for group, held in gradients(alone, thrown(single, 0.2, 0.3, (seed,)), loss).items():
            for name, value in held.items():
                axis = 1 if group == "controls" else 0
                assert torch.equal(plain[group][name].select(axis, world), value.select(axis, 0)), (group, name)
                assert torch.equal(plain[group][name], kept[group][name]), (group, name)


def test_refusals() -> None:
    """What of contact has no gradient is told by name, with the way out."""
    model = on_shape("sphere", "free").model
    with pytest.raises(ValueError, match=r"measured anew more than once a step \(contact_passes=2.*contact_passes=1"):
        Rollout(sw.Simulation(model, dt=0.01, contact_passes=2))
    builder = sw.ModelBuilder()
    cube(builder)
    block, other = (
        builder.add_rigid(sw.Box((0.1,) * 3), mass=0.1, name=name, pose=(0.0, 0.0, z))
        for name, z in (("block", -0.1), ("other", -0.3))
    )
    builder.add_contact(block, other)
    with pytest.raises(ValueError, match=r"contact of '(block|other)' and '(block|other)' .* two rigid bodies"):
        Rollout(made(builder))
