"""A twisted ring that is closed by a joint buckles out of its plane: Michell, 1889 (catalogue 4.7)."""

import numpy as np
import pytest
import torch

import softwarp as sw

LENGTH, SEGMENTS = 1.0, 40


def out_of_plane(share: float, nu: float, precision: str) -> float:
    """Growth of a kick normal to the plane over 5 s, the first second left out, at a share of the critical twist.

    A straight rod with twist at rest lies in an untwisted circle; a weld joins its ends. Its natural time is 0.3 s.
    """
    turn = np.linspace(0.0, 2 * np.pi, SEGMENTS + 1)
    points = LENGTH / (2 * np.pi) * np.stack([np.cos(turn), np.sin(turn), 0.0 * turn], axis=1)
    twist = share * 2 * np.pi * np.sqrt(3.0) * (1.0 + nu)  # EI / GJ = 1 + nu
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    ring = builder.add_rod(
        points, radius=0.005, youngs=1e6, nu=nu, density=1000.0, curvature=(0.0, 0.0, twist / LENGTH)
    )
    builder.add_joint((ring, SEGMENTS), (ring, 0), "weld", anchor=tuple(points[0]))
    sim = sw.Simulation(builder.finalize(1, precision=precision), dt=0.01)
    sim.rod_v[0, :, 2] = 1e-4 * torch.cos(2 * torch.as_tensor(turn)).to(sim.rod_v)
    heights = []
    for _ in range(500):
        sim.step()
        assert (sim.status == sw.Status.OK).all()
        heights.append(float(sim.rod_x[0, :, 2].abs().max()))
    assert float((sim.rod_x[0, 0] - sim.rod_x[0, -1]).norm()) < 1e-5
    return max(heights[400:]) / max(heights[:100])


@pytest.mark.parametrize(("nu", "precision"), [(0.0, "float64"), (0.4, "float64"), (0.4, "float32")])
def test_michell(nu: float, precision: str) -> None:
    """At 2 pi sqrt(3) EI / GJ the ring leaves its plane: 3 % below it a kick dies away, 4 % above it grows."""
    assert out_of_plane(0.97, nu, precision) < 0.5
    assert out_of_plane(1.04, nu, precision) > 10.0
