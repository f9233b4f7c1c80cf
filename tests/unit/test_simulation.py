"""Several steps in one call: the same bits as one by one, the worst status, on one thread and on two."""

import dataclasses

import pytest
import torch

import softwarp as sw
from softwarp.envs.scenes.cart_stem import CartStemSceneConfig, build_cart_stem_scene
from softwarp.solvers.options import Options


def make(worlds, threads):
    builder = sw.ModelBuilder()
    scene = build_cart_stem_scene(CartStemSceneConfig(), builder)
    sim = sw.Simulation(builder.finalize(worlds), threads=threads)
    sim.control.body_force[:, scene.cart, 0] = torch.linspace(-10.0, 10.0, worlds)
    return sim


@pytest.mark.parametrize(("worlds", "threads"), [(1, 1), (40, 1), (40, 2)])
def test_several_steps_are_single_steps(worlds, threads):
    """From the first call on, whose first step compiles and whose second one is captured."""
    several, single = make(worlds, threads), make(worlds, threads)
    for count in (3, 5, 1, 4):
        several.step(count)
        assert several._graphs is not None
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


def test_exact_systems_are_refused_where_the_tangent_is_not_known():
    """A cart with a stem has frames, rows and a rod that path following knows nothing of."""
    sim = make(1, 1)
    assert len(sim.make_systems(3)) == 1
    with pytest.raises(ValueError, match="without exact"):
        sim.make_systems(3, exact=True)


BY_SCENE = {"further_passes", "skin"}  # chosen where contact_passes is not given
INSIDE = {"gpu_path", "turning_tangent", "iterated_passes"}  # for tests, statics and steps that are taken again
GIVEN = {
    "integrator": "bdf2",
    "newton_iterations": 3,
    "newton_tolerance": 2e-4,
    "refinement": 2,
    "contact_passes": 2,
    "gauss_seidel_iterations": 7,
    "gauss_seidel_tolerance": 3e-6,
    "recovery_speed": 0.2,
    "recovery_time": 0.03,
    "bounce_speed": 0.05,
    "project_tangent": False,
    "pressure_tangent": True,
    "most_swing": 0.7,
    "repeat_swing": 0.2,
    "reach": 2.5,
}


def test_every_option_reaches_the_solver():
    """What a simulation is given, its systems have; none of the solver's options can be left out of this list."""
    builder = sw.ModelBuilder()
    build_cart_stem_scene(CartStemSceneConfig(), builder)
    model = builder.finalize(1)
    default, given = sw.Simulation(model), sw.Simulation(model, **GIVEN)
    assert {field.name for field in dataclasses.fields(Options)} == {*GIVEN, *INSIDE, *BY_SCENE}
    for name, value in GIVEN.items():
        assert getattr(default.options, name) != value, f"{name}: choose a value that is not the default"
        assert [getattr(system.options, name) for system in given._systems] == [value], name
