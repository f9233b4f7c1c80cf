"""``softwarp transfer``: what a plan makes its robot do becomes commands of another, replayed and written down.

    softwarp plan env=simple_maze planner=opd planner.until_success=true out=plan.json
    softwarp transfer plan.json to=maze out=servos.csv

The plan is carried out in its own environment and watched (planning/tracing.py); inverse control lets the other robot
follow (control/following.py); its commands are played again in the coupled simulation, as they are and in many worlds
whose parameters, offsets and delays differ (transfer_replays.py); and they go to a file that a robot can play
(deploy/commands.py).
"""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np

from softwarp.control import Followed, InverseController, PointEffector, TargetPath, TiltController, follow
from softwarp.control.effectors import AXES
from softwarp.deploy import load_policy
from softwarp.deploy.commands import Channel, CommandFile
from softwarp.envs import registry
from softwarp.io.atomic import write_text
from softwarp.planning import plans
from softwarp.planning.tracing import Trace, trace
from softwarp.solvers.inverse.actuators import CABLE, CHAMBER, JOINT

from . import verbs
from .config import make_env_config
from .maze_replanning import Replanner
from .transfer_replays import Replays, Spread, Transfer, closed_by_policy, closed_by_replanning, replay
from .verbs import TransferConfig

Steering = InverseController | TiltController

REPLAN = "replan"  # name of planning anew among the closed loops
MOST, LEAST = 2.0, 10.0  # a closed loop may take so many times as long as the plan, or so many seconds


def main(plan: str, arguments: list[str]) -> int:
    """Transfer a plan as the overrides say; returns 0 if the replay without changes meets the goal, else 1.

    Args:
        plan: Plan file.
        arguments: Overrides of TransferConfig, ``to=maze`` and ``to.youngs=...`` for the robot that is to follow.
    """
    config = verbs.transferring(plan, arguments)
    config.device = registry.check_device(config.device)
    name, _ = make_env_config(config.env)
    result = transfer(plans.Plan.load(plan), config, given=verbs.named(arguments))
    if config.out:
        result.file.save(config.out)
    if config.summary:
        write_text(config.summary, json.dumps(summary(result), indent=1) + "\n")
    if config.picture:
        from . import transfer_picture

        transfer_picture.draw(result, config.picture)
    print(report(name, config, result))
    return 0 if bool(result.nominal.success.all()) else 1


def transfer(plan: plans.Plan, config: TransferConfig, given: set[str]) -> Transfer:
    """Follow a plan with another robot, and replay what came of it.

    Args:
        plan: The plan.
        config: Settings.
        given: Options of the other robot's environment that were asked for; they stand against those of the plan.

    Raises:
        ValueError: If the plan's targets are none that this robot can follow.
    """
    watched = trace(plan, device=config.device)
    make = Maker(config, watched, given)
    env = make(1)
    env.reset()
    steering = make_steering(env, watched, config.period)
    times, targets = watched.path(config.ramp)
    if watched.kind == "normal":
        height = config.height if config.height is not None else float(env.sim.marker_x[0, env.plate_marker, 2])
        targets = np.column_stack([targets, np.full(len(targets), height)])
    if config.height is not None:
        follow(steering, TargetPath([0.0], targets[:1]), settle=config.rest)
    start = env.snapshot([0])
    followed = follow(steering, TargetPath(times, targets))
    file = command_file(env, steering, followed, note=f"{plan.env['name']} plan for {type(env).__name__}")
    env.restore(start)
    nominal = replay(env, steering, file, watched)
    replays = _replays(config, make, watched, file, float(targets[0, -1])) if config.replays else {}
    return Transfer(watched, followed, file, nominal, replays)


def _replays(
    config: TransferConfig, make: "Maker", watched: Trace, file: CommandFile, height: float
) -> dict[str, Replays]:
    """Replays in worlds that differ, open loop, and closed loops where asked for."""
    spread = Spread(config.offset, config.delay, config.seed)
    env = make(config.replays, spread=config.spread)
    steering = make_steering(env, watched, config.period)
    env.reset()
    done = {"open": replay(env, steering, file, watched, rest=config.rest, spread=spread)}
    seconds = max(MOST * file.seconds, LEAST)
    for name in config.closed:
        env.reset()
        if name == REPLAN:
            if not isinstance(steering, TiltController) or not hasattr(env, "ball_place"):
                raise ValueError(f"transfer: closed={REPLAN} replans for mazes; {type(env).__name__} is none")
            replanner = Replanner(watched.options, config.replan, config.depth, config.replays, config.device)
            done[name] = closed_by_replanning(
                env,
                steering,
                file,
                watched,
                spread,
                replanner,
                heights=height,
                ramp=config.ramp,
                rest=config.rest,
                seconds=seconds,
            )
        else:
            policy = policy_of(env, name)
            done[name] = closed_by_policy(
                env, policy, steering, file, watched, spread, rest=config.rest, seconds=seconds
            )
    return done


def policy_of(env: Any, name: str) -> Any:
    """A hand-written policy of an environment by its name, or a trained one by its run."""
    from softwarp.policies.baselines.table import rule

    if Path(name).exists():
        return load_policy(name)
    return rule(env, registry.name_of(type(env)), name)


class Maker:
    """Makes the environment of the robot that follows, with the plan's task.

    Args:
        config: Settings.
        watched: The plan's trace, whose task it is.
        given: Options that were asked for.
    """

    def __init__(self, config: TransferConfig, watched: Trace, given: set[str]) -> None:
        self.name, base = make_env_config(config.env)
        names = {field.name for field in dataclasses.fields(base)}
        task = {key: value for key, value in watched.options.items() if key in names - given}
        self.base = dataclasses.replace(base, **task)
        self.config, self.names = config, names

    def __call__(self, num_worlds: int, *, spread: float = 0.0) -> Any:
        """An environment of so many worlds, their parameters spread by a part of themselves where that can be."""
        ranges = {}
        for option in ("youngs", "mu", "ball_mass"):
            if spread and f"{option}_range" in self.names and getattr(self.base, f"{option}_range") is None:
                value = getattr(self.base, option)
                ranges[f"{option}_range"] = (value * (1.0 - spread), value * (1.0 + spread))
        options = dataclasses.replace(self.base, **ranges)
        return registry.make(
            self.name, num_worlds=num_worlds, seed=self.config.seed, device=self.config.device, config=options
        )


def make_steering(env: Any, watched: Trace, period: float) -> Steering:
    """Inverse control of a robot, for targets of the trace's kind.

    Raises:
        ValueError: If the robot has nothing that such targets could be for.
    """
    options = {**getattr(env, "steering", {}), "period": period}
    if watched.kind == "normal" and hasattr(env, "plate"):
        return TiltController(env.sim, env.plate, env.plate_marker, **options)
    if watched.kind == "point" and hasattr(env, "tip_markers"):
        effector = PointEffector(env.tip_markers, axes=getattr(env, "goal_axes", AXES))
        return InverseController(env.sim, [effector], **options)
    what = {"normal": "tilts of a plate, which Maze can follow", "point": "points, which Trunk and Diamond can follow"}
    raise ValueError(f"transfer: the plan's targets are {what[watched.kind]}; {type(env).__name__} has none such")


def command_file(env: Any, steering: Steering, followed: Followed, *, note: str) -> CommandFile:
    """Commands of world 0 with the limits that the scene gives its actuators."""
    controller = steering.controller if isinstance(steering, TiltController) else steering
    plan, params = controller.actuators, env.sim.params
    channels = []
    for name, kind, item, is_effort in zip(controller.command_names, plan.kind, plan.item, plan.is_effort, strict=True):

        def limit(what: str, at: int = int(item)) -> float:
            return float(getattr(params, what)[0, at])

        if kind == JOINT and not is_effort:
            channels.append(
                Channel(name, "rad", limit("joint_min_position"), limit("joint_max_position"), limit("joint_max_rate"))
            )
        elif kind == JOINT:
            channels.append(Channel(name, "N m", -limit("joint_max_force"), limit("joint_max_force")))
        elif kind == CABLE:
            what = "tension" if is_effort else "displacement"
            rate = np.inf if is_effort else limit("cable_max_rate")
            unit = "N" if is_effort else "m"
            channels.append(Channel(name, unit, limit(f"cable_min_{what}"), limit(f"cable_max_{what}"), rate))
        elif kind == CHAMBER:
            what, unit = ("pressure", "Pa") if is_effort else ("volume", "m^3")
            rate = limit("cavity_max_pressure_rate" if is_effort else "cavity_max_flow")
            channels.append(Channel(name, unit, limit(f"cavity_min_{what}"), limit(f"cavity_max_{what}"), rate))
    values = followed.commands[:, 0]
    low, high = (np.array([getattr(channel, side) for channel in channels]) for side in ("low", "high"))
    return CommandFile(followed.times, np.clip(values, low, high), tuple(channels), note)


def summary(result: Transfer) -> dict[str, Any]:
    """Numbers for a file."""
    report = result.file.check()
    told: dict[str, Any] = {
        "seconds": result.file.seconds,
        "plan_success": result.trace.success,
        "unreached": float(result.followed.unreached[0]),
        "within_limits": report.is_sound,
        "nominal": result.nominal.told(),
    }
    return told | {name: replays.told() for name, replays in result.replays.items()}


def report(name: str, config: TransferConfig, result: Transfer) -> str:
    """A few lines on the transfer."""
    nominal, file = result.nominal, result.file
    met = "meets" if bool(nominal.success.all()) else "misses"
    lines = [
        f"{name} follows the plan for {file.seconds:.2f} s: its replay {met} the goal",
        f"  commands             {len(file.times)} rows of {len(file.channels)}, {file.check()}",
        f"  targets              {100.0 * float(result.followed.unreached[0]):.0f} % of the periods out of reach",
        f"  deviation [mm]       mean {1e3 * nominal.deviation.mean():.2f}, largest "
        f"{1e3 * nominal.deviation.max():.2f}, at the end {1e3 * nominal.last_deviation.mean():.2f}",
    ]
    for kind, replays in result.replays.items():
        share = 100.0 * float(replays.success.mean())
        lines.append(
            f"  {kind + ' loop':<20} goal met in {int(replays.success.sum())} of {len(replays.success)} replays "
            f"({share:.0f} %), {replays.seconds.mean():.2f} s on average"
        )
    if config.out:
        lines.append(f"  written              {config.out}")
    return "\n".join(lines)
