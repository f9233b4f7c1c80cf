"""Options that every environment has."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import get_args

from softwarp.advice import nearest
from softwarp.envs.options import Count, Duration, NotNegative, Pixels, check_choice, check_options
from softwarp.solvers.options import Integrator, SolverPath

# What ``EnvConfig.sensors`` may name, and of which parts each tells; the numbers of a world stand in their order.
SENSORS = {
    "stress": "body",  # Pa, von Mises: the largest and the mean of the elements of every soft body
    "strain": "body",  # norm of the Green-Lagrange strain: likewise
    "reaction": "world",  # of what holds them: N on every soft body, N on all rods, N and N m on every rigid body
    "energy": "world",  # J, elastic and kinetic
    "contact_force": "pair",  # N on part a of every pair
    "cable_tension": "cable",  # N
    "cable_length": "cable",  # m
    "cavity_pressure": "cavity",  # Pa, gauge
    "cavity_volume": "cavity",  # m^3
    "joint_position": "joint",  # m, of hinges rad
    "joint_force": "joint",  # N, N m, of motors
    "joint_reaction": "joint",  # N and N m at the anchor on the child
}


@dataclass(kw_only=True)
class EnvConfig:
    """Options that every environment has."""

    dt: Duration = 0.01  # s, one simulation sub-step
    action_repeat: Count = 5  # sub-steps per action, exactly
    max_episode_steps: Count = 250  # actions until truncation
    newton_iterations: Count = 1  # per sub-step
    reduced: str | None = None  # file of softwarp reduce, with the modes that a body moves in; None: node by node
    integrator: str = "euler"  # or "bdf2", of second order at twice the time; as of Simulation
    precision: str = "float32"  # of the simulation; observations are float32 always
    solver_path: str = "auto"  # as of Simulation; "auto" differs by rounding between up to 3 and more worlds
    settle: bool = True  # start at rest under gravity instead of in the unloaded shape
    end_on_success: bool = False  # terminate when the goal is met; else the agent has to stay there
    end_on_inversion: bool = False  # terminate where an action leaves elements inside out
    inversion_penalty: NotNegative = 0.0  # taken from the reward of every action that leaves elements inside out
    failure_penalty: NotNegative = 1.0  # taken from the reward of a world whose simulation failed
    contact_capacity: Count | None = None  # contacts that a world can hold; None leaves it to the task
    contact_growth: bool = False  # make more room where contacts find none, and repeat the step; no capture then
    sensors: tuple[str, ...] = ()  # keys of ``SENSORS``, each told beside the observation
    check_actions: bool = True  # refuse bad actions before a step; captured steps and False find bad choices later
    capture: bool | None = None  # replay a step as one CUDA graph; False launches its parts, None captures on CUDA
    render_width: Pixels = 480  # pixel
    render_height: Pixels = 360  # pixel

    def __post_init__(self) -> None:
        """Turn lists into declared tuples; refuse values that no environment can use."""
        check_options(self)
        if self.capture and self.contact_growth:
            raise ValueError(
                f"{type(self).__name__}: capture=True and contact_growth=True exclude each other, as steps that may be "
                "repeated cannot be captured; leave capture out, or set contact_capacity instead"
            )
        for place, name in enumerate(self.sensors):
            if name not in SENSORS or name in self.sensors[:place]:
                fault = f"unknown sensor {name!r}; {nearest(name, SENSORS)}"
                if name in SENSORS:
                    fault = f"{name!r} is there twice; name each sensor once"
                raise ValueError(f"{type(self).__name__}: sensors: {fault}")
        if self.reduced is not None and not Path(self.reduced).is_file():
            raise ValueError(
                f"{type(self).__name__}: reduced: there is no file {self.reduced!r}; softwarp reduce env=... FILE.npz "
                "makes one, and null leaves it out"
            )
        check_choice(self, "precision", ("float32", "float64"))
        check_choice(self, "solver_path", get_args(SolverPath))
        check_choice(self, "integrator", get_args(Integrator))
