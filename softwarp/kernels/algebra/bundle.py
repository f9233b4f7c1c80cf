"""Eight elements of one world in SIMD lanes, on a CPU in float32.

A world by itself has no neighbours to share a register with, as in ``lanes``. What an element needs is therefore
gathered for eight at a time, computed by the functions of ``lanes``, and its result scattered; behind the last element,
that one is repeated. Used where ``wide.is_wide`` holds.
"""

import warp as wp

from softwarp.kernels.algebra.lanes import LANE_COUNT

nine = wp.types.matrix((9, LANE_COUNT), wp.float32)  # a 3x3 matrix of every element, entries in rows

three = wp.types.matrix((3, LANE_COUNT), wp.float32)

_EACH = f"""
wp::mat_t<9, {LANE_COUNT}, wp::float32> result;
for (int lane = 0; lane < {LANE_COUNT}; ++lane) {{
    const int place = {LANE_COUNT} * bundle + lane;
    const int element = index.data[place < index.shape[0] ? place : index.shape[0] - 1];
    BODY
}}
"""


@wp.func
def member(index: wp.array(dtype=wp.int32), bundle: int, lane: int):
    """The element of one lane."""
    return index[wp.min(wp.static(LANE_COUNT) * bundle + lane, index.shape[0] - 1)]


@wp.func_native(
    _EACH.replace(
        "BODY",
        """
    const float* origin = &wp::index(x, w, 3 * wp::index(node, element, 0));
    for (int b = 0; b < 3; ++b) {
        const float* corner = &wp::index(x, w, 3 * wp::index(node, element, b + 1));
        for (int c = 0; c < 3; ++c) result.data[3 * b + c][lane] = corner[c] - origin[c];
    }
""",
    )
    + "return result;"
)
def edges(
    x: wp.array2d(dtype=wp.float32),
    w: int,
    node: wp.array2d(dtype=wp.int32),
    index: wp.array(dtype=wp.int32),
    bundle: int,
) -> nine:
    """Edges from corner 0 to the others, in rows."""


@wp.func_native(
    _EACH.replace("BODY", "for (int k = 0; k < 9; ++k) result.data[k][lane] = wp::index(values, element, k);")
    + "return result;"
)
def constants(values: wp.array2d(dtype=wp.float32), index: wp.array(dtype=wp.int32), bundle: int) -> nine:
    """Nine numbers of every element, row by row."""


_WRITE = _EACH.replace(
    "BODY", "for (int k = 0; k < COUNT; ++k) wp::index(rows_out, w, rows * element + row + k) = m.data[k][lane];"
)


@wp.func_native(_WRITE.replace("COUNT", "9"))
def scatter(
    rows_out: wp.array2d(dtype=wp.float32),
    w: int,
    index: wp.array(dtype=wp.int32),
    bundle: int,
    rows: int,
    row: int,
    m: nine,
):
    """Write nine rows from ``row`` on of every element, which has ``rows`` of them."""


@wp.func_native(_WRITE.replace("COUNT", "3"))
def scatter_vector(
    rows_out: wp.array2d(dtype=wp.float32),
    w: int,
    index: wp.array(dtype=wp.int32),
    bundle: int,
    rows: int,
    row: int,
    m: three,
):
    """The same with three."""


@wp.func_native(
    _EACH.replace(
        "BODY",
        """
    const int code = wp::index(block, element, corner_pair);
    if (code < 0 || place >= index.shape[0]) continue;
    float* b = &wp::index(a_out, w, 9 * (code >> 1));
    if (code & 1)
        for (int r = 0; r < 3; ++r)
            for (int c = 0; c < 3; ++c) b[3 * r + c] += m.data[3 * c + r][lane];
    else
        for (int k = 0; k < 9; ++k) b[k] += m.data[k][lane];
""",
    )
)
def add_blocks(
    a_out: wp.array2d(dtype=wp.float32),
    w: int,
    index: wp.array(dtype=wp.int32),
    bundle: int,
    block: wp.array2d(dtype=wp.int32),
    corner_pair: int,
    m: nine,
):
    """Add a 3x3 matrix of every element to the block of A that ``block`` tells for a pair of its corners, or to none.

    The code is twice the number of the block, and one more if that takes the transpose.
    """
