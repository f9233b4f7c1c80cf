"""An environment that runs in real time while browsers look at it and take part."""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from softwarp import checks
from softwarp.view.paint import UNITS
from softwarp.view.panel import HAND, Panel
from softwarp.view.server import FPS, LOCAL, PORT
from softwarp.view.window import Window

_IDLE = 0.02  # s between looks at a paused viewer
_TOLD = 4.0  # Hz, text and plots
_GRIP = 0.04  # radius, in sizes of the scene, of what a pulling user holds
_NEAR = 1.0e-9  # m

Policy = Callable[[Any], Any]


class Viewer(Window):
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
        fps: float = FPS,
    ) -> None:
        checks.number(speed, "viewer: speed", above=0.0, high=1000.0)
        self.policies = dict(policies or {})
        self._td = _begin(env, seed)
        super().__init__(env, host=host, port=port, fps=fps)
        goals = env.goal_points()
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
        self._handles: list[Any] = []
        self._moved_goals: dict[int, tuple[float, ...]] = {}
        self._add_goal_handles(goals)
        self._pull: tuple[Any, Any] | None = None  # where the user took hold and is now, on the stage
        self._held: tuple[int, torch.Tensor] | None = None  # world and nodes
        self._hear_pulls()
        self._resets, self._steps, self._sees_through = 0, 0, False
        self._is_stopped = False
        self._told_at = -math.inf
        self._measured = (time.monotonic(), 0.0, 0)  # clock, simulated time and pictures when last told
        self.actions = 0
        self._last = (0.0, math.nan)  # reward and distance of world 0
        self._trouble = ""  # why a policy does not act
        self.draw()

    def run(self, seconds: float = math.inf) -> None:
        """Simulate and show until ``stop`` is called, or so many seconds have passed."""
        end = time.monotonic() + seconds
        self.env.watcher = None if self.env.captures.are_on else self.after_substep
        self._clock = time.monotonic()
        try:
            while not self._is_stopped and time.monotonic() < end:
                self._serve()
                if self.panel.paused and self._steps == self.panel.steps_asked:
                    self._rest()
                    continue
                self._steps = self.panel.steps_asked
                self._act()
                self.after_action()
        finally:
            self.env.watcher = None

    def stop(self) -> None:
        """End ``run``; from any thread."""
        self._is_stopped = True

    def close(self) -> None:
        """End ``run``, let browsers go and free the port."""
        self.stop()
        super().close()

    def __enter__(self) -> Viewer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _serve(self) -> None:
        """Do what users asked for."""
        if self._resets != self.panel.resets_asked:
            self._resets = self.panel.resets_asked
            self._td = _begin(self.env, self.panel.seed)
            self.panel.forget()
            self._let_go()
            self._follow_goals(self.env.goal_points())
            self.draw()
        for world, place in list(self._moved_goals.items()):
            del self._moved_goals[world]
            goal = self.env.world_state["goal"]
            goal[world] = torch.tensor(np.asarray(place) - self.stage.offsets[world], dtype=goal.dtype)
        if self._sees_through != self.panel.shows_chambers:
            self._sees_through = self.panel.shows_chambers
            self.stage.see_through(self._sees_through)
            self.draw()

    def _act(self) -> None:
        """One action in all worlds."""
        driver = self.panel.driver
        if driver == HAND:
            self._td.set("action", self.panel.action())
        else:
            try:
                self._td = self.policies[driver](self._td)
            except ValueError as error:  # of a policy that cannot act here: the user takes over
                self._trouble = f"{driver}: {error}"
                self.panel.take_over()
                return
            self._trouble = ""
        if self.panel.goes_on:
            stepped, self._td = self.env.step_and_maybe_reset(self._td)
            after = stepped["next"]
        else:
            after = self.env.step(self._td)["next"]
            self._td = after.exclude("reward", "done", "terminated", "truncated")
        self.actions += 1
        self._last = (float(after["reward"].reshape(-1)[0]), float(after["distance"].reshape(-1)[0]))
        self.panel.note(self.simulated, *self._last, after)
        if self.panel.goes_on and bool(after["done"].any()):
            self._follow_goals(self.env.goal_points())

    @property
    def speed(self) -> float:
        """Simulated time over that of the clock."""
        return self.panel.speed

    @property
    def color(self) -> str:
        """What soft bodies are coloured by."""
        return self.panel.color

    @property
    def shows_contacts(self) -> bool:
        """Whether contact forces are drawn."""
        return self.panel.shows_contacts

    def after_substep(self) -> None:
        """Pull where the user does, and show where the sub-step led."""
        self._hold()
        super().after_substep()

    def _rest(self) -> None:
        """Nothing happens; texts and what was moved are still shown."""
        time.sleep(_IDLE)
        self._clock = time.monotonic()
        if self._clock - self._drawn_at >= 10.0 / self._fps:
            self.draw()

    def draw(self) -> None:
        """A picture, now, and texts where it is time for them."""
        super().draw()
        if self._drawn_at - self._told_at >= 1.0 / _TOLD:
            self._tell()

    def _tell(self) -> None:
        then, simulated, pictures = self._measured
        now = time.monotonic()
        passed = max(now - then, 1.0e-6)
        factor, rate = (self.simulated - simulated) / passed, (self.pictures - pictures) / passed
        self._measured, self._told_at = (now, self.simulated, self.pictures), now
        reward, distance = self._last
        bad = int((self.env.sim.status >= 2).sum())
        lines = [
            f"**{type(self.env).__name__}**, {self.env.num_worlds} world(s), step {int(self.env.step_count[0])}",
            f"{self.simulated:.1f} s simulated, {factor:.2f} x real time, {rate:.0f} pictures/s",
            f"world 0: reward {reward:.3g}, distance {distance:.4g}",
        ]
        if self.color in self.stage.limits:
            lines.append(f"colours end at {self.stage.limits[self.color]:.3g} {UNITS[self.color]} of {self.color}")
        if bad:
            lines.append(f"**{bad} world(s) failed in the last step**")
        if self._trouble:
            lines.append(f"**{self._trouble}**")
        self.panel.tell("  \n".join(lines))
        if self.panel.driver != HAND and "action" in self._td:
            self.panel.show_action(self._td["action"])

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


def _begin(env: Any, seed: int) -> Any:
    """The episode of a seed in every world."""
    env.set_seed(seed)
    return env.reset()
