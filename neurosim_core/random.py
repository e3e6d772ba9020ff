# mypy: disable-error-code="index,attr-defined,misc,arg-type,operator,no-any-return,no-untyped-call"
"""Counter-based random numbers: addressed by (seed, stream, step, element), never drawn from a state.

The value at an address does not depend on what was asked for before, so any order of calls, any batch and
any number of threads gives the same bits on one type of device. The generator is Philox 4x32-10; one address
is one block of 128 random bits, from which a kernel takes two float64 or four float32 numbers:

    normals = random.normal2(random.random_bits(seed, stream, step, element))

`stream` separates uses (`stream_id("imu/gyroscope/white")`), `step` is a tick or a stamp, `element` an index.

Reference: Salmon, Moraes, Dror, Shaw (2011), Parallel random numbers: as easy as 1, 2, 3.
"""

import zlib

import warp as wp

wp.set_module_options({"enable_backward": False})

_MULTIPLIER_0 = wp.constant(wp.uint64(0xD2511F53))
_MULTIPLIER_1 = wp.constant(wp.uint64(0xCD9E8D57))
_WEYL_0 = wp.constant(wp.uint32(0x9E3779B9))
_WEYL_1 = wp.constant(wp.uint32(0xBB67AE85))
_LOW_32 = wp.constant(wp.uint64(0xFFFFFFFF))
_HALF_WORD = wp.constant(wp.uint64(32))
_UNIT_52 = wp.constant(wp.float64(2.0**-52))
_UNIT_23 = wp.constant(wp.float32(2.0**-23))
_TWO_PI = wp.constant(wp.float64(6.283185307179586))
_TWO_PI_32 = wp.constant(wp.float32(6.2831855))


def stream_id(name: str) -> int:
    """Return the stream of a use of random numbers, as an unsigned 32-bit integer.

    It is the CRC-32 of the name in UTF-8, hence the same in every process.
    """
    return zlib.crc32(name.encode())


def mix_seed(seed: int, stamp_ns: int) -> int:
    """Return a seed of 64 bits that differs for each stamp (finaliser of SplitMix64, Steele et al. 2014)."""
    mixed = (seed + 0x9E3779B97F4A7C15 * (stamp_ns + 1)) % 2**64
    mixed = ((mixed ^ (mixed >> 30)) * 0xBF58476D1CE4E5B9) % 2**64
    mixed = ((mixed ^ (mixed >> 27)) * 0x94D049BB133111EB) % 2**64
    return mixed ^ (mixed >> 31)


@wp.func
def philox(counter: wp.vec4ui, key: wp.vec2ui) -> wp.vec4ui:
    """Return Philox 4x32-10 of a counter under a key."""
    c0 = counter[0]
    c1 = counter[1]
    c2 = counter[2]
    c3 = counter[3]
    k0 = key[0]
    k1 = key[1]
    for _round in range(10):
        product_0 = _MULTIPLIER_0 * wp.uint64(c0)
        product_1 = _MULTIPLIER_1 * wp.uint64(c2)
        c0 = wp.uint32(product_1 >> _HALF_WORD) ^ c1 ^ k0
        c1 = wp.uint32(product_1 & _LOW_32)
        c2 = wp.uint32(product_0 >> _HALF_WORD) ^ c3 ^ k1
        c3 = wp.uint32(product_0 & _LOW_32)
        k0 += _WEYL_0
        k1 += _WEYL_1
    return wp.vec4ui(c0, c1, c2, c3)


@wp.func
def random_bits(seed: wp.uint64, stream: wp.uint32, step: wp.int64, element: wp.int32) -> wp.vec4ui:
    """Return the 128 random bits of an address."""
    tick = wp.uint64(step)
    counter = wp.vec4ui(
        wp.uint32(element), wp.uint32(tick & _LOW_32), wp.uint32(tick >> _HALF_WORD), wp.uint32(stream)
    )
    return philox(counter, wp.vec2ui(wp.uint32(seed & _LOW_32), wp.uint32(seed >> _HALF_WORD)))


@wp.func
def _uniform(high: wp.uint32, low: wp.uint32) -> wp.float64:
    # 52 bits at the middle of their interval: exact in float64, never 0 nor 1
    word = (wp.uint64(high) << _HALF_WORD) | wp.uint64(low)
    return (wp.float64(word >> wp.uint64(12)) + wp.float64(0.5)) * _UNIT_52


@wp.func
def _uniform_32(word: wp.uint32) -> wp.float32:
    return (wp.float32(word >> wp.uint32(9)) + wp.float32(0.5)) * _UNIT_23


@wp.func
def uniform2(bits: wp.vec4ui) -> wp.vec2d:
    """Return two independent uniform numbers in the open interval (0, 1), with 52 bits each."""
    return wp.vec2d(_uniform(bits[0], bits[1]), _uniform(bits[2], bits[3]))


@wp.func
def normal2(bits: wp.vec4ui) -> wp.vec2d:
    """Return two independent standard normal numbers (Box-Muller); |z| is at most 8.57."""
    u = uniform2(bits)
    radius = wp.sqrt(wp.float64(-2.0) * wp.log(u[0]))
    return wp.vec2d(radius * wp.cos(_TWO_PI * u[1]), radius * wp.sin(_TWO_PI * u[1]))


@wp.func
def uniform4(bits: wp.vec4ui) -> wp.vec4:
    """Return four independent uniform numbers in the open interval (0, 1), with 23 bits each."""
    return wp.vec4(_uniform_32(bits[0]), _uniform_32(bits[1]), _uniform_32(bits[2]), _uniform_32(bits[3]))


@wp.func
def normal4(bits: wp.vec4ui) -> wp.vec4:
    """Return four independent standard normal numbers in float32 (Box-Muller); |z| is at most 5.77."""
    u = uniform4(bits)
    radius_0 = wp.sqrt(wp.float32(-2.0) * wp.log(u[0]))
    radius_1 = wp.sqrt(wp.float32(-2.0) * wp.log(u[2]))
    return wp.vec4(
        radius_0 * wp.cos(_TWO_PI_32 * u[1]),
        radius_0 * wp.sin(_TWO_PI_32 * u[1]),
        radius_1 * wp.cos(_TWO_PI_32 * u[3]),
        radius_1 * wp.sin(_TWO_PI_32 * u[3]),
    )
