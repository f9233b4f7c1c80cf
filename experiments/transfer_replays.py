"""Replays of commands in many worlds, whose parameters, offsets and delays may differ, and closed loops in them."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from torch import Tensor

from softwarp.control import Followed, InverseController, TiltController
from softwarp.deploy.commands import CommandFile
from softwarp.planning.tracing import Trace

FloatArray = NDArray[np.float64]

AFTER = 1.0  # s for which a replay is looked at after its last command


@dataclass(frozen=True)
class Spread:
    """How actuators of worlds differ.

    Attributes:
        offset: Largest error of every actuator's zero, in its unit.
        delay: Largest time [s] by which a world's commands come late.
        seed: Of both.
    """

    offset: float
    delay: float
    seed: int

    def draw(self, worlds: int, actuators: int) -> tuple[Tensor, FloatArray]:
        """Offsets (world, actuator), uniform around 0, and delays [s] (world,), uniform from 0."""
        generator = torch.Generator().manual_seed(self.seed)
        offset = self.offset * (2.0 * torch.rand((worlds, actuators), generator=generator, dtype=torch.float64) - 1.0)
        delay = self.delay * torch.rand(worlds, generator=generator, dtype=torch.float64)
        return offset, delay.numpy()


@dataclass(frozen=True, eq=False)
class Replays:
    """What came of replays.

    Attributes:
        success: Whether the goal was met at some time, (world,).
        seconds: When; the whole time where it was not, (world,).
        places: What the task is about at every simulation step, (step + 1, world, k) [m].
        deviation: Distance from the plan's places until these end, (step + 1, world) [m].
        failed: Worlds whose simulation failed, (world,).
    """

    success: NDArray[np.bool_]
    seconds: FloatArray
    places: FloatArray
    deviation: FloatArray
    failed: NDArray[np.bool_]

    @property
    def last_deviation(self) -> FloatArray:
        """Distance from the plan's last place, (world,) [m]."""
        return np.asarray(self.deviation[-1])

    def told(self) -> dict[str, float]:
        """Numbers for a file."""
        return {
            "replays": len(self.success),
            "success": float(self.success.mean()),
            "seconds": float(self.seconds.mean()),
            "deviation": float(self.deviation.mean()),
            "largest_deviation": float(self.deviation.max()),
            "last_deviation": float(self.last_deviation.mean()),
            "failed": float(self.failed.mean()),
        }


@dataclass(frozen=True)
class Transfer:
    """Commands that follow a plan, and what came of them.

    Attributes:
        trace: What the plan does in its own environment.
        followed: What inverse control made of it.
        file: The commands.
        nominal: Their replay without any change.
        replays: Replays in worlds that differ, open loop, then closed loop where asked for, by name.
    """

    trace: Trace
    followed: Followed
    file: CommandFile
    nominal: Replays
    replays: dict[str, Replays]


class Watch:
    """Notes places and success of all worlds of an environment after every step of its simulation."""

    def __init__(self, env: Any) -> None:
        self.env = env
        self.places = [self._row()]
        self.met = np.full(env.num_worlds, math.inf)
        self.failed = np.zeros(env.num_worlds, dtype=bool)
        self.steps = 0

    def _row(self) -> FloatArray:
        return np.asarray(self.env.tracked().double().cpu().numpy())

    def step(self) -> None:
        """One step of the simulation."""
        env = self.env
        env.sim.step()
        self.steps += 1
        self.places.append(self._row())
        self.failed |= (env.sim.status >= 3).cpu().numpy()
        is_met = env.is_success(env.measure_distance()).cpu().numpy() & ~self.failed
        self.met = np.where(is_met, np.minimum(self.met, self.steps * env.sim.dt), self.met)

    def result(self, watched: Trace) -> Replays:
        """The replays so far, beside the plan's places."""
        places = np.array(self.places)
        count = min(len(places), len(watched.places))
        deviation = np.linalg.norm(places[:count] - watched.places[:count, None], axis=-1)
        success = np.isfinite(self.met)
        whole = self.steps * self.env.sim.dt
        return Replays(success, np.where(success, self.met, whole), places, deviation, self.failed)


class Servos:
    """Actuators of all worlds as they really are: late, with zeros that are wrong, within their limits.

    Args:
        steering: Inverse control of their simulation, which knows where commands go.
        file: Commands, whose channels tell the limits.
        spread: How actuators differ; None leaves them perfect.
    """

    def __init__(self, steering: InverseController | TiltController, file: CommandFile, spread: Spread | None) -> None:
        self.controller = steering.controller if isinstance(steering, TiltController) else steering
        self.sim = self.controller.sim
        worlds, count = self.sim.num_worlds, len(file.channels)
        offset, delay = torch.zeros((worlds, count), dtype=torch.float64), np.zeros(worlds)
        if spread is not None:
            offset, delay = spread.draw(worlds, count)
        device = self.sim.device
        self.offset = offset.to(device)
        self.late = torch.from_numpy(np.rint(delay / self.sim.dt).astype(np.int64)).to(device)  # steps
        self.low = torch.tensor([channel.low for channel in file.channels], dtype=torch.float64, device=device)
        self.high = torch.tensor([channel.high for channel in file.channels], dtype=torch.float64, device=device)
        self._world = torch.arange(worlds, device=device)
        self._sent: list[Tensor] = []

    def send(self, command: Tensor) -> None:
        """Commands for the next step, (world, actuator); each world obeys those of some steps ago."""
        self._sent.append(command.to(torch.float64).expand(self.sim.num_worlds, -1).clone())
        kept = torch.stack(self._sent[-1 - int(self.late.max()) :])
        obeyed = kept[(len(kept) - 1 - self.late).clamp_min(0), self._world]
        self.controller.write(torch.minimum(torch.maximum(obeyed + self.offset, self.low), self.high))

    def resend(self) -> None:
        """The same for what an environment has just written to ``sim.control``."""
        self.send(self.controller.present())


def replay(
    env: Any,
    steering: InverseController | TiltController,
    file: CommandFile,
    watched: Trace,
    *,
    rest: float = 0.0,
    spread: Spread | None = None,
) -> Replays:
    """Play commands in all worlds of an environment from their present state, straight between rows, and look on.

    Args:
        env: Environment.
        steering: Inverse control of its simulation, which knows where commands go.
        file: Commands.
        watched: The plan's trace.
        rest: Time [s] for which the first commands are held before, where there is a spread.
        spread: How actuators differ; None plays the commands as they are.
    """
    servos = Servos(steering, file, spread)
    if spread is not None:
        prepare(env, servos, file, rest)
    watch, dt = Watch(env), env.sim.dt
    for step in range(round((file.seconds + AFTER) / dt)):
        servos.send(torch.from_numpy(file.at((step + 1) * dt)[None]).to(env.device))
        watch.step()
    return watch.result(watched)


def prepare(env: Any, servos: Servos, file: CommandFile, rest: float) -> None:
    """Hold the first commands for a time [s]; what rolled away meanwhile, as a ball does, is laid back to its start."""
    start = env.tracked().clone()
    first = torch.from_numpy(file.values[:1]).to(env.device)
    for _ in range(round(rest / env.sim.dt)):
        servos.send(first)
        env.sim.step()
    if hasattr(env, "lay_ball"):
        env.lay_ball(start)


def closed_by_policy(
    env: Any,
    policy: Callable[[TensorDict], TensorDict],
    steering: InverseController | TiltController,
    file: CommandFile,
    watched: Trace,
    spread: Spread,
    *,
    rest: float,
    seconds: float,
) -> Replays:
    """Let a policy of the environment act on what it sees after every action, through the same imperfect actuators.

    Args:
        env: Environment, just reset.
        policy: From observations to actions.
        steering: Inverse control of its simulation, which knows where commands go.
        file: Commands, whose channels tell the limits.
        watched: The plan's trace.
        spread: How actuators differ.
        rest: Time [s] for which the first commands are held before.
        seconds: How long.
    """
    servos = Servos(steering, file, spread)
    prepare(env, servos, file, rest)
    watch = Watch(env)
    for _ in range(round(seconds / env.control_dt)):
        seen = TensorDict({key: value.float() for key, value in env.observe().items()}, batch_size=env.batch_size)
        mask = env.action_mask()
        action = policy(seen if mask is None else seen.set("action_mask", mask))["action"]
        for substep in range(env.action_repeat):
            if substep == 0 or not env.holds_commands:
                env.apply_action(action, substep)
            servos.resend()
            watch.step()
    return watch.result(watched)


def closed_by_replanning(
    env: Any,
    steering: TiltController,
    file: CommandFile,
    watched: Trace,
    spread: Spread,
    replanner: Any,
    *,
    heights: float,
    ramp: float,
    rest: float,
    seconds: float,
) -> Replays:
    """Plan anew from the measured ball every so often, and let inverse control follow, through imperfect servos.

    Args:
        env: A Maze, just reset.
        steering: Inverse control of its simulation.
        file: Commands, whose channels tell the limits.
        watched: The plan's trace.
        spread: How actuators differ.
        replanner: Gives normals (world, 3) for the next ``replanner.seconds``.
        heights: Of the plate [m].
        ramp: Time [s] that it takes to turn to a new normal.
        rest: Time [s] for which the first commands are held before.
        seconds: How long.
    """
    servos = Servos(steering, file, spread)
    prepare(env, servos, file, rest)
    watch = Watch(env)
    period = steering.controller.options.period
    substeps, ticks = round(period / env.sim.dt), round(replanner.seconds / period)
    command = torch.from_numpy(file.values[:1]).to(env.device).expand(env.num_worlds, -1)
    height = torch.full((env.num_worlds, 1), heights, dtype=torch.float64, device=env.device)
    wished = steering.normal()
    for _ in range(math.ceil(seconds / replanner.seconds - 1.0e-9)):
        before, wished = wished, replanner.decide(env).double()
        for tick in range(ticks):
            share = min(1.0, (tick + 1) * period / ramp) if ramp > 0.0 else 1.0
            target = torch.cat((torch.lerp(before, wished, share), height), dim=1)
            start, command = command, steering.solve(target, apply=False).command.double()
            for step in range(substeps):
                servos.send(torch.lerp(start, command, (step + 1) / substeps))
                watch.step()
    return watch.result(watched)
