"""Inverse control of reduced bodies: with all modes that of the full model, with few it still reaches."""

import pytest
import torch

import softwarp as sw
from softwarp.control import InverseController, PointEffector
from tests.reduction_cases import every_node, reduced_by, scene


def controlled(reduction, contact, precision="float64"):
    """The slab, reduced or not, after ten steps of control towards a point beside its tip: commands and way."""
    builder = scene(held=not contact, contact=contact)
    if reduction is not None:
        builder.reduce(0, reduction)
    sim = sw.Simulation(builder.finalize(1, precision=precision), dt=0.01)
    for _ in range(5):
        sim.step()
    controller = InverseController(sim, [PointEffector((0,))])
    goal, told = sim.marker_x[:, 0] + torch.tensor([[0.0, 0.0, 1e-3]]).to(sim.marker_x), []
    before = float((sim.marker_x[:, 0] - goal).norm())
    for _ in range(10):
        controller.solve(goal)
        told.append(torch.cat([sim.control.cable_displacement[0], sim.control.cavity_volume[0] * 1e3]))
        sim.step()
    return torch.stack(told), float((sim.marker_x[:, 0] - goal).norm()) / before, sim.marker_x.clone()


@pytest.mark.parametrize("contact", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_all_modes_give_the_commands_of_the_full_model(contact):
    """Modes take the place of nodes among rows of effectors, actuators and contacts.

    On the floor 28 contacts share the load in more than one way, within the tolerance of Gauss-Seidel: there the first
    commands are compared, and roughly.
    """
    full, left, tip = controlled(None, contact)
    small, _, other = controlled(reduced_by(every_node(not contact)), contact)
    assert float((full[-1] - full[0]).abs().max()) > 1e-6
    if contact:
        torch.testing.assert_close(small[0], full[0], rtol=0.02, atol=1e-9)
        torch.testing.assert_close(other, tip, rtol=0.0, atol=1e-4)
        return
    torch.testing.assert_close(small, full, rtol=1e-5, atol=1e-9)
    torch.testing.assert_close(other, tip, rtol=0.0, atol=1e-9)
    assert left < 0.5
