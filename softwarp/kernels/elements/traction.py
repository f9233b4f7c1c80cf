"""Tractions on faces of soft bodies: dead loads per area. Equations: docs/theory/traction.md."""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels for one scalar type."""
    S = variant.S
    real = variant.real
    world_fastest = variant.world_fastest
    module = variant.module("traction")

    @wp.kernel(module=module, enable_backward=False)
    def add_tractions(
        # Model
        loaded_node: wp.array(dtype=wp.int32),
        entry_start: wp.array(dtype=wp.int32),
        entry_traction: wp.array(dtype=wp.int32),
        entry_share: wp.array(dtype=real),
        # Workspace in
        traction_in: wp.array2d(dtype=S),
        # Workspace out
        node_external_out: wp.array2d(dtype=S),
    ):
        """Add to the external force of one node what all tractions give it: t times the integral of its shape."""
        w, item = wp.tid()
        if wp.static(world_fastest):
            item, w = wp.tid()
        row = 3 * loaded_node[item]
        for c in range(3):
            total = S(real(0.0))
            for p in range(entry_start[item], entry_start[item + 1]):
                total += traction_in[w, 3 * entry_traction[p] + c] * entry_share[p]
            node_external_out[w, row + c] += total

    @wp.kernel(module=module, enable_backward=False)
    def by_tractions(
        lanes: int,
        items: int,
        # Model
        loaded_node: wp.array(dtype=wp.int32),
        entry_start: wp.array(dtype=wp.int32),
        entry_traction: wp.array(dtype=wp.int32),
        entry_share: wp.array(dtype=real),
        # State
        force_bar_in: wp.array2d(dtype=real),
        # State out
        traction_bar_out: wp.array2d(dtype=real),
    ):
        """Gradient of a loss by one traction, from that by the external forces of nodes."""
        pack, traction, lane = wp.tid()
        world = pack * lanes + lane
        if world < traction_bar_out.shape[0]:
            for c in range(3):
                total = real(0.0)
                for item in range(items):
                    for p in range(entry_start[item], entry_start[item + 1]):
                        if entry_traction[p] == traction:
                            total += entry_share[p] * force_bar_in[world, 3 * loaded_node[item] + c]
                traction_bar_out[world, 3 * traction + c] = total

    return SimpleNamespace(add_tractions=add_tractions, by_tractions=by_tractions)
