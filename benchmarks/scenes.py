"""The scenes of ``softwarp bench`` and how one of them is timed.

The trunk, a rod, a finger with and without contact and the cantilever of the peers, each in a file of its own, and the
scene of every environment of the registry under random actions; there whole environment steps are timed as well.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch
import warp as wp

import softwarp
from softwarp.envs import registry

from . import cantilever, contact, rod, trunk
from .timing import array_bytes, machine, measure, measure_stages

RESET_EVERY = 10  # samples of an environment's scene from one start to the next


@dataclass(frozen=True)
class Case:
    """A scene that was built, ready to be timed.

    Attributes:
        sim: The simulation.
        drive: Gives commands; called before each sample with its number.
        notes: What the record tells besides times.
        env: The environment whose scene it is, if it is one.
    """

    sim: softwarp.Simulation
    drive: Callable[[int], None]
    notes: Callable[[], dict[str, float]] = dict
    env: Any = None


@dataclass(frozen=True)
class Scene:
    """How a scene is built and timed.

    Attributes:
        title: Its name in tables.
        make: Builds it from the number of worlds, the device, the precision and options of ``Simulation``.
        steps: Steps of one sample.
        warm_up: Steps before the first sample.
        worlds: Numbers of worlds that it is timed with, by kind of device.
    """

    title: str
    make: Callable[..., Case]
    steps: int = 20
    warm_up: int = 5
    worlds: dict[str, tuple[int, ...]] = field(default_factory=lambda: {"cpu": (1, 64), "cuda": (64, 1024, 4096)})


def bare(module: Any, worlds: int, device: str, precision: str, **options: Any) -> Case:
    """A scene that a file of this folder builds."""
    sim = module.build(worlds, device, precision, **options)
    notes = partial(module.notes, sim) if hasattr(module, "notes") else dict
    return Case(sim, partial(module.drive, sim), notes)


def environment(
    name: str, worlds: int, device: str, precision: str, solver_path: str = "auto", threads: int | None = None
) -> Case:
    """The scene of an environment under random actions.

    Raises:
        ValueError: For ``threads``: environments take all cores of the process; use ``--cores``.
    """
    if threads is not None:
        raise ValueError(f"{name}: environments step on all cores of the process; limit those instead of threads")
    env = registry.make(name, num_worlds=worlds, device=device, seed=0, precision=precision, solver_path=solver_path)
    torch.manual_seed(0)
    env.reset()

    def drive(step: int) -> None:
        if step % RESET_EVERY == 0:
            env.reset()
        env.apply_action(env.action_spec.rand(), 0)

    return Case(env.sim, drive, env=env)


SCENES: dict[str, Scene] = {
    "trunk": Scene("trunk, 8 cables", partial(bare, trunk)),
    "rod": Scene(
        "rod of 20 segments, tip mass",
        partial(bare, rod),
        steps=200,
        worlds={"cpu": (1, 256), "cuda": (64, 1024, 4096, 16384)},
    ),
    "contact": Scene("finger on a cube, contact", partial(bare, contact), warm_up=contact.WARM_UP),
    "free": Scene("finger without contact", partial(bare, contact, contact=False), warm_up=contact.WARM_UP),
    "cantilever": Scene("cantilever", partial(bare, cantilever)),
}


def add_environment(name: str) -> str:
    """A scene of an environment, by any name that ``softwarp.make`` takes; returns its key."""
    key = f"env_{registry.spec(name).file_name}"
    SCENES[key] = Scene(f"environment {name}", partial(environment, name))
    return key


for _name in registry.ENVIRONMENTS:
    add_environment(_name)


def time_scene(
    name: str,
    worlds: int,
    device: str,
    cores: int,
    *,
    precision: str = "float32",
    repeats: int = 9,
    steps: int | None = None,
    stages: bool = True,
    **options: Any,
) -> dict[str, Any]:
    """Build a scene and time it.

    Args:
        name: A key of ``SCENES``.
        worlds: Number of worlds.
        device: Warp device.
        cores: Cores that the process was limited to, for the record.
        precision: ``float32`` or ``float64``.
        repeats: Samples.
        steps: Steps of a sample; None takes the scene's own number.
        stages: Also time the stages of a step.
        **options: Of the scene and of ``Simulation``.
    """
    scene = SCENES[name]
    start = time.perf_counter()
    case = scene.make(worlds, device, precision, **options)
    wp.synchronize_device(device)
    built = time.perf_counter() - start
    sim = case.sim
    rod_nodes = 0 if sim.model.frames is None else sim.frame_pose.shape[1] - sim.model.rigid_count
    record: dict[str, Any] = {
        "case": name,
        "scene": scene.title,
        "worlds": worlds,
        "nodes": sim.model.node_count + rod_nodes,
        "tets": sim.model.tet_count,
        "precision": precision,
        "build_s": built,
    }
    record |= measure(sim, case.drive, steps or scene.steps, repeats, scene.warm_up)
    record["times_real_time"] = 1e3 * sim.dt / record["ms_per_step"]
    record["memory_mb_per_world"] = 1e-6 * array_bytes(sim) / worlds
    record |= case.notes()
    if case.env is not None:
        record |= time_environment(case.env, repeats)
    if stages:
        record["stages_us"] = measure_stages(sim, 5)
    return record | machine(device, cores if wp.get_device(device).is_cpu else None)


def time_environment(env: Any, steps: int) -> dict[str, float]:
    """Whole steps of an environment per second: commands, sub-steps, observation, reward and reset."""
    data = env.reset()
    for step in range(2 + steps):
        if step == 2:
            wp.synchronize_device(env.sim.device)
            start = time.perf_counter()
        data = env.rand_action(data)
        _, data = env.step_and_maybe_reset(data)
    wp.synchronize_device(env.sim.device)
    seconds = (time.perf_counter() - start) / steps
    return {"env_steps_per_s": env.num_worlds / seconds, "substeps": float(env.action_repeat)}
