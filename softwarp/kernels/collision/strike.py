"""How fast an object may become within a step, struck by what is near it. Theory: docs/theory/strike.md.

An object at rest is seen by the broad phase where it is, but another may strike it and send it into a third. So every
object has a box of velocities, and each side of a couple a *hull* around those of all that may strike it first.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.kernels.collision import geometry
from softwarp.model.codes import FAR, CoupleColumn, Target

HULL_ROWS = 12  # of a couple: low and high bounds (3 each) of side a, then of side b


@cache
def functions(scalar: Any) -> SimpleNamespace:
    """Test of boxes, and the fastest velocity in a hull."""
    real = scalar
    types = geometry.structures(real)
    vec3 = types.vec3
    Scene, Motion = types.Scene, types.Motion
    place = geometry.functions(real)
    target_x, target_q = place.target_x, place.target_q

    @wp.func
    def is_near(
        scene: Scene, motion: Motion, box: wp.array3d(dtype=real), pack: int, lane: int, item: int, reach: real
    ):
        """Whether the boxes of a couple, or a box and a plane, are not farther apart than ``reach``."""
        a = 7 * scene.couple[item, wp.static(CoupleColumn.OBJECT_A)]
        b = 7 * scene.couple[item, wp.static(CoupleColumn.OBJECT_B)]
        target = scene.couple[item, wp.static(CoupleColumn.TARGET)]
        near = bool(True)
        if scene.target_kind[target] == wp.static(Target.PLANE):
            q = target_q(scene, motion, pack, lane, target)
            n = vec3(
                real(2.0) * (q[0] * q[2] + q[3] * q[1]),
                real(2.0) * (q[1] * q[2] - q[3] * q[0]),
                real(1.0) - real(2.0) * (q[0] * q[0] + q[1] * q[1]),
            )
            x = target_x(scene, motion, pack, lane, target)
            lowest = real(0.0)
            for c in range(3):
                lowest += n[c] * (box[pack, a + c, lane] - x[c])
                lowest -= wp.abs(n[c]) * box[pack, a + 3 + c, lane]
            near = lowest <= reach
        elif scene.couple[item, wp.static(CoupleColumn.SELF)] == 0:
            for c in range(3):
                between = wp.abs(box[pack, a + c, lane] - box[pack, b + c, lane])
                if between > box[pack, a + 3 + c, lane] + box[pack, b + 3 + c, lane] + reach:
                    near = False
        return near

    @wp.func
    def along(hull: wp.array3d(dtype=real), pack: int, row: int, lane: int, n: vec3):
        """Largest n . v of the velocities in the hull that starts at a row; very negative for an empty one."""
        total = real(0.0)
        for c in range(3):
            total += wp.max(n[c] * hull[pack, row + c, lane], n[c] * hull[pack, row + 3 + c, lane])
        if hull[pack, row, lane] > hull[pack, row + 3, lane]:
            total = real(-FAR)
        return total

    return SimpleNamespace(is_near=is_near, along=along)


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels on single worlds."""
    real = variant.real
    module = variant.module("strike")
    types = geometry.structures(real)
    vec3 = types.vec3
    Scene, Motion = types.Scene, types.Motion
    is_near = functions(real).is_near

    @wp.func
    def lows(values: wp.array3d(dtype=real), pack: int, row: int, lane: int):
        """Three rows."""
        return vec3(values[pack, row, lane], values[pack, row + 1, lane], values[pack, row + 2, lane])

    @wp.func
    def other_of(scene: Scene, item: int, own: int):
        """The object that a couple sets against ``own``."""
        other = scene.couple[item, wp.static(CoupleColumn.OBJECT_A)]
        if other == own:
            other = scene.couple[item, wp.static(CoupleColumn.OBJECT_B)]
        return other

    @wp.func
    def hull_of(
        scene: Scene,
        object_start: wp.array(dtype=wp.int32),
        object_couple: wp.array(dtype=wp.int32),
        reach: wp.array3d(dtype=real),
        velocity: wp.array3d(dtype=real),
        restitution: wp.array3d(dtype=real),
        struck: wp.array3d(dtype=real),
        pack: int,
        lane: int,
        own: int,
        partner: int,
        rounds: int,
    ):
        """Bounds of the velocities that near objects but the partner can give to an object.

        A strike gives the velocity of what strikes, and bounces beyond it. With two rounds, what strikes may have been
        struck itself.
        """
        low = vec3(real(FAR), real(FAR), real(FAR))
        high = -low
        slowest = lows(velocity, pack, 6 * own, lane)
        fastest = lows(velocity, pack, 6 * own + 3, lane)
        for k in range(object_start[own], object_start[own + 1]):
            item = object_couple[k]
            other = other_of(scene, item, own)
            if reach[pack, item, lane] >= real(0.0) and other != partner:
                bounce = restitution[pack, scene.couple[item, wp.static(CoupleColumn.PAIR)], lane]
                v_low = lows(velocity, pack, 6 * other, lane)
                v_high = lows(velocity, pack, 6 * other + 3, lane)
                if rounds > 1:
                    v_low = wp.min(v_low, lows(struck, pack, 6 * other, lane))
                    v_high = wp.max(v_high, lows(struck, pack, 6 * other + 3, lane))
                zero = vec3()
                low = wp.min(low, v_low - bounce * wp.max(fastest - v_low, zero))
                high = wp.max(high, v_high + bounce * wp.max(v_high - slowest, zero))
        return low, high

    @wp.kernel(module=module, enable_backward=False)
    def object_strikes(
        # Model
        scene: Scene,
        object_start: wp.array(dtype=wp.int32),
        object_couple: wp.array(dtype=wp.int32),
        object_free: wp.array(dtype=wp.int32),
        # Workspace in
        reach_in: wp.array3d(dtype=real),
        velocity_in: wp.array3d(dtype=real),
        pair_restitution_in: wp.array3d(dtype=real),
        # Workspace out
        struck_out: wp.array3d(dtype=real),
    ):
        """Bounds of the velocities that what is near can give to one object; empty for what nothing moves."""
        pack, item, lane = wp.tid()
        low = vec3(real(FAR), real(FAR), real(FAR))
        high = -low
        if object_free[item] != 0:
            low, high = hull_of(
                scene,
                object_start,
                object_couple,
                reach_in,
                velocity_in,
                pair_restitution_in,
                velocity_in,
                pack,
                lane,
                item,
                -1,
                1,
            )
        for c in range(3):
            struck_out[pack, 6 * item + c, lane] = low[c]
            struck_out[pack, 6 * item + 3 + c, lane] = high[c]

    @wp.kernel(module=module, enable_backward=False)
    def couple_strikes(
        # Model
        scene: Scene,
        object_start: wp.array(dtype=wp.int32),
        object_couple: wp.array(dtype=wp.int32),
        object_free: wp.array(dtype=wp.int32),
        # Workspace in
        motion: Motion,
        box_in: wp.array3d(dtype=real),
        near_in: wp.array3d(dtype=real),
        velocity_in: wp.array3d(dtype=real),
        struck_in: wp.array3d(dtype=real),
        pair_restitution_in: wp.array3d(dtype=real),
        pair_distance_in: wp.array3d(dtype=real),
        pair_alarm_in: wp.array3d(dtype=real),
        slack: real,
        h: real,
        # Workspace out
        hull_out: wp.array3d(dtype=real),
        reach_out: wp.array3d(dtype=real),
    ):
        """Hulls of both sides of one couple, and how far apart its contacts may be; -1 where it is farther."""
        pack, item, lane = wp.tid()
        pair = scene.couple[item, wp.static(CoupleColumn.PAIR)]
        limit = wp.max(pair_alarm_in[pack, pair, lane], pair_distance_in[pack, pair, lane]) + slack
        reach = limit
        own = real(0.0)
        for side in range(2):
            body = scene.couple[item, wp.static(CoupleColumn.OBJECT_A) + side]
            partner = scene.couple[item, wp.static(CoupleColumn.OBJECT_B) - side]
            speed = box_in[pack, 7 * body + 6, lane]
            own += real(1.5) * speed
            low = vec3(real(FAR), real(FAR), real(FAR))
            high = -low
            if object_free[body] != 0:
                low, high = hull_of(
                    scene,
                    object_start,
                    object_couple,
                    near_in,
                    velocity_in,
                    pair_restitution_in,
                    struck_in,
                    pack,
                    lane,
                    body,
                    partner,
                    2,
                )
                if low[0] <= high[0]:
                    speed = wp.max(speed, wp.length(wp.max(high, -low)))
            reach += h * speed
            for c in range(3):
                hull_out[pack, wp.static(HULL_ROWS) * item + 6 * side + c, lane] = low[c]
                hull_out[pack, wp.static(HULL_ROWS) * item + 6 * side + 3 + c, lane] = high[c]
        reach = wp.max(reach, limit + h * own)
        if not is_near(scene, motion, box_in, pack, lane, item, reach):
            reach = real(-1.0)
        reach_out[pack, item, lane] = reach

    return SimpleNamespace(object_strikes=object_strikes, couple_strikes=couple_strikes)
