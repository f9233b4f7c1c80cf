"""Points of collision surfaces in the adjoint of contacts: nodes of their own, whose motion is that of others.

An embedded point moves with the weighted mean of four nodes. Where contacts are pulled back it has a number behind all
nodes, and velocities behind those of all dofs; what it has goes to its carriers. Theory: docs/theory/adjoint.md.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant, single_worlds


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels for one scalar type, on single worlds: (pack, row, lane)."""
    real = variant.real
    module = variant.module("adjoint.embedded")
    one = single.functions(variant)
    vector_at, put = one.vector_at, one.put

    @wp.kernel(module=module, enable_backward=False)
    def spread(
        lanes: int,
        nodes: int,
        points: int,
        moves: bool,
        # Model
        carrier: wp.array2d(dtype=wp.int32),
        carrier_weight: wp.array2d(dtype=real),
        node_dof: wp.array(dtype=wp.int32),
        # State
        whole_in: wp.array2d(dtype=real),
        # State out
        bar_out: wp.array2d(dtype=real),
    ):
        """Add what nodes and embedded points of one world have to the gradients by nodes.

        Those by velocities (``moves``) are none of fixed nodes.
        """
        pack, lane = wp.tid()
        world = pack * lanes + lane
        if world < bar_out.shape[0]:
            for row in range(3 * nodes):
                bar_out[world, row] = bar_out[world, row] + whole_in[world, row]
            for point in range(points):
                for j in range(4):
                    node = carrier[point, j]
                    if node_dof[node] >= 0 or not moves:
                        for c in range(3):
                            share = carrier_weight[point, j] * whole_in[world, 3 * (nodes + point) + c]
                            bar_out[world, 3 * node + c] = bar_out[world, 3 * node + c] + share

    @wp.kernel(module=module, enable_backward=False)
    def spread_listed(
        lanes: int,
        # Model
        touched: wp.array(dtype=wp.int32),
        moves: wp.array(dtype=wp.int32),
        start: wp.array(dtype=wp.int32),
        source: wp.array(dtype=wp.int32),
        weight: wp.array(dtype=real),
        # State
        whole_x_in: wp.array2d(dtype=real),
        whole_v_in: wp.array2d(dtype=real),
        # Workspace out
        by_x_out: wp.array3d(dtype=real),
        by_v_out: wp.array3d(dtype=real),
    ):
        """The same for one node that may touch something, into rows of listed nodes."""
        pack, item, lane = wp.tid()
        world = pack * lanes + lane
        if world < whole_x_in.shape[0]:
            row = 3 * touched[item]
            by_x = vector_at(by_x_out, pack, lane, row)
            by_v = vector_at(by_v_out, pack, lane, row)
            for i in range(start[item], start[item + 1]):
                for c in range(3):
                    by_x[c] = by_x[c] + weight[i] * whole_x_in[world, 3 * source[i] + c]
                    if moves[item] != 0:
                        by_v[c] = by_v[c] + weight[i] * whole_v_in[world, 3 * source[i] + c]
            put(by_x_out, pack, lane, row, by_x)
            put(by_v_out, pack, lane, row, by_v)

    return SimpleNamespace(spread=spread, spread_listed=spread_listed)


@cache
def element_kernels(variant: Variant) -> SimpleNamespace:
    """Kernels on the elements of a variant, (w, row)."""
    S, real, world_fastest = variant.S, variant.real, variant.world_fastest
    module = variant.module("adjoint.embedded_elements")

    @wp.kernel(module=module, enable_backward=False)
    def embed(
        dofs: int,
        # Model
        carrier: wp.array2d(dtype=wp.int32),
        carrier_weight: wp.array2d(dtype=real),
        node_dof: wp.array(dtype=wp.int32),
        # Workspace out
        velocity_out: wp.array2d(dtype=S),
    ):
        """Velocity of one embedded point, behind those of the dofs; fixed nodes stand still."""
        w, point = wp.tid()
        if wp.static(world_fastest):
            point, w = wp.tid()
        for c in range(3):
            total = S(real(0.0))
            for j in range(4):
                dof = node_dof[carrier[point, j]]
                if dof >= 0:
                    total += velocity_out[w, 3 * dof + c] * carrier_weight[point, j]
            velocity_out[w, 3 * (dofs + point) + c] = total

    return SimpleNamespace(embed=embed)
