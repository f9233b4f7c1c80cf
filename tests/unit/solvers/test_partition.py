"""Which kernels a batch is taken through a step with, and what of it reaches the bits of a result."""

import pytest
import torch

import softwarp as sw
from softwarp import meshing
from softwarp.solvers.partition import LANES_FROM, choose_variant, free_ranges, world_ranges


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


def test_uneven_steps_have_shards_to_spare():
    """Threads that are free take what is left of them; every world is in one, and a single thread needs no others."""
    for precision, count, most in (("float64", 16, 4), ("float32", 8, 8)):
        model = scene(64, precision)
        chosen = choose_variant(model, "auto")
        ranges, is_free = free_ranges(chosen, model, 2, True)
        assert is_free and len(ranges) == count and max(b - a for a, b in ranges) == most
        assert [a for a, _ in ranges] == [0, *(b for _, b in ranges[:-1])] and ranges[-1][1] == 64
        assert free_ranges(chosen, model, 2, False) == (world_ranges(chosen, model, 2), False)
        assert len(world_ranges(chosen, model, 2)) == 2
        assert free_ranges(chosen, model, 1, True) == ([(0, 64)], False)
    few = scene(5)
    assert free_ranges(choose_variant(few, "scalar"), few, 2, True) == ([(0, 3), (3, 5)], False)
