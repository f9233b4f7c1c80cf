"""An environment that runs in real time while browsers look at it and take part."""

from __future__ import annotations

import contextlib
import functools
import importlib
import io
import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from softwarp import checks
from softwarp.render.camera import Camera
from softwarp.view.panel import HAND, Panel
from softwarp.view.stage import Stage

LOCAL = "127.0.0.1"
PORT = 8080
MOST_WORLDS = 64  # on the stage
_IDLE = 0.02  # s between looks at a paused viewer
_LATE = 0.25  # s behind the clock, after which the delay is given up instead of made up for
_TOLD = 4.0  # Hz, text and plots
_GRIP = 0.04  # radius, in sizes of the scene, of what a pulling user holds
_NEAR = 1.0e-9  # m

Policy = Callable[[Any], Any]


class Viewer:
    """Runs an environment and shows it to browsers; sliders, goals and bodies can be moved there.

    The simulation never waits for a browser: pictures are sent to whoever is connected, the newest ones to
    whoever comes later. Only this machine can connect unless ``host`` says otherwise.

    Args:
        env: A soft environment, bare.
        policies: Who may choose actions besides the user, by name: what reads a TensorDict and writes ``action``. The
            first one does at the start, without any the user.
        host: Address to listen at; ``"0.0.0.0"`` lets other machines connect.
        port: First port that is tried; the next free one is taken.
        seed: Of the first episode.
        speed: Simulated time over that of the clock.
        fps: Pictures per second, at most.

    Raises:
        ImportError: Without viser.
        ValueError: For a value out of range.
    """

    def __init__(
        self,
        env: Any,
        policies: dict[str, Policy] | None = None,
        *,
        host: str = LOCAL,
        port: int = PORT,
        seed: int = 0,
        speed: float = 1.0,
        fps: float = 30.0,
    ) -> None:
        checks.count(port, "viewer: port", high=65535)
        checks.number(speed, "viewer: speed", above=0.0, high=1000.0)
        checks.number(fps, "viewer: fps", above=0.0, high=1000.0)
        try:
            viser = importlib.import_module("viser")
        except ImportError as error:
            raise ImportError("the viewer needs viser, which is not installed; pip install 'softwarp[view]'") from error
        self.env, self.policies = env, dict(policies or {})
        self._fps = fps
        self._td = self._begin(seed)
        shown = min(env.num_worlds, MOST_WORLDS)
        with contextlib.redirect_stdout(io.StringIO()):  # it prints addresses, of which ``url`` is one
            self._server = viser.ViserServer(host=host, port=port, label="softwarp", verbose=False)
        self._server.gui.configure_theme(show_share_button=False)  # which would open a way in from the internet
        self._host = host
        goals = env.goal_points()
        self.stage = Stage(
            self._server, env.sim, has_goals=goals is not None, goal_radius=env.goal_radius, worlds=shown
        )
        model = env.sim.model
        self.panel = Panel(
            self._server,
            env,
            list(self.policies),
            seed=seed,
            speed=speed,
            has_chambers=self.stage.parts.cavity_count > 0,
            has_contacts=model.contact is not None,
            has_nodes=model.node_count > 0,
        )
        self._look_at_all(goals)
        self._handles: list[Any] = []
        self._moved_goals: dict[int, tuple[float, ...]] = {}
        self._add_goal_handles(goals)
        self._pull: tuple[Any, Any] | None = None  # where the user took hold and is now, on the stage
        self._held: tuple[int, torch.Tensor] | None = None  # world and nodes
        self._hear_pulls()
        self._resets, self._steps, self._sees_through = 0, 0, False
        self._is_stopped = False
        self._drawn_at = self._due = self._told_at = -math.inf
        self._pictures = 0
        self._clock = time.monotonic()
        self._measured = (time.monotonic(), 0.0, 0)  # clock, simulated time and pictures when last told
        self.simulated = 0.0  # s
        self.actions = 0
        self._last = (0.0, math.nan)  # reward and distance of world 0
        self._draw()

    @property
    def url(self) -> str:
        """Where browsers look."""
        return f"http://{'localhost' if self._host == LOCAL else self._host}:{self._server.get_port()}"

    @property
    def clients(self) -> int:
        """Browsers that look."""
        return len(self._server.get_clients())

    @property
    def pictures(self) -> int:
        """Pictures drawn so far."""
        return self._pictures

    def run(self, seconds: float = math.inf) -> None:
        """Simulate and show until ``stop`` is called, or so many seconds have passed."""
        end = time.monotonic() + seconds
        watches = not self.env.captures.are_on
        self.env.watcher = self._after_substep if watches else None
        self._clock = time.monotonic()
        try:
            while not self._is_stopped and time.monotonic() < end:
                self._serve()
                if self.panel.paused and self._steps == self.panel.steps_asked:
                    self._rest()
                    continue
                self._steps = self.panel.steps_asked
                self._act()
                if not watches:
                    self._beat(self.env.control_dt)
        finally:
            self.env.watcher = None

    def stop(self) -> None:
        """End ``run``; from any thread."""
        self._is_stopped = True

    def close(self) -> None:
        """Let browsers go and free the port."""
        self.stop()
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()

    def __enter__(self) -> Viewer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _begin(self, seed: int) -> Any:
        self.env.set_seed(seed)
        return self.env.reset()

    def _serve(self) -> None:
        """Do what users asked for."""
        if self._resets != self.panel.resets_asked:
            self._resets = self.panel.resets_asked
            self._td = self._begin(self.panel.seed)
            self.panel.forget()
            self._let_go()
            self._follow_goals(self.env.goal_points())
            self._draw()
        for world, place in list(self._moved_goals.items()):
            del self._moved_goals[world]
            goal = self.env.world_state["goal"]
            goal[world] = torch.tensor(np.asarray(place) - self.stage.offsets[world], dtype=goal.dtype)
        if self._sees_through != self.panel.shows_chambers:
            self._sees_through = self.panel.shows_chambers
            self.stage.see_through(self._sees_through)
            self._draw()

    def _act(self) -> None:
        """One action in all worlds."""
        driver = self.panel.driver
        if driver == HAND:
            self._td.set("action", self.panel.action())
        else:
            self._td = self.policies[driver](self._td)
        if self.panel.goes_on:
            stepped, self._td = self.env.step_and_maybe_reset(self._td)
            after = stepped["next"]
        else:
            after = self.env.step(self._td)["next"]
            self._td = after.exclude("reward", "done", "terminated", "truncated")
        self.actions += 1
        self._last = (float(after["reward"].reshape(-1)[0]), float(after["distance"].reshape(-1)[0]))
        self.panel.note(self.simulated, *self._last)
        if self.panel.goes_on and bool(after["done"].any()):
            self._follow_goals(self.env.goal_points())

    def _after_substep(self) -> None:
        self._hold()
        self._beat(float(self.env.sim.dt))

    def _beat(self, dt: float) -> None:
        """Draw if it is time to, and wait for the clock."""
        self.simulated += dt
        self._clock += dt / self.panel.speed
        now = time.monotonic()
        if now >= self._due:
            self._draw()
            self._due = max(self._due + 1.0 / self._fps, now)
            now = time.monotonic()
        if now - self._clock > _LATE:
            self._clock = now
        elif self._clock > now:
            time.sleep(self._clock - now)

    def _rest(self) -> None:
        """Nothing happens; texts and what was moved are still shown."""
        time.sleep(_IDLE)
        self._clock = time.monotonic()
        if self._clock - self._drawn_at >= 10.0 / self._fps:
            self._draw()

    def _draw(self) -> None:
        self._drawn_at = time.monotonic()
        self._pictures += 1
        goals = self.env.goal_points()
        self.stage.show(None if goals is None else goals.cpu().numpy(), contacts=self.panel.shows_contacts)
        if self._drawn_at - self._told_at >= 1.0 / _TOLD:
            self._tell()

    def _tell(self) -> None:
        then, simulated, pictures = self._measured
        now = time.monotonic()
        passed = max(now - then, 1.0e-6)
        factor, rate = (self.simulated - simulated) / passed, (self._pictures - pictures) / passed
        self._measured, self._told_at = (now, self.simulated, self._pictures), now
        reward, distance = self._last
        bad = int((self.env.sim.status >= 2).sum())
        lines = [
            f"**{type(self.env).__name__}**, {self.env.num_worlds} world(s), step {int(self.env.step_count[0])}",
            f"{self.simulated:.1f} s simulated, {factor:.2f} x real time, {rate:.0f} pictures/s",
            f"world 0: reward {reward:.3g}, distance {distance:.4g}",
        ]
        if bad:
            lines.append(f"**{bad} world(s) failed in the last step**")
        self.panel.tell("  \n".join(lines))
        if self.panel.driver != HAND and "action" in self._td:
            self.panel.show_action(self._td["action"])

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

    def _add_goal_handles(self, goals: torch.Tensor | None) -> None:
        """Arrows that drag goals, where a goal is a point that nothing else hangs on."""
        held = self.env.world_state.get("goal")
        if goals is None or held is None or tuple(held.shape[1:]) != (3,):
            return
        for world in range(self.stage.count):
            handle = self._server.scene.add_transform_controls(
                f"/drag/{world}", scale=0.15 * self.stage.size, disable_rotations=True, line_width=1.5
            )
            handle.on_update(functools.partial(self._goal_dragged, world))
            self._handles.append(handle)
        self._follow_goals(goals)

    def _goal_dragged(self, world: int, event: Any) -> None:
        self._moved_goals[world] = event.target.position

    def _follow_goals(self, goals: torch.Tensor | None) -> None:
        """Put the arrows where new goals are."""
        if goals is None:
            return
        places = goals.cpu().numpy()[: len(self._handles)] + self.stage.offsets[: len(self._handles)]
        for handle, at in zip(self._handles, places, strict=True):
            handle.position = tuple(float(v) for v in at)

    def _hear_pulls(self) -> None:
        """Dragging a soft body with shift held pulls it."""
        soft = self.stage.bodies.get("soft")
        if soft is not None:
            soft.on_drag("left", modifier="shift")(self._pulled)

    def _pulled(self, event: Any) -> None:
        self._pull = None if event.phase == "end" else (event.start_position, event.end_position)

    def _hold(self) -> None:
        """The force of the user's spring, spread over the nodes that were taken hold of."""
        pull = self._pull
        if pull is None:
            self._let_go()
            return
        sim = self.env.sim
        if self._held is None:
            world, at = self.stage.world_at(pull[0])
            away = torch.linalg.vector_norm(sim.node_x[world] - torch.as_tensor(at).to(sim.node_x), dim=-1)
            near = away <= max(_GRIP * self.stage.size, float(away.min()) + _NEAR)
            self._held = (world, torch.nonzero(near).flatten())
        world, nodes = self._held
        place = torch.as_tensor(np.asarray(pull[1]) - self.stage.offsets[world]).to(sim.node_x)
        missing = place - sim.node_x[world, nodes].mean(dim=0)
        sim.control.node_force[world, nodes] = self.panel.pull_stiffness * missing / len(nodes)

    def _let_go(self) -> None:
        if self._held is not None:
            world, nodes = self._held
            self.env.sim.control.node_force[world, nodes] = 0.0
            self._held = None
