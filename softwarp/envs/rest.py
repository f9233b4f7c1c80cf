"""The state at rest that episodes start from."""

from __future__ import annotations

import math

from softwarp import notices
from softwarp.model.codes import Status
from softwarp.simulation import Simulation

SPEED = 1.0e-4  # m/s or rad/s, every component of every node and frame at rest
LIMIT = 60.0  # s of simulated time
LOOK = 20  # steps between two looks at the speed


class NotAtRestError(ValueError):
    """The start state does not come to rest."""


def bring_to_rest(owner: str, sim: Simulation, dt: float) -> None:
    """Step a simulation until nothing moves, then take away what is left of velocities; its time is 0 again.

    Time steps end in the equilibrium that an episode without actions would fall into; a static solve follows a path
    of its own and may end on another stable branch.

    Args:
        owner: Of whom messages speak.
        sim: Simulation, whose commands stay as they are.
        dt: Its time step [s].

    Raises:
        NotAtRestError: If a step fails, or something still moves after ``LIMIT``.
    """
    work = f"{owner}: coming to rest"
    for look in range(max(1, round(LIMIT / (LOOK * dt)))):
        for _ in range(LOOK):
            sim.step()
        speed = max(float(v.abs().max()) for v in (sim.node_v, sim.frame_twist) if v.numel())
        if (status := Status(int(sim.status.max()))).failed:  # and would again: it has been rolled back
            raise NotAtRestError(
                f"{owner}: the start state fails ({status.name}) while it comes to rest; check {_loads(sim)}, "
                f"stiffness and the time step of {dt:g} s, or set settle=False"
            )
        if speed < SPEED:
            break
        notices.progress(work, f"{speed:.1g} m/s after {(look + 1) * LOOK * dt:.3g} s, of {LIMIT:g} s at most")
    else:
        raise NotAtRestError(
            f"{owner}: the start state still moves at {speed:.3g} m/s after {LIMIT:g} s; check {_loads(sim)}, "
            "stiffness and damping, or set settle=False"
        )
    notices.progress_ends()
    for value in (sim.node_v, sim.frame_twist, sim.mode_v, sim.time, sim.contact_overflow):
        value.zero_()
    sim.refresh()


def _loads(sim: Simulation) -> str:
    """What may keep a scene from coming to rest: cables that pull whatever they are told, by their option."""
    least = max((float(t) for t in sim.params.cable_min_tension.flatten() if math.isfinite(t)), default=0.0)
    return f"loads (a min_tension of {least:g} N pulls all the time)" if least > 0.0 else "loads"
