"""Mass of free soft bodies in the factor and the residual, where stiff elements bury it in rounding.

Internal forces do not push their own body, so that the blocks of a row of A sum up to the mass of its node. Elimination
and products by differences that know this sum lose nothing of it. ``excess`` says of every free body by how much the
largest entry of its part of A exceeds what its mass can bear; above 0 the body is *marked*, and only then anything here
changes a bit. Theory: docs/theory/cholesky.md, "Free bodies".
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.linear import cholesky_panels

BEARABLE = 2.0**16  # largest entry of A in masses of the body, up to which the mass keeps eight bits in float32
ROOT_SHARE = 2.0**-18  # of the excess, which the last block receives while the factor is found: more than rounding
SHARES = 32  # threads of a GPU that share the dofs of a body


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels for one scalar type."""
    S = variant.S
    real = variant.real
    world_fastest = variant.world_fastest
    module = variant.module("free_bodies")
    mul = variant.mul
    vec3 = wp.types.vector(3, real)
    mat33 = wp.types.matrix((3, 3), real)

    @wp.func
    def gauge(
        part_start: wp.array(dtype=wp.int32),
        part_dof: wp.array(dtype=wp.int32),
        dof_node: wp.array(dtype=wp.int32),
        node_body: wp.array(dtype=wp.int32),
        body_mass_scale: wp.array2d(dtype=S),
        node_mass: wp.array2d(dtype=S),
        a: wp.array2d(dtype=S),
        w: int,
        part: int,
        first: int,
        stride: int,
    ):
        """Largest diagonal entry of A among some dofs of a body, and their mass."""
        largest = S(real(0.0))
        mass = S(real(0.0))
        for k in range(part_start[part] + first, part_start[part + 1], stride):
            dof = part_dof[k]
            node = dof_node[dof]
            mass += mul(body_mass_scale[w, node_body[node]], node_mass[w, node])
            for c in range(3):
                largest = wp.max(largest, a[w, 9 * dof + 4 * c])
        return largest, mass

    @wp.kernel(module=module, enable_backward=False)
    def gauge_shares(
        # Symbolic
        part_start: wp.array(dtype=wp.int32),
        part_dof: wp.array(dtype=wp.int32),
        # Model
        dof_node: wp.array(dtype=wp.int32),
        node_body: wp.array(dtype=wp.int32),
        # Workspace in
        body_mass_scale_in: wp.array2d(dtype=S),
        node_mass_in: wp.array2d(dtype=S),
        a_in: wp.array2d(dtype=S),
        # Workspace out
        share_out: wp.array2d(dtype=S),
    ):
        """Largest entry and mass of every ``SHARES``-th dof of a body, on a GPU: one thread would wait for each."""
        item, w = wp.tid()
        largest, mass = gauge(
            part_start,
            part_dof,
            dof_node,
            node_body,
            body_mass_scale_in,
            node_mass_in,
            a_in,
            w,
            item // SHARES,
            item % SHARES,
            SHARES,
        )
        share_out[w, 2 * item] = largest
        share_out[w, 2 * item + 1] = mass

    @wp.kernel(module=module, enable_backward=False)
    def mark(
        # Symbolic
        part_start: wp.array(dtype=wp.int32),
        part_dof: wp.array(dtype=wp.int32),
        # Model
        dof_node: wp.array(dtype=wp.int32),
        node_body: wp.array(dtype=wp.int32),
        # Workspace in
        body_mass_scale_in: wp.array2d(dtype=S),
        node_mass_in: wp.array2d(dtype=S),
        share_in: wp.array2d(dtype=S),
        # Workspace out
        a_out: wp.array2d(dtype=S),
        excess_out: wp.array2d(dtype=S),
        root_out: wp.array2d(dtype=S),
    ):
        """Excess of a body; its last block receives a share of it, and ``root`` keeps what stood there."""
        w, part = wp.tid()
        if wp.static(world_fastest):
            part, w = wp.tid()
        largest = S(real(0.0))
        mass = S(real(0.0))
        if wp.static(world_fastest):
            for item in range(part * SHARES, (part + 1) * SHARES):
                largest = wp.max(largest, share_in[w, 2 * item])
                mass += share_in[w, 2 * item + 1]
        else:
            largest, mass = gauge(
                part_start, part_dof, dof_node, node_body, body_mass_scale_in, node_mass_in, a_out, w, part, 0, 1
            )
        excess = wp.max(largest - mass * real(BEARABLE), S(real(0.0)))
        excess_out[w, part] = excess
        root = part_dof[part_start[part + 1] - 1]
        for c in range(3):
            value = a_out[w, 9 * root + 4 * c]
            root_out[w, 3 * part + c] = value
            a_out[w, 9 * root + 4 * c] = value + excess * real(ROOT_SHARE)

    @wp.func
    def side_block(y: wp.array3d(dtype=real), pack: int, lane: int, size: int, dof: int):
        """Three right-hand sides of a dof, in columns."""
        m = mat33()
        for side in range(3):
            for c in range(3):
                m[c, side] = y[pack, 3 * (side * size + dof) + c, lane]
        return m

    @wp.func
    def inverse_root(sum_block: mat33):
        """Inverse of the lower Cholesky factor of a block, symmetric but for rounding; zeros if there is none."""
        s = (sum_block + wp.transpose(sum_block)) * real(0.5)
        zero = real(0.0)
        one = real(1.0)
        if s[0, 0] > zero:
            i00 = one / wp.sqrt(s[0, 0])
            l10 = s[1, 0] * i00
            l20 = s[2, 0] * i00
            d11 = s[1, 1] - l10 * l10
            if d11 > zero:
                i11 = one / wp.sqrt(d11)
                l21 = (s[2, 1] - l20 * l10) * i11
                d22 = s[2, 2] - l20 * l20 - l21 * l21
                if d22 > zero:
                    i22 = one / wp.sqrt(d22)
                    i10 = -l10 * i00 * i11
                    i21 = -l21 * i11 * i22
                    i20 = -(l20 * i00 + l21 * i10) * i22
                    return mat33(i00, zero, zero, i10, i11, zero, i20, i21, i22)
        return mat33()

    @wp.func
    def restore(a: wp.array3d(dtype=real), root: wp.array3d(dtype=real), pack: int, lane: int, part: int, dof: int):
        """Put back what ``mark`` has changed."""
        for c in range(3):
            a[pack, 9 * dof + 4 * c, lane] = root[pack, 3 * part + c, lane]

    @wp.kernel(module=module, enable_backward=False)
    def mend_root(
        size: int,
        # Symbolic
        part_start: wp.array(dtype=wp.int32),
        part_dof: wp.array(dtype=wp.int32),
        l_col: wp.array(dtype=wp.int32),
        row_start: wp.array(dtype=wp.int32),
        row_block: wp.array(dtype=wp.int32),
        # Model
        dof_node: wp.array(dtype=wp.int32),
        node_body: wp.array(dtype=wp.int32),
        # Workspace in
        body_mass_scale_in: wp.array3d(dtype=real),
        node_mass_in: wp.array3d(dtype=real),
        excess_in: wp.array3d(dtype=real),
        root_in: wp.array3d(dtype=real),
        lower_in: wp.array3d(dtype=real),
        # Workspace out
        a_out: wp.array3d(dtype=real),
        y_out: wp.array3d(dtype=real),
        diagonal_out: wp.array3d(dtype=real),
    ):
        """Last pivot of a marked body: what forward substitution of its mass along three axes comes to.

        Overwrites three right-hand sides of its dofs.
        """
        pack, part, lane = wp.tid()
        if excess_in[pack, part, lane] <= real(0.0):
            return
        end = part_start[part + 1]
        for k in range(part_start[part], end):
            i = part_dof[k]
            node = dof_node[i]
            mass = body_mass_scale_in[pack, node_body[node], lane] * node_mass_in[pack, node, lane]
            s = mat33(mass, real(0.0), real(0.0), real(0.0), mass, real(0.0), real(0.0), real(0.0), mass)
            for p in range(row_start[i], row_start[i + 1]):
                b = 9 * row_block[p]
                m = mat33()
                for c in range(9):
                    m[c // 3, c % 3] = lower_in[pack, b + c, lane]
                s -= m * side_block(y_out, pack, lane, size, l_col[row_block[p]])
            d = 6 * i
            if k == end - 1:
                inverse = inverse_root(s)
                if inverse[0, 0] > real(0.0):
                    for r in range(3):
                        for c in range(r + 1):
                            diagonal_out[pack, d + (r * (r + 1)) // 2 + c, lane] = inverse[r, c]
                restore(a_out, root_in, pack, lane, part, i)
                return
            inverse = mat33()
            for r in range(3):
                for c in range(r + 1):
                    inverse[r, c] = diagonal_out[pack, d + (r * (r + 1)) // 2 + c, lane]
            s = inverse * s
            for side in range(3):
                for c in range(3):
                    y_out[pack, 3 * (side * size + i) + c, lane] = s[c, side]

    @wp.kernel(module=module, enable_backward=False)
    def residual(
        # Symbolic
        part_start: wp.array(dtype=wp.int32),
        part_dof: wp.array(dtype=wp.int32),
        dof_part: wp.array(dtype=wp.int32),
        # Model
        dof_node: wp.array(dtype=wp.int32),
        node_body: wp.array(dtype=wp.int32),
        neighbour_start: wp.array(dtype=wp.int32),
        neighbour: wp.array(dtype=wp.int32),
        neighbour_block: wp.array(dtype=wp.int32),
        # Workspace in
        body_mass_scale_in: wp.array3d(dtype=real),
        node_mass_in: wp.array3d(dtype=real),
        excess_in: wp.array3d(dtype=real),
        a_in: wp.array3d(dtype=real),
        b_in: wp.array3d(dtype=real),
        u_in: wp.array3d(dtype=real),
        # Workspace out
        y_out: wp.array3d(dtype=real),
    ):
        """y = b - A u by differences, of the dofs of marked bodies: b_i - m_i u_i - sum A_ij (u_j - u_i)."""
        pack, item, lane = wp.tid()
        first = int(0)
        last = part_dof.shape[0]
        if wp.static(world_fastest):
            first = item
            last = item + 1
        for k in range(first, last):
            i = part_dof[k]
            if excess_in[pack, dof_part[i], lane] > real(0.0):
                node = dof_node[i]
                mass = body_mass_scale_in[pack, node_body[node], lane] * node_mass_in[pack, node, lane]
                u = vec3(u_in[pack, 3 * i, lane], u_in[pack, 3 * i + 1, lane], u_in[pack, 3 * i + 2, lane])
                y = vec3(b_in[pack, 3 * i, lane], b_in[pack, 3 * i + 1, lane], b_in[pack, 3 * i + 2, lane]) - u * mass
                for p in range(neighbour_start[i], neighbour_start[i + 1]):
                    j = neighbour[p]
                    code = neighbour_block[p]
                    m = mat33()
                    b = 9 * wp.where(code >= 0, code, ~code)
                    for c in range(9):
                        m[c // 3, c % 3] = a_in[pack, b + c, lane]
                    if code < 0:
                        m = wp.transpose(m)
                    d = vec3(u_in[pack, 3 * j, lane], u_in[pack, 3 * j + 1, lane], u_in[pack, 3 * j + 2, lane]) - u
                    y -= m * d
                for c in range(3):
                    y_out[pack, 3 * i + c, lane] = y[c]

    @wp.kernel(module=module, enable_backward=False)
    def balance(
        # Symbolic
        part_start: wp.array(dtype=wp.int32),
        part_dof: wp.array(dtype=wp.int32),
        # Model
        dof_node: wp.array(dtype=wp.int32),
        node_body: wp.array(dtype=wp.int32),
        # Workspace in
        body_mass_scale_in: wp.array3d(dtype=real),
        node_mass_in: wp.array3d(dtype=real),
        excess_in: wp.array3d(dtype=real),
        b_in: wp.array3d(dtype=real),
        u_in: wp.array3d(dtype=real),
        # Workspace out
        y_out: wp.array3d(dtype=real),
    ):
        """Let the residuals of a marked body sum up to b - m u, in which nothing internal stands; spread by mass."""
        pack, part, lane = wp.tid()
        if excess_in[pack, part, lane] <= real(0.0):
            return
        total = wp.float64(0.0)
        left = wp.vec3d()
        for k in range(part_start[part], part_start[part + 1]):
            i = part_dof[k]
            node = dof_node[i]
            mass = body_mass_scale_in[pack, node_body[node], lane] * node_mass_in[pack, node, lane]
            total += wp.float64(mass)
            for c in range(3):
                row = 3 * i + c
                own = wp.float64(b_in[pack, row, lane]) - wp.float64(mass) * wp.float64(u_in[pack, row, lane])
                left[c] = left[c] + own - wp.float64(y_out[pack, row, lane])
        left = left / total
        for k in range(part_start[part], part_start[part + 1]):
            i = part_dof[k]
            node = dof_node[i]
            mass = body_mass_scale_in[pack, node_body[node], lane] * node_mass_in[pack, node, lane]
            for c in range(3):
                y_out[pack, 3 * i + c, lane] = y_out[pack, 3 * i + c, lane] + mass * real(left[c])

    return SimpleNamespace(
        balance=balance,
        gauge_shares=gauge_shares,
        mark=mark,
        mend_root=mend_root,
        residual=residual,
        side_block=side_block,
        inverse_root=inverse_root,
        restore=restore,
    )


@cache
def panel_kernels(variant: Variant) -> SimpleNamespace:
    """The same for a factor in panels, whose substitution is that of all other sides."""
    real = variant.real
    module = variant.module("free_bodies.panel")
    k = kernels(variant)
    side_block, inverse_root, restore = k.side_block, k.inverse_root, k.restore
    shared = cholesky_panels.kernels(variant)
    block, store = shared.block, shared.store

    @wp.kernel(module=module, enable_backward=False)
    def place_masses(
        size: int,
        parts: int,
        # Symbolic
        dof_part: wp.array(dtype=wp.int32),
        # Model
        dof_node: wp.array(dtype=wp.int32),
        node_body: wp.array(dtype=wp.int32),
        # Workspace in
        body_mass_scale_in: wp.array3d(dtype=real),
        node_mass_in: wp.array3d(dtype=real),
        excess_in: wp.array3d(dtype=real),
        # Workspace out
        skipped_out: wp.array2d(dtype=wp.int32),
        y_out: wp.array3d(dtype=real),
    ):
        """Mass of the dofs of marked bodies along three axes, one right-hand side each; worlds without are skipped."""
        pack, i, lane = wp.tid()
        marked = int(0)
        for part in range(parts):
            if excess_in[pack, part, lane] > real(0.0):
                marked = 1
        if i == 0:
            skipped_out[pack + lane, 0] = 1 - marked
        if marked == 0:
            return
        mass = real(0.0)
        part = dof_part[i]
        if part >= 0:
            if excess_in[pack, part, lane] > real(0.0):
                node = dof_node[i]
                mass = body_mass_scale_in[pack, node_body[node], lane] * node_mass_in[pack, node, lane]
        for side in range(3):
            for c in range(3):
                y_out[pack, 3 * (side * size + i) + c, lane] = wp.where(c == side, mass, real(0.0))

    @wp.kernel(module=module, enable_backward=False)
    def mend_panel(
        size: int,
        # Symbolic
        part_start: wp.array(dtype=wp.int32),
        part_dof: wp.array(dtype=wp.int32),
        position: wp.array(dtype=wp.int32),
        column: wp.array(dtype=wp.vec4i),
        # Workspace in
        excess_in: wp.array3d(dtype=real),
        root_in: wp.array3d(dtype=real),
        y_in: wp.array3d(dtype=real),
        # Workspace out
        a_out: wp.array3d(dtype=real),
        lower_out: wp.array2d(dtype=real),
    ):
        """Last column of the inverse of a marked body's last panel, as another last pivot has it."""
        pack, part, lane = wp.tid()
        if excess_in[pack, part, lane] <= real(0.0):
            return
        w = pack + lane
        root = part_dof[part_start[part + 1] - 1]
        entry = column[position[root]]
        wide = entry[2]
        old = wp.transpose(block(lower_out, w, entry[3] + entry[1] * wide + entry[1], wide * wide))
        back = wp.inverse(old)
        inverse = inverse_root(back * side_block(y_in, pack, lane, size, root))
        if inverse[0, 0] > real(0.0):
            factor = wp.transpose(inverse * back)
            for p in range(entry[1] + 1):
                place = entry[3] + p * wide + entry[1]
                store(lower_out, w, place, wide * wide, block(lower_out, w, place, wide * wide) * factor)
        restore(a_out, root_in, pack, lane, part, root)

    return SimpleNamespace(place_masses=place_masses, mend_panel=mend_panel)
