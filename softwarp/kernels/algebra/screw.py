"""Geometry of turning and moving at the same time, for kernels of single worlds. Theory: docs/theory/telescope.md."""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant


@cache
def functions(variant: Variant) -> SimpleNamespace:
    """Way of a pose that turns while it moves, its inverse, and turns about the tangent."""
    real = variant.real
    one = single.functions(variant)
    vec3, quat = one.vec3, one.quat

    @wp.func
    def spread(turn: vec3, v: vec3):
        """Way of a pose that moves by v and turns by a rotation vector at the same time."""
        angle = wp.length(turn)
        b = real(0.5)
        c = real(1.0) / real(6.0)
        if angle > real(1.0e-3):
            square = angle * angle
            b = (real(1.0) - wp.cos(angle)) / square
            c = (angle - wp.sin(angle)) / (square * angle)
        across = wp.cross(turn, v)
        return v + b * across + c * wp.cross(turn, across)

    @wp.func
    def gathered(turn: vec3, v: vec3):
        """The inverse of ``spread``."""
        angle = wp.length(turn)
        a = real(1.0) / real(12.0)
        if angle > real(1.0e-2):
            half = real(0.5) * angle
            a = (real(1.0) - half * wp.cos(half) / wp.sin(half)) / (angle * angle)
        across = wp.cross(turn, v)
        return v - real(0.5) * across + a * wp.cross(turn, across)

    @wp.func
    def about_z(angle: real):
        """Quaternion of a turn about the tangent."""
        return quat(real(0.0), real(0.0), wp.sin(real(0.5) * angle), wp.cos(real(0.5) * angle))

    return SimpleNamespace(spread=spread, gathered=gathered, about_z=about_z)
