"""Table 1 of SofaGym's paper on Diamond: inverse control, planners and a policy, on the same targets.

    python -m experiments.diamond_table1 FOLDER [--policy RUN | --train] [--setting small]

Every method brings the top of the robot to the same targets, one world, one target after the other, with the task's own
actions of 50 ms: inverse control (QP) and PPO change four commands by up to 5 mm per action, MPPI and CEM choose four
commands, approached by 5 mm per action and held for 5 of them; OPD takes one of eight choices, one cable by 5 mm, or
with ``DiamondConfig.paper``'s scene by 6.25 mm. QP and PPO run a whole episode (50 actions) and hold the top; planners
stop within ``TOLERANCE`` or after ``ACTIONS`` actions. The error is that at the end. Reachable targets are equilibria
of the part that training does not see; unreachable ones are drawn from SofaGym's box, as it draws its goals, and lie
outside what was ever seen to be reached. ``table.csv``, ``table.md``, ``table1.json`` and ``table1.png`` are written.
"""

import argparse
import dataclasses
import functools
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from softwarp.control import InverseController, InversePolicy, Outcome, PointEffector
from softwarp.envs import registry
from softwarp.envs.tasks.diamond import GOAL_BOX, DiamondConfig, reachable_points
from softwarp.planning.cem import CEMConfig
from softwarp.planning.env_model import EnvModel, ModelConfig, choice_count
from softwarp.planning.execution import execute
from softwarp.planning.mppi import MPPIConfig
from softwarp.planning.opd import OPDConfig
from softwarp.planning.planners import make_planner, pool_size
from softwarp.planning.search import PlannerConfig

from . import train
from .config import make_env_config
from .diamond_table1_report import OTHER_SCENE, Trial, write_report
from .eval import check_fit, load_run

Points = NDArray[np.float64]  # m, (point, 3)
Method = Callable[["Setting"], Callable[[Points], Trial]]  # makes its environment, then runs it for a target, (3,)

NAME = "Diamond"
SEED = 2_000_003
OUTSIDE = 0.005  # m, least distance of unreachable targets from all points that were seen to be reached
TOLERANCE = 0.003  # m, at which planners stop
ACTIONS = 20  # of planners, at most
STARTS = ((0.0, 0.0, 0.0, 0.0), (0.02, 0.02, 0.0, 0.0), (0.0, 0.0, 0.02, 0.02), (0.02, 0.0, 0.02, 0.0))  # m
SETTLING = 10  # periods that a start is held for
SEARCHING = 60  # periods of the search for the nearest point
CHOICES = {"action_kind": "discrete"}
COMMANDS = {"action_kind": "absolute"}
OPD = (OPDConfig(gamma=0.7, expansions=12, batch=2, until_success=True), ModelConfig(objective="distance"))
CEM = (
    CEMConfig(expansions=128, population=16, elites=4, horizon=2, until_success=True),
    ModelConfig(objective="distance", hold=5),
)
MPPI = (
    MPPIConfig(expansions=128, population=16, horizon=2, effective=0.2, until_success=True),
    ModelConfig(objective="distance", hold=5),
)


@dataclass(frozen=True)
class Setting:
    """Size of the study."""

    mesh: str = "medium"
    reachable: int = 20  # targets
    unreachable: int = 10
    training: tuple[str, ...] = ()  # overrides of the preset


SETTINGS = {
    "full": Setting(),
    "small": Setting("coarse", 2, 1, ("total_steps=1600", "evaluations=1", "evaluation_episodes=4")),
}


def reachable_targets(count: int) -> Points:
    """The last of the points that the top was seen to reach [m]; training takes the first."""
    return reachable_points()[-count:].astype(np.float64) if count else np.zeros((0, 3))


def unreachable_targets(count: int) -> Points:
    """Draws from SofaGym's box of goals that lie far from all points that were seen to be reached [m]."""
    rng, seen = np.random.default_rng(SEED), reachable_points().astype(np.float64)
    kept: list[NDArray[np.float64]] = []
    while len(kept) < count:
        point = rng.uniform(*GOAL_BOX)
        if np.linalg.norm(seen - point, axis=1).min() > OUTSIDE:
            kept.append(point)
    return np.array(kept).reshape(-1, 3)


def least_distances(targets: Points, mesh: str) -> NDArray[np.float64]:
    """How near the top comes to targets [m], found by long inverse control from several starts; (start, target)."""
    starts = torch.tensor(STARTS).repeat_interleave(len(targets), dim=0)
    goals = torch.from_numpy(targets).repeat(len(STARTS), 1)
    if not len(goals):
        return np.zeros((len(STARTS), 0))
    env = registry.make(NAME, num_worlds=len(goals), mesh=mesh, seed=SEED)
    env.reset()
    controller = InverseController(env.sim, [PointEffector(env.tip_markers)], period=env.control_dt)
    env.sim.control.cable_displacement.copy_(starts)
    for period in range(SETTLING + SEARCHING):
        if period >= SETTLING:
            controller.solve(goals)
        for _ in range(env.action_repeat):
            env.sim.step()
    distances = (controller.positions()[:, 0].double() - goals).norm(dim=-1)
    return np.asarray(distances.reshape(len(STARTS), -1).numpy())


def aim(env: Any, target: Points) -> None:
    """Start an episode with a goal of our own."""
    env.reset()
    env.goal.copy_(torch.from_numpy(target))
    for kept in (env.distance, env.best):
        kept.copy_(env.measure_distance())


def hold(env: Any, policy: Callable[[Any], Any], target: Points) -> Trial:
    """A whole episode of a policy."""
    aim(env, target)
    data = TensorDict(env.observe(), batch_size=env.batch_size)
    begin, begin_cpu, control = time.perf_counter(), time.process_time(), 0.0
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        for _ in range(env.max_episode_steps):
            asked = time.perf_counter()
            data = policy(data)
            control += time.perf_counter() - asked
            data = env.step(data)["next"]
    spent = (time.perf_counter() - begin, time.process_time() - begin_cpu, control)
    solution = getattr(policy, "solution", None)
    outcome = "" if solution is None else Outcome(int(solution.outcome[0])).name
    return result(env, target, spent, env.max_episode_steps, outcome)


def result(env: Any, target: Points, spent: tuple[float, float, float], actions: int, outcome: str) -> Trial:
    """Where the top of the one world is now."""
    end = env.tip()[0].double().numpy()
    error = float(np.linalg.norm(end - target))
    seconds, processor, control = spent
    return Trial(
        target=target.tolist(),
        end=end.tolist(),
        error=error,
        seconds=seconds,
        processor_seconds=processor,
        control_seconds=control,
        simulated_seconds=actions * env.control_dt,
        outcome=outcome,
    )


def inverse(setting: Setting) -> Callable[[Points], Trial]:
    """QP: inverse control through the task's continuous actions."""
    env = registry.make(NAME, mesh=setting.mesh, seed=SEED)
    return functools.partial(hold, env, InversePolicy(env))


def learned(run: Path, setting: Setting) -> Callable[[Points], Trial]:
    """A trained policy on this study's mesh."""
    trained = load_run(str(run), device="cpu", overrides=[])
    if trained.config.env["name"] != NAME:
        raise ValueError(f"{run}: was trained on {trained.config.env['name']}; table 1 is that of {NAME}")
    name, config = make_env_config({**trained.config.env, "mesh": setting.mesh})
    env = registry.make(name, seed=SEED, config=config)
    return functools.partial(hold, env, check_fit(trained, env))


def planned(
    search: tuple[PlannerConfig, ModelConfig], options: dict[str, Any], setting: Setting
) -> Callable[[Points], Trial]:
    """A planner that stops within the tolerance; the world runs on the path of the pool, so predictions are exact."""
    ends = {"max_episode_steps": ACTIONS, "end_on_success": True, "success_tolerance": TOLERANCE}
    config = DiamondConfig(**{**options, **ends, "mesh": setting.mesh, "solver_path": "lanes"})
    env = registry.make(NAME, seed=SEED, config=config)
    planner_config, view = search
    worlds = pool_size(planner_config, choice_count(env, view.levels))
    model, planner = EnvModel(env, view, worlds=worlds), make_planner(planner_config)

    def run(target: Points) -> Trial:
        aim(env, target)
        begin, begin_cpu = time.perf_counter(), time.process_time()
        done = execute(env, model, planner)
        spent = (time.perf_counter() - begin, time.process_time() - begin_cpu, done.seconds)
        steps = view.hold * sum(search.transitions for search in done.searches)
        trial = result(env, target, spent, len(done.steps), "REACHED" if done.success else "")
        return replace(trial, model_steps=steps)

    return run


def paper_options() -> dict[str, Any]:
    """Those of SofaGym's scene and actions."""
    return dataclasses.asdict(DiamondConfig.paper())


def methods(policy: Path | None) -> dict[str, Method]:
    """What is compared."""
    found: dict[str, Method] = {"QP": inverse, "OPD": functools.partial(planned, OPD, CHOICES)}
    found[OTHER_SCENE] = functools.partial(planned, OPD, paper_options())
    if policy is not None:
        found["PPO"] = functools.partial(learned, policy)
    found["MPPI"] = functools.partial(planned, MPPI, COMMANDS)
    found["CEM"] = functools.partial(planned, CEM, COMMANDS)
    return found


def compare(setting: Setting, chosen: dict[str, Method]) -> list[Trial]:
    """All methods on all targets."""
    reachable, unreachable = reachable_targets(setting.reachable), unreachable_targets(setting.unreachable)
    least = least_distances(unreachable, setting.mesh).min(axis=0)
    trials = []
    for name, method in chosen.items():
        run = method(setting)
        run(reachable[0] if len(reachable) else unreachable[0])  # compiles what is not compiled yet
        for target in reachable:
            trials.append(replace(run(target), method=name, is_reachable=True))
        for target, distance in zip(unreachable, least.tolist(), strict=True):
            known = 0.0 if name == OTHER_SCENE else distance
            trials.append(replace(run(target), method=name, is_reachable=False, least=known))
        errors = [1e3 * trial.error for trial in trials if trial.method == name and trial.is_reachable]
        print(f"{name}: mean error {np.mean(errors) if errors else math.nan:.2f} mm on reachable targets", flush=True)
    return trials


def main(argv: Sequence[str] | None = None) -> list[Trial]:
    """Run the study and write its files; returns all trials."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--setting", choices=list(SETTINGS), default="full")
    parser.add_argument("--policy", type=Path, metavar="RUN", help="run folder of a trained policy")
    parser.add_argument("--train", action="store_true", help="train one with experiment=fast/diamond in FOLDER/ppo")
    parser.add_argument("--reachable", type=int, help="number of targets")
    parser.add_argument("--unreachable", type=int, help="number of targets")
    parser.add_argument("--methods", nargs="+", metavar="NAME", help="some of those of the table; default: all")
    given = parser.parse_args(argv)
    setting = SETTINGS[given.setting]
    for name in ("reachable", "unreachable"):
        if getattr(given, name) is not None:
            if getattr(given, name) < 0:
                parser.error(f"--{name} must not be negative, got {getattr(given, name)}")
            setting = replace(setting, **{name: getattr(given, name)})
    if setting.reachable + setting.unreachable == 0:
        parser.error("there is nothing to do without targets; raise --reachable or --unreachable")
    if given.train:
        if given.policy is not None:
            parser.error("--policy names a trained policy and --train trains one; give one of them")
        given.policy = given.folder / "ppo"
        code = train.main(["experiment=fast/diamond", f"out={given.policy}", *setting.training])
        if code:
            raise SystemExit(code)
    chosen = methods(given.policy)
    unknown = [name for name in given.methods or [] if name not in chosen]
    if unknown:
        parser.error(f"--methods: {', '.join(unknown)} is none of {', '.join(chosen)} (PPO needs --policy or --train)")
    trials = compare(setting, {name: chosen[name] for name in given.methods or chosen})
    print(write_report(given.folder, trials, setting.mesh))
    return trials


if __name__ == "__main__":
    main()
