"""Touches of the narrow phases: whether they become contacts, and their rows. Theory: docs/theory/collision.md."""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from softwarp.kernels.collision import geometry, strike
from softwarp.kernels.collision.geometry import BARY, DISTANCE, NORMAL, POINT_A, POINT_B, SHARE, TOUCH_ROWS
from softwarp.kernels.collision.strike import HULL_ROWS

MARGIN = 1.5  # times the way of a step along the normal that is looked ahead
ASIDE = 0.25  # times the whole way of a step, for velocities that turn


@cache
def functions(scalar: Any) -> SimpleNamespace:
    """Whether a touch becomes a contact, and its rows."""
    real = scalar
    types = geometry.structures(real)
    vec3, Touch = types.vec3, types.Touch
    along = strike.functions(real).along

    @wp.func
    def write_touch(pack: int, c: int, lane: int, touch: Touch, touch_out: wp.array3d(dtype=real)):
        """Store a touch."""
        row = c * wp.static(TOUCH_ROWS)
        for k in range(3):
            touch_out[pack, row + wp.static(NORMAL) + k, lane] = touch.normal[k]
            touch_out[pack, row + wp.static(POINT_A) + k, lane] = touch.a[k]
            touch_out[pack, row + wp.static(POINT_B) + k, lane] = touch.b[k]
        touch_out[pack, row + wp.static(DISTANCE), lane] = touch.distance
        touch_out[pack, row + wp.static(SHARE), lane] = touch.share
        touch_out[pack, row + wp.static(BARY), lane] = touch.u
        touch_out[pack, row + wp.static(BARY) + 1, lane] = touch.v

    @wp.func
    def keep_touch(
        pack: int,
        key: int,
        lane: int,
        touch: Touch,
        seats: int,
        found_key_out: wp.array3d(dtype=wp.int32),
        found_touch_out: wp.array3d(dtype=real),
    ):
        """Keep the touch of a key for ``kept_touch``, in the seat of its number, from which it drives another key."""
        if seats > 0:
            seat = key % seats
            found_key_out[pack, seat, lane] = key + 1
            write_touch(pack, seat, lane, touch, found_touch_out)

    @wp.func
    def kept_touch(
        pack: int,
        c: int,
        key: int,
        lane: int,
        seats: int,
        found_key: wp.array3d(dtype=wp.int32),
        found_touch: wp.array3d(dtype=real),
        touch_out: wp.array3d(dtype=real),
    ):
        """Store what was kept of a key as the touch of contact c; whether it was there."""
        is_kept = bool(False)
        if seats > 0:
            seat = key % seats
            if found_key[pack, seat, lane] == key + 1:
                is_kept = True
                for k in range(wp.static(TOUCH_ROWS)):
                    row = wp.static(TOUCH_ROWS) * seat + k
                    touch_out[pack, wp.static(TOUCH_ROWS) * c + k, lane] = found_touch[pack, row, lane]
        return is_kept

    @wp.func
    def urgency(
        touch: Touch,
        a: vec3,
        b: vec3,
        hull: wp.array3d(dtype=real),
        pack: int,
        couple: int,
        lane: int,
        limit: real,
        slack: real,
        h: real,
    ):
        """0 for a touch within ``limit``, 1 for one that can come about within the step, 2 with slack, -1 for none.

        With the velocities of both sides: what counts is how fast they close, that the direction can change, and how
        fast they could close if others struck them first.
        """
        n = touch.normal
        closing = wp.max(real(-MARGIN) * wp.dot(a - b, n), real(ASIDE) * wp.length(a - b))
        row = wp.static(HULL_ROWS) * couple
        struck = wp.max(along(hull, pack, row, lane, -n), -wp.dot(a, n))
        struck += wp.max(along(hull, pack, row + 6, lane, n), wp.dot(b, n))
        closing = wp.max(closing, struck)
        urgent = int(-1)
        if touch.distance <= limit:
            urgent = 0
        elif touch.distance <= limit + h * closing:
            urgent = 1
        elif touch.distance <= limit + slack + h * closing:
            urgent = 2
        return urgent

    return SimpleNamespace(write_touch=write_touch, keep_touch=keep_touch, kept_touch=kept_touch, urgency=urgency)
