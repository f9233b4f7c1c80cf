"""Reduced bodies with a floating frame: turning costs nothing, momentum stays, and the full model does the same."""

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp import reduction
from softwarp.reduction.floating import frames
from tests.reduction_cases import (
    SLAB,
    deformations,
    every_node,
    quadratic_modes,
    reduced_by,
    scene,
    smooth_modes,
)

ANYHOW = torch.tensor([0.48, -0.6, 0.36, 0.53], dtype=torch.float64)  # quaternion of a large turn, nearly of length 1
FLAT = torch.tensor([0.0, 0.0, np.sin(1.2), np.cos(1.2)], dtype=torch.float64)  # about what is upright


def plain(modes=None, frame="floating", dt=0.01, youngs=1e5, **options):
    """The slab alone in free space, in modes or node by node."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    slab = builder.add_tets(SLAB, material=sw.NeoHookean(youngs, 0.3), density=1000.0, rayleigh=(0.0, 0.0), name="slab")
    if modes is not None:
        given = reduced_by(modes, frame=frame)
        builder.reduce(slab, reduction.Reduction(**{**vars(given), "membrane_weight": {}}), frame=frame)
    return sw.Simulation(builder.finalize(1, precision="float64"), dt=dt, **options)


def spun(sim, spin):
    """Let the body turn about its centre of mass with an angular velocity [rad/s], and move along [m/s]."""
    spin, along = torch.tensor(spin, dtype=torch.float64), torch.tensor([0.1, 0.0, 0.05], dtype=torch.float64)
    arm = sim.node_x[0] - momentum(sim)[2]
    sim.node_v[0] = torch.cross(spin.expand_as(arm), arm, dim=1) + along
    if sim.model.floating_count:
        sim.mode_v[0, :3] = along
        sim.mode_v[0, 3:6] = spin * float(sim.model.reduction.floating.radius.numpy()[0])
        before = sim.node_v.clone()
        sim.refresh()
        torch.testing.assert_close(sim.node_v, before, rtol=0.0, atol=1e-14)
    return sim


def momentum(sim):
    """Angular momentum about the centre of mass [N m s], momentum [N s], centre [m], kinetic energy [J]."""
    mass, x, v = sim.mass[0, :, None], sim.node_x[0], sim.node_v[0]
    centre = (mass * x).sum(dim=0) / mass.sum()
    spin = torch.cross(x - centre, mass * v, dim=1).sum(dim=0)
    return spin, (mass * v).sum(dim=0), centre, 0.5 * (mass * v * v).sum()


def matrix(quaternion):
    """Rotation matrix of a quaternion x y z w."""
    x, y, z, w = (quaternion / quaternion.norm()).tolist()
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return torch.tensor(np.eye(3) + 2 * w * cross + 2 * cross @ cross)


def test_turned_body_rests():
    """Turned by hand by any angle it is congruent to that at rest to rounding, and stays in bits: nothing resists."""
    sim = plain(quadratic_modes())
    sim.mode_turn[0, 0] = ANYHOW / ANYHOW.norm()
    sim.refresh()
    centre = momentum(sim)[2]
    rest = torch.tensor(SLAB.nodes)
    home = (sim.mass[0, :, None] * rest).sum(dim=0) / sim.mass.sum()
    torch.testing.assert_close(sim.node_x[0], (rest - home) @ matrix(ANYHOW).T + centre, rtol=0.0, atol=1e-16)
    start = sim.node_x.clone()
    for _ in range(20):
        sim.step()
    assert float((sim.node_x - start).abs().max()) < 1e-16
    assert float(sim.mode_q[0, 6:].abs().max()) < 1e-16


def test_tumbling_body_keeps_its_momentum():
    """A slab about its middle axis, which turns over as such bodies do: momentum to rounding, energy within 0.3 %."""
    sim = spun(plain(quadratic_modes(), youngs=1e6), (0.1, 5.0, 0.0))
    (spin, along, _, energy), turned = momentum(sim)[:4], []
    for _ in range(300):
        sim.step()
        now = momentum(sim)
        torch.testing.assert_close(now[0], spin, rtol=0.0, atol=1e-12 * float(spin.norm()))
        torch.testing.assert_close(now[1], along, rtol=0.0, atol=1e-12 * float(along.norm()))
        assert float(now[3]) == pytest.approx(float(energy), rel=3e-3)
        turned.append(matrix(sim.mode_turn[0, 0])[1, 1])
    assert min(turned) < -0.9


@pytest.mark.slow
@pytest.mark.parametrize("spin", [(0.0, 0.0, 14.0), (1.0, 5.0, 9.0)])
def test_spinning_bar_is_the_full_ones(spin):
    """Beyond 360 degrees in 0.5 s, at steps of 10 ms: within 2 % of its length of the full model at steps of 0.5 ms.

    The full model's linearly implicit steps of 10 ms lose most of their angular momentum meanwhile, here none is lost.
    """
    reference = spun(plain(dt=5e-4, integrator="trapezoidal"), spin)
    small, full = spun(plain(quadratic_modes()), spin), spun(plain(), spin)
    start = momentum(small)[0].norm()
    for _ in range(1000):
        reference.step()
    for sim in (small, full):
        for _ in range(50):
            sim.step()
    assert float(momentum(reference)[0].norm() / start) == pytest.approx(1.0, abs=1e-6)
    assert float(momentum(small)[0].norm() / start) == pytest.approx(1.0, abs=1e-10)
    assert float(momentum(full)[0].norm() / start) < 0.5
    assert float((small.node_x - reference.node_x).norm(dim=-1).max()) < 0.02 * 0.06


@pytest.mark.parametrize("contact", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_all_modes_come_near_the_full_model(contact):
    """All 330 deformations: what is left of the difference is of the first order of the step, and small.

    Damping by stiffness resists turning under stress, in both.
    """
    apart = []
    for dt in (0.004, 0.002):
        sims = []
        for reduced in (False, True):
            builder = scene(held=False, contact=contact, law=sw.NeoHookean(1e5, 0.3))
            if reduced:
                builder.reduce(0, reduced_by(deformations(every_node(held=False)), frame="floating"))
            sims.append(sw.Simulation(builder.finalize(1, precision="float64"), dt=dt))
        rest = float(sims[0].model.cavities.rest_volume[0])
        for sim in sims:
            for step in range(round(0.064 / dt)):
                sim.control.cavity_volume.fill_(rest * (1.0 + (step + 1) * dt))
                sim.control.cable_displacement.fill_(1e-2 * (step + 1) * dt)
                sim.step()
        apart.append(float((sims[0].node_x - sims[1].node_x).abs().max()))
    assert apart[1] < 0.65 * apart[0] < 4e-5


@pytest.mark.parametrize(
    ("precision", "worlds", "mu", "tolerance"),
    [("float64", 1, 0.0, 1e-9), ("float64", 1, 0.7, 2e-5), ("float32", 1, 0.7, 5e-5), ("float32", 8, 0.7, 5e-5)],
)
def test_turned_scene_is_the_same(precision, worlds, mu, tolerance):
    """Turned by 138 degrees on the floor, with chamber, cable, membrane, load and contacts: the same, turned.

    With friction 28 contacts share the load in more than one way, and tangents decide which: to some um of 5 mm.
    """
    sims, turn = [], matrix(FLAT)
    for angle in (torch.tensor([0.0, 0.0, 0.0, 1.0]), FLAT):
        builder = scene(held=False, contact=True)
        builder.reduce(0, reduced_by(quadratic_modes(), frame="floating"))
        sim = sw.Simulation(builder.finalize(worlds, precision=precision), dt=0.01)
        sim.mode_turn[:, 0] = angle.to(sim.mode_turn)
        sim.refresh()
        sim.params.pair_mu.fill_(mu)
        push = torch.tensor([0.0, 2e-3, 0.0], dtype=torch.float64)
        sim.control.node_force[:, 5] = (push if angle is not FLAT else turn @ push).to(sim.node_x)
        for step in range(40):
            sim.control.cavity_volume.fill_(float(sim.model.cavities.rest_volume[0]) * (1.0 + 0.01 * step))
            sim.control.cable_displacement.fill_(1e-4 * step)
            sim.step()
        sims.append(sim)
    assert int(sims[0].contact_count.min()) > 0
    assert bool((sims[0].status == 0).all())
    assert float((sims[0].node_x[0].double() - torch.tensor(SLAB.nodes)).abs().max()) > 2e-3
    places = [sim.node_x[0].double() - sim.mode_q[0, :3].double() for sim in sims]
    home = (sims[0].mass[0, :, None].double() * torch.tensor(SLAB.nodes)).sum(dim=0) / sims[0].mass[0].double().sum()
    torch.testing.assert_close((places[0] - home) @ turn.T + home, places[1], rtol=0.0, atol=tolerance)
    speeds = [sim.node_v[0].double() for sim in sims]
    torch.testing.assert_close(speeds[0] @ turn.T, speeds[1], rtol=0.0, atol=100.0 * tolerance)
    torch.testing.assert_close(sims[0].cavity_pressure, sims[1].cavity_pressure, rtol=1e-3, atol=0.0)


def test_training_takes_turns_out_of_motion():
    """States of a bending, turning slab: one mode holds them in a floating frame, to the last bits of float32."""
    draws = np.random.default_rng(3)
    x = SLAB.nodes - SLAB.nodes.mean(axis=0)
    bent = np.zeros_like(x)
    bent[:, 2] = x[:, 0] ** 2
    states = []
    for _ in range(30):
        q, _ = np.linalg.qr(draws.normal(size=(3, 3)))
        q *= np.sign(np.linalg.det(q))
        states.append((x + 2.0 * draws.normal() * bent) @ q.T + draws.normal(size=3))
    mass = np.full(len(x), 1e-3)
    centre, R = frames(np.array(states), SLAB.nodes, mass)
    left = np.einsum("snc,scd->snd", np.array(states) - centre[:, None], R) - x
    assert np.abs(np.einsum("ni,snj->sij", x, left) - np.einsum("nj,sni->sij", x, left)).max() < 1e-12
    builder = scene(held=False, contact=False, lone=True)
    sim = sw.Simulation(builder.finalize(4, precision="float64"), dt=0.01)
    motion = reduction.Motion(np.array(states))
    small = reduction.train(sim, motion, modes=1, frame="floating", element_tolerance=None, membrane_tolerance=None)
    assert small.turns
    assert small.rigid == 0
    assert small.report["unseen_error"] < 1e-12
    fixed = reduction.train(sim, motion, modes=1, element_tolerance=None, membrane_tolerance=None)
    assert fixed.report["missing"] > 0.3


def test_modes_of_a_fixed_frame_float():
    """Rigid ones are left out, those of deformation stay what they were, turned against nothing."""
    draws = np.random.default_rng(2)
    mass = draws.uniform(0.5, 1.5, len(SLAB.nodes))
    states = np.einsum("sk,knc->snc", draws.normal(size=(40, 18)), quadratic_modes())
    basis = reduction.pod(states, mass, SLAB.nodes, count=5, rigid="motions")
    known = {"rigid": 6, "share": mass / mass.sum(), "report": {"amplitudes": list(range(11))}}
    floated = reduction.Reduction(**{**vars(reduced_by(basis.modes)), **known}).floated()
    assert floated.turns
    assert floated.rigid == 0
    assert floated.floated() is floated
    assert floated.report["amplitudes"] == [6, 7, 8, 9, 10]
    np.testing.assert_allclose(floated.modes, basis.modes[6:], atol=1e-10)
    with pytest.raises(ValueError, match="it does not know the nodes' masses"):
        reduced_by(smooth_modes(held=False)).floated()


def test_files_and_mistakes(tmp_path):
    """A file tells its frame; one that turns is of a version that older ones refuse, and every mistake is told."""
    given = reduced_by(quadratic_modes(), frame="floating")
    given.save(tmp_path / "slab.npz")
    again = reduction.Reduction.load(tmp_path / "slab.npz")
    assert again.turns
    assert "in a floating frame" in again.told()
    with np.load(tmp_path / "slab.npz") as file:
        assert b'"version": 3' in file["about"].tobytes()
    reduced_by(smooth_modes(held=False)).save(tmp_path / "fixed.npz")
    with np.load(tmp_path / "fixed.npz") as file:
        assert b'"version": 2' in file["about"].tobytes()
    fixed = reduction.Reduction.load(tmp_path / "fixed.npz")
    assert not fixed.turns
    with pytest.raises(ValueError, match="trained in a fixed frame; train it with frame='floating'"):
        scene(held=False, contact=False).reduce(0, fixed, frame="floating")
    with pytest.raises(ValueError, match="must be one of"):
        scene(held=False, contact=False).reduce(0, fixed, frame="turning")
    held = scene(held=True, contact=False)
    held.reduce(0, given)
    with pytest.raises(ValueError, match=r"nodes are fixed, so that it cannot move as a whole"):
        held.finalize()
    rigid = scene(held=False, contact=False)
    rigid.reduce(0, reduced_by(smooth_modes(held=False), frame="floating"))
    with pytest.raises(ValueError, match="mode 0 is a rigid motion or a combination"):
        rigid.finalize()
    with pytest.raises(ValueError, match="a floating frame moves the body rigidly itself"):
        reduction.Reduction(**{**vars(given), "rigid": 3})
    free = scene(held=False, contact=False)
    free.reduce(0, given)
    with pytest.raises(ValueError, match="integrator 'bdf2' cannot advance reduced bodies with a floating frame"):
        sw.Simulation(free.finalize(), dt=0.01, integrator="bdf2")
    sim = sw.Simulation(scene(held=True, contact=False).finalize(2), dt=0.01)
    motion = reduction.Motion(np.repeat(SLAB.nodes[None], 4, axis=0), {"air": 1.0, "cable": 1.0})
    with pytest.raises(ValueError, match=r"nodes of body 'slab' are fixed"):
        reduction.train(sim, motion, frame="floating")
    sim = sw.Simulation(scene(held=False, contact=False).finalize(2), dt=0.01)
    with pytest.raises(ValueError, match="a floating frame moves body 'slab' rigidly itself"):
        reduction.train(sim, motion, frame="floating", rigid="motions")
