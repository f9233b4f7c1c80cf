"""Eight elements of one world in SIMD lanes, on a CPU in float32.

A world by itself has no neighbours to share a register with, as in ``lanes``. What an element needs is therefore
gathered for eight at a time, computed by the functions of ``lanes``, and its result scattered; behind the last element,
that one is repeated. Used where ``wide.is_wide`` holds.
"""

import warp as wp

from softwarp.kernels.algebra.lanes import LANE_COUNT, vec8
from softwarp.kernels.algebra.packs import TURN_ROWS

nine = wp.types.matrix((9, LANE_COUNT), wp.float32)  # a 3x3 matrix of every element, entries in rows
three = wp.types.matrix((3, LANE_COUNT), wp.float32)  # a vector of every element

_LISTED = "index.data[place < index.shape[0] ? place : index.shape[0] - 1]"
_ALL = "place < COUNT ? place : COUNT - 1"  # of a table of all elements, in its order
_EACH = f"""
for (int lane = 0; lane < {LANE_COUNT}; ++lane) {{
    const int place = {LANE_COUNT} * bundle + lane;
    const int element = {_LISTED};
BODY}}
"""
# Numbers of an element lie one behind the other, those of a register apart: squares of eight by eight change places.
_REGISTERS = f"""
typedef float row_t __attribute__((vector_size({4 * LANE_COUNT})));
typedef float four_t __attribute__((vector_size(16)));
row_t a[8], b[8];
"""
# Four registers with numbers of elements k and k + 4, a, as columns, in b; and back, but for their order.
_TURN_FOUR = """
for (int k = 0; k < 4; k += 2) {
    b[k] = __builtin_shufflevector(a[k], a[k + 1], 0, 8, 1, 9, 4, 12, 5, 13);
    b[k + 1] = __builtin_shufflevector(a[k], a[k + 1], 2, 10, 3, 11, 6, 14, 7, 15);
}
for (int m = 0; m < 2; ++m) {
    a[2 * m] = __builtin_shufflevector(b[m], b[2 + m], 0, 1, 8, 9, 4, 5, 12, 13);
    a[2 * m + 1] = __builtin_shufflevector(b[m], b[2 + m], 2, 3, 10, 11, 6, 7, 14, 15);
}
for (int k = 0; k < 4; ++k) b[k] = a[k];
"""


@wp.func
def member(index: wp.array(dtype=wp.int32), bundle: int, lane: int):
    """The element of one lane."""
    return index[wp.min(wp.static(LANE_COUNT) * bundle + lane, index.shape[0] - 1)]


_EDGES = (
    _REGISTERS
    + f"wp::mat_t<9, {LANE_COUNT}, wp::float32> result;\nfour_t third[{LANE_COUNT}];"
    + "const float* const start = &wp::index(x, w, 0);"
    + _EACH.replace(
        "BODY",
        """
    const int* const own = node.data + 4 * element;
    four_t corner[4] = {};
    for (int c = 0; c < 4; ++c) __builtin_memcpy(corner + c, start + 3 * own[c], 3 * sizeof(float));
    const four_t first = corner[1] - corner[0], second = corner[2] - corner[0];
    a[lane] = __builtin_shufflevector(first, second, 0, 1, 2, 3, 4, 5, 6, 7);
    third[lane] = corner[3] - corner[0];
""",
    )
    + TURN_ROWS
    + "for (int k = 0; k < 6; ++k) __builtin_memcpy(&result.data[k], b + (k < 3 ? k : k + 1), sizeof(row_t));"
    + "for (int k = 0; k < 4; ++k) a[k] = __builtin_shufflevector(third[k], third[k + 4], 0, 1, 2, 3, 4, 5, 6, 7);"
    + _TURN_FOUR
    + "for (int k = 0; k < 3; ++k) __builtin_memcpy(&result.data[6 + k], b + k, sizeof(row_t));\nreturn result;"
)


@wp.func_native(_EDGES)
def edges(
    x: wp.array2d(dtype=wp.float32),
    w: int,
    node: wp.array2d(dtype=wp.int32),
    index: wp.array(dtype=wp.int32),
    bundle: int,
) -> nine:
    """Edges from corner 0 to the others, in rows."""


@wp.func_native(_EDGES.replace(_LISTED, _ALL.replace("COUNT", "node.shape[0]")))
def all_edges(x: wp.array2d(dtype=wp.float32), w: int, node: wp.array2d(dtype=wp.int32), bundle: int) -> nine:
    """The same of all elements in their order."""


@wp.func_native(
    _REGISTERS
    + f"wp::mat_t<9, {LANE_COUNT}, wp::float32> result;\nrow_t last;"
    + _EACH.replace(
        "BODY",
        """
    const float* const row = values.data + 9 * element;
    __builtin_memcpy(a + lane, row, sizeof(row_t));
    last[lane] = row[8];
""",
    )
    + TURN_ROWS
    + """
__builtin_memcpy(&result.data[0], b, sizeof(b));
__builtin_memcpy(&result.data[8], &last, sizeof(last));
return result;
"""
)
def constants(values: wp.array2d(dtype=wp.float32), index: wp.array(dtype=wp.int32), bundle: int) -> nine:
    """Nine numbers of every element, row by row."""


_GATHER = (
    f"wp::vec_t<{LANE_COUNT}, wp::float32> result;" + _EACH.replace("BODY", "result[lane] = NUMBER;") + "return result;"
)


@wp.func_native(_GATHER.replace("NUMBER", "values.data[element]"))
def numbers(values: wp.array(dtype=wp.float32), index: wp.array(dtype=wp.int32), bundle: int) -> vec8:
    """A number of every element that all worlds share."""


@wp.func_native(
    _GATHER.replace("NUMBER", "values.data[element]").replace(_LISTED, _ALL.replace("COUNT", "values.shape[0]"))
)
def all_numbers(values: wp.array(dtype=wp.float32), bundle: int) -> vec8:
    """The same of all elements in their order."""


@wp.func_native(_GATHER.replace("NUMBER", "values.data[owner.data[element]]"))
def owners_numbers(
    values: wp.array(dtype=wp.float32),
    owner: wp.array(dtype=wp.int32),
    index: wp.array(dtype=wp.int32),
    bundle: int,
) -> vec8:
    """A number of what every element belongs to."""


@wp.func_native(
    "const float* const start = &wp::index(values, w, 0);" + _GATHER.replace("NUMBER", "start[owner.data[element]]")
)
def owners_rows(
    values: wp.array2d(dtype=wp.float32),
    w: int,
    owner: wp.array(dtype=wp.int32),
    index: wp.array(dtype=wp.int32),
    bundle: int,
) -> vec8:
    """The same of a world."""


@wp.func_native(
    _REGISTERS
    + "__builtin_memcpy(a, m.data, sizeof(a));\nfloat* const start = &wp::index(rows_out, w, row);"
    + TURN_ROWS
    + _EACH.replace(
        "BODY",
        """
    float* const target = start + rows * element;
    __builtin_memcpy(target, b + lane, sizeof(row_t));
    target[8] = m.data[8][lane];
""",
    )
)
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


@wp.func_native(
    _EACH.replace(
        "BODY", "for (int k = 0; k < 3; ++k) wp::index(rows_out, w, rows * element + row + k) = m.data[k][lane];"
    )
)
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


# Corner 0 takes three of the first eight rows of an element, and so on.
@wp.func_native(
    _REGISTERS
    + "float* const start = &wp::index(rows_out, w, 0);"
    + "row_t v[9], first[8];\n__builtin_memcpy(v, m.data, sizeof(v));"
    + "for (int c = 0; c < 3; ++c) a[c] = -(v[c] + v[3 + c] + v[6 + c]);"
    + "for (int k = 0; k < 5; ++k) a[3 + k] = v[k];"
    + TURN_ROWS
    + "for (int k = 0; k < 8; ++k) first[k] = b[k];"
    + "for (int k = 0; k < 4; ++k) a[k] = v[5 + k];"
    + _TURN_FOUR
    + _EACH.replace(
        "BODY",
        """
    float* const target = start + 12 * element;
    __builtin_memcpy(target, first + lane, sizeof(row_t));
    const four_t rest = lane < 4 ? __builtin_shufflevector(b[lane & 3], b[lane & 3], 0, 1, 2, 3)
                                 : __builtin_shufflevector(b[lane & 3], b[lane & 3], 4, 5, 6, 7);
    __builtin_memcpy(target + 8, &rest, sizeof(rest));
""",
    )
)
def scatter_corners(
    rows_out: wp.array2d(dtype=wp.float32), w: int, index: wp.array(dtype=wp.int32), bundle: int, m: nine
):
    """Write vectors of corners 1 to 3 of every element, in rows of ``m``, and of corner 0, which balances them."""


@wp.func_native(
    _REGISTERS
    + "typedef int whole_t __attribute__((vector_size(sizeof(row_t))));"
    + "__builtin_memcpy(a, m.data, sizeof(a));\nfloat* const start = &wp::index(a_out, w, 0);"
    + TURN_ROWS
    + _EACH.replace(
        "BODY",
        """
    const int code = wp::index(block, element, corner_pair);
    if (code < 0 || place >= index.shape[0]) continue;
    float* const target = start + 9 * (code >> 1);
    const row_t transposed = __builtin_shufflevector(b[lane], b[lane], 0, 3, 6, 1, 4, 7, 2, 5);
    const whole_t is_transposed = whole_t{} - (code & 1);
    row_t sum;
    __builtin_memcpy(&sum, target, sizeof(sum));
    sum += is_transposed ? transposed : b[lane];
    __builtin_memcpy(target, &sum, sizeof(sum));
    target[8] += m.data[8][lane];
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
