"""Volume ratios J = det F of linear tetrahedra, and how many are inside out. Theory: docs/theory/corotational.md.

A step tells of each world the largest 1 - J of its elements, and how many have J <= 0. A GPU finds both at once. On a
CPU, where lanes hold several worlds, the second looks again at worlds in which the first has reached 1.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.elements import access, corotational

CHUNK = 16  # tets of a GPU's thread; a thread of a CPU takes all


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels for one scalar type."""
    S = variant.S
    real = variant.real
    world_fastest = variant.world_fastest
    module = variant.module("inversion")
    at = access.functions(variant)
    T, edges, sizes, largest = at.inner.S, at.all_edges, at.all_numbers, at.largest
    volume_ratio = corotational.functions(at.inner).volume_ratio
    vector_at = single.functions(variant).vector_at

    @wp.kernel(module=module, enable_backward=False)
    def compression(
        # Model
        tet_node: wp.array2d(dtype=wp.int32),
        tet_size: wp.array(dtype=real),
        # Workspace in
        node_x_in: wp.array2d(dtype=S),
        # Workspace out
        compression_out: wp.array2d(dtype=S),
        inverted_out: wp.array2d(dtype=wp.int32),
    ):
        """Largest 1 - J of some tets, and on a GPU how many have J <= 0, into what others have found.

        ``tet_size`` is that of ``corotational``.
        """
        w, part = wp.tid()
        first = 0
        last = -(-tet_size.shape[0] // wp.static(at.per_item))
        if wp.static(world_fastest):
            part, w = wp.tid()
            first = CHUNK * part
            last = wp.min(first + CHUNK, last)
        most = T(real(0.0))
        found = int(0)
        for i in range(first, last):
            J = volume_ratio(edges(node_x_in, w, tet_node, i), sizes(tet_size, i))
            most = wp.max(most, T(real(1.0)) - J)
            if wp.static(world_fastest):
                if J <= real(0.0):
                    found += 1
        if wp.static(world_fastest):
            wp.atomic_max(compression_out, w, 0, most)  # the same for any order
            if found > 0:
                wp.atomic_add(inverted_out, w, 0, found)  # a sum of integers: the same for any order
        else:
            compression_out[w, 0] = wp.max(compression_out[w, 0], largest(most))

    @wp.kernel(module=module, enable_backward=False)
    def count(
        # Model
        tet_node: wp.array2d(dtype=wp.int32),
        # Workspace in
        node_x_in: wp.array3d(dtype=real),
        compression_in: wp.array3d(dtype=real),
        # Workspace out
        inverted_out: wp.array3d(dtype=wp.int32),
    ):
        """Add the number of tets that are inside out or flat; on a CPU."""
        pack, lane = wp.tid()
        if compression_in[pack, 0, lane] < real(1.0):
            return
        found = int(0)
        for i in range(tet_node.shape[0]):
            origin = vector_at(node_x_in, pack, lane, 3 * tet_node[i, 0])
            b = vector_at(node_x_in, pack, lane, 3 * tet_node[i, 1]) - origin
            c = vector_at(node_x_in, pack, lane, 3 * tet_node[i, 2]) - origin
            d = vector_at(node_x_in, pack, lane, 3 * tet_node[i, 3]) - origin
            if wp.dot(b, wp.cross(c, d)) <= real(0.0):
                found += 1
        inverted_out[pack, 0, lane] += found

    return SimpleNamespace(compression=compression, count=count)
