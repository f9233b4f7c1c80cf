"""Sizes of what should balance in a world, on a GPU: its rows are shared among threads. Theory: docs/theory/newton.md.

A thread that takes all rows of a world waits for each of them; worlds that repeat steps, or come to rest one by one,
are too few to hide that. Every part sums every ``PARTS``-th row, whatever the number of worlds; one thread sums up.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant

PARTS = 32  # threads that share the rows of a world


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels of a variant of a GPU: ``force_squares`` and ``frame_squares`` over (part, w), the others over w."""
    S, real = variant.S, variant.real
    mul, sqrt = variant.mul, variant.sqrt
    module = variant.module("norms")

    @wp.kernel(module=module, enable_backward=False)
    def force_squares(
        # Model
        dof_count: int,
        node_count: int,
        dof_node: wp.array(dtype=wp.int32),
        force_rows: int,
        # Workspace in
        node_mass_in: wp.array2d(dtype=S),
        node_external_in: wp.array2d(dtype=S),
        node_v0_in: wp.array2d(dtype=S),
        tet_force_in: wp.array2d(dtype=S),
        b_in: wp.array2d(dtype=S),
        f_scale: real,
        inertia: real,
        # Workspace out
        part_out: wp.array2d(dtype=S),
    ):
        """Squares of ``assembly.force_norms``, of every ``PARTS``-th dof and row."""
        part, w = wp.tid()
        imbalance = S(real(0.0))
        forces = S(real(0.0))
        for dof in range(part, dof_count, wp.static(PARTS)):
            node = dof_node[dof]
            for c in range(3):
                r = b_in[w, 3 * dof + c]
                imbalance += mul(r, r)
                if node < node_count:
                    f = node_external_in[w, 3 * node + c] * f_scale
                    p = mul(node_mass_in[w, node], node_v0_in[w, 3 * node + c]) * inertia
                    forces += mul(f, f) + mul(p, p)
        for row in range(part, force_rows, wp.static(PARTS)):
            f = tet_force_in[w, row] * f_scale
            forces += mul(f, f)
        part_out[w, 2 * part] = imbalance
        part_out[w, 2 * part + 1] = forces

    @wp.kernel(module=module, enable_backward=False)
    def force_norms(
        # Workspace in
        part_in: wp.array2d(dtype=S),
        # Workspace out
        norm_out: wp.array2d(dtype=S),
    ):
        """Row 0: the imbalance; row 1: the size of the forces that should balance."""
        w = wp.tid()
        for row in range(2):
            total = S(real(0.0))
            for part in range(wp.static(PARTS)):
                total += part_in[w, 2 * part + row]
            norm_out[w, row] = sqrt(total)

    @wp.kernel(module=module, enable_backward=False)
    def frame_squares(
        # Model
        frame_count: int,
        segment_count: int,
        # Workspace in
        external_in: wp.array2d(dtype=S),
        momentum_in: wp.array2d(dtype=S),
        segment_force_in: wp.array2d(dtype=S),
        f_scale: real,
        # Workspace out
        part_out: wp.array2d(dtype=S),
    ):
        """Squares of ``frames.inertia.frame_norms``, of every ``PARTS``-th row."""
        part, w = wp.tid()
        total = S(real(0.0))
        for row in range(part, 6 * frame_count, wp.static(PARTS)):
            f = external_in[w, row] * f_scale
            total += mul(f, f) + mul(momentum_in[w, row], momentum_in[w, row])
        for row in range(part, 12 * segment_count, wp.static(PARTS)):
            f = segment_force_in[w, row] * f_scale
            total += mul(f, f)
        part_out[w, 2 * part] = total

    @wp.kernel(module=module, enable_backward=False)
    def frame_norms(
        # Workspace in
        part_in: wp.array2d(dtype=S),
        # Workspace out
        norm_out: wp.array2d(dtype=S),
    ):
        """Add forces, moments and momenta of frames to the size of the forces that should balance (row 1)."""
        w = wp.tid()
        total = mul(norm_out[w, 1], norm_out[w, 1])
        for part in range(wp.static(PARTS)):
            total += part_in[w, 2 * part]
        norm_out[w, 1] = sqrt(total)

    return SimpleNamespace(
        force_squares=force_squares, force_norms=force_norms, frame_squares=frame_squares, frame_norms=frame_norms
    )
