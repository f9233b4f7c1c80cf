"""Volumes of chambers and their gradients on a CPU: chamber by chamber, each triangle looked at once.

A triangle (a, b, c) pulls at each of its corners with a third of its area vector, dV/da = (b - a) x (c - a) / 6. On a
GPU every point gathers those of the triangles around it, ``cavity_gradient``; there three times the products are made,
side by side. Theory: docs/theory/cavity.md.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import LANE_COUNT, Variant

# Differences are from a corner of the triangle or a point of the chamber, so that both stay exact to rounding far from
# the origin; V = 1/3 sum (x_i - x_0) . dV/dx_i, as V is homogeneous of degree 3.
_SURFACE = """
#pragma clang fp contract(fast)
typedef REAL number_t NUMBER;
const int* tri = cavity_tri.data;
const number_t* x = (const number_t*)&wp::index(point_x, w, 0);
number_t* g = (number_t*)&wp::index(gradient_out, w, 0);
for (int i = 3 * begin; i < 3 * end; ++i) g[i] = x[i] - x[i];
for (int t = 3 * tri_begin; t < 3 * tri_end; t += 3) {
    const int a = 3 * tri[t], b = 3 * tri[t + 1], c = 3 * tri[t + 2];
    const number_t b0 = x[b] - x[a], b1 = x[b + 1] - x[a + 1], b2 = x[b + 2] - x[a + 2];
    const number_t c0 = x[c] - x[a], c1 = x[c + 1] - x[a + 1], c2 = x[c + 2] - x[a + 2];
    const number_t n0 = b1 * c2 - b2 * c1, n1 = b2 * c0 - b0 * c2, n2 = b0 * c1 - b1 * c0;
    g[a] += n0, g[a + 1] += n1, g[a + 2] += n2;
    g[b] += n0, g[b + 1] += n1, g[b + 2] += n2;
    g[c] += n0, g[c + 1] += n1, g[c + 2] += n2;
}
const REAL sixth = (REAL)1 / (REAL)6;
number_t total = x[3 * begin] - x[3 * begin];
for (int p = 3 * begin; p < 3 * end; p += 3)
    for (int c = 0; c < 3; ++c) {
        g[p + c] *= sixth;
        total += (x[p + c] - x[3 * begin + c]) * g[p + c];
        g[p + c] *= scale;
    }
*(number_t*)&wp::index(volume_out, w, cavity) = total * ((REAL)1 / (REAL)3);
"""


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """``measure_cavity`` for one scalar type of a CPU."""
    S, real = variant.S, variant.real
    name = "double" if real is wp.float64 else "float"
    lanes = f"__attribute__((vector_size({4 * LANE_COUNT}), aligned(4)))" if variant.lanes > 1 else ""
    source = _SURFACE.replace("NUMBER", lanes).replace("REAL", name)

    @wp.func_native(source)
    def surface(
        cavity_tri: wp.array2d(dtype=wp.int32),
        point_x: wp.array2d(dtype=S),
        w: int,
        cavity: int,
        begin: int,
        end: int,
        tri_begin: int,
        tri_end: int,
        scale: real,
        gradient_out: wp.array2d(dtype=S),
        volume_out: wp.array2d(dtype=S),
    ):
        """Volume of one chamber, and its gradient times a scale."""

    @wp.kernel(module=variant.module("cavity"), enable_backward=False)
    def measure_cavity(
        scaled: bool,
        # Model
        cavity_point_start: wp.array(dtype=wp.int32),
        cavity_tri_start: wp.array(dtype=wp.int32),
        cavity_tri: wp.array2d(dtype=wp.int32),
        cavity_area: wp.array(dtype=real),
        # Workspace in
        point_x_in: wp.array2d(dtype=S),
        # Workspace out
        point_gradient_out: wp.array2d(dtype=S),
        volume_out: wp.array2d(dtype=S),
    ):
        """Volume [m^3] of one chamber and dV/dx of its points [m^2]; where scaled, over its area, for a row in metres.

        ``cavity_tri`` names points as ``cavity_point_start`` counts them, triangles of a chamber after each other.
        """
        w, cavity = wp.tid()
        scale = real(1.0)
        if scaled:
            scale = real(1.0) / cavity_area[cavity]
        surface(
            cavity_tri,
            point_x_in,
            w,
            cavity,
            cavity_point_start[cavity],
            cavity_point_start[cavity + 1],
            cavity_tri_start[cavity],
            cavity_tri_start[cavity + 1],
            scale,
            point_gradient_out,
            volume_out,
        )

    return SimpleNamespace(measure_cavity=measure_cavity)
