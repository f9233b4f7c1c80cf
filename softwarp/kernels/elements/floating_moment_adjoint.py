"""Gradients of a floating frame's moments by the amplitudes that they are of. Theory: docs/theory/adjoint.md.

A moment of the body is a sum over its modes with the constants D_lk, G_k = sum_l q_l D_lk (``floating_adjoint``).
"""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant, single_worlds
from softwarp.model.floating import RIGID

# Sixteen amplitudes side by side; each has the sums over modes k and entries c in their order.
_MOMENT_BARS = """
#pragma clang fp contract(off)
const int lanes = moment_bar.shape[2];
const REAL* bar = &wp::index(moment_bar, pack, 9 * begin, lane);
const REAL* own = &wp::index(mode_bar, pack, mode, lane);
REAL* out = &wp::index(bar_out, world, mode);
for (int first = 0; first < count; first += 16) {
    REAL total[16];
    for (int l = 0; l < 16; ++l) total[l] = first + l < count ? own[(first + l) * lanes] : 0;
    for (int k = 0; k < count; ++k) {
        if (k > 0 && k < rigid) continue;
        for (int c = 0; c < 9; ++c) {
            const REAL share = bar[(9 * k + c) * lanes];
            const REAL* column = &wp::index(moments, at) + (9 * k + c) * stride + first;
            for (int l = 0; l < 16; ++l) total[l] += column[l] * share;
        }
    }
    for (int l = 0; l < 16; ++l)
        if (first + l >= rigid && first + l < count) out[first + l] = out[first + l] + total[l];
}
"""


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels of one scalar type."""
    real = variant.real
    module = variant.module("adjoint.floating.moment")

    @wp.kernel(module=module, enable_backward=False)
    def moment_bars(
        lanes: int,
        # Model
        moment_body: wp.array(dtype=wp.int32),
        moment_start: wp.array(dtype=wp.int32),
        moment_first: wp.array(dtype=wp.int32),
        moment_stride: wp.array(dtype=wp.int32),
        moments: wp.array(dtype=real),
        first: wp.array(dtype=wp.int32),
        modes: wp.array(dtype=wp.int32),
        # Workspace in
        moment_bar_in: wp.array3d(dtype=real),
        mode_bar_in: wp.array3d(dtype=real),
        # State out
        bar_out: wp.array2d(dtype=real),
    ):
        """Add to the gradient by one amplitude what moments have, and ``mode_bar_in``."""
        pack, item, lane = wp.tid()
        f = moment_body[item]
        own = item - moment_start[f]
        world = pack * lanes + lane
        if own >= wp.static(RIGID) and own < modes[f] and world < bar_out.shape[0]:
            stride = moment_stride[item]
            total = mode_bar_in[pack, first[f] + own, lane]
            for k in range(modes[f]):
                if k == 0 or k >= wp.static(RIGID):
                    at = moment_first[moment_start[f] + k] + own
                    for c in range(9):
                        total += moments[at + c * stride] * moment_bar_in[pack, 9 * (moment_start[f] + k) + c, lane]
            bar_out[world, first[f] + own] = bar_out[world, first[f] + own] + total

    @wp.func_native(_MOMENT_BARS.replace("REAL", "double" if real is wp.float64 else "float"))
    def add_moments(
        moments: wp.array(dtype=real),
        at: int,
        stride: int,
        count: int,
        begin: int,
        rigid: int,
        moment_bar: wp.array3d(dtype=real),
        mode_bar: wp.array3d(dtype=real),
        mode: int,
        pack: int,
        lane: int,
        world: int,
        bar_out: wp.array2d(dtype=real),
    ):
        """What ``moment_bars`` adds for all amplitudes of one body."""

    @wp.kernel(module=module, enable_backward=False)
    def body_moment_bars(
        lanes: int,
        # Model
        moment_start: wp.array(dtype=wp.int32),
        moment_first: wp.array(dtype=wp.int32),
        moment_stride: wp.array(dtype=wp.int32),
        moments: wp.array(dtype=real),
        first: wp.array(dtype=wp.int32),
        modes: wp.array(dtype=wp.int32),
        # Workspace in
        moment_bar_in: wp.array3d(dtype=real),
        mode_bar_in: wp.array3d(dtype=real),
        # State out
        bar_out: wp.array2d(dtype=real),
    ):
        """``moment_bars`` of all amplitudes of one body, on a CPU."""
        pack, f, lane = wp.tid()
        world = pack * lanes + lane
        begin = moment_start[f]
        if world < bar_out.shape[0]:
            add_moments(
                moments,
                moment_first[begin],
                moment_stride[begin],
                modes[f],
                begin,
                wp.static(RIGID),
                moment_bar_in,
                mode_bar_in,
                first[f],
                pack,
                lane,
                world,
                bar_out,
            )

    return SimpleNamespace(moment_bars=moment_bars, body_moment_bars=body_moment_bars)
