"""A snapshot holds every array, restore writes every array or none, and reset returns every state and command."""

import copy
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import meshing, shapes
from softwarp.envs.snapshot import EnvSnapshot
from softwarp.model.fields import declarations
from softwarp.model.state import Control, Parameters, State
from softwarp.snapshot import Snapshot

WORLDS = 3
GROUPS = {"state": State, "control": Control, "params": Parameters}


def everything(worlds: int, device: str = "cpu", precision: str = "float32") -> sw.Simulation:
    """A scene in which no declared array is empty."""
    builder = sw.ModelBuilder()
    floor = builder.add_rigid(sw.Plane(), kinematic=True, pose=(0.0, 0.0, -0.1))
    arm = builder.add_rigid(sw.Box((0.05, 0.02, 0.02)), mass=0.1, pose=(0.1, 0.0, 0.0))
    servo = {"control": "position", "stiffness": 20.0, "damping": 0.2, "max_rate": 0.5}
    builder.add_joint(None, arm, "hinge", axis=(0.0, 1.0, 0.0), **servo)
    mesh = meshing.box((0.04, 0.04, 0.08), (2, 2, 2))
    soft = builder.add_tets(mesh, material=sw.Yeoh(c10=1e4, bulk=1e6), density=1000.0, relaxation=(0.2, 0.02))
    builder.fix(soft, nodes=np.flatnonzero(mesh.nodes[:, 2] < 1e-9))
    air = meshing.box((0.02, 0.02, 0.04), (1, 1, 1))
    builder.add_cavity(soft, air.nodes + (0.01, 0.01, 0.02), air.surface())
    side = [t for t in mesh.surface() if (mesh.nodes[t][:, 0] < 1e-9).all()]
    builder.add_membrane(soft, side, thickness=5e-4, youngs=2e6, nu=0.4)
    builder.add_cable(soft, [(0.03, 0.02, z) for z in (0.08, 0.06, 0.04)], (0.03, 0.02, 0.0))
    builder.add_spring(arm, soft, [(0.1, 0.0, 0.0), (0.03, 0.02, 0.07)], stiffness=5.0, damping=0.1)
    builder.add_traction(soft, (10.0, 0.0, 0.0), triangles=side)
    builder.add_rod(np.linspace((0.2, 0.0, 0.0), (0.3, 0.0, 0.0), 3), radius=0.003, youngs=1e6, density=1000.0)
    builder.add_telescope([sw.Tube([sw.TubeSection(0.1)], radius=0.001)], port=(0.0, 0.3, 0.0), lengths=(0.05,))
    builder.add_marker(soft, (0.02, 0.02, 0.08))
    either = [sw.RigidMesh(*sw.Box((0.1, 0.1, height)).surface()) for height in (0.1, 0.2)]
    builder.add_rigid(shapes.OneOf(either), kinematic=True, pose=(1.0, 0.0, 0.0))
    builder.add_contact(arm, floor, mu=0.4)
    block = meshing.box((0.02, 0.02, 0.02), (1, 1, 1))
    small = builder.add_tets(block, material=sw.NeoHookean(1e5, 0.3), density=1000.0)
    modes = (block.nodes - 0.01)[None] * np.eye(3)[:, None]  # stretches, in a frame that turns with the body
    whole = {"tet_weight": np.ones(len(block.tets)), "membrane_weight": {}}
    builder.reduce(small, SimpleNamespace(nodes=block.nodes, tets=block.tets, modes=modes, turns=True, **whole))
    return sw.Simulation(builder.finalize(worlds, device, precision), dt=0.01)


@pytest.fixture(scope="module")
def sim():
    return everything(WORLDS)


def views(sim: sw.Simulation) -> dict[str, torch.Tensor]:
    """Every declared array; ``contact_force`` of the state has a method before it."""
    tensors = {"state": sim._views, "control": sim.control.tensors(), "params": sim.params.tensors()}
    return {f"{group}.{name}": tensors[group][name] for group, cls in GROUPS.items() for name in declarations(cls)}


def bits(sim: sw.Simulation) -> dict[str, torch.Tensor]:
    return {key: view.cpu().clone() for key, view in views(sim).items()}


def assert_same(one, other, keys=None):
    for key in keys or one:
        assert torch.equal(one[key], other[key]), key


def perturb(sim: sw.Simulation, seed: int) -> dict[str, torch.Tensor]:
    """Other numbers in every element of every array; returns them."""
    generator = torch.Generator().manual_seed(seed)
    for view in views(sim).values():
        view.copy_(1 + torch.randint(2**20, view.shape, generator=generator))
    return bits(sim)


def test_no_array_is_forgotten(sim):
    """Snapshot, restore and reset, each array overwritten in between; reset leaves parameters alone."""
    assert all(view.numel() for view in views(sim).values()), "add to the scene what the new array belongs to"
    first = perturb(sim, 1)
    saved = sim.snapshot()
    assert saved.arrays.keys() == first.keys()
    perturb(sim, 2)
    sim.restore(saved)
    assert_same(bits(sim), first)

    sim.set_initial()
    second = perturb(sim, 3)
    own = [key for key in first if not key.startswith("params.")]
    sim.reset(torch.tensor([False, True, False]))
    for world in range(WORLDS):
        wanted = first if world == 1 else second
        for key in own:
            assert torch.equal(views(sim)[key][world], wanted[key][world]), key
    sim.reset()
    assert_same(bits(sim), first, own)
    assert_same(bits(sim), second, first.keys() - own)


def changed(saved: Snapshot, **arrays: torch.Tensor | None) -> Snapshot:
    """A copy with arrays of the state exchanged, added, or taken out."""
    made = copy.copy(saved.arrays) | {f"state.{name}": value for name, value in arrays.items() if value is not None}
    for name in (name for name, value in arrays.items() if value is None):
        del made[f"state.{name}"]
    return Snapshot(saved.fingerprint, saved.precision, made)


def test_refused_snapshots_change_no_bit(sim):
    """The last array may be at fault: those before it are not written."""
    saved = sim.snapshot()
    before = perturb(sim, 4)
    tail = saved.arrays["state.cable_displacement"]
    for bad, message in (
        (changed(saved, joint_reference=None), r"lacks state\.joint_reference: it is damaged or of another version"),
        (changed(saved, cable_displacement=None), r"lacks state\.cable_displacement"),
        (changed(saved, tomorrow=tail), r"holds state\.tomorrow, which is unknown here"),
        (changed(saved, cable_displacement=tail[:, :0]), r"state\.cable_displacement must be torch.float32 of shape"),
        (changed(saved, cable_displacement=tail[:2]), r"of shape \(3, 2\), got torch.float32 of shape \(2, 2\)"),
        (changed(saved, cable_displacement=tail.double()), r"got torch.float64"),
        (changed(saved, status=saved.arrays["state.status"].long()), r"state\.status must be torch.int32"),
        (Snapshot("other", saved.precision, saved.arrays), "another scene"),
        (Snapshot(saved.fingerprint, "float64", saved.arrays), "in float64, this simulation in float32"),
        (Snapshot(saved.fingerprint, saved.precision, {}), "lacks state.node_x"),
    ):
        with pytest.raises(ValueError, match=message):
            sim.restore(bad)
        assert_same(bits(sim), before)
    with pytest.raises(TypeError, match=r"takes a Snapshot, got dict; sim.snapshot\(\) and"):
        sim.restore(saved.arrays)
    for worlds, message in (([0, 1], "holds 3 worlds but 2"), ([0, 1, 3], "world 3 does not exist")):
        with pytest.raises(ValueError, match=message):
            sim.restore(saved, worlds)
        assert_same(bits(sim), before)


@pytest.mark.slow
def test_other_batches(sim, tmp_path):
    """Through a file into another batch: all worlds, chosen ones in another order, one world into all."""
    first = perturb(sim, 5)
    sim.snapshot().save(tmp_path / "state.npz")
    sim.snapshot(worlds=[2]).save(tmp_path / "one.npz")
    other = everything(5)
    before = perturb(other, 6)
    other.restore(Snapshot.load(tmp_path / "state.npz"), worlds=[4, 0, 2])
    for key, view in views(other).items():
        assert torch.equal(view[[4, 0, 2]], first[key]), key
        assert torch.equal(view[[1, 3]], before[key][[1, 3]]), key
    other.restore(Snapshot.load(tmp_path / "one.npz"))
    assert all(torch.equal(view, first[key][[2] * 5]) for key, view in views(other).items())


@pytest.mark.cuda
@pytest.mark.parametrize(("source", "target"), [("cpu", "cuda:0"), ("cuda:0", "cpu")])
def test_other_device(source, target, tmp_path):
    """From the memory of one kind of device into that of the other, every array to the bit."""
    sim, other = everything(WORLDS, source), everything(WORLDS + 2, target)
    first = perturb(sim, 7)
    sim.snapshot().save(tmp_path / "state.npz")
    for saved in (sim.snapshot(), Snapshot.load(tmp_path / "state.npz")):
        perturb(other, 8)
        other.restore(saved, worlds=[1, 2, 4])
        assert all(torch.equal(view[[1, 2, 4]].cpu(), first[key]) for key, view in views(other).items())


def test_servo_goes_on_from_its_reference():
    """Its speed is limited, so that the future depends on how far the reference has come."""
    builder = sw.ModelBuilder()
    arm = builder.add_rigid(sw.Box((0.05, 0.02, 0.02)), mass=0.1)
    builder.add_joint(None, arm, "hinge", axis=(0.0, 1.0, 0.0), control="position", stiffness=20.0, max_rate=0.5)
    sim = sw.Simulation(builder.finalize(2), dt=0.01, threads=1)
    sim.control.joint_target[:] = 1.0
    sim.set_initial()

    def go_on() -> torch.Tensor:
        sim.step(10)
        return torch.cat((sim.frame_pose.flatten(), sim.joint_reference.flatten()))

    first = go_on()
    saved = sim.snapshot()
    second = go_on()
    sim.restore(saved)
    assert torch.equal(go_on(), second)
    sim.reset()
    assert torch.equal(go_on(), first)
    assert 0.0 < float(first[-1]) < float(second[-1]) < 1.0


def test_snapshots_of_environments_are_checked():
    """Nothing but what ``state_dict`` gave is taken; tensors of another type or number of worlds do not fit."""
    sim = Snapshot("scene", "float32", {"state.node_x": torch.zeros(2, 1, 3)})
    saved = EnvSnapshot("Task", sim, {"step_count": torch.zeros(2), "goal": torch.zeros(2, 3)})
    held = {"step_count": torch.zeros(4), "goal": torch.zeros(4, 3)}
    EnvSnapshot.from_state_dict(saved.state_dict()).check_fit("Task", held, 2)
    whole = saved.state_dict()
    for bad in (
        {},
        whole | {"env": 3},
        whole | {"tensors": {}},
        whole | {"tensors": 1.0},
        whole | {"sim": {"arrays": {}}},
        whole | {"sim": whole["sim"] | {"arrays": {"state.node_x": 1.0}}},
        whole | {"sim": whole["sim"] | {"more": 1}},
    ):
        with pytest.raises(ValueError, match="snapshot: not the state_dict of one"):
            EnvSnapshot.from_state_dict(bad)
    for tensors, message in (
        ({"goal": torch.zeros(2, 3).double()}, "does not fit this Task"),
        ({"goal": torch.zeros(1, 3)}, "different numbers of worlds"),
    ):
        with pytest.raises(ValueError, match=message):
            EnvSnapshot("Task", sim, saved.tensors | tensors).check_fit("Task", held, 2)
