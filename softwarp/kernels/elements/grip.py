"""Stiffness of quadratic elements whose nodes a frame carries. Theory: docs/theory/attachment.md.

A frame that carries nodes a of an element at levers r_a moves a Gauss point's displacement gradient by
H = V G' + sum_k w_k (e_k x M), with G = sum g_a and M = sum r_a g_a': the translation is one more node, of gradient G,
and M stands for the rotation. With them a block of A costs the same whatever number of nodes the frame carries.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.algebra.vectors import algebra
from softwarp.kernels.elements import corotational
from softwarp.model.codes import Side

ROWS = 48  # per element and frame: G, then the rows of M, as nodes in ``quadratic.spread_gradient``


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels that gather what frames carry of elements, and add it to A."""
    S = variant.S
    real = variant.real
    mul, minus = variant.mul, variant.sub
    world_fastest = variant.world_fastest
    module = variant.module("grip")
    a = algebra(variant)
    Vector, Matrix, vector, rows = a.Vector, a.Matrix, a.vector, a.rows
    add, scaled, matvec, crossed, transposed = a.add, a.scaled, a.matvec, a.crossed, a.transposed
    summed, subtracted, row_x, row_y, row_z = a.summed, a.subtracted, a.row_x, a.row_y, a.row_z
    add_outer, add_matrix, read_vector = a.add_outer, a.add_matrix, a.read_vector
    isotropic = corotational.kernels(variant).isotropic

    @wp.func
    def at_point(gradient: wp.array2d(dtype=S), w: int, row: int):
        """A vector of one Gauss point, whose number is in the row."""
        return vector(gradient[w, row], gradient[w, row + 4], gradient[w, row + 8])

    @wp.func
    def put_at_point(gradient: wp.array2d(dtype=S), w: int, row: int, v: Vector):
        gradient[w, row] = v.x
        gradient[w, row + 4] = v.y
        gradient[w, row + 8] = v.z

    @wp.kernel(module=module, enable_backward=False)
    def gather(
        # Model
        grip_start: wp.array(dtype=wp.int32),
        grip_corner: wp.array(dtype=wp.int32),
        grip_item: wp.array(dtype=wp.int32),
        # Workspace in
        shape_gradient_in: wp.array2d(dtype=S),
        lever_in: wp.array2d(dtype=S),
        # Workspace out
        grip_out: wp.array2d(dtype=S),
    ):
        """G and M of one frame and one element at all Gauss points; a corner is 10 element + node."""
        w, grip = wp.tid()
        if wp.static(world_fastest):
            grip, w = wp.tid()
        for q in range(4):
            G = Vector()
            M = Matrix()
            for p in range(grip_start[grip], grip_start[grip + 1]):
                g = at_point(shape_gradient_in, w, 12 * grip_corner[p] + q)
                G = add(G, g)
                M = add_outer(M, read_vector(lever_in, w, 3 * grip_item[p]), g)
            row = wp.static(ROWS) * grip + q
            put_at_point(grip_out, w, row, G)
            put_at_point(grip_out, w, row + 12, row_x(M))
            put_at_point(grip_out, w, row + 24, row_y(M))
            put_at_point(grip_out, w, row + 36, row_z(M))

    @wp.func
    def gradient_of(shape: wp.array2d(dtype=S), grip: wp.array2d(dtype=S), w: int, code: int, q: int):
        """Gradient of a free node or of a frame's translation at one Gauss point."""
        v = Vector()
        if (code & 3) == wp.static(int(Side.NODE)):
            v = at_point(shape, w, 12 * (code >> 2) + q)
        else:
            v = at_point(grip, w, wp.static(ROWS) * (code >> 2) + q)
        return v

    @wp.func
    def translated(shape: wp.array2d(dtype=S), grip: wp.array2d(dtype=S), w: int, left: int, right: int, mu: S, lam: S):
        """Block between nodes or translations."""
        X = Matrix()
        for q in range(4):
            X = add_outer(X, gradient_of(shape, grip, w, left, q), gradient_of(shape, grip, w, right, q))
        return isotropic(X, mu, lam)

    @wp.func
    def turned(shape: wp.array2d(dtype=S), grip: wp.array2d(dtype=S), w: int, left: int, right: int, mu: S, lam: S):
        """Block between a rotation and a node or translation: sum of lam c g' + mu [M g] - mu [g] M.

        c is the axial vector of M, sum r_a x g_a.
        """
        along = Matrix()
        across = Matrix()
        m = Vector()
        for q in range(4):
            row = wp.static(ROWS) * (left >> 2) + 12 + q
            M = rows(at_point(grip, w, row), at_point(grip, w, row + 12), at_point(grip, w, row + 24))
            g = gradient_of(shape, grip, w, right, q)
            along = add_outer(along, vector(minus(M.yz, M.zy), minus(M.zx, M.xz), minus(M.xy, M.yx)), g)
            across = subtracted(across, crossed(g, M))
            m = add(m, matvec(M, g))
        zero = S(real(0.0))
        spin = rows(
            vector(zero, minus(zero, m.z), m.y),
            vector(m.z, zero, minus(zero, m.x)),
            vector(minus(zero, m.y), m.x, zero),
        )
        across = summed(across, spin)
        return rows(
            add(scaled(row_x(along), lam), scaled(row_x(across), mu)),
            add(scaled(row_y(along), lam), scaled(row_y(across), mu)),
            add(scaled(row_z(along), lam), scaled(row_z(across), mu)),
        )

    @wp.func
    def add_rotations(
        grip: wp.array2d(dtype=S), w: int, left: int, right: int, mu: S, lam: S, out: wp.array2d(dtype=S), row: int
    ):
        """Block between rotations, from H_k = e_k x M: lam tr H_k tr H_l + mu (H_k : H_l + H_k : H_l')."""
        for place in range(36):  # so many that the compiler keeps the loop: entry (k, n) at point q
            q = place % 4
            k = place // 12
            n = (place // 4) % 3
            i = wp.static(ROWS) * (left >> 2) + 12 + q
            j = wp.static(ROWS) * (right >> 2) + 12 + q
            k1 = (k + 1) % 3
            k2 = (k + 2) % 3
            n1 = (n + 1) % 3
            n2 = (n + 2) % 3
            spread = grip[w, i + 12 * k1 + 4 * k2] - grip[w, i + 12 * k2 + 4 * k1]
            other = grip[w, j + 12 * n1 + 4 * n2] - grip[w, j + 12 * n2 + 4 * n1]
            shape = mul(grip[w, i + 12 * k1 + 4 * n2], grip[w, j + 12 * n1 + 4 * k2])
            shape -= mul(grip[w, i + 12 * k1 + 4 * n1], grip[w, j + 12 * n2 + 4 * k2])
            shape -= mul(grip[w, i + 12 * k2 + 4 * n2], grip[w, j + 12 * n1 + 4 * k1])
            shape += mul(grip[w, i + 12 * k2 + 4 * n1], grip[w, j + 12 * n2 + 4 * k1])
            for c in range(3):
                shape -= mul(grip[w, i + 12 * n + 4 * c], grip[w, j + 12 * k + 4 * c])
            if k == n:
                for c in range(3):
                    for r in range(3):
                        shape += mul(grip[w, i + 12 * r + 4 * c], grip[w, j + 12 * r + 4 * c])
            out[w, row + 3 * k + n] += mul(lam, mul(spread, other)) + mul(mu, shape)

    @wp.kernel(module=module, enable_backward=False)
    def stiffness(
        # Model
        point_body: wp.array(dtype=wp.int32),
        block: wp.array(dtype=wp.int32),
        entry_start: wp.array(dtype=wp.int32),
        entry: wp.array2d(dtype=wp.int32),
        # Workspace in
        body_mu_in: wp.array2d(dtype=S),
        body_lam_in: wp.array2d(dtype=S),
        body_stiffness_scale_in: wp.array2d(dtype=S),
        shape_gradient_in: wp.array2d(dtype=S),
        grip_in: wp.array2d(dtype=S),
        # Workspace out
        a_out: wp.array2d(dtype=S),
    ):
        """Add the elements around one block of A; an entry is (element, side of the row, of the column).

        A side is 4 index + kind; the index is 10 element + node of a free node, else the grip.
        """
        w, place = wp.tid()
        if wp.static(world_fastest):
            place, w = wp.tid()
        row = 9 * block[place]
        for p in range(entry_start[place], entry_start[place + 1]):
            body = point_body[4 * entry[p, 0]]
            left = entry[p, 1]
            right = entry[p, 2]
            mu = mul(body_stiffness_scale_in[w, body], body_mu_in[w, body])
            lam = mul(body_stiffness_scale_in[w, body], body_lam_in[w, body])
            is_turned = (left & 3) == wp.static(int(Side.ROTATION))
            if is_turned and (right & 3) == wp.static(int(Side.ROTATION)):
                add_rotations(grip_in, w, left, right, mu, lam, a_out, row)
            elif is_turned:
                add_matrix(a_out, w, row, turned(shape_gradient_in, grip_in, w, left, right, mu, lam))
            elif (right & 3) == wp.static(int(Side.ROTATION)):
                K = turned(shape_gradient_in, grip_in, w, right, left, mu, lam)
                add_matrix(a_out, w, row, transposed(K))
            else:
                add_matrix(a_out, w, row, translated(shape_gradient_in, grip_in, w, left, right, mu, lam))

    return SimpleNamespace(gather=gather, stiffness=stiffness)
