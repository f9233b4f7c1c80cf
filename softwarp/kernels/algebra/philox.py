"""Counter-based random numbers, Philox-4x32-10. Theory: docs/theory/philox.md."""

from types import SimpleNamespace

import warp as wp

from softwarp.kernels.algebra.lanes import Variant, single_worlds

_ROUNDS = 10
_FIRST, _SECOND = wp.constant(wp.uint32(0xD2511F53)), wp.constant(wp.uint32(0xCD9E8D57))  # multipliers
_STEP_0, _STEP_1 = wp.constant(wp.uint32(0x9E3779B9)), wp.constant(wp.uint32(0xBB67AE85))  # of the key, each round
_LOW = wp.constant(wp.int64(0xFFFFFFFF))
_TWO_TO_MINUS_24 = 2.0**-24


@wp.func
def low_word(number: wp.int64):
    """The last 32 bits."""
    return wp.uint32(number & _LOW)


@wp.func
def high_word(number: wp.int64):
    """The 32 bits before them."""
    return wp.uint32(number >> wp.int64(32) & _LOW)


@wp.func
def high_product(a: wp.uint32, b: wp.uint32):
    """Upper half of the 64-bit product."""
    return wp.uint32(wp.uint64(a) * wp.uint64(b) >> wp.uint64(32))


@wp.func
def philox(counter: wp.vec4ui, key: wp.vec2ui):
    """Four random words of a counter and a key.

    Reference: Salmon, Moraes, Dror, Shaw (2011), Parallel Random Numbers: As Easy as 1, 2, 3.
    """
    c0, c1, c2, c3 = counter[0], counter[1], counter[2], counter[3]
    k0, k1 = key[0], key[1]
    for _ in range(wp.static(_ROUNDS)):
        high0, low0 = high_product(_FIRST, c0), _FIRST * c0
        high1, low1 = high_product(_SECOND, c2), _SECOND * c2
        c0, c1, c2, c3 = high1 ^ c1 ^ k0, low1, high0 ^ c3 ^ k1, low0
        k0 += _STEP_0
        k1 += _STEP_1
    return wp.vec4ui(c0, c1, c2, c3)


@single_worlds
def kernels(variant: Variant) -> SimpleNamespace:
    """Kernels of one variant; their arrays are torch's, with the world as the slow index."""
    module = variant.module("philox")

    @wp.kernel(module=module, enable_backward=False)
    def uniform(
        stream: wp.int64,
        # State
        seed_in: wp.array(dtype=wp.int64),
        owner_in: wp.array(dtype=wp.int64),
        episode_in: wp.array(dtype=wp.int64),
        # Samples out
        u_out: wp.array2d(dtype=wp.float32),
    ):
        """Numbers in [0, 1) of 24 bits, four from each counter (block, stream, episode, owner) under a world's seed."""
        world, block = wp.tid()
        counter = wp.vec4ui(wp.uint32(block), low_word(stream), low_word(episode_in[world]), low_word(owner_in[world]))
        words = philox(counter, wp.vec2ui(low_word(seed_in[world]), high_word(seed_in[world])))
        for i in range(4):
            if 4 * block + i < u_out.shape[1]:
                u_out[world, 4 * block + i] = wp.float32(words[i] >> wp.uint32(8)) * wp.static(_TWO_TO_MINUS_24)

    return SimpleNamespace(uniform=uniform)
