"""Cables, chambers and joints in one scene: the rows of each kind act as those of a scene that has nothing else."""

import pytest
import torch

import softwarp as sw
from softwarp import meshing
from softwarp.control import InverseController, PointEffector

SCENES = ("finger", "pump", "arm")
OUTPUTS = {
    "finger": ("cable_tension", "cable_displacement"),
    "pump": ("cavity_pressure", "cavity_volume"),
    "arm": ("joint_force", "joint_position", "joint_reaction"),
}
SILICONE = sw.NeoHookean(1e5, 0.4)


def moved(mesh: meshing.TetMesh, y: float) -> meshing.TetMesh:
    return meshing.TetMesh(mesh.nodes + (0.0, y, 0.0), mesh.tets, "block")


def finger(builder: sw.ModelBuilder) -> None:
    """A held bar with two cables; marker at its end."""
    body = builder.add_tets(meshing.box((0.06, 0.02, 0.02), (4, 1, 1)), material=SILICONE, density=1000.0)
    builder.fix(body, box=((-1.0, -1.0, -1.0), (1e-9, 1.0, 1.0)))
    for z in (0.015, 0.005):
        builder.add_cable(body, [(0.01 * i, 0.01, z) for i in range(7)], max_rate=0.1)
    builder.add_marker(body, (0.06, 0.01, 0.01))


def pump(builder: sw.ModelBuilder) -> None:
    """A held block with a chamber under pressure; marker on its top."""
    body = builder.add_tets(
        moved(meshing.box((0.02, 0.02, 0.02), (2, 2, 2)), 0.05), material=SILICONE, density=1000.0, rayleigh=(0.0, 0.02)
    )
    builder.fix(body, box=((-1.0, -1.0, -1.0), (1.0, 1.0, 1e-9)))
    inner = meshing.box((0.01, 0.01, 0.01), (1, 1, 1))
    builder.add_cavity(body, inner.nodes + (0.005, 0.055, 0.005), inner.surface(), max_pressure_rate=2e5)
    builder.add_marker(body, (0.01, 0.06, 0.02))


def arm(builder: sw.ModelBuilder) -> None:
    """A link on a hinge with a soft servo; marker at its tip."""
    link = builder.add_rigid(sw.shapes.Box((0.1, 0.01, 0.01)), mass=0.05, pose=(0.05, 0.1, 0.0))
    servo = {"control": "position", "stiffness": 2.0, "damping": 0.05, "max_force": 0.4}
    builder.add_joint(None, link, "hinge", anchor=(0.0, 0.1, 0.0), axis=(0.0, -1.0, 0.0), **servo)
    builder.add_marker(link, (0.1, 0.1, 0.0))


def build(names: tuple[str, ...], precision: str = "float64", **options) -> sw.Simulation:
    """The named parts in this order, under the same commands wherever they stand."""
    builder = sw.ModelBuilder()
    for name in names:
        globals()[name](builder)
    sim = sw.Simulation(builder.finalize(3, precision=precision), dt=0.005, **options)
    sim.control.cable_displacement.copy_(torch.tensor([0.003, 0.0])[: sim.model.cable_count])
    sim.control.cavity_pressure.fill_(8e3)
    sim.control.joint_target.fill_(0.3)
    return sim


@pytest.mark.parametrize(
    ("precision", "options", "tolerance"),
    [
        ("float64", {}, 1e-6),
        pytest.param("float64", {"newton_iterations": 6, "newton_tolerance": 1e-10}, 1e-6, marks=pytest.mark.slow),
        ("float32", {"solver_path": "lanes"}, 1e-2),
    ],
    ids=["once", "Newton", "lanes"],
)
def test_rows_of_all_kinds_share_a_scene(precision: str, options: dict, tolerance: float) -> None:
    """After 12 steps the three parts are where they are alone, with the same tensions, pressures and forces."""
    whole = build(SCENES, precision, **options)
    whole.step(12)
    sizes, nodes, markers = [], 0, 0
    for name in SCENES:
        alone = build((name,), precision, **options)
        alone.step(12)
        for output in OUTPUTS[name]:
            value = getattr(alone, output)
            assert float(value.abs().max()) > 0.0
            error = float((getattr(whole, output) - value).abs().max() / value.abs().max())
            assert error < tolerance, f"{output} differs by {error}"
        count, points = alone.model.node_count, alone.model.marker_count
        torch.testing.assert_close(whole.node_x[:, nodes : nodes + count], alone.node_x, rtol=0.0, atol=0.1 * tolerance)
        torch.testing.assert_close(
            whole.marker_x[:, markers : markers + points], alone.marker_x, rtol=0.0, atol=0.1 * tolerance
        )
        nodes, markers = nodes + count, markers + points
        sizes.append(torch.from_numpy(alone.model.row_size.numpy()))
    torch.testing.assert_close(torch.from_numpy(whole.model.row_size.numpy()), torch.cat(sizes))


def test_outputs_are_those_of_the_last_positions() -> None:
    """Volumes, positions and lengths after a linearised step are what ``refresh`` measures where it ended."""
    sim, names = build(SCENES), ("cavity_volume", "joint_position", "cable_displacement", "marker_x")
    sim.step(3)
    before = {name: getattr(sim, name).clone() for name in names}
    sim.step()
    after = {name: getattr(sim, name).clone() for name in names}
    sim.refresh()
    for name in names:
        assert float((after[name] - before[name]).abs().max()) > 1e-6 * float(after[name].abs().max()), name
        torch.testing.assert_close(getattr(sim, name), after[name], rtol=1e-9, atol=1e-15)


def test_inverse_control_finds_the_rows_of_all_kinds() -> None:
    """Three targets at once take the commands that each takes alone; the pressure moves by its rate, 10 kPa a call."""
    ways = torch.tensor([[0.0, 0.0, 0.004], [0.0, 0.0, 0.01], [0.0, 0.0, 0.02]])
    found = []
    for names in (SCENES, *((name,) for name in SCENES)):
        sim = build(names)
        sim.step(12)
        effectors = [PointEffector((marker,), axes="z") for marker in range(len(names))]
        controller = InverseController(sim, effectors, period=0.05, share=1.0)
        rows = [SCENES.index(name) for name in names]
        target = sim.marker_x + ways[rows].to(sim.marker_x)
        before = sim.cavity_pressure.clone()
        command = controller.solve(target).command[0].clone()
        if "pump" in names:
            place = list(controller.command_names).index("cavity0")
            assert float(command[place] - before[0, 0]) == pytest.approx(1e4, rel=1e-3)
        found.append(command)
    torch.testing.assert_close(found[0], torch.cat(found[1:]), rtol=1e-3, atol=1e-9)


def repeated(kind: str, times: int, worlds: int, precision: str) -> sw.Simulation:
    """A held block with the same actuator some times, and one other."""
    builder = sw.ModelBuilder()
    if kind == "cables":
        body = builder.add_tets(meshing.box((0.06, 0.02, 0.02), (4, 1, 1)), material=SILICONE, density=1000.0)
        builder.fix(body, box=((-1.0, -1.0, -1.0), (1e-9, 1.0, 1.0)))
        for z in (*[0.015] * times, 0.005):
            builder.add_cable(body, [(0.01 * i, 0.01, z) for i in range(7)])
    else:
        body = builder.add_tets(
            meshing.box((0.03, 0.02, 0.02), (3, 2, 2)), material=SILICONE, density=1000.0, rayleigh=(0.0, 0.02)
        )
        builder.fix(body, box=((-1.0, -1.0, -1.0), (1.0, 1.0, 1e-9)))
        inner = meshing.box((0.01, 0.01, 0.01), (1, 1, 1))
        for x in (*[0.005] * times, 0.015):
            builder.add_cavity(body, inner.nodes + (x, 0.005, 0.005), inner.surface(), control="volume")
    return sw.Simulation(builder.finalize(worlds, precision=precision), dt=0.005)


@pytest.mark.parametrize("kind", ["cables", "chambers"])
@pytest.mark.parametrize(("worlds", "precision"), [(1, "float64"), (9, "float32")])
def test_rows_that_repeat_each_other_share_evenly(kind: str, worlds: int, precision: str) -> None:
    """An actuator that stands there three times pulls or presses with a third each time, and moves the body as one."""
    found = []
    for times in (1, 3):
        sim = repeated(kind, times, worlds, precision)
        for step in range(12):
            if kind == "cables":
                sim.control.cable_displacement.copy_(torch.tensor([*[3e-4 * step] * times, 0.0]))
            else:
                growth = torch.tensor([*[2e-8 * step] * times, 1e-8 * step])
                sim.control.cavity_volume.copy_(1e-6 + growth)
            sim.step()
        found.append((sim.node_x, sim.cable_tension if kind == "cables" else sim.cavity_pressure))
    (x, single), (same_x, many) = found
    exact = precision == "float64"
    torch.testing.assert_close(same_x, x, rtol=0.0, atol=1e-9 if exact else 2e-6)
    spread = many[:, :3].amax(1) - many[:, :3].amin(1)
    assert float((spread / many[:, 0]).max()) < (1e-6 if exact else 1e-4)
    torch.testing.assert_close(many[:, :3].sum(1), single[:, 0], rtol=1e-5 if exact else 5e-3, atol=0.0)
    torch.testing.assert_close(many[:, 3], single[:, 1], rtol=1e-5 if exact else 5e-3, atol=1e-3)


def test_a_slack_cable_beside_the_same_taut_one_has_no_tension() -> None:
    """Of two cables through the same points the shorter one pulls alone."""
    sim = repeated("cables", 2, 1, "float64")
    sim.control.cable_displacement.copy_(torch.tensor([0.002, 0.003, 0.0]))
    sim.step(10)
    assert float(sim.cable_tension[0, 0]) == 0.0
    assert float(sim.cable_tension[0, 1]) > 0.1
