"""Places and velocities of the nodes of reduced bodies on a GPU: a thread has some nodes of a world.

Amplitudes, which differ by world, then come once for these nodes, and rows of Phi, which threads share, by sixteen
bytes. Sums go over the modes in order, as for a node alone. Theory: docs/theory/reduction.md.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant

NODES = 4  # of a thread

# Displacements of nodes begin .. end - 1 of one body, by COUNT arrays of amplitudes; the first also gets X added.
_DISPLACE = """
struct alignas(16) Piece { REAL v[16 / sizeof(REAL)]; };
const int each = 16 / sizeof(REAL);
const REAL* amplitude[] = {AMPLITUDES};
const long long across[] = {STRIDES};
const Piece* b[NODES];
for (int n = 0; n < NODES; ++n)
    b[n] = (const Piece*)&wp::index(basis, wp::index(node_basis, begin + n < end ? begin + n : begin));
REAL s[COUNT][NODES][3] = {};
for (int k = 0; k < stride; k += each) {
    REAL q[COUNT][each];
    for (int i = 0; i < COUNT; ++i)
        for (int p = 0; p < each; ++p) q[i][p] = amplitude[i][(k + p) * across[i]];
    for (int n = 0; n < NODES; ++n)
        for (int c = 0; c < 3; ++c) {
            const Piece piece = b[n][(c * stride + k) / each];
            for (int i = 0; i < COUNT; ++i)
                for (int p = 0; p < each; ++p) s[i][n][c] += q[i][p] * piece.v[p];
        }
}
for (int n = 0; n < NODES; ++n) {
    if (begin + n >= end) continue;
    const int row = 3 * (PLACE);
    for (int c = 0; c < 3; ++c) {
        wp::index(x_out, w, row + c) = s[0][n][c] ORIGIN;
        OTHERS
    }
}
"""


def _amplitudes(names: list[str], real: str) -> dict[str, str]:
    """Words of ``_DISPLACE`` for some arrays."""
    return {
        "AMPLITUDES": ", ".join(f"&wp::index({name}, w, first)" for name in names),
        "STRIDES": ", ".join(f"(long long)({name}.strides[1] / sizeof({real}))" for name in names),
        "COUNT": str(len(names)),
        "OTHERS": "wp::index(v_out, w, row + c) = s[1][n][c];" if len(names) > 1 else "",
        "NODES": str(NODES),
        "REAL": real,
        "PLACE": "wp::index(node, begin + n)",
        "ORIGIN": "+ wp::index(node_rest, begin + n, c)",
    }


def _source(names: list[str], real: str, **words: str) -> str:
    code = _DISPLACE
    for word, text in (_amplitudes(names, real) | words).items():
        code = code.replace(word, text)
    return code


@cache
def kernels(variant: Variant) -> SimpleNamespace:
    """``node_positions``, ``node_states`` and ``touch_velocities`` of the ``cuda`` variant."""
    S = variant.S
    name = "double" if variant.real is wp.float64 else "float"
    module = variant.module("mode_places")

    @wp.func_native(_source(["wide_q"], name))
    def place(
        begin: int,
        end: int,
        stride: int,
        first: int,
        w: int,
        node: wp.array(dtype=wp.int32),
        node_basis: wp.array(dtype=wp.int32),
        basis: wp.array(dtype=S),
        node_rest: wp.array2d(dtype=S),
        wide_q: wp.array2d(dtype=S),
        x_out: wp.array2d(dtype=S),
    ):
        """X + Phi q of some nodes of a body."""

    @wp.func_native(_source(["wide_q", "wide_v"], name))
    def place_both(
        begin: int,
        end: int,
        stride: int,
        first: int,
        w: int,
        node: wp.array(dtype=wp.int32),
        node_basis: wp.array(dtype=wp.int32),
        basis: wp.array(dtype=S),
        node_rest: wp.array2d(dtype=S),
        wide_q: wp.array2d(dtype=S),
        wide_v: wp.array2d(dtype=S),
        x_out: wp.array2d(dtype=S),
        v_out: wp.array2d(dtype=S),
    ):
        """X + Phi q and Phi v of some nodes of a body."""

    @wp.func_native(_source(["wide_v"], name, PLACE="dof_count + begin + n", ORIGIN=""))
    def move(
        begin: int,
        end: int,
        stride: int,
        first: int,
        w: int,
        dof_count: int,
        node_basis: wp.array(dtype=wp.int32),
        basis: wp.array(dtype=S),
        wide_v: wp.array2d(dtype=S),
        x_out: wp.array2d(dtype=S),
    ):
        """Phi v of some nodes of a body, behind the dofs."""

    @wp.func
    def same_body(node_body: wp.array(dtype=wp.int32), begin: int, end: int):
        """The end of the nodes from ``begin`` on that belong to the same body."""
        i = begin + 1
        while i < end and node_body[i] == node_body[begin]:
            i += 1
        return i

    @wp.kernel(module=module, enable_backward=False)
    def node_positions(
        count: int,
        # Model
        node: wp.array(dtype=wp.int32),
        node_body: wp.array(dtype=wp.int32),
        node_basis: wp.array(dtype=wp.int32),
        body_wide: wp.array(dtype=wp.int32),
        body_stride: wp.array(dtype=wp.int32),
        basis: wp.array(dtype=S),
        node_rest: wp.array2d(dtype=S),
        # Workspace in
        wide_q_in: wp.array2d(dtype=S),
        # Workspace out
        x_out: wp.array2d(dtype=S),
    ):
        """X + Phi q of the next of ``count`` listed nodes."""
        item, w = wp.tid()
        begin = wp.static(NODES) * item
        last = wp.min(begin + wp.static(NODES), count)
        while begin < last:
            end = same_body(node_body, begin, last)
            body = node_body[begin]
            first = body_wide[body]
            place(begin, end, body_stride[body], first, w, node, node_basis, basis, node_rest, wide_q_in, x_out)
            begin = end

    @wp.kernel(module=module, enable_backward=False)
    def node_states(
        count: int,
        # Model
        node: wp.array(dtype=wp.int32),
        node_body: wp.array(dtype=wp.int32),
        node_basis: wp.array(dtype=wp.int32),
        body_wide: wp.array(dtype=wp.int32),
        body_stride: wp.array(dtype=wp.int32),
        basis: wp.array(dtype=S),
        node_rest: wp.array2d(dtype=S),
        # Workspace in
        wide_q_in: wp.array2d(dtype=S),
        wide_v_in: wp.array2d(dtype=S),
        # Workspace out
        x_out: wp.array2d(dtype=S),
        v_out: wp.array2d(dtype=S),
    ):
        """X + Phi q and Phi v of the next of ``count`` listed nodes."""
        item, w = wp.tid()
        begin = wp.static(NODES) * item
        last = wp.min(begin + wp.static(NODES), count)
        while begin < last:
            end = same_body(node_body, begin, last)
            body = node_body[begin]
            stride = body_stride[body]
            first = body_wide[body]
            place_both(
                begin, end, stride, first, w, node, node_basis, basis, node_rest, wide_q_in, wide_v_in, x_out, v_out
            )
            begin = end

    @wp.kernel(module=module, enable_backward=False)
    def touch_velocities(
        dof_count: int,
        # Model
        touch_listed: wp.array(dtype=wp.int32),
        touch_basis: wp.array(dtype=wp.int32),
        node_body: wp.array(dtype=wp.int32),
        body_wide: wp.array(dtype=wp.int32),
        body_stride: wp.array(dtype=wp.int32),
        basis: wp.array(dtype=S),
        # Workspace in
        wide_v_in: wp.array2d(dtype=S),
        # Workspace out
        dof_out: wp.array2d(dtype=S),
    ):
        """Velocities of the next nodes that may touch something, behind those of the dofs."""
        item, w = wp.tid()
        begin = wp.static(NODES) * item
        last = wp.min(begin + wp.static(NODES), touch_listed.shape[0])
        while begin < last:
            body = node_body[touch_listed[begin]]
            end = begin + 1
            while end < last and node_body[touch_listed[end]] == body:
                end += 1
            move(begin, end, body_stride[body], body_wide[body], w, dof_count, touch_basis, basis, wide_v_in, dof_out)
            begin = end

    return SimpleNamespace(node_positions=node_positions, node_states=node_states, touch_velocities=touch_velocities)
