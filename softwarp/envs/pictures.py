"""Pictures of running worlds: one camera, fitted to the robot and its goals, that stays where it is."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from softwarp.render import Camera, RayCaster

_MOST = 64  # ray casters that are kept
_ROOM = 1.02  # of the picture within which the centre of a goal has to lie


class LivePictures:
    """Draws the worlds of an environment.

    The camera is chosen at the first picture and stays, so that films are steady. Only a goal outside of the picture,
    as a reset may draw one, makes it wider; goals of earlier pictures stay in sight.

    Args:
        env: The environment; its hooks ``camera``, ``shown_region``, ``shown_goals`` and ``viewed_from`` are asked.
    """

    def __init__(self, env: Any) -> None:
        self._env = env
        self._caster: RayCaster | None = None
        self._casters: dict[tuple[float, ...], RayCaster] = {}  # of worlds that chose other meshes, with its camera
        self._goals = np.empty((0, 3))  # m, that have been in sight

    def draw(self, index: Tensor, **shown: bool) -> NDArray[np.uint8]:
        """Pictures of the worlds ``index``, (n, height, width, 3); ``shown`` as of ``RayCaster.draw``."""
        goals = self._env.goal_points()
        goals = None if goals is None else goals[index]
        caster, worlds, choice = self._fitted(_points(goals)), index.tolist(), self._env.sim.params.body_choice
        if choice.shape[1] == 0:
            return caster.draw(self._env.sim, worlds, goals, **shown)
        chosen = [tuple(row) for row in choice[index].tolist()]
        pictures = [
            self._caster_of(key).draw(self._env.sim, [world], None if goals is None else goals[at : at + 1], **shown)[0]
            for at, (world, key) in enumerate(zip(worlds, chosen, strict=True))
        ]
        return np.stack(pictures)

    def _caster_of(self, choice: tuple[float, ...]) -> RayCaster:
        """The ray caster of worlds with some of several meshes, which looks from where all do."""
        assert self._caster is not None
        held = self._casters.pop(choice, None)
        if held is None or held.camera != self._caster.camera:
            held = self._new(self._caster.camera, None, choice)
        self._casters[choice] = held
        if len(self._casters) > _MOST:
            del self._casters[next(iter(self._casters))]
        return held

    def _new(self, camera: Camera | None, beside: NDArray[np.float64] | None, choice: tuple[float, ...]) -> RayCaster:
        env, width, height = self._env, self._env.config.render_width, self._env.config.render_height
        options: dict[str, Any] = {
            "camera": camera,
            "region": env.shown_region(),
            "beside": beside,
            "towards": env.viewed_from,
            "goal_radius": env.goal_radius,
        }
        return RayCaster.for_model(env.sim.model.as_chosen(choice), width=width, height=height, **options)

    def _fitted(self, goals: NDArray[np.float64]) -> RayCaster:
        """The ray caster, with these goals [m] in its picture unless the environment has a camera of its own."""
        env, width, height = self._env, self._env.config.render_width, self._env.config.render_height
        camera = env.camera()
        if self._caster is not None:
            at = self._caster.camera.project(goals, width / height)
            if camera is not None or bool((np.abs(at) < _ROOM).all()):
                return self._caster
        self._goals = np.concatenate([self._goals, goals, _points(env.shown_goals())])
        beside = None if camera is not None else self._goals
        self._caster = self._new(camera, beside, ())
        return self._caster


def _points(goals: Tensor | None) -> NDArray[np.float64]:
    """Finite ones of the positions [m], shape (k, 3)."""
    if goals is None:
        return np.empty((0, 3))
    points = goals.detach().cpu().numpy().astype(np.float64)
    return points[np.isfinite(points).all(axis=1)]
