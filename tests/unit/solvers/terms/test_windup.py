"""Angles of tubes: as a GPU finds them, all segments side by side, and as a CPU does, one after the other."""

from __future__ import annotations

import pytest
import torch

import softwarp as sw
from softwarp.kernels.algebra import lanes
from softwarp.kernels.frames import windup
from softwarp.solvers.terms.telescopes import TelescopeTerm


def scene(precision: str) -> sw.Simulation:
    """Three curved tubes, turned against each other, of different lengths."""
    builder = sw.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    tubes = [
        sw.Tube([sw.TubeSection(0.15), sw.TubeSection(0.05, (-k, 0.0, 0.0))], radius=r, inner_radius=inner)
        for k, r, inner in ((30.0, 4e-4, 0.0), (20.0, 7e-4, 5e-4), (12.0, 1e-3, 8e-4))
    ]
    builder.add_telescope(tubes, segments=12, lengths=(0.12, 0.07, 0.033), windup=True, rayleigh=(0.1, 0.01))
    model = builder.finalize(2, "cpu", precision)  # type: ignore[arg-type]
    sim = sw.Simulation(model, dt=0.01, solver_path="scalar", threads=1)
    sim.control.tube_angle[0] = torch.tensor((0.5, -0.4, 0.1))
    sim.control.tube_angle[1] = torch.tensor((-0.2, 0.6, 0.3))
    return sim


@pytest.mark.slow
@pytest.mark.parametrize(("precision", "tolerance"), [("float64", 1e-10), ("float32", 1e-4)])
def test_segments_side_by_side_find_the_same_angles(precision: str, tolerance: float) -> None:
    """Kernels of the GPU's variant on a CPU, in every step from the same state."""
    sim, other = scene(precision), scene(precision)
    (system,) = other.systems
    (term,) = (term for term in system.terms if isinstance(term, TelescopeTerm))
    term.side_by_side, term.k_windup = True, windup.kernels(lanes.variant("cuda", precision))
    term.equations = system.shard.rows(windup.EQUATION_ROWS * term.model.piece_place.size)
    before = sim.windup.clone()
    for _ in range(4):
        sim.step()
        other.step()
    assert (sim.windup - before).abs().max() > 0.05
    torch.testing.assert_close(other.windup, sim.windup, rtol=0.0, atol=tolerance)
