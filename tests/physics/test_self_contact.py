"""Parts that touch themselves hold together like two parts that touch each other."""

import numpy as np
import pytest

import softwarp as sw
from softwarp import meshing
from tests.contact_cases import array, contacts, run

SOFT = sw.NeoHookean(5e4, 0.3)
both = pytest.mark.parametrize("precision", ["float64", "float32"])


def tweezers(is_one_body: bool, precision: str) -> tuple[sw.Simulation, np.ndarray]:
    """Two soft arms on a fixed base that their tips press together; one body that touches itself, or two bodies."""
    mesh = meshing.box((0.06, 0.02, 0.1), (6, 2, 10))
    centre = mesh.nodes[mesh.tets].mean(axis=1)
    solid = (np.abs(centre[:, 0] - 0.03) > 0.01) | (centre[:, 2] < 0.02)
    parts = [solid] if is_one_body else [solid & (centre[:, 0] < 0.03), solid & (centre[:, 0] > 0.03)]
    builder, nodes = sw.ModelBuilder(gravity=(0, 0, 0)), []
    for part in parts:
        x, tets = meshing.compact(mesh.nodes, mesh.tets[part])
        body = builder.add_tets(x, tets, material=SOFT, density=1000, rayleigh=(5.0, 0.02))
        builder.fix(body, nodes=np.flatnonzero(x[:, 2] < 0.02 + 1e-9))
        nodes.append(x)
    builder.add_contact(0, len(parts) - 1, mu=0.3)
    rest = np.concatenate(nodes)
    sim = sw.Simulation(builder.finalize(1, precision=precision, contact_capacity=100), dt=0.01)
    for side, force in ((0.0, 0.3), (0.06, -0.27)):
        tip = (np.abs(rest[:, 0] - side) < 1e-9) & (rest[:, 2] > 0.1 - 1e-9)
        sim.control.node_force[0, tip, 0] = force / tip.sum()
    return sim, rest


@pytest.mark.parametrize("precision", [pytest.param("float64", marks=pytest.mark.slow), "float32"])
def test_soft_body(precision: str) -> None:
    """Arms of one body hold each other apart as those of two: same mesh, both bent by 13 mm, to 2e-3 of that."""
    seen = {}
    for is_one_body in (True, False):
        sim, rest = tweezers(is_one_body, precision)
        run(sim, 400)
        assert np.abs(array(sim.node_v[0])).max() < 1e-3
        assert contacts(sim)["gap"].min() > -1e-6
        load = np.abs(contacts(sim)["load"][:, 0]).sum()
        seen[is_one_body] = {tuple(np.round(r, 6)): x for r, x in zip(rest, array(sim.node_x[0]), strict=True)}, load
    one, two = seen[True][0], seen[False][0]
    assert one.keys() == two.keys()
    moved = max(np.linalg.norm(np.array(r) - x) for r, x in one.items())
    assert moved > 0.01
    assert max(np.linalg.norm(one[r] - two[r]) for r in one) < 2e-3 * moved
    assert seen[True][1] == pytest.approx(seen[False][1], rel=2e-3)
    assert seen[True][1] > 0.1


def hairpin(is_one_rod: bool, precision: str) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Legs of a rod whose bend is held, pressed together at their ends; one rod, or two. Positions, contacts."""
    gap, length, segments = 0.01, 0.12, 12
    z = np.linspace(0.0, length, segments + 1)
    left = np.stack([0.0 * z - gap, 0.0 * z, z], axis=1)
    right = left * (-1.0, 1.0, 1.0) + (0.0, 0.001, 0.0)
    turn = np.linspace(0.0, np.pi, 7)[1:-1]
    bend = np.stack([-gap * np.cos(turn), 0.0005 + 0.0 * turn, -gap * np.sin(turn)], axis=1)
    rods = [np.concatenate([left[::-1], bend, right])] if is_one_rod else [left[::-1], right]
    held = [range(segments, segments + len(bend) + 2)] if is_one_rod else [[segments], [0]]
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    for points, nodes in zip(rods, held, strict=True):
        rod = builder.add_rod(points, radius=0.003, youngs=2e5, nu=0.3, density=1000.0, rayleigh=(5.0, 0.02))
        builder.fix(rod, nodes=list(nodes))
    builder.add_contact(sw.scene.Rod(0), sw.scene.Rod(len(rods) - 1), mu=0.3)
    sim = sw.Simulation(builder.finalize(1, precision=precision, contact_capacity=60), dt=0.01)
    sim.control.rod_force[0, 0, 0], sim.control.rod_force[0, -1, 0] = 0.0015, -0.00135
    run(sim, 400)
    assert float(sim.rod_v.abs().max()) < 1e-3
    x = array(sim.rod_x[0])
    return np.concatenate([x[: segments + 1], x[-segments - 1 :]]), contacts(sim)


@both
def test_rod(precision: str) -> None:
    """Legs of one rod against those of two rods: bent by 9 mm, equal to 1e-3 of that, and so is the force."""
    (one, seen), (two, expected) = hairpin(True, precision), hairpin(False, precision)
    assert np.abs(one - two).max() < 1e-5
    assert np.abs(one[0, 0] + 0.01) > 0.009
    assert seen["gap"].min() > -1e-6
    force = np.abs(expected["load"][:, 0]).sum()
    assert np.abs(seen["load"][:, 0]).sum() == pytest.approx(force, rel=1e-3 if precision == "float64" else 1e-2)
    assert force > 0.001
