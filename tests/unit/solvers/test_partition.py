"""Which kernels a batch is taken through a step with, and what of it reaches the bits of a result."""

import dataclasses

import pytest
import torch

import softwarp as sw
from softwarp import meshing
from softwarp.kernels.algebra.lanes import variant
from softwarp.solvers.partition import GPU_UNIT, GPU_WORLDS, LANES_FROM, choose_variant, turn_count, world_ranges


def scene(worlds: int, precision: str = "float32") -> sw.Model:
    """A cube of soft tetrahedra that hangs by its upper face."""
    builder = sw.ModelBuilder()
    cube = builder.add_tets(meshing.box((0.1,) * 3, (2, 2, 2)), material=sw.Corotational(1e5, 0.4), density=1e3)
    builder.fix(cube, box=((-1, -1, 0.099), (1, 1, 1)))
    return builder.finalize(worlds, precision=precision)


def stepped(worlds: int, path: str) -> torch.Tensor:
    """Positions of world 0 after some steps, (node, 3)."""
    sim = sw.Simulation(scene(worlds), solver_path=path)
    for _ in range(20):
        sim.step()
    assert (sim.status == sw.Status.OK).all()
    return sim.node_x[0].clone()


def test_path_that_auto_takes_is_the_documented_one():
    """On a CPU one to three worlds go one by one and four or more in lanes; float64 and a named path never change."""
    assert LANES_FROM == 4
    assert [choose_variant(scene(n), "auto").name for n in (1, 2, 3, 4, 9)] == ["scalar"] * 3 + ["lanes"] * 2
    for worlds in (1, 9):
        assert choose_variant(scene(worlds, "float64"), "auto").name == "scalar"
        for path in ("scalar", "lanes"):
            assert choose_variant(scene(worlds), path).name == path


def test_many_worlds_of_a_gpu_are_two_shards():
    """Of reduced bodies, from twice ``GPU_WORLDS`` on: whole warps, all worlds once, and both at the same time."""
    chosen, one = variant("cuda", "float32"), scene(1)
    assert world_ranges(chosen, dataclasses.replace(one, num_worlds=4096), None) == [(0, 4096)]
    one = dataclasses.replace(one, reduction=object())
    for worlds in (1, 33, 2 * GPU_WORLDS - 1, 2 * GPU_WORLDS, 4096, 5001):
        bounds = world_ranges(chosen, dataclasses.replace(one, num_worlds=worlds), None)
        assert len(bounds) == (1 if worlds < 2 * GPU_WORLDS else 2) == turn_count(chosen, 1, len(bounds))
        assert [world for part in bounds for world in range(*part)] == list(range(worlds))
        assert all(begin % GPU_UNIT == 0 for begin, _ in bounds)
        sizes = [end - begin for begin, end in bounds]
        assert max(sizes) - min(sizes) <= 2 * GPU_UNIT


def test_one_path_gives_one_answer():
    """A named path gives a world equal bits in batches of 1, 3 and 9; ``auto`` does up to 3 and from 4 worlds on.

    Between the two paths the results differ, by rounding.
    """
    lanes, scalar = (stepped(1, path) for path in ("lanes", "scalar"))
    for worlds in (3, 9):
        assert torch.equal(stepped(worlds, "lanes"), lanes)
        assert torch.equal(stepped(worlds, "scalar"), scalar)
    assert torch.equal(stepped(3, "auto"), scalar)
    assert torch.equal(stepped(4, "auto"), lanes)
    assert not torch.equal(lanes, scalar)
    torch.testing.assert_close(lanes, scalar, rtol=0.0, atol=1e-6)


def test_unknown_paths_and_those_of_a_gpu_are_refused():
    """Messages name the value and the choices."""
    with pytest.raises(ValueError, match="solver_path must be one of auto, scalar, lanes, panels, levels, got 'simd'"):
        choose_variant(scene(1), "simd")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="'panels' is for a GPU; for device 'cpu' choose auto, scalar or lanes"):
        choose_variant(scene(1), "panels")
