"""Cables, springs and markers of a scene: part of ``ModelBuilder``."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Literal

from numpy.typing import ArrayLike

from softwarp.scene import cables
from softwarp.scene.parts import Scene


class Tendons:
    """Part of ``ModelBuilder``; see there."""

    scene: Scene

    def add_cable(
        self,
        body: int | Sequence[int],
        waypoints: ArrayLike,
        pull_point: Sequence[float] | None = None,
        *,
        control: Literal["length", "force"] = "length",
        min_tension: float = 0.0,
        max_tension: float = math.inf,
        min_displacement: float = -math.inf,
        max_displacement: float = math.inf,
        max_rate: float = math.inf,
        closing_length: float = 0.0,
        stiffness: float = math.inf,
        damping: float = 0.0,
        pull_on: int | None = None,
        patches: Mapping[int, tuple[ArrayLike, ArrayLike]] | None = None,
        tolerance: float | None = None,
        name: str | None = None,
    ) -> int:
        """Add a frictionless cable through soft bodies, rods and rigid bodies.

        Args:
            body: Body that the cable runs through, or one per waypoint. On a rod the nearest section carries a
                waypoint, at any distance from the centre line; a rigid body carries points anywhere.
            waypoints: Points at rest [m], shape (p, 3), in order; inside a soft body that carries them.
            pull_point: First point [m], fixed in space unless ``pull_on`` carries it; without one the cable starts at
                its first waypoint.
            control: ``length`` imposes a displacement (shortening from rest), ``force`` a tension.
            min_tension: 0 for a cable that only pulls, ``-inf`` for a bilateral one [N].
            max_tension: Upper limit [N].
            min_displacement: Lower limit of the imposed displacement [m].
            max_displacement: Upper limit of the imposed displacement [m].
            max_rate: Largest change of the displacement per time [m/s].
            closing_length: Distance of neighbouring points [m] below which the segment between them pulls in proportion
                to it, so that material crushed by the cable comes to rest; less than every segment at rest. 0 keeps
                the full tension down to the last, where a segment has no direction and a taut cable chatters.
            stiffness: Tension per stretch [N/m] of an elastic cable under length control; infinite for one that does
                not stretch.
            damping: Tension per speed of stretching [N s/m], of an elastic cable.
            pull_on: Part that carries the pull point, such as the wrist of a hand.
            patches: For waypoints that pull at an area of a soft body rather than at a point, by their number: up to
                four of its nodes and the share of each. The waypoint is their mean, and must be given so.
            tolerance: Distance [m] that a waypoint may lie outside the body's faceted surface.
            name: For messages and exports.

        Returns:
            Index of the cable.
        """
        return cables.add_cable(
            self.scene,
            body,
            waypoints,
            pull_point,
            control=control,
            min_tension=min_tension,
            max_tension=max_tension,
            min_displacement=min_displacement,
            max_displacement=max_displacement,
            max_rate=max_rate,
            closing_length=closing_length,
            stiffness=stiffness,
            damping=damping,
            pull_on=pull_on,
            patches=patches,
            tolerance=tolerance,
            name=name,
        )

    def add_spring(
        self,
        a: int,
        b: int,
        points: ArrayLike,
        *,
        stiffness: float,
        damping: float = 0.0,
        rest_length: float | None = None,
        only_pulls: bool = False,
        tolerance: float | None = None,
        name: str | None = None,
    ) -> int:
        """Add a spring with a damper between points of two parts, or of one.

        It is an elastic cable of two points: it has their index, ``sim.cable_tension`` is its force [N], negative where
        it pushes, ``sim.params.cable_stiffness`` and ``cable_damping`` are its constants in each world, and both limits
        of ``cable_displacement`` are the rest length of the cable less that of the spring.

        Args:
            a: Soft body, rigid body or rod.
            b: The other part, or the same.
            points: Its ends at rest [m], on a and on b, shape (2, 3), in different places.
            stiffness: Force per stretch [N/m].
            damping: Force per speed of stretching [N s/m].
            rest_length: Length without force [m]; None takes the distance of the points.
            only_pulls: Slack where it is shorter than its rest length, as a rubber band.
            tolerance: Distance [m] that a point may lie outside a soft body's faceted surface.
            name: For messages and exports.

        Returns:
            Index of the cable.
        """
        return cables.add_spring(
            self.scene,
            a,
            b,
            points,
            stiffness=stiffness,
            damping=damping,
            rest_length=rest_length,
            only_pulls=only_pulls,
            tolerance=tolerance,
            name=name,
        )

    def add_marker(
        self, body: int, point: Sequence[float], *, tolerance: float | None = None, name: str | None = None
    ) -> int:
        """Follow a material point.

        Args:
            body: Soft body, rigid body or rod that carries the point; of a rod, its nearest section does.
            point: Position at rest [m], inside a soft body.
            tolerance: Distance [m] that the point may lie outside.
            name: For messages and exports.

        Returns:
            Index of the marker.
        """
        return cables.add_marker(self.scene, body, point, tolerance=tolerance, name=name)
