"""Several steps in one call: the same bits as one by one, the worst status, on one thread and on two."""

import pytest
import torch

import softwarp as sw
from softwarp.envs.scenes.cart_stem import CartStemSceneConfig, build_cart_stem_scene


def make(worlds, threads):
    builder = sw.ModelBuilder()
    scene = build_cart_stem_scene(CartStemSceneConfig(), builder)
    sim = sw.Simulation(builder.finalize(worlds), threads=threads)
    sim.control.body_force[:, scene.cart, 0] = torch.linspace(-10.0, 10.0, worlds)
    return sim


@pytest.mark.parametrize(("worlds", "threads"), [(1, 1), (40, 1), (40, 2)])
def test_several_steps_are_single_steps(worlds, threads):
    """From the first call on, which compiles, over the second, which captures."""
    several, single = make(worlds, threads), make(worlds, threads)
    for count in (3, 5, 1, 4):
        several.step(count)
        for _ in range(count):
            single.step()
        assert torch.equal(several.frame_pose, single.frame_pose)
        assert torch.equal(several.time, single.time)
    assert (several.status == sw.Status.OK).all()


@pytest.mark.parametrize("threads", [1, 2])
def test_status_is_the_worst_of_the_steps(threads):
    """A world whose first of three steps fails, and which then goes on, tells so."""
    sim = make(16, threads)
    for _ in range(3):
        sim.frame_twist[11] = torch.nan
        sim.step(3)
        assert sim.status.nonzero().flatten().tolist() == [11]
        assert sim.status[11] == sw.Status.NONFINITE
        assert sim.frame_pose.isfinite().all()
        sim.step()
        assert (sim.status == sw.Status.OK).all()


def test_count_is_checked():
    with pytest.raises(ValueError, match="count must be an integer of at least 1, got 0"):
        make(1, 1).step(0)
