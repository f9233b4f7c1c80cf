"""Scenes of rods that several tests share, and what their theory needs. SI units, z up."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

import softwarp as sw

YOUNGS, NU, DENSITY, RADIUS, LENGTH = 1.0e6, 0.3, 1000.0, 0.01, 1.0


def area(radius: float = RADIUS) -> float:
    """Area of a round section [m^2]."""
    return np.pi * radius**2


def bending(radius: float = RADIUS, youngs: float = YOUNGS) -> float:
    """Bending stiffness E I of a round section [N m^2]."""
    return youngs * np.pi * radius**4 / 4.0


def scene(
    points: np.ndarray,
    *,
    fixed: Sequence[int] = (0,),
    gravity: Sequence[float] = (0.0, 0.0, 0.0),
    tip_mass: float = 0.0,
    precision: str = "float64",
    num_worlds: int = 1,
    simulation: dict[str, Any] | None = None,
    **rod: Any,
) -> sw.Simulation:
    """One rod, its nodes ``fixed`` clamped, perhaps with a rigid body of ``tip_mass`` [kg] as a point on its end."""
    builder = sw.ModelBuilder(gravity=gravity)
    given = {"radius": RADIUS, "youngs": YOUNGS, "nu": NU, "density": DENSITY} | rod
    part = builder.add_rod(points, **given)
    if fixed:
        builder.fix(part, nodes=list(fixed))
    if tip_mass:
        body = builder.add_rigid(mass=tip_mass, inertia=np.full(3, 1e-9 * tip_mass), pose=points[-1])
        builder.attach(body, to=part, node=-1)
    return sw.Simulation(builder.finalize(num_worlds=num_worlds, precision=precision), **(simulation or {}))


def positions(sim: sw.Simulation, world: int = 0) -> np.ndarray:
    """Nodes of all rods [m], (node, 3), float64 copy."""
    return sim.rod_x[world].double().cpu().numpy().copy()


def rotations(sim: sw.Simulation, world: int = 0) -> Rotation:
    """Orientations of all rod nodes."""
    return Rotation.from_quat(sim.rod_q[world].double().cpu().numpy())


def pull(sim: sw.Simulation, node: int, force: Sequence[float], moment: Sequence[float] = (0.0, 0.0, 0.0)) -> None:
    """Dead force [N] and moment [N m] on one node, in every world."""
    load = torch.tensor([*force, *moment], dtype=torch.float64)
    sim.control.rod_force[:, node] = load.to(sim.control.rod_force)


def settle(sim: sw.Simulation, **options: Any) -> None:
    """Static equilibrium; fails the test where there is none."""
    result = sim.solve_static(**options)
    assert bool(result.converged.all()), result


def flatten(sim: sw.Simulation, start: torch.Tensor) -> None:
    """Bring a rod that bends about y back to the plane y = 0; ``start`` holds its quaternions when it was straight."""
    turn = Rotation.from_quat(sim.rod_q[0].double().numpy()) * Rotation.from_quat(start.double().numpy()).inv()
    plane = turn.as_quat() * (0.0, 1.0, 0.0, 1.0)
    flat = Rotation.from_quat(plane) * Rotation.from_quat(start.double().numpy())
    sim.rod_q[:] = torch.as_tensor(flat.as_quat()).to(sim.rod_q)
    sim.rod_x[..., 1] = 0.0


# Vibration


def beam_number(mass_ratio: float, mode: int) -> float:
    """Root beta L of 1 + cos x cosh x = m x (sin x cosh x - cos x sinh x), a cantilever with the tip mass m rho A L."""

    def equation(x: float) -> float:
        hyperbolic, sine = (np.cosh(x), np.sinh(x)), (np.cos(x), np.sin(x))
        coupling = sine[1] * hyperbolic[0] - sine[0] * hyperbolic[1]
        return 1.0 + sine[0] * hyperbolic[0] - mass_ratio * x * coupling

    grid = np.linspace(0.5, 12.0, 1000)
    value = [equation(x) for x in grid]
    roots = [brentq(equation, a, b) for a, b, f, g in zip(grid, grid[1:], value, value[1:], strict=False) if f * g < 0]
    return float(roots[mode])


def mode_shape(beta: float, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Deflection of a clamped beam in the mode of ``beam_number`` beta and its slope, at s in [0, 1].

    The moment vanishes at the tip with and without a mass there.
    """
    k = (np.cosh(beta) + np.cos(beta)) / (np.sinh(beta) + np.sin(beta))
    shape = np.cosh(beta * s) - np.cos(beta * s) - k * (np.sinh(beta * s) - np.sin(beta * s))
    slope = beta * (np.sinh(beta * s) + np.sin(beta * s) - k * (np.cosh(beta * s) - np.cos(beta * s)))
    return shape, slope


def lumped(count: int, tip: float = 0.0) -> np.ndarray:
    """Masses of the nodes of a rod of unit mass with a tip mass."""
    mass = np.full(count, 1.0 / (count - 1))
    mass[[0, -1]] *= 0.5
    mass[-1] += tip
    return mass


def recurrence(values: Sequence[float]) -> np.ndarray:
    """p and q of x_{n+1} = p x_n - q x_{n-1}, fitted to a series of one mode."""
    x = np.asarray(values)
    result: np.ndarray = np.linalg.lstsq(np.stack([x[1:-1], -x[:-2]], axis=1), x[2:], rcond=None)[0]
    return result


def backward_euler(omega: float, h: float, alpha: float = 0.0, beta: float = 0.0) -> np.ndarray:
    """p and q of ``recurrence`` for x'' + (alpha + beta w^2) x' + w^2 x = 0 by backward Euler."""
    damping = h * (alpha + beta * omega**2)
    return np.array([2.0 + damping, 1.0]) / (1.0 + damping + (h * omega) ** 2)


def frequency(values: Sequence[float], h: float) -> float:
    """Angular frequency [rad/s] of an undamped mode advanced by backward Euler: q = 1 / (1 + w^2 h^2)."""
    x = np.asarray(values)
    force = 2.0 * x[1:-1] - x[:-2] - x[2:]
    return float(np.sqrt(force @ x[2:] / (x[2:] @ x[2:])) / h)
