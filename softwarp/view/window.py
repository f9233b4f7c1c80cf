"""A page for browsers that shows an environment whoever drives it, in real time."""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np
import torch

from softwarp import checks
from softwarp.render.camera import Camera
from softwarp.view import server
from softwarp.view.server import FPS, LOCAL, PORT
from softwarp.view.stage import Stage

MOST_WORLDS = 64  # on the stage
_LATE = 0.25  # s behind the clock, after which the delay is given up instead of made up for


class Window:
    """Shows an environment to browsers; set ``env.watcher`` to ``after_substep``, or call ``after_action``.

    The simulation never waits for a browser: pictures are sent to whoever is connected, the newest ones to
    whoever comes later. Only this machine can connect unless ``host`` says otherwise.

    Args:
        env: A soft environment, bare, after a reset.
        host: Address to listen at; ``"0.0.0.0"`` lets other machines connect.
        port: First port that is tried; the next free one is taken.
        fps: Pictures per second, at most.

    Raises:
        ImportError: Without viser.
        ValueError: For a value out of range.
    """

    def __init__(self, env: Any, *, host: str = LOCAL, port: int = PORT, fps: float = FPS) -> None:
        checks.number(fps, "viewer: fps", above=0.0, high=1000.0)
        self.env = env
        self._fps = fps
        self._server = server.serve(host, port)
        self._host = host
        goals, shown = env.goal_points(), min(env.num_worlds, MOST_WORLDS)
        self.stage = Stage(
            self._server, env.sim, has_goals=goals is not None, goal_radius=env.goal_radius, worlds=shown
        )
        self._look_at_all(goals)
        self._drawn_at = self._due = -math.inf
        self._clock = time.monotonic()
        self.pictures = 0  # drawn so far
        self.simulated = 0.0  # s

    @property
    def url(self) -> str:
        """Where browsers look."""
        return server.url(self._server, self._host)

    @property
    def clients(self) -> int:
        """Browsers that look."""
        return len(self._server.get_clients())

    @property
    def speed(self) -> float:
        """Simulated time over that of the clock."""
        return 1.0

    @property
    def color(self) -> str:
        """What soft bodies are coloured by."""
        return "plain"

    @property
    def shows_contacts(self) -> bool:
        """Whether contact forces are drawn."""
        return False

    def close(self) -> None:
        """Let browsers go and free the port."""
        server.stop(self._server)

    def after_substep(self) -> None:
        """Show where a sub-step led, when it is time to."""
        self._beat(float(self.env.sim.dt))

    def after_action(self) -> None:
        """Show where an action led, unless its sub-steps were watched."""
        if self.env.watcher is None:
            self._beat(self.env.control_dt)

    def draw(self) -> None:
        """A picture, now."""
        self._drawn_at = time.monotonic()
        self.pictures += 1
        goals = self.env.goal_points()
        shown = None if goals is None else goals.cpu().numpy()
        self.stage.show(shown, contacts=self.shows_contacts, color=self.color)

    def _beat(self, dt: float) -> None:
        """Draw if it is time to, and wait for the clock."""
        self.simulated += dt
        self._clock += dt / self.speed
        now = time.monotonic()
        if now >= self._due:
            self.draw()
            self._due = max(self._due + 1.0 / self._fps, now)
            now = time.monotonic()
        if now - self._clock > _LATE:
            self._clock = now
        elif self._clock > now:
            time.sleep(self._clock - now)

    def _look_at_all(self, goals: torch.Tensor | None) -> None:
        """The picture that browsers begin with."""
        region = self.stage.region()
        if goals is not None:
            seen = goals.cpu().numpy()[: self.stage.count] + self.stage.offsets
            region = np.concatenate([region, seen[np.isfinite(seen).all(axis=1)]])
        camera = self.env.camera() if self.stage.count == 1 else None
        if camera is None:
            camera = Camera.seeing(region, self.stage.up, towards=self.env.viewed_from, aspect=1.0)
        first = self._server.initial_camera
        first.position, first.look_at, first.up = camera.eye, camera.target, camera.up
        first.fov = math.radians(camera.fov)
        first.near, first.far = 0.01 * self.stage.size, 1000.0 * self.stage.size
