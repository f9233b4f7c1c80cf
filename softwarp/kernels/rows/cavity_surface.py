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

# The change of the gradient along ways of points: (b - a) x (c - a) by both factors, for all three corners.
_ALONG = """
#pragma clang fp contract(fast)
typedef REAL number_t NUMBER;
const int* tri = cavity_tri.data;
const number_t* x = (const number_t*)&wp::index(point_x, w, 0);
const number_t* y = (const number_t*)&wp::index(way, w, 0);
const number_t* g = (const number_t*)&wp::index(gradient, w, 0);
const number_t share = *(const number_t*)&wp::index(measured, w, row);
number_t* out = (number_t*)&wp::index(point_bar_out, w, 0);
for (int i = 3 * begin; i < 3 * end; ++i) out[i] = x[i] - x[i];
for (int t = 3 * tri_begin; t < 3 * tri_end; t += 3) {
    const int a = 3 * tri[t], b = 3 * tri[t + 1], c = 3 * tri[t + 2];
    const number_t b0 = x[b] - x[a], b1 = x[b + 1] - x[a + 1], b2 = x[b + 2] - x[a + 2];
    const number_t c0 = x[c] - x[a], c1 = x[c + 1] - x[a + 1], c2 = x[c + 2] - x[a + 2];
    const number_t u0 = y[b] - y[a], u1 = y[b + 1] - y[a + 1], u2 = y[b + 2] - y[a + 2];
    const number_t v0 = y[c] - y[a], v1 = y[c + 1] - y[a + 1], v2 = y[c + 2] - y[a + 2];
    const number_t n0 = (u1 * c2 - u2 * c1) + (b1 * v2 - b2 * v1);
    const number_t n1 = (u2 * c0 - u0 * c2) + (b2 * v0 - b0 * v2);
    const number_t n2 = (u0 * c1 - u1 * c0) + (b0 * v1 - b1 * v0);
    out[a] += n0, out[a + 1] += n1, out[a + 2] += n2;
    out[b] += n0, out[b + 1] += n1, out[b + 2] += n2;
    out[c] += n0, out[c + 1] += n1, out[c + 2] += n2;
}
for (int i = 3 * begin; i < 3 * end; ++i) out[i] = out[i] * scale + share * g[i];
"""


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """``measure_cavity`` for one scalar type of a CPU, and ``points_along`` for gradients."""
    S, real = variant.S, variant.real
    name = "double" if real is wp.float64 else "float"
    lanes = f"__attribute__((vector_size({4 * LANE_COUNT}), aligned(4)))" if variant.lanes > 1 else ""
    surface_source, along_source = (text.replace("NUMBER", lanes).replace("REAL", name) for text in (_SURFACE, _ALONG))

    @wp.func_native(surface_source)
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

    @wp.func_native(along_source)
    def along(
        cavity_tri: wp.array2d(dtype=wp.int32),
        point_x: wp.array2d(dtype=S),
        gradient: wp.array2d(dtype=S),
        way: wp.array2d(dtype=S),
        measured: wp.array2d(dtype=S),
        w: int,
        row: int,
        begin: int,
        end: int,
        tri_begin: int,
        tri_end: int,
        scale: real,
        point_bar_out: wp.array2d(dtype=S),
    ):
        """Change of one chamber's gradient along ways, times a scale, and a share of the gradient."""

    @wp.kernel(module=variant.module("adjoint.surface"), enable_backward=False)
    def points_along(
        first_row: int,
        # Model
        cavity_point_start: wp.array(dtype=wp.int32),
        cavity_tri_start: wp.array(dtype=wp.int32),
        cavity_tri: wp.array2d(dtype=wp.int32),
        cavity_area: wp.array(dtype=real),
        # Workspace in
        point_x_in: wp.array2d(dtype=S),
        point_gradient_in: wp.array2d(dtype=S),
        way_in: wp.array2d(dtype=S),
        measured_in: wp.array2d(dtype=S),
        # Workspace out
        point_bar_out: wp.array2d(dtype=S),
    ):
        """Gradient by the points of one chamber's surface; ``cavity_adjoint.cavity_points`` has it by rings."""
        w, cavity = wp.tid()
        along(
            cavity_tri,
            point_x_in,
            point_gradient_in,
            way_in,
            measured_in,
            w,
            first_row + cavity,
            cavity_point_start[cavity],
            cavity_point_start[cavity + 1],
            cavity_tri_start[cavity],
            cavity_tri_start[cavity + 1],
            real(1.0) / (real(6.0) * cavity_area[cavity]),
            point_bar_out,
        )

    return SimpleNamespace(measure_cavity=measure_cavity, points_along=points_along)
