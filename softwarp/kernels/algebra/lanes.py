"""Scalar types that one kernel source is compiled for: one world, eight CPU worlds in SIMD lanes, or a GPU thread.

Solver arrays have logical shape ``(w, row)``. What an element holds depends on the variant:

=============  ==============================  ========================================
variant        element                         memory
=============  ==============================  ========================================
``scalar``     one world, float32 or float64   a world is contiguous
``lanes``      eight worlds, ``vec8``          eight worlds interleaved, float32
``cuda``       one world, float32 or float64   world is the fastest index (coalesced)
=============  ==============================  ========================================

Kernels are written against the type ``S`` and the functions ``mul``, ``fma``, ``div``, ``sqrt``, ``sin``, ``cos``,
``atan2`` of a :class:`Variant`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, wraps
from typing import Any

import warp as wp

LANE_COUNT = 8
vec8 = wp.types.vector(LANE_COUNT, wp.float32)


@wp.func
def _add(a: Any, b: Any):
    return a + b


@wp.func
def _sub(a: Any, b: Any):
    return a - b


@wp.func
def _mul(a: Any, b: Any):
    return a * b


@wp.func
def _fma(a: Any, b: Any, c: Any):
    return a * b + c


@wp.func
def _div(a: Any, b: Any):
    return a / b


@wp.func
def _sqrt(a: Any):
    return wp.sqrt(a)


@wp.func
def _sin(a: Any):
    return wp.sin(a)


@wp.func
def _cos(a: Any):
    return wp.cos(a)


@wp.func
def _atan2(y: Any, x: Any):
    return wp.atan2(y, x)


@wp.func
def _any_positive(a: Any):
    return a > a - a


@wp.func
def _select(condition: Any, a: Any, b: Any):
    return wp.where(condition > condition - condition, a, b)


# Warp's own loops over the components of a vector reach the CPU's vector unit only where the compiler's search for
# parallel scalar code succeeds, which it does not in long expressions. Vector types of the compiler leave it no choice:
# the kernel of a rod segment runs eight times faster and compiles in a tenth of the time.
_NATIVE = f"""
typedef float lanes_t __attribute__((vector_size({4 * LANE_COUNT})));
lanes_t x, y;
__builtin_memcpy(&x, &a, sizeof(x));
__builtin_memcpy(&y, &b, sizeof(y));
lanes_t z = EXPRESSION;
wp::vec_t<{LANE_COUNT}, wp::float32> result;
__builtin_memcpy(&result, &z, sizeof(z));
return result;
"""


@wp.func_native(_NATIVE.replace("EXPRESSION", "x + y"))
def _add8(a: vec8, b: vec8) -> vec8: ...


@wp.func_native(_NATIVE.replace("EXPRESSION", "x - y"))
def _sub8(a: vec8, b: vec8) -> vec8: ...


@wp.func_native(_NATIVE.replace("EXPRESSION", "x * y"))
def _mul8(a: vec8, b: vec8) -> vec8: ...


# One expression, which stays in registers; results are those of a product and a sum.
_FUSED = _NATIVE.replace("x, y;", "x, y, s;").replace("lanes_t z", "__builtin_memcpy(&s, &c, sizeof(s));\nlanes_t z")


@wp.func_native(_FUSED.replace("EXPRESSION", "x * y + s"))
def _fma8(a: vec8, b: vec8, c: vec8) -> vec8: ...


@wp.func_native(_NATIVE.replace("EXPRESSION", "x / y"))
def _div8(a: vec8, b: vec8) -> vec8: ...


@wp.func_native(_NATIVE.replace("&b", "&a").replace("EXPRESSION", "__builtin_elementwise_sqrt(x)"))
def _sqrt8(a: vec8) -> vec8: ...


@wp.func_native(_FUSED.replace("EXPRESSION", "x > 0.0f ? y : s"))
def _select8(a: vec8, b: vec8, c: vec8) -> vec8: ...


@wp.func
def _sin8(a: vec8):
    result = vec8()
    for lane in range(wp.static(LANE_COUNT)):
        result[lane] = wp.sin(a[lane])
    return result


@wp.func
def _cos8(a: vec8):
    result = vec8()
    for lane in range(wp.static(LANE_COUNT)):
        result[lane] = wp.cos(a[lane])
    return result


@wp.func
def _atan28(y: vec8, x: vec8):
    result = vec8()
    for lane in range(wp.static(LANE_COUNT)):
        result[lane] = wp.atan2(y[lane], x[lane])
    return result


@wp.func
def _any_positive8(a: vec8):
    return wp.max(a) > 0.0


@dataclass(frozen=True)
class Variant:
    """One instantiation of the solver kernels.

    Attributes:
        name: ``scalar``, ``lanes`` or ``cuda``.
        real: Scalar of a single world, ``wp.float32`` or ``wp.float64``.
        S: Element of a solver array; equals ``real`` except for ``lanes``.
        lanes: Worlds per element.
        world_fastest: Whether neighbouring threads are neighbouring worlds.
        add, sub, mul, div, sqrt, sin, cos, atan2: Elementwise arithmetic on ``S`` as Warp functions; angles in radians.
            ``add`` and ``sub`` equal + and - and are for kernels whose long sums take the compiler seconds.
        any_positive: Whether a number, of any lane, is positive; a branch for what few elements need.
        select: The second argument where the first is positive, else the third.
        fma: a b + c in one expression; for the sums of products that steps spend their time in.
    """

    name: str
    real: Any
    S: Any
    lanes: int
    world_fastest: bool
    add: Callable[..., Any]
    sub: Callable[..., Any]
    mul: Callable[..., Any]
    fma: Callable[..., Any]
    div: Callable[..., Any]
    sqrt: Callable[..., Any]
    sin: Callable[..., Any]
    cos: Callable[..., Any]
    atan2: Callable[..., Any]
    any_positive: Callable[..., Any]
    select: Callable[..., Any]

    @property
    def key(self) -> str:
        """Unique short name, used for module names."""
        return f"{self.name}_{'f64' if self.real is wp.float64 else 'f32'}"

    def module(self, concept: str) -> wp.Module:
        """Warp module that holds this variant's kernels of one concept."""
        module = wp.get_module(f"softwarp.kernels.{concept}.{self.key}")
        module.options["enable_backward"] = False
        return module

    def dim(self, packs: int, items: int) -> tuple[int, int]:
        """Launch size of a kernel with one thread per (w, item)."""
        return (items, packs) if self.world_fastest else (packs, items)

    def parts(self, count: int) -> int:
        """Threads that share ``count`` short pieces of work: one on a CPU, where a thread's index costs as much."""
        return count if self.world_fastest else min(count, 1)


def single_worlds(factory: Callable[..., Any]) -> Callable[..., Any]:
    """A cache of kernels that take worlds one by one, also out of lanes: both variants of a CPU then share one module.

    Args:
        factory: Of a variant, of which it uses ``real`` and the order of memory, and of other things that can be keys.
    """
    kept = cache(factory)

    @wraps(factory)
    def made(variant_asked: Variant, *others: Any, **named: Any) -> Any:
        return kept(variant("scalar") if variant_asked.lanes > 1 else variant_asked, *others, **named)

    return made


@cache
def variant(name: str, precision: str = "float32") -> Variant:
    """Return the variant ``scalar``, ``lanes`` or ``cuda`` for ``float32`` or ``float64``.

    Raises:
        ValueError: For an unknown name or precision, or lanes in float64, which are not offered.
    """
    if name not in ("scalar", "lanes", "cuda") or precision not in ("float32", "float64"):
        raise ValueError(
            f"solver variant {name!r} in {precision!r}: choose scalar, lanes or cuda and float32 or float64"
        )
    if name == "lanes":
        if precision != "float32":
            raise ValueError("solver variant 'lanes' exists in float32 only; use 'scalar' for float64")
        arithmetic = (_add8, _sub8, _mul8, _fma8, _div8, _sqrt8, _sin8, _cos8, _atan28, _any_positive8, _select8)
        return Variant(name, wp.float32, vec8, LANE_COUNT, False, *arithmetic)
    real = wp.float64 if precision == "float64" else wp.float32
    arithmetic = (_add, _sub, _mul, _fma, _div, _sqrt, _sin, _cos, _atan2, _any_positive, _select)
    return Variant(name, real, real, 1, name == "cuda", *arithmetic)
