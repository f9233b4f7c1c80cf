"""Vectors, quaternions and inertias of single worlds, in Warp's own types. Theory: docs/theory/frames.md.

For kernels that give every world of a pack a thread of its own, because its worlds take different ways: they branch,
decompose and iterate. Their arrays have the shape (pack, row, lane). Where lanes go together, ``vectors`` serves.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant


@cache
def functions(variant: Variant) -> SimpleNamespace:
    """Types of one precision and functions on them."""
    real = variant.real
    vec3 = wp.types.vector(3, real)
    mat33 = wp.types.matrix((3, 3), real)
    quat = wp.types.quaternion(real)

    @wp.func
    def vector_at(array: wp.array3d(dtype=real), pack: int, lane: int, row: int):
        """Vector in three rows."""
        return vec3(array[pack, row, lane], array[pack, row + 1, lane], array[pack, row + 2, lane])

    @wp.func
    def quat_at(array: wp.array3d(dtype=real), pack: int, lane: int, row: int):
        """Quaternion in four rows."""
        return quat(
            array[pack, row, lane], array[pack, row + 1, lane], array[pack, row + 2, lane], array[pack, row + 3, lane]
        )

    @wp.func
    def inertia_at(array: wp.array3d(dtype=real), pack: int, lane: int, row: int):
        """Matrix in the rows xx, yy, zz, xy, xz, yz."""
        d = vector_at(array, pack, lane, row)
        o = vector_at(array, pack, lane, row + 3)
        return mat33(d[0], o[0], o[1], o[0], d[1], o[2], o[1], o[2], d[2])

    @wp.func
    def put(array: wp.array3d(dtype=real), pack: int, lane: int, row: int, v: vec3):
        """Write a vector to three rows."""
        for c in range(3):
            array[pack, row + c, lane] = v[c]

    @wp.func
    def put_quat(array: wp.array3d(dtype=real), pack: int, lane: int, row: int, q: quat):
        """Write a quaternion to four rows."""
        for c in range(4):
            array[pack, row + c, lane] = q[c]

    @wp.func
    def add_to(array: wp.array3d(dtype=real), pack: int, lane: int, row: int, v: vec3):
        """Add a vector to three rows."""
        for c in range(3):
            array[pack, row + c, lane] = array[pack, row + c, lane] + v[c]

    @wp.func
    def exponential(v: vec3):
        """Quaternion of a rotation vector."""
        angle = wp.length(v)
        part = real(0.5)
        if angle > real(1.0e-6):
            part = wp.sin(real(0.5) * angle) / angle
        return quat(v[0] * part, v[1] * part, v[2] * part, wp.cos(real(0.5) * angle))

    @wp.func
    def logarithm(q: quat):
        """Rotation vector of a unit quaternion, by the shorter way."""
        v = vec3(q[0], q[1], q[2])
        c = q[3]
        if c < real(0.0):
            v = -v
            c = -c
        s = wp.length(v)
        part = real(2.0)
        if s > real(1.0e-7):
            part = real(2.0) * wp.atan2(s, c) / s
        return v * part

    return SimpleNamespace(
        vec3=vec3,
        mat33=mat33,
        quat=quat,
        vector_at=vector_at,
        quat_at=quat_at,
        inertia_at=inertia_at,
        put=put,
        put_quat=put_quat,
        add_to=add_to,
        exponential=exponential,
        logarithm=logarithm,
    )
