"""``softwarp reduce``: a robot's body in some dozens of modes, from how it moves; with a report and a picture."""

import statistics
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from softwarp import notices, reduction
from softwarp.envs import registry
from softwarp.envs.base import SoftEnv
from softwarp.meshing.quadratic import POINTS
from softwarp.reduction.error import shared_nodes
from softwarp.reduction.motion import Watch
from softwarp.simulation import Simulation

from . import verbs
from .config import make_env_config
from .record import demonstrator
from .verbs import ReduceConfig

UNSEEN = 7919  # added to the seed of episodes that test
TIMED = 30  # steps
EXACT_NODES = 30_000  # of all worlds in float64; one of 15 000 nodes takes 1 GB


def main(arguments: list[str], given: dict[str, Any]) -> int:
    """Reduce as the overrides say; returns the exit code.

    Args:
        arguments: Hydra overrides of ReduceConfig, for example ``["env=diamond", "modes=32"]``.
        given: Fields of ReduceConfig from the command line, taken literally.
    """
    config = verbs.reducing(arguments, given)
    config.device = registry.check_device(config.device)
    full = _environment(config, {"reduced": None}, config.num_worlds, config.seed)
    body = _body(full.sim, config.body)
    motion = _motion(full, config)
    worlds = min(config.num_worlds, 8, max(EXACT_NODES // full.sim.model.node_count, 1))
    options = {"reduced": None, "precision": "float64", "settle": False}  # forces of elements are asked for, no motion
    exact = _environment(config, options, worlds, config.seed).sim
    small = reduction.train(
        exact,
        motion,
        body,
        modes=config.modes or None,
        tolerance=config.tolerance,
        frame="floating" if config.frame == "floating" else "fixed",
        contact_modes=config.contact_modes,
        norm="step" if config.norm == "step" else "mass",
        element_tolerance=config.element_tolerance or None,
        membrane_tolerance=config.membrane_tolerance or None,
        states=config.states,
        seed=config.seed,
    )
    small.save(config.out)
    picture = Path(config.out).with_suffix(".png")
    _draw(small, picture)
    print(f"{config.out}: {small.told()}; picture: {picture}")
    for line in [*_training(small), *_comparison(config, small)]:
        print(f"  {line}")
    return 0


def _environment(config: ReduceConfig, options: dict[str, Any], worlds: int, seed: int) -> SoftEnv:
    """The environment with some options changed."""
    name, env_config = make_env_config({**config.env, **options})
    return registry.make(name, num_worlds=worlds, device=config.device, seed=seed, config=env_config)


def _body(sim: Simulation, name: str) -> int:
    """Number of the body to reduce: the one of that name, or that of the most elements."""
    names, hexes = sim.model.body_names, sim.model.hexes
    bricks = set() if hexes is None else {names[body] for body in np.unique(hexes.layout.body)}
    if name:
        if name not in names:
            raise ValueError(f"body={name}: there is no such soft body; the scene has {', '.join(names)}")
        if name in bricks:
            raise ValueError(f"body={name}: it has hexahedra, which cannot be reduced yet; take tetrahedra")
        return names.index(name)
    if bricks.issuperset(names):
        told = f": {', '.join(names)} has hexahedra, which cannot be reduced yet; take tetrahedra" if names else ""
        raise ValueError(f"the scene has no soft body that could be reduced{told}")
    quadratic = sim.model.quadratic
    of_points = np.empty(0, dtype=np.int64) if quadratic is None else np.repeat(quadratic.layout.body, POINTS)
    return int(np.bincount(np.concatenate([sim.model.tet_body.numpy(), of_points])).argmax())


def _motion(env: SoftEnv, config: ReduceConfig) -> reduction.Motion:
    """States of all worlds while a policy acts, several of every action."""
    policy = demonstrator(env, registry.name_of(type(env)), config.policy)
    watch, every = Watch(env.sim), max(env.action_repeat // config.looks, 1)
    state = env.reset()
    for action in range(config.actions):
        chosen = policy(state)["action"]
        for substep in range(env.action_repeat):
            env.apply_action(chosen, substep)
            env.sim.step()
            if (substep + 1) % every == 0:
                watch.look()
        state = state.exclude("action").update(env.observe())
        notices.progress("recording motion", f"action {action + 1} of {config.actions}, {env.num_worlds} worlds")
    notices.progress_ends()
    return watch.finish()


def _training(small: reduction.Reduction) -> list[str]:
    """What training says of itself."""
    r = small.report
    kept = ", ".join(f"{name} {100 * value:.2g} %" for name, value in r["unseen_residuals"].items())
    return [
        f"modes leave out {100 * r['missing']:.2g} % of the motion; of states not learned from "
        f"{1e3 * r['unseen_error']:.2g} of {1e3 * r['unseen_motion']:.3g} mm",
        f"forces of the chosen elements, of such states: {kept} off, as displacements",
    ]


def _comparison(config: ReduceConfig, small: reduction.Reduction) -> list[str]:
    """Both models beside each other in unseen episodes, and the time of their steps."""
    if config.compare == 0:
        return []
    worlds = min(config.num_worlds, 8)
    pair = [_environment(config, {"reduced": path}, worlds, config.seed + UNSEEN) for path in (None, config.out)]
    rest = pair[0].sim.node_x.clone()
    torch.manual_seed(config.seed)
    states = [env.reset() for env in pair]
    for action in range(config.compare):
        chosen = pair[0].action_spec.rand()
        for k, env in enumerate(pair):
            states[k] = env.step(states[k].set("action", chosen))["next"].exclude("reward")
        notices.progress("comparing models", f"action {action + 1} of {config.compare}")
    notices.progress_ends()
    same = shared_nodes(*(env.sim.model for env in pair))
    apart = (pair[0].sim.node_x - pair[1].sim.node_x[:, same]).norm(dim=-1)
    way = (pair[0].sim.node_x - rest).norm(dim=-1)
    failed = sum(int((env.sim.status >= 3).sum()) for env in pair)
    lines = [
        f"after {config.compare} unseen random actions nodes are {1e3 * apart.mean():.3g} mm apart (worst "
        f"{1e3 * apart.max():.3g}) on a mean way of {1e3 * way.mean():.3g} mm: {100 * apart.mean() / way.mean():.2g} %"
    ]
    if failed:
        lines.append(f"{failed} worlds failed meanwhile")
    for count in (1, config.num_worlds):
        times = [_time(_environment(config, {"reduced": path}, count, config.seed).sim) for path in (None, config.out)]
        lines.append(
            f"a step of {count} world{'s' if count > 1 else ''}: {1e3 * times[0]:.3g} ms in full, "
            f"{1e3 * times[1]:.3g} ms reduced: {times[0] / times[1]:.3g} times faster"
        )
    return lines


def _time(sim: Simulation) -> float:
    """Median time of a step [s]."""
    found = []
    for step in range(5 + TIMED):
        begin = time.perf_counter()
        sim.step()
        if sim.device != "cpu":
            torch.cuda.synchronize()
        if step >= 5:
            found.append(time.perf_counter() - begin)
    return statistics.median(found)


def _draw(small: reduction.Reduction, path: Path) -> None:
    """Energy of the modes, the elements that count, and the first deformations."""
    from matplotlib.figure import Figure

    from softwarp import meshing
    from softwarp.io.atomic import atomic_path

    figure = Figure(figsize=(13.0, 7.0), layout="constrained")
    curve = figure.add_subplot(2, 3, 1)
    share = np.sqrt(np.append(np.cumsum(small.singular_values[::-1] ** 2)[::-1], 0.0))
    shown = share[: min(len(share), 4 * len(small.modes))] / share[0]
    curve.semilogy(shown, color="tab:blue")
    curve.axvline(len(small.modes) - small.rigid, color="0.6", lw=1.0)
    curve.set(xlabel="modes besides rigid ones", ylabel="part of the motion left out")
    surface, size = meshing.tet_surface(small.tets), float(np.ptp(small.nodes, axis=0).max())
    chosen = figure.add_subplot(2, 3, 2, projection="3d")
    kept = small.tet_weight > 0.0
    centres = small.places[kept]
    chosen.plot_trisurf(*small.nodes.T, triangles=surface, color=(0.7, 0.7, 0.7, 0.12), linewidth=0.0)
    chosen.scatter(*centres.T, s=4.0 + 40.0 * small.tet_weight[kept] / small.tet_weight.max(), color="tab:red")
    chosen.set_title(f"{int(kept.sum())} of {len(kept)} {small.what}, by weight")
    _frame(chosen, small.nodes)
    for place, number in enumerate(range(small.rigid, min(small.rigid + 4, len(small.modes))), 3):
        axes = figure.add_subplot(2, 3, place, projection="3d")
        mode = small.modes[number]
        length = np.linalg.norm(mode, axis=1)
        moved = small.nodes + 0.15 * size / max(float(length.max()), 1e-12) * mode
        drawn = axes.plot_trisurf(*moved.T, triangles=surface, cmap="viridis", linewidth=0.1)
        drawn.set_array(length[surface].mean(axis=1))
        drawn.autoscale()
        axes.set_title(f"deformation {number - small.rigid + 1}")
        _frame(axes, small.nodes)
    with atomic_path(path) as scratch:
        figure.savefig(scratch, dpi=110, format="png")


def _frame(axes: Any, nodes: np.ndarray[Any, Any]) -> None:
    """Equal scales around a body, without numbers."""
    spans: Sequence[float] = np.ptp(nodes, axis=0) + 0.1 * np.ptp(nodes, axis=0).max()
    for name, low, span in zip("xyz", nodes.min(axis=0), spans, strict=True):
        getattr(axes, f"set_{name}lim")(low - 0.05 * span, low + 0.95 * span)
    axes.set_box_aspect(spans)
    axes.set_axis_off()
