"""Further looks at contacts: who takes them, what they are good for, and that a world does so whatever others do."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import softwarp as sw
from softwarp.solvers import looks
from softwarp.solvers.looks import FurtherLooks

SPEED = 3.0  # m/s
THROWN = (2, 5)  # worlds


def scene(worlds: int, *, device: str = "cpu", passes: int | None = None, path: str = "lanes") -> sw.Simulation:
    """A tube beside a ball."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    tube = sw.Tube([sw.TubeSection(0.1)], radius=1e-3, youngs=1e9)
    line = builder.add_telescope([tube], segments=8, lengths=(0.08,), contact_radius=2e-4)
    builder.add_contact(line, builder.add_rigid(sw.Sphere(0.005), kinematic=True, pose=(0.008, 0.004, 0.06)))
    model = builder.finalize(worlds, device)
    return sw.Simulation(model, dt=0.01, contact_passes=passes, solver_path=path, threads=1)


def throw(sim: sw.Simulation, worlds: tuple[int, ...]) -> None:
    """Move the tube towards the ball, by many of its radii a step."""
    for world in worlds:
        sim.rod_v[world, 1:, 0] = SPEED


@pytest.mark.parametrize(
    ("device", "path"),
    [("cpu", "lanes"), *(pytest.param("cuda:0", path, marks=pytest.mark.cuda) for path in ("panels", "levels"))],
)
def test_a_world_looks_again_by_its_own_need(device: str, path: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those that are thrown do so in the midst of others at rest, and all have the bits that they have alone."""
    looked: list[torch.Tensor] = []
    watch = FurtherLooks.watch

    def told(self: FurtherLooks, x_scale: float) -> None:
        watch(self, x_scale)
        looked.append(torch.as_tensor(1 - self.contact.contacts.idle.real.numpy().reshape(-1)))

    monkeypatch.setattr(looks, "SKIN", 1e-3)  # so that all that is thrown looks again
    sims = [scene(worlds, device=device, path=path) for worlds in (9, 1, 1, 1)]
    monkeypatch.setattr(FurtherLooks, "watch", told)
    throw(sims[0], THROWN)
    for sim in sims[1::2]:
        throw(sim, (0,))
    sims[0].step()  # the first one is not captured
    assert looked[0][:9].nonzero().flatten().tolist() == list(THROWN)
    monkeypatch.undo()
    for sim in sims[1:]:
        sim.step()
    for system in sims[3].systems:
        system.always = True  # asks nobody, as in a recording of Torch
    for _ in range(4):
        for sim in sims:
            sim.step()
    for world in range(9):
        for alone in sims[1::2] if world in THROWN else sims[2:3]:
            for name in ("frame_pose", "frame_twist", "contact_key", "contact_force", "contact_count", "residual"):
                one, other = (sim.state_tensors()[name] for sim in (sims[0], alone))
                assert torch.equal(one[world], other[0]), (world, name)


def test_looks_are_chosen_by_the_scene() -> None:
    """Up to three with a telescope that touches; a number that is named is that number in every world."""
    options = scene(1).options
    assert (options.contact_passes, options.further_passes, options.skin) == (1, 2, pytest.approx(2e-5))
    assert (scene(1, passes=2).options.contact_passes, scene(1, passes=2).options.further_passes) == (2, 0)
    builder = sw.ModelBuilder()
    ball = builder.add_rigid(sw.Sphere(0.01), density=1e3, pose=(0.0, 0.0, 0.01))
    builder.add_contact(ball, builder.add_rigid(sw.Plane(), kinematic=True))
    options = sw.Simulation(builder.finalize(1), dt=0.01).options
    assert (options.contact_passes, options.further_passes) == (1, 0)
    builder = sw.ModelBuilder()
    corners, stuff = np.vstack((np.zeros((1, 3)), 0.01 * np.eye(3))), sw.Corotational(1e5, 0.3)
    one, other = (
        builder.add_tets(corners + shift, [[0, 1, 2, 3]], material=stuff, density=1e3) for shift in (0.0, 0.02)
    )
    builder.add_contact(one, other)
    options = sw.Simulation(builder.finalize(1), dt=0.01).options
    assert (options.contact_passes, options.further_passes) == (1, 1)
    assert options.skin == pytest.approx(0.25 * 0.01 * 2.0 ** (1.0 / 6.0))  # of a regular element as large as these
