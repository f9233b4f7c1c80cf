"""Search against shapes on a CPU: what is left out before it touches nothing, what it keeps is not measured again."""

from collections.abc import Callable

import pytest
import torch

import softwarp as sw
from softwarp import meshing


def _scene(worlds: int) -> sw.Simulation:
    """A soft bar that falls on a floor, a tilted plane, a box, ball and capsule, in every world at another speed."""
    builder = sw.ModelBuilder()
    mesh = meshing.box((0.4, 0.06, 0.06), (12, 2, 2))
    bar = builder.add_tets(mesh, material=sw.Corotational(1e5, 0.4), density=1000.0, rayleigh=(0.0, 0.01))
    half = 0.5 * 0.3
    turn = (0.0, half, 0.0, (1.0 - half * half) ** 0.5)
    for shape, pose in (
        (sw.Plane(), (0.0, 0.0, -0.06)),
        (sw.Plane(), (-0.03, 0.0, -0.05, *turn)),
        (sw.Box((0.08, 0.05, 0.04)), (0.1, 0.03, -0.03, *turn)),
        (sw.Sphere(0.03), (0.22, 0.02, -0.04)),
        (sw.Capsule(0.02, 0.1), (0.33, 0.03, -0.08, *turn)),
    ):
        builder.add_contact(bar, builder.add_rigid(shape, kinematic=True, pose=pose), mu=0.3)
    sim = sw.Simulation(builder.finalize(worlds), dt=0.01)
    sim.node_v[:, :, 2] -= torch.linspace(0.0, 1.0, worlds)[:, None]
    sim.node_v[:, :, 1] += 0.3
    return sim


def _on_boxes(worlds: int) -> sw.Simulation:
    """A soft cube that slides over a level box and turned ones: its edges run along faces, and across their borders."""
    builder = sw.ModelBuilder()
    mesh = meshing.box((0.1, 0.1, 0.1), (5, 5, 5))
    cube = builder.add_tets(mesh, material=sw.Corotational(1e5, 0.4), density=1000.0, rayleigh=(0.0, 0.01))
    for turn, pose in ((0.0, (0.05, 0.02, -0.031)), (0.3, (0.14, 0.05, -0.035)), (1.2, (-0.03, 0.1, -0.04))):
        half = 0.5 * turn
        turned = (*pose, 0.6 * half, 0.8 * half, 0.0, (1.0 - half * half) ** 0.5)
        builder.add_contact(cube, builder.add_rigid(sw.Box((0.07, 0.09, 0.06)), kinematic=True, pose=turned), mu=0.3)
    sim = sw.Simulation(builder.finalize(worlds), dt=0.01)
    sim.node_v[:, :, 0] += torch.linspace(0.0, 0.5, worlds)[:, None]
    return sim


@pytest.mark.parametrize("scene", [_scene, _on_boxes])
@pytest.mark.parametrize("worlds", [1, 9])
def test_contacts_are_those_without_a_sieve(worlds: int, scene: Callable[[int], sw.Simulation]) -> None:
    """Equal bits over an impact: features of one world in a register, and one feature of eight worlds."""
    sifted, plain = scene(worlds), scene(worlds)
    for system in plain.systems:
        assert system.contact is not None
        detector = system.contact.detector
        assert detector.k_near is not None and bool(detector.sifted.numpy().any())
        detector.k_near = None
        detector.sifted.zero_()
    most = 0
    for _ in range(15):
        sifted.step()
        plain.step()
        most = max(most, int(sifted.contact_count.min()))
        assert torch.equal(sifted.contact_count, plain.contact_count)
        assert torch.equal(sifted.contact_key, plain.contact_key)
    for system in sifted.systems:
        assert system.contact is not None
        detector = system.contact.detector
        assert detector.arrays.box_chunks.size > 0 and (detector.k_box is not None) == (worlds > 1)
    assert most > 5
    assert torch.equal(sifted.node_x, plain.node_x) and torch.equal(sifted.contact_load, plain.contact_load)


@pytest.mark.parametrize(
    ("scene", "worlds", "seats"),
    [(_on_boxes, 1, None), (_scene, 9, 3), pytest.param(_on_boxes, 9, None, marks=pytest.mark.slow)],
)
def test_kept_touches_are_those_measured_anew(
    scene: Callable[[int], sw.Simulation], worlds: int, seats: int | None
) -> None:
    """Equal bits over an impact with the touches that the search keeps and without, also where seats are too few."""
    keeping, plain = scene(worlds), scene(worlds)
    for sim, own in ((keeping, seats), (plain, 0)):
        for system in sim.systems:
            assert system.contact is not None
            detector = system.contact.detector
            assert detector.seats > 0
            detector.seats = detector.seats if own is None else own
    most = 0
    for _ in range(15):
        keeping.step()
        plain.step()
        most = max(most, int(keeping.contact_count.min()))
        for name in ("contact_count", "contact_key", "contact_gap", "contact_normal", "contact_point", "node_x"):
            assert torch.equal(getattr(keeping, name), getattr(plain, name)), name
    assert most > 5
    for sim, is_kept in ((keeping, True), (plain, False)):
        kept = [system.contact.detector.found_key.S.numpy() for system in sim.systems if system.contact is not None]
        assert any(keys.any() for keys in kept) == is_kept
