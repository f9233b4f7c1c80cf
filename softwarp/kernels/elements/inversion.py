"""Volume ratios J = det F of linear tetrahedra, and how many are inside out. Theory: docs/theory/corotational.md.

A step tells of each world the largest 1 - J of its elements, and how many have J <= 0. A GPU finds both at once. On a
CPU, where lanes hold several worlds, the second looks again at worlds in which the first has reached 1.

Forces of inverted elements are large and far from linear. In worlds that begin a step with some, corners move apart or
together by at most ``FARTHEST`` edges in it: all velocities are shortened by one factor until they do not.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra import single
from softwarp.kernels.algebra.lanes import Variant
from softwarp.kernels.elements import access, corotational

CHUNK = 16  # tets of a GPU's thread; a thread of a CPU takes all
PARTS = 32  # threads of a GPU that share the tets of a world
FARTHEST = 0.5  # edges that corners move apart in one step of a world with inverted elements


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
    vec3 = wp.types.vector(3, real)

    @wp.func
    def velocity(node_dof: wp.array(dtype=wp.int32), u: wp.array3d(dtype=real), pack: int, lane: int, node: int):
        """Of a node; nodes that are held rest."""
        dof = node_dof[node]
        if dof < 0:
            return vec3()
        return vector_at(u, pack, lane, 3 * dof)

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

    @wp.kernel(module=module, enable_backward=False)
    def strides(
        lanes: int,
        h: real,
        # Model
        tet_node: wp.array2d(dtype=wp.int32),
        tet_size: wp.array(dtype=real),
        node_dof: wp.array(dtype=wp.int32),
        # State
        compression_in: wp.array2d(dtype=real),
        # Workspace in
        u_in: wp.array3d(dtype=real),
        # Workspace out
        stride_out: wp.array3d(dtype=real),
    ):
        """Square of the farthest that corners of some tets move apart, in edges; 0 in worlds without inverted ones.

        An edge is that of a cube of six such tets.
        """
        pack, part, lane = wp.tid()
        world = pack * lanes + lane
        stride_out[pack, part, lane] = real(0.0)
        if world >= compression_in.shape[0]:
            return
        if compression_in[world, 0] < real(1.0):
            return
        most = real(0.0)
        stride = int(1)
        if wp.static(world_fastest):
            stride = PARTS
        for i in range(part, tet_size.shape[0], stride):
            edge = wp.pow(wp.abs(tet_size[i]) * real(6.0), real(1.0 / 3.0))
            origin = velocity(node_dof, u_in, pack, lane, tet_node[i, 0])
            for corner in range(1, 4):
                d = (velocity(node_dof, u_in, pack, lane, tet_node[i, corner]) - origin) * (h / edge)
                most = wp.max(most, wp.dot(d, d))
        stride_out[pack, part, lane] = most

    @wp.kernel(module=module, enable_backward=False)
    def hold_back(
        parts: int,
        # Model
        dof_free: wp.array2d(dtype=real),
        # Workspace in
        stride_in: wp.array3d(dtype=real),
        # Workspace out
        u_out: wp.array3d(dtype=real),
        held_out: wp.array3d(dtype=wp.int32),
    ):
        """Worlds whose corners would move too far apart go a share of their way, and are told."""
        pack, item, lane = wp.tid()
        most = real(0.0)
        for part in range(parts):
            most = wp.max(most, stride_in[pack, part, lane])
        if most > real(FARTHEST * FARTHEST):
            share = real(FARTHEST) / wp.sqrt(most)
            held_out[pack, 0, lane] = 1
            first = int(0)
            last = dof_free.shape[0]
            if wp.static(world_fastest):
                first = item
                last = item + 1
            for dof in range(first, last):
                for c in range(3):
                    if dof_free[dof, c] != real(0.0):
                        u_out[pack, 3 * dof + c, lane] = share * u_out[pack, 3 * dof + c, lane]

    return SimpleNamespace(compression=compression, count=count, strides=strides, hold_back=hold_back)
