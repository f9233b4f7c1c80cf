"""Sums of the adjoint of a step, by node, body and world. Theory: docs/theory/adjoint.md.

With p, the adjoint of the unknowns, and the gradients y_x and y_v by the positions and velocities that a step leads to,

    A p = y_v + h y_x,   by x0: y_x + sums over elements and rows,   by v0: M p,   by node forces: h p.

State arrays are ``[world, row]``; workspace arrays ``[pack, row, lane]``, or ``[w, row]`` of elements.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import packs, single
from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.elements import assembly
from softwarp.kernels.elements.adjoint import PARAMETERS, ROWS


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels for one scalar type and memory order."""
    S, real, mul, world_fastest = variant.S, variant.real, variant.mul, variant.world_fastest
    module = variant.module("adjoint.step")
    one, of_packs = single.functions(variant), packs.adjoint_functions(real)
    vec3, vector_at = one.vec3, one.vector_at
    give_nodes, give_forces, seed_of_pack = of_packs.give_nodes, of_packs.give_forces, of_packs.seed

    @wp.func
    def world_vector(array: wp.array2d(dtype=real), world: int, row: int):
        """Vector in three rows of a state array."""
        return vec3(array[world, row], array[world, row + 1], array[world, row + 2])

    @wp.func
    def rows_of(part: int, count: int):
        """First and last item of a thread."""
        if wp.static(world_fastest):
            return part, part + 1
        return 0, count

    @wp.kernel(module=module, enable_backward=False)
    def seed(
        h: real,
        lanes: int,
        # Model
        dof_node: wp.array(dtype=wp.int32),
        dof_free: wp.array2d(dtype=real),
        # State
        x_bar_in: wp.array2d(dtype=real),
        v_bar_in: wp.array2d(dtype=real),
        # Workspace out
        seed_out: wp.array3d(dtype=real),
        y_out: wp.array3d(dtype=real),
    ):
        """y_v + h y_x of the dofs, twice; 0 at prescribed scalars. On a GPU, a thread has one; on a CPU as ``nodes``.

        Lanes past the last world repeat it.
        """
        pack, part, lane = wp.tid()
        count = dof_node.shape[0]
        if wp.static(world_fastest):
            row = 3 * dof_node[part]
            for c in range(3):
                value = real(0.0)
                if row < x_bar_in.shape[1]:  # else it is of a frame, which is prescribed
                    value = (v_bar_in[lane, row + c] + h * x_bar_in[lane, row + c]) * dof_free[part, c]
                seed_out[pack, 3 * part + c, lane] = value
                y_out[pack, 3 * part + c, lane] = value
        else:
            first = lane * count / lanes
            last = (lane + 1) * count / lanes
            seed_of_pack(h, dof_node, dof_free, x_bar_in, v_bar_in, pack, first, last, seed_out, y_out)

    @wp.kernel(module=module, enable_backward=False)
    def to_nodes(
        # Model
        node_dof: wp.array(dtype=wp.int32),
        node_volume: wp.array(dtype=real),
        # Workspace in
        dof_v_in: wp.array2d(dtype=S),
        dof_p_in: wp.array2d(dtype=S),
        # Workspace out
        node_v_out: wp.array2d(dtype=S),
        node_p_out: wp.array2d(dtype=S),
        node_mass_p_out: wp.array2d(dtype=S),
    ):
        """Velocity at the end of the step, adjoint p and lumped mass per density times p of one node; 0 if fixed.

        On a CPU of all.
        """
        w, part = wp.tid()
        if wp.static(world_fastest):
            part, w = wp.tid()
        first, last = rows_of(part, node_dof.shape[0])
        for node in range(first, last):
            dof = node_dof[node]
            for c in range(3):
                v = S(real(0.0))
                p = S(real(0.0))
                if dof >= 0:
                    v = dof_v_in[w, 3 * dof + c]
                    p = dof_p_in[w, 3 * dof + c]
                node_v_out[w, 3 * node + c] = v
                node_p_out[w, 3 * node + c] = p
                node_mass_p_out[w, 3 * node + c] = p * node_volume[node]

    corner_sum = assembly.kernels(variant).corner_sum

    @wp.func
    def sum_at(
        node: int,
        corner_start: wp.array(dtype=wp.int32),
        corner: wp.array(dtype=wp.int32),
        node_point_start: wp.array(dtype=wp.int32),
        node_point: wp.array(dtype=wp.int32),
        node_point_weight: wp.array(dtype=real),
        corner_bar: wp.array2d(dtype=S),
        point_bar: wp.array2d(dtype=S),
        w: int,
        out: wp.array2d(dtype=S),
        row_out: int,
    ):
        """Sum of the gradients by corners of elements and by points of rows that one node carries, into three rows."""
        x, y, z = corner_sum(corner_bar, w, corner_start[node], corner_start[node + 1], corner)
        for i in range(node_point_start[node], node_point_start[node + 1]):
            row = 3 * node_point[i]
            weight = node_point_weight[i]
            x += point_bar[w, row] * weight
            y += point_bar[w, row + 1] * weight
            z += point_bar[w, row + 2] * weight
        out[w, row_out] = x
        out[w, row_out + 1] = y
        out[w, row_out + 2] = z

    @wp.kernel(module=module, enable_backward=False)
    def node_sums(
        # Model
        corner_start: wp.array(dtype=wp.int32),
        corner: wp.array(dtype=wp.int32),
        node_point_start: wp.array(dtype=wp.int32),
        node_point: wp.array(dtype=wp.int32),
        node_point_weight: wp.array(dtype=real),
        # Workspace in
        corner_bar_in: wp.array2d(dtype=S),
        point_bar_in: wp.array2d(dtype=S),
        # Workspace out
        node_bar_out: wp.array2d(dtype=S),
    ):
        """See ``sum_at``; of one node, on a CPU of all."""
        w, part = wp.tid()
        if wp.static(world_fastest):
            part, w = wp.tid()
        first, last = rows_of(part, corner_start.shape[0] - 1)
        for node in range(first, last):
            sum_at(
                node,
                corner_start,
                corner,
                node_point_start,
                node_point,
                node_point_weight,
                corner_bar_in,
                point_bar_in,
                w,
                node_bar_out,
                3 * node,
            )

    @wp.kernel(module=module, enable_backward=False)
    def listed_sums(
        count: int,
        # Model
        listed: wp.array(dtype=wp.int32),
        corner_start: wp.array(dtype=wp.int32),
        corner: wp.array(dtype=wp.int32),
        node_point_start: wp.array(dtype=wp.int32),
        node_point: wp.array(dtype=wp.int32),
        node_point_weight: wp.array(dtype=real),
        # Workspace in
        corner_bar_in: wp.array2d(dtype=S),
        point_bar_in: wp.array2d(dtype=S),
        # Workspace out
        listed_bar_out: wp.array2d(dtype=S),
    ):
        """The same of one node of the first ``count`` of a list, in its order."""
        w, part = wp.tid()
        if wp.static(world_fastest):
            part, w = wp.tid()
        first, last = rows_of(part, count)
        for i in range(first, last):
            sum_at(
                listed[i],
                corner_start,
                corner,
                node_point_start,
                node_point,
                node_point_weight,
                corner_bar_in,
                point_bar_in,
                w,
                listed_bar_out,
                3 * i,
            )

    @wp.kernel(module=module, enable_backward=False)
    def node_forces(
        h: real,
        lanes: int,
        # Workspace in
        node_p_in: wp.array3d(dtype=real),
        # State out
        force_bar_out: wp.array2d(dtype=real),
    ):
        """Gradient by the forces on nodes: on a GPU one component, on a CPU a share of a pack's."""
        pack, part, lane = wp.tid()
        count = force_bar_out.shape[1]
        if wp.static(world_fastest):
            force_bar_out[lane, part] = h * node_p_in[pack, part, lane]
        else:
            give_forces(h, node_p_in, pack, lane * count / lanes, (lane + 1) * count / lanes, force_bar_out)

    @wp.kernel(module=module, enable_backward=False)
    def nodes(
        lanes: int,
        # Model
        node_body: wp.array(dtype=wp.int32),
        # Workspace in
        density_in: wp.array3d(dtype=real),
        node_mass_p_in: wp.array3d(dtype=real),
        node_bar_in: wp.array3d(dtype=real),
        # State out
        x_bar_out: wp.array2d(dtype=real),
        v_bar_out: wp.array2d(dtype=real),
    ):
        """Gradients by positions and velocities at the start of the step; on a GPU, a thread has one node.

        On a CPU it has its share of those of a pack.
        """
        pack, part, lane = wp.tid()
        count = node_body.shape[0]
        if wp.static(world_fastest):
            density = density_in[pack, node_body[part], lane]
            for c in range(3):
                row = 3 * part + c
                x_bar_out[lane, row] = x_bar_out[lane, row] + node_bar_in[pack, row, lane]
                v_bar_out[lane, row] = density * node_mass_p_in[pack, row, lane]
        else:
            first = lane * count / lanes
            last = (lane + 1) * count / lanes
            give_nodes(node_body, density_in, node_mass_p_in, node_bar_in, pack, first, last, x_bar_out, v_bar_out)

    @wp.kernel(module=module, enable_backward=False)
    def bodies(
        h: real,
        lanes: int,
        # Model
        body_node_start: wp.array(dtype=wp.int32),
        node_heft: wp.array(dtype=real),
        # Workspace in
        density_in: wp.array3d(dtype=real),
        body_mass_in: wp.array3d(dtype=real),
        gravity_in: wp.array3d(dtype=real),
        node_v0_in: wp.array3d(dtype=real),
        node_v_in: wp.array3d(dtype=real),
        node_p_in: wp.array3d(dtype=real),
        node_mass_p_in: wp.array3d(dtype=real),
        # State out
        density_bar_out: wp.array2d(dtype=real),
        rayleigh_mass_bar_out: wp.array2d(dtype=real),
    ):
        """Add the gradients by density and by Rayleigh's alpha of one body: of M v0 + h rho V g - (1 + h alpha) M v."""
        pack, body, lane = wp.tid()
        world = pack * lanes + lane
        if world < density_bar_out.shape[0]:
            g = vector_at(gravity_in, pack, lane, 0)
            density = density_in[pack, body, lane]
            scale = body_mass_in[pack, body, lane]
            by_density = real(0.0)
            by_alpha = real(0.0)
            for node in range(body_node_start[body], body_node_start[body + 1]):
                p = vector_at(node_p_in, pack, lane, 3 * node)
                v = vector_at(node_v_in, pack, lane, 3 * node)
                v0 = vector_at(node_v0_in, pack, lane, 3 * node)
                mass_p = vector_at(node_mass_p_in, pack, lane, 3 * node)
                by_density += h * node_heft[node] * wp.dot(p, g) + wp.dot(mass_p, v0 - scale * v)
                by_alpha -= h * density * wp.dot(mass_p, v)
            density_bar_out[world, body] = density_bar_out[world, body] + by_density
            rayleigh_mass_bar_out[world, body] = rayleigh_mass_bar_out[world, body] + by_alpha

    @wp.kernel(module=module, enable_backward=False)
    def moduli(
        h: real,
        lanes: int,
        # Model
        body_tet_start: wp.array(dtype=wp.int32),
        body_tet: wp.array(dtype=wp.int32),
        body_law_start: wp.array(dtype=wp.int32),
        body_law_count: wp.array(dtype=wp.int32),
        # Workspace in
        youngs_in: wp.array3d(dtype=real),
        nu_in: wp.array3d(dtype=real),
        parameter_bar_in: wp.array3d(dtype=real),
        # State out
        youngs_bar_out: wp.array2d(dtype=real),
        nu_bar_out: wp.array2d(dtype=real),
        law_bar_out: wp.array2d(dtype=real),
        rayleigh_stiffness_bar_out: wp.array2d(dtype=real),
    ):
        """Add the gradients by the moduli of one body, by its law's own parameters and by Rayleigh's beta.

        A law without own parameters (``body_law_count`` = 0) has mu = E / 2(1 + nu) and lam = E nu / D with
        D = (1 + nu)(1 - 2 nu). The factor k = h (h + beta) of the stiffness changes by h with beta.
        """
        pack, body, lane = wp.tid()
        world = pack * lanes + lane
        if world < youngs_bar_out.shape[0]:
            first = body_tet_start[body]
            last = body_tet_start[body + 1]
            count = body_law_count[body]
            for n in range(count):
                row = body_law_start[body] + n
                total = real(0.0)
                for i in range(first, last):
                    total += parameter_bar_in[pack, wp.static(ROWS) * body_tet[i] + n, lane]
                law_bar_out[world, row] = law_bar_out[world, row] + total
            by_mu = real(0.0)
            by_lam = real(0.0)
            by_beta = real(0.0)
            for i in range(first, last):
                row = wp.static(ROWS) * body_tet[i]
                by_beta += h * parameter_bar_in[pack, row + wp.static(PARAMETERS), lane]
                if count == 0:
                    by_mu += parameter_bar_in[pack, row, lane]
                    by_lam += parameter_bar_in[pack, row + 1, lane]
            rayleigh_stiffness_bar_out[world, body] = rayleigh_stiffness_bar_out[world, body] + by_beta
            youngs = youngs_in[pack, body, lane]
            nu = nu_in[pack, body, lane]
            one = real(1.0)
            two = real(2.0)
            D = (one + nu) * (one - two * nu)
            by_youngs = by_mu / (two * (one + nu)) + by_lam * nu / D
            by_nu = by_lam * (one + two * nu * nu) / (D * D) - by_mu / (two * (one + nu) * (one + nu))
            youngs_bar_out[world, body] = youngs_bar_out[world, body] + by_youngs
            nu_bar_out[world, body] = nu_bar_out[world, body] + youngs * by_nu

    @wp.kernel(module=module, enable_backward=False)
    def gravity(
        h: real,
        lanes: int,
        node_count: int,
        # Model
        node_body: wp.array(dtype=wp.int32),
        node_heft: wp.array(dtype=real),
        # Workspace in
        density_in: wp.array3d(dtype=real),
        node_p_in: wp.array3d(dtype=real),
        # State out
        gravity_bar_out: wp.array2d(dtype=real),
    ):
        """Add the gradient by gravity of one world."""
        pack, lane = wp.tid()
        world = pack * lanes + lane
        if world < gravity_bar_out.shape[0]:
            total = vec3()
            for node in range(node_count):
                weight = h * density_in[pack, node_body[node], lane] * node_heft[node]
                total += weight * vector_at(node_p_in, pack, lane, 3 * node)
            for c in range(3):
                gravity_bar_out[world, c] = gravity_bar_out[world, c] + total[c]

    @wp.kernel(module=module, enable_backward=False)
    def rest_nodes(
        lanes: int,
        # Model
        corner_start: wp.array(dtype=wp.int32),
        corner: wp.array(dtype=wp.int32),
        # Workspace in
        rest_in: wp.array3d(dtype=real),
        # State out
        rest_bar_out: wp.array2d(dtype=real),
    ):
        """Add the gradient by the rest position of one node."""
        pack, node, lane = wp.tid()
        world = pack * lanes + lane
        if world < rest_bar_out.shape[0]:
            total = vec3()
            for i in range(corner_start[node], corner_start[node + 1]):
                total += vector_at(rest_in, pack, lane, 3 * corner[i])
            for c in range(3):
                rest_bar_out[world, 3 * node + c] = rest_bar_out[world, 3 * node + c] + total[c]

    @wp.kernel(module=module, enable_backward=False)
    def points(
        h: real,
        # Model
        point_node: wp.array2d(dtype=wp.int32),
        point_weight: wp.array2d(dtype=real),
        point_row: wp.array(dtype=wp.int32),
        # Workspace in
        node_v_in: wp.array2d(dtype=S),
        node_p_in: wp.array2d(dtype=S),
        multiplier_in: wp.array2d(dtype=S),
        q_in: wp.array2d(dtype=S),
        # Workspace out
        way_out: wp.array2d(dtype=S),
    ):
        """h T p - h q v of one point of a cable or a chamber."""
        w, point = wp.tid()
        if wp.static(world_fastest):
            point, w = wp.tid()
        row = point_row[point]
        by_p = multiplier_in[w, row] * h
        by_v = q_in[w, row] * -h
        x = S(real(0.0))
        y = S(real(0.0))
        z = S(real(0.0))
        for k in range(4):
            node = 3 * point_node[point, k]
            if node >= 0:
                weight = point_weight[point, k]
                x += (mul(by_p, node_p_in[w, node]) + mul(by_v, node_v_in[w, node])) * weight
                y += (mul(by_p, node_p_in[w, node + 1]) + mul(by_v, node_v_in[w, node + 1])) * weight
                z += (mul(by_p, node_p_in[w, node + 2]) + mul(by_v, node_v_in[w, node + 2])) * weight
        way_out[w, 3 * point] = x
        way_out[w, 3 * point + 1] = y
        way_out[w, 3 * point + 2] = z

    @wp.kernel(module=module, enable_backward=False)
    def kept_sides(
        # Model
        size: int,
        row_dof: wp.array(dtype=wp.int32),
        row_side: wp.array(dtype=wp.int32),
        dof_free: wp.array2d(dtype=real),
        # Workspace in
        row_in: wp.array2d(dtype=S),
        # Workspace out
        y_out: wp.array2d(dtype=S),
    ):
        """One 3-entry of H' among the right-hand sides, of rows that the step has left."""
        w, entry = wp.tid()
        if wp.static(world_fastest):
            entry, w = wp.tid()
        dof = row_dof[entry]
        target = 3 * ((1 + row_side[entry]) * size + dof)
        for c in range(3):
            y_out[w, target + c] = row_in[w, 3 * entry + c] * dof_free[dof, c]

    return SimpleNamespace(
        points=points,
        kept_sides=kept_sides,
        rest_nodes=rest_nodes,
        seed=seed,
        to_nodes=to_nodes,
        node_sums=node_sums,
        listed_sums=listed_sums,
        node_forces=node_forces,
        nodes=nodes,
        bodies=bodies,
        moduli=moduli,
        gravity=gravity,
    )
