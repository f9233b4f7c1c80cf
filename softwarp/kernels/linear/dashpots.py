"""Dashpots along the edges of a body with flat or inverted elements, whose stiffness buries all else in rounding.

They push and pull two nodes alike: no body gains momentum, and the blocks of a row of A sum up to what they did.
Theory: docs/theory/corotational.md, "Upright elements".
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant

FLAT = 0.8  # 1 - J from which on an element counts as flat
BEARABLE = 2.0**20  # largest entry of A in masses of the body, up to which its pivots stand
SHARE = 2.0**-18  # of the excess over that: more than rounding, 2^-24 of the largest entry, makes of a pivot


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels for one scalar type."""
    real = variant.real
    world_fastest = variant.world_fastest
    module = variant.module("dashpots")

    @wp.kernel(module=module, enable_backward=False)
    def gauge(
        lanes: int,
        # Symbolic
        part_start: wp.array(dtype=wp.int32),
        part_dof: wp.array(dtype=wp.int32),
        # Model
        dof_node: wp.array(dtype=wp.int32),
        node_body: wp.array(dtype=wp.int32),
        # State
        compression_in: wp.array2d(dtype=real),
        # Workspace in
        body_mass_scale_in: wp.array3d(dtype=real),
        node_mass_in: wp.array3d(dtype=real),
        a_in: wp.array3d(dtype=real),
        # Workspace out
        strength_out: wp.array3d(dtype=real),
        held_out: wp.array3d(dtype=wp.int32),
    ):
        """Dashpots of a part: 0 in worlds that begin a step without flat elements, which are nearly all."""
        pack, part, lane = wp.tid()
        world = pack * lanes + lane
        strength_out[pack, part, lane] = real(0.0)
        if world >= compression_in.shape[0]:
            return
        if compression_in[world, 0] < real(FLAT):
            return
        largest = real(0.0)
        mass = real(0.0)
        for k in range(part_start[part], part_start[part + 1]):
            dof = part_dof[k]
            node = dof_node[dof]
            mass += body_mass_scale_in[pack, node_body[node], lane] * node_mass_in[pack, node, lane]
            for c in range(3):
                largest = wp.max(largest, a_in[pack, 9 * dof + 4 * c, lane])
        excess = largest - mass * real(BEARABLE)
        if excess > real(0.0):
            strength_out[pack, part, lane] = excess * real(SHARE)
            held_out[pack, 0, lane] = 1

    @wp.kernel(module=module, enable_backward=False)
    def dampen(
        # Symbolic
        dof_part: wp.array(dtype=wp.int32),
        # Model
        neighbour_start: wp.array(dtype=wp.int32),
        neighbour: wp.array(dtype=wp.int32),
        neighbour_block: wp.array(dtype=wp.int32),
        # Workspace in
        strength_in: wp.array3d(dtype=real),
        # Workspace out
        a_out: wp.array3d(dtype=real),
    ):
        """Add the dashpots of edges to A."""
        pack, item, lane = wp.tid()
        first = int(0)
        last = dof_part.shape[0]
        if wp.static(world_fastest):
            first = item
            last = item + 1
        for i in range(first, last):
            strength = strength_in[pack, dof_part[i], lane]
            if strength > real(0.0):
                total = real(0.0)
                for p in range(neighbour_start[i], neighbour_start[i + 1]):
                    code = neighbour_block[p]
                    if neighbour[p] != i:
                        total += strength
                        if code >= 0:  # each pair of nodes has one block
                            for c in range(3):
                                row = 9 * code + 4 * c
                                a_out[pack, row, lane] = a_out[pack, row, lane] - strength
                for c in range(3):
                    row = 9 * i + 4 * c
                    a_out[pack, row, lane] = a_out[pack, row, lane] + total

    return SimpleNamespace(gauge=gauge, dampen=dampen)
