# mypy: disable-error-code="index,attr-defined,misc,arg-type,operator,no-any-return,no-untyped-call"
# mypy: disable-error-code="call-overload,untyped-decorator,empty-body,assignment"
"""Kernels of the event camera: the pixels' scan over a stack of frames, and the 64-bit keys it writes.

The law is in `scan_pixel`, once. A pixel holds the log radiance it was reset to (`base`), its last sample,
and how many levels it crossed upwards and downwards since. The reference level is a function of these counts,

    L_ref = base + up * threshold_on - down * threshold_off     (float64)

so nothing accumulates: after any number of events it has the rounding of one evaluation. Where both sums
agree within that rounding, the level is the base itself.

The tie rule (stated in `EventCamera`) is in `_bound`: the float32 that a sample must reach, for each level.

Crossing times are rounded to 2^-10 ns, then written as a key that sorts in the order of the packets:

    time [us] | late | row | col | polarity | nanoseconds after the microsecond, rounded up (0 .. 1000)

Rounded down to the microsecond, a crossing gets its time; rounded up to the nanosecond, it is compared
exactly with the stamps of windows. `mark_late` sets `late` on events that share the microsecond of a window's
end but come after it, so that windows are contiguous in the sorted keys.

Pixels that are not ideal have a scan of their own, made to measure, in `event_noise`; levels, the tie rule
and keys are those of this module.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

SUB_BITS = 11
"""Bits of a key below the column: polarity and nanoseconds."""
BLOCK_SIZE = wp.constant(256)
"""Threads of a block on CUDA."""
TILE_SIZE = wp.constant(256)
"""Pixels that a thread of `screen` takes."""
LOG_RADIANCE_MAX = 1.0e3
"""Larger magnitudes are refused like non-finite values: exp(1000) is no radiance."""

OPEN = wp.constant(0)
PUT = wp.constant(1)
CLOSE = wp.constant(2)
READ = wp.constant(3)
START = wp.constant(4)

_HALF_ULP = wp.constant(wp.float64(2.0**-24))
"""Of a float32 in [1, 2)."""
_ROUNDING = wp.constant(wp.float64(2.0**-50))
"""Bound of the relative error of the sums in a level."""
_STEP_ROUNDING = wp.constant(wp.float64(2.0**-23))
"""Relative error of k C computed in float32: half an ulp for C, and half an ulp for the product."""
LIMIT = wp.constant(wp.float32(LOG_RADIANCE_MAX))
_TICKS_PER_NS = wp.constant(wp.float64(1024.0))
COLUMN_SHIFT = wp.constant(wp.int64(SUB_BITS))
_US = wp.constant(wp.int64(1000))


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    // keys gather in shared memory, and one atomic per block finds their place; what does not fit goes alone
    constexpr unsigned SIZE = 1536;
    __shared__ int64_t gathered[SIZE];
    __shared__ unsigned gathered_count;
    __shared__ unsigned long long block_start;
    unsigned long long* total = (unsigned long long*)counters.data;
    if (step == 1) {
        const unsigned place = atomicAdd(&gathered_count, 1u);
        if (place < SIZE) {
            gathered[place] = key;
        } else {
            const unsigned long long slot = atomicAdd(total, 1ull);
            if (slot < (unsigned long long)keys.shape[0]) keys.data[slot] = key;
        }
        return;
    }
    if (step == 0) {
        if (threadIdx.x == 0) gathered_count = 0;
        __syncthreads();
        return;
    }
    __syncthreads();
    const unsigned count = gathered_count < SIZE ? gathered_count : SIZE;
    if (threadIdx.x == 0 && count > 0) block_start = atomicAdd(total, (unsigned long long)count);
    __syncthreads();
    for (unsigned place = threadIdx.x; place < count; place += blockDim.x) {
        const unsigned long long slot = block_start + place;
        if (slot < (unsigned long long)keys.shape[0]) keys.data[slot] = gathered[place];
    }
#else
    if (step != 1) return;
    const int64_t slot = counters.data[0]++;
    if (slot < (int64_t)keys.shape[0]) keys.data[slot] = key;
#endif
""")
def write_key(step: wp.int32, key: wp.int64, keys: wp.array[wp.int64], counters: wp.array[wp.int64]) -> None:
    """Append a key (step PUT) and count it, also where there is no room for it.

    Every thread of a block comes here once before with OPEN, and once after with CLOSE.
    """
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    constexpr int SIZE = 2048;  // a crossing for each thread and each of 8 frames
    __shared__ int words[5][SIZE];
    __shared__ unsigned kept_count, total;  // of 64 bits together they would be added in a loop
    __shared__ unsigned long long start;
    if (step == 1) {
        const unsigned index = atomicAdd(&kept_count, 1u);
        words[0][index] = (event_count << 11) | ((frame & 7) << 8) | threadIdx.x;
        words[1][index] = __float_as_int(last);
        words[2][index] = up;
        words[3][index] = down;
        words[4][index] = (int)atomicAdd(&total, (unsigned)event_count);
        return 1;
    }
    if (step == 3) return words[place][index];
    if (step == 4) return (int64_t)start;
    __syncthreads();
    if (step == 0) {
        if (threadIdx.x == 0) kept_count = total = 0;
    } else if (threadIdx.x == 0 && total > 0) {
        start = atomicAdd((unsigned long long*)counters.data, (unsigned long long)total);
    }
    __syncthreads();
    return (int64_t)kept_count;
#else
    return 0;
#endif
""")
def keep_crossing(
    step: wp.int32,
    frame: wp.int32,
    event_count: wp.int32,
    last: wp.float32,
    up: wp.int32,
    down: wp.int32,
    place: wp.int32,
    index: wp.int32,
    counters: wp.array[wp.int64],
) -> wp.int64:
    """Keep what a pixel crosses in a frame (step PUT), for its whole block to turn into keys; only on CUDA.

    Few threads cross levels, some many in each frame, and the others would wait for them. At most 2^21 - 1
    levels are crossed in a frame, and 8 frames that begin at a multiple of 8 are kept together.

    Every thread of a block comes here before with OPEN, and after with CLOSE, which counts the events and
    returns how many crossings are kept. Then READ returns a word of one: its levels, the last bits of the
    frame and the thread; and `last`, `up` and `down` as they were before, and the number of its first event.
    START returns the place of event 0. On a CPU, PUT returns 0 and nothing is kept.
    """
    ...


@wp.func
def _read_word(place: wp.int32, index: wp.int32, counters: wp.array[wp.int64]) -> wp.int32:
    return wp.int32(keep_crossing(READ, 0, 0, wp.float32(0.0), 0, 0, place, index, counters))


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __dmul_rn(a, b);
#else
    return a * b;
#endif
""")
def _product(a: wp.float64, b: wp.float64) -> wp.float64:
    """Return a product, on CUDA not joined with a sum: a level has the same bits wherever it is asked."""
    ...


@wp.func
def level_at(
    base: wp.float64, up: wp.int32, down: wp.int32, threshold_on: wp.float64, threshold_off: wp.float64
) -> wp.float64:
    """Return the level after so many crossings, from the log radiance of the reset."""
    rise = _product(wp.float64(up), threshold_on)
    fall = _product(wp.float64(down), threshold_off)
    step = rise - fall
    if wp.abs(step) <= _ROUNDING * (rise + fall):
        return base
    return base + step


@wp.func
def _half_ulp(base: wp.float32) -> wp.float64:
    """Return half the distance from a float32 to the next larger in magnitude; 0 below 2^-126."""
    return wp.float64(wp.cast(wp.cast(base, wp.int32) & 0x7F800000, wp.float32)) * _HALF_ULP


@wp.func
def _bound(level: wp.float64, base: wp.float64, half_ulp: wp.float64, direction: wp.float64) -> wp.float32:
    """Return the float32 at which a sample reaches a level from below (direction 1) or above (-1)."""
    if level == base:
        return wp.float32(base)
    slack = wp.max(half_ulp, _STEP_ROUNDING * wp.abs(level - base))
    return wp.float32(level - direction * slack)


@wp.func
def _lower(
    base: wp.float64,
    up: wp.int32,
    down: wp.int32,
    threshold_on: wp.float64,
    threshold_off: wp.float64,
) -> wp.float32:
    """Return the largest sample that reaches the level below."""
    level = level_at(base, up, down + 1, threshold_on, threshold_off)
    return _bound(level, base, _half_ulp(wp.float32(base)), wp.float64(-1.0))


@wp.func
def _upper(
    base: wp.float64,
    up: wp.int32,
    down: wp.int32,
    threshold_on: wp.float64,
    threshold_off: wp.float64,
) -> wp.float32:
    """Return the least sample that reaches the level above."""
    level = level_at(base, up + 1, down, threshold_on, threshold_off)
    return _bound(level, base, _half_ulp(wp.float32(base)), wp.float64(1.0))


@wp.func
def quiet_range(
    base: wp.float64,
    up: wp.int32,
    down: wp.int32,
    threshold_on: wp.float64,
    threshold_off: wp.float64,
) -> wp.vec2:
    """Return the samples that reach the level below and the level above; between them a pixel is quiet."""
    return wp.vec2(
        _lower(base, up, down, threshold_on, threshold_off),
        _upper(base, up, down, threshold_on, threshold_off),
    )


@wp.func
def key_after(
    elapsed_ns: wp.float64,
    start_ns: wp.int64,
    place: wp.int64,
    time_shift: wp.int32,
    polarity: wp.int32,
) -> wp.int64:
    """Return the key of an event some time, rounded to 2^-10 ns, after a stamp."""
    ticks = wp.int64(wp.rint(elapsed_ns * _TICKS_PER_NS))
    ticks = wp.max(ticks, wp.int64(1))  # an interval does not hold its start: that is the window before
    whole_ns = ticks >> wp.int64(10)
    down_ns = start_ns + whole_ns
    up_ns = down_ns
    if ticks > (whole_ns << wp.int64(10)):
        up_ns += wp.int64(1)
    time_us = down_ns // _US
    sub_ns = up_ns - time_us * _US
    return (time_us << wp.int64(time_shift)) | place | wp.int64(polarity << 10) | sub_ns


@wp.func
def _key(
    level: wp.float64,
    last: wp.float64,
    sample: wp.float64,
    start_ns: wp.int64,
    end_ns: wp.int64,
    place: wp.int64,
    time_shift: wp.int32,
    polarity: wp.int32,
) -> wp.int64:
    """Return the key of the crossing of a level on the line from (start_ns, last) to (end_ns, sample)."""
    fraction = wp.min((level - last) / (sample - last), wp.float64(1.0))
    return key_after(wp.float64(end_ns - start_ns) * fraction, start_ns, place, time_shift, polarity)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    // not used there, and arrays on the stack take the compiler two seconds
    for (int pixel = begin; pixel < end; ++pixel) {
        const float* sample = log_radiance.data + pixel;
        int lead = 0;
        while (lead < frame_count && *sample > low_32.data[pixel] && *sample < high_32.data[pixel]) {
            ++lead;
            sample += log_radiance.shape[1];
        }
        lead_out.data[pixel] = lead;
    }
#else
    // frame by frame, so that memory is read in order and the inner loop becomes vector instructions
    constexpr int SIZE = 256;
    const int count = end - begin < SIZE ? end - begin : SIZE;
    int alive[SIZE];
    int lead[SIZE];
    for (int i = 0; i < count; ++i) { alive[i] = 1; lead[i] = 0; }
    const float* __restrict__ low = low_32.data + begin;
    const float* __restrict__ high = high_32.data + begin;
    for (int frame = 0; frame < frame_count; ++frame) {
        const float* __restrict__ sample = log_radiance.data + (size_t)frame * log_radiance.shape[1] + begin;
        int any = 0;
        for (int i = 0; i < count; ++i) {
            alive[i] &= (sample[i] > low[i]) & (sample[i] < high[i]);
            lead[i] += alive[i];
            any |= alive[i];
        }
        if (!any) break;
    }
    for (int i = 0; i < count; ++i) lead_out.data[begin + i] = lead[i];
#endif
""")
def _count_lead(
    begin: wp.int32,
    end: wp.int32,
    log_radiance: wp.array2d[wp.float32],
    frame_count: wp.int32,
    low_32: wp.array[wp.float32],
    high_32: wp.array[wp.float32],
    lead_out: wp.array[wp.int32],
) -> None:
    """Count for at most 256 pixels the frames before the first that leaves (low, high)."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return first + 8 < frame_count ? first + 8 : frame_count;
#else
    return frame_count;
#endif
""")
def _end_of_round(first: wp.int32, frame_count: wp.int32) -> wp.int32:
    """Return where the frames end that a block scans before it writes their events; 8 on CUDA."""
    ...


@wp.func_native("""
    const float* sample = log_radiance.data + pixel;
    const size_t stride = log_radiance.shape[1];
#if defined(__CUDA_ARCH__)
    // the loads of all frames of a round are under way together; beyond the end the last frame stands in
    constexpr int SIZE = 8;
    if (first >= end) return end;
    const int begin = first / SIZE * SIZE;
    float value[SIZE];
    const float* at = sample + begin * stride;
#pragma unroll
    for (int i = 0; i < SIZE; ++i) {
        value[i] = *at;
        if (begin + i + 1 < end) at += stride;
    }
    unsigned loud = 0;
#pragma unroll
    for (int i = 0; i < SIZE; ++i) loud |= (value[i] > low && value[i] < high ? 0u : 1u) << i;
    loud &= ~0u << (first - begin);
    return loud != 0 && begin + __ffs(loud) - 1 < end ? begin + __ffs(loud) - 1 : end;
#else
    int frame = first;
    while (frame < end && sample[frame * stride] > low && sample[frame * stride] < high) ++frame;
    return frame;
#endif
""")
def _next_loud(
    log_radiance: wp.array2d[wp.float32],
    pixel: wp.int32,
    first: wp.int32,
    end: wp.int32,
    low: wp.float32,
    high: wp.float32,
) -> wp.int32:
    """Return the first frame of a round from `first` on whose sample leaves (low, high), or its end."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    for (int frame = 0; frame < frame_count; ++frame) {
        const float* sample = log_radiance.data + (size_t)frame * log_radiance.shape[1] + pixel;
        asm volatile("prefetch.global.L1 [%0];" :: "l"(sample));
    }
#endif
""")
def call_up(log_radiance: wp.array2d[wp.float32], pixel: wp.int32, frame_count: wp.int32) -> None:
    """Have the samples of a pixel come near, on CUDA, before they are read one after the other."""
    ...


@wp.func
def _place(pixel: wp.int32, row: wp.int32, width: wp.int32, row_shift: wp.int32) -> wp.int64:
    """Return the bits of a key that say which pixel it is."""
    return (wp.int64(row) << wp.int64(row_shift)) | (wp.int64(pixel - row * width) << COLUMN_SHIFT)


@wp.func
def _rise(
    sample: wp.float32,
    base: wp.float64,
    up: wp.int32,
    down: wp.int32,
    threshold_on: wp.float64,
    threshold_off: wp.float64,
) -> wp.int32:
    """Return `up` when a sample that has reached the level above has crossed all that it reaches."""
    least = up + 1
    if sample < _upper(base, least, down, threshold_on, threshold_off):
        return least
    level = level_at(base, least, down, threshold_on, threshold_off)
    found = least + wp.int32((wp.float64(sample) - level) / threshold_on)  # but for rounding
    while sample >= _upper(base, found, down, threshold_on, threshold_off):
        found += 1
    while found > least and sample < _upper(base, found - 1, down, threshold_on, threshold_off):
        found -= 1
    return found


@wp.func
def _fall(
    sample: wp.float32,
    base: wp.float64,
    up: wp.int32,
    down: wp.int32,
    threshold_on: wp.float64,
    threshold_off: wp.float64,
) -> wp.int32:
    """Return `down` when a sample that has reached the level below has crossed all that it reaches."""
    least = down + 1
    if sample > _lower(base, up, least, threshold_on, threshold_off):
        return least
    level = level_at(base, up, least, threshold_on, threshold_off)
    found = least + wp.int32((level - wp.float64(sample)) / threshold_off)
    while sample <= _lower(base, up, found, threshold_on, threshold_off):
        found += 1
    while found > least and sample > _lower(base, up, found - 1, threshold_on, threshold_off):
        found -= 1
    return found


@wp.func
def _key_of_level(
    event: wp.int32,
    base: wp.float64,
    up: wp.int32,
    down: wp.int32,
    threshold_on: wp.float64,
    threshold_off: wp.float64,
    last: wp.float32,
    sample: wp.float32,
    start_ns: wp.int64,
    end_ns: wp.int64,
    place: wp.int64,
    time_shift: wp.int32,
) -> wp.int64:
    """Return the key of one of the events between two samples, from `up` and `down` at the first of them."""
    polarity = wp.where(sample > last, 1, 0)
    level = level_at(
        base,
        up + (event + 1) * polarity,
        down + (event + 1) * (1 - polarity),
        threshold_on,
        threshold_off,
    )
    return _key(level, wp.float64(last), wp.float64(sample), start_ns, end_ns, place, time_shift, polarity)


@wp.func
def _write_kept(
    index: wp.int32,
    threshold_on: wp.float64,
    threshold_off: wp.float64,
    width: wp.int32,
    row_shift: wp.int32,
    time_shift: wp.int32,
    first_pixel: wp.int32,
    first_frame: wp.int32,
    log_radiance: wp.array2d[wp.float32],
    stamps: wp.array[wp.int64],
    base: wp.array[wp.float32],
    keys_out: wp.array[wp.int64],
    counters_out: wp.array[wp.int64],
) -> None:
    """Write the keys of what a pixel of the block has crossed in a frame, as far as there is room."""
    word = _read_word(0, index, counters_out)
    pixel = first_pixel + (word & 255)
    frame = first_frame + ((word >> 8) & 7)
    last = wp.cast(_read_word(1, index, counters_out), wp.float32)
    up = _read_word(2, index, counters_out)
    down = _read_word(3, index, counters_out)
    offset = wp.int64(_read_word(4, index, counters_out)) & wp.int64(0xFFFFFFFF)
    slot = keep_crossing(START, 0, 0, wp.float32(0.0), 0, 0, 0, 0, counters_out) + offset
    sample = log_radiance[frame, pixel]
    level_0 = wp.float64(base[pixel])
    place = _place(pixel, pixel // width, width, row_shift)
    for event in range((word >> 11) & 0x1FFFFF):
        if slot + wp.int64(event) < wp.int64(keys_out.shape[0]):
            keys_out[wp.int32(slot) + event] = _key_of_level(
                event,
                level_0,
                up,
                down,
                threshold_on,
                threshold_off,
                last,
                sample,
                stamps[frame],
                stamps[frame + 1],
                place,
                time_shift,
            )


@wp.func
def scan_pixel(
    threshold_on: wp.float64,
    threshold_off: wp.float64,
    width: wp.int32,
    row_shift: wp.int32,
    time_shift: wp.int32,
    pixel: wp.int32,
    end_pixel: wp.int32,
    lane: wp.int32,
    log_radiance: wp.array2d[wp.float32],
    stamps: wp.array[wp.int64],
    frame_count: wp.int32,
    lead: wp.array[wp.int32],
    row_limit: wp.array[wp.int32],
    base: wp.array[wp.float32],
    last: wp.array[wp.float32],
    crossed: wp.array[wp.vec2i],
    tabulate: wp.bool,
    last_out: wp.array[wp.float32],
    crossed_out: wp.array[wp.vec2i],
    keys_out: wp.array[wp.int64],
    counters_out: wp.array[wp.int64],
    table_out: wp.array2d[wp.int32],
) -> None:
    """Take one pixel from its state before a stack to that after it; parameters as for `scan`.

    All threads of a block come here together, also those whose pixel is past the end. `lane` is their number.
    """
    alive = pixel < end_pixel
    base_32 = wp.float32(0.0)
    row = wp.int32(0)
    up = wp.int32(0)
    down = wp.int32(0)
    low = wp.float32(0.0)
    high = wp.float32(0.0)
    sample_before = wp.float32(0.0)
    seen = wp.int32(0)  # the frames that `sample_before` knows of
    frame = wp.int32(0)
    invalid_count = wp.int32(0)
    invalid_first = wp.int32(0)
    if alive:
        before = crossed[pixel]
        up = before[0]
        down = before[1]
        frame = lead[pixel]
        if frame < frame_count:
            base_32 = base[pixel]
            sample_before = last[pixel]
            row = pixel // width
            low = _lower(wp.float64(base_32), up, down, threshold_on, threshold_off)
            high = _upper(wp.float64(base_32), up, down, threshold_on, threshold_off)

    begin = wp.int32(0)
    while begin < frame_count:
        end = _end_of_round(begin, frame_count)
        keep_crossing(OPEN, 0, 0, wp.float32(0.0), 0, 0, 0, 0, counters_out)
        if alive:
            frame = _next_loud(log_radiance, pixel, wp.max(frame, begin), end, low, high)
            while frame < end:
                if frame > seen:
                    sample_before = log_radiance[frame - 1, pixel]
                sample = log_radiance[frame, pixel]
                if wp.abs(sample) <= LIMIT:
                    level_0 = wp.float64(base_32)
                    up_before = up
                    down_before = down
                    if sample >= high:
                        up = _rise(sample, level_0, up, down, threshold_on, threshold_off)
                    else:
                        down = _fall(sample, level_0, up, down, threshold_on, threshold_off)
                    low = _lower(level_0, up, down, threshold_on, threshold_off)
                    high = _upper(level_0, up, down, threshold_on, threshold_off)
                    found = up - up_before + down - down_before
                    if tabulate:
                        wp.atomic_add(table_out, frame, row, found)
                    elif row < row_limit[frame]:
                        kept = keep_crossing(
                            PUT, frame, found, sample_before, up_before, down_before, 0, 0, counters_out
                        )
                        if kept == wp.int64(0):
                            place = _place(pixel, row, width, row_shift)
                            for event in range(found):
                                key = _key_of_level(
                                    event,
                                    level_0,
                                    up_before,
                                    down_before,
                                    threshold_on,
                                    threshold_off,
                                    sample_before,
                                    sample,
                                    stamps[frame],
                                    stamps[frame + 1],
                                    place,
                                    time_shift,
                                )
                                write_key(PUT, key, keys_out, counters_out)
                    sample_before = sample
                else:
                    if invalid_count == 0:
                        invalid_first = frame
                    invalid_count += 1
                seen = frame + 1
                frame = _next_loud(log_radiance, pixel, seen, end, low, high)
        kept_count = wp.int32(keep_crossing(CLOSE, 0, 0, wp.float32(0.0), 0, 0, 0, 0, counters_out))
        for index in range(lane, kept_count, BLOCK_SIZE):
            _write_kept(
                index,
                threshold_on,
                threshold_off,
                width,
                row_shift,
                time_shift,
                pixel - lane,
                begin,
                log_radiance,
                stamps,
                base,
                keys_out,
                counters_out,
            )
        if alive and seen < end:
            sample_before = log_radiance[end - 1, pixel]
            seen = end
        begin = end

    if alive and not tabulate:
        last_out[pixel] = sample_before
        crossed_out[pixel] = wp.vec2i(up, down)
        if invalid_count > 0:
            pixel_count = base.shape[0]
            flat = wp.int64(invalid_first) * wp.int64(pixel_count) + wp.int64(pixel)
            wp.atomic_add(counters_out, 1, wp.int64(invalid_count))
            wp.atomic_max(counters_out, 2, wp.int64(frame_count) * wp.int64(pixel_count) - flat)


@wp.func
def screen_tile(
    threshold_on: wp.float64,
    threshold_off: wp.float64,
    begin: wp.int32,
    end: wp.int32,
    log_radiance: wp.array2d[wp.float32],
    frame_count: wp.int32,
    base: wp.array[wp.float32],
    crossed: wp.array[wp.vec2i],
    low_out: wp.array[wp.float32],
    high_out: wp.array[wp.float32],
    lead_out: wp.array[wp.int32],
) -> None:
    """Count the leading quiet frames of the pixels [begin, end), at most 256; parameters as for `screen`."""
    for pixel in range(begin, end):
        before = crossed[pixel]
        quiet = quiet_range(wp.float64(base[pixel]), before[0], before[1], threshold_on, threshold_off)
        low_out[pixel] = quiet[0]
        high_out[pixel] = quiet[1]
    _count_lead(begin, end, log_radiance, frame_count, low_out, high_out, lead_out)


@wp.kernel
def screen(
    # Model:
    threshold_on: wp.float64,
    threshold_off: wp.float64,
    # In:
    first_pixel: wp.int32,
    end_pixel: wp.int32,
    log_radiance: wp.array2d[wp.float32],
    frame_count: wp.int32,
    base: wp.array[wp.float32],
    crossed: wp.array[wp.vec2i],
    # Out:
    low_out: wp.array[wp.float32],
    high_out: wp.array[wp.float32],
    lead_out: wp.array[wp.int32],
) -> None:
    """Count the frames of each pixel before the first that may fire; one thread takes TILE_SIZE pixels.

    This is what makes the scan fast on a CPU: a pixel's own samples lie far apart in memory. It changes no
    event.

    Args:
        threshold_on: Step of log radiance upwards.
        threshold_off: Step of log radiance downwards.
        first_pixel: First pixel of thread 0.
        end_pixel: End of the last thread's pixels.
        log_radiance: Frames, shape [frame, pixel], contiguous.
        frame_count: Frames to look at.
        base: Log radiance of the reset, shape [pixel].
        crossed: Levels crossed upwards and downwards, shape [pixel].
        low_out: Lower end of the quiet range, shape [pixel].
        high_out: Upper end of the quiet range, shape [pixel].
        lead_out: Quiet frames, shape [pixel].
    """
    begin = first_pixel + wp.tid() * TILE_SIZE
    screen_tile(
        threshold_on,
        threshold_off,
        begin,
        wp.min(begin + TILE_SIZE, end_pixel),
        log_radiance,
        frame_count,
        base,
        crossed,
        low_out,
        high_out,
        lead_out,
    )


@wp.kernel(launch_bounds=(BLOCK_SIZE, 3))  # as many blocks as need no register spilled
def scan(
    # Model:
    threshold_on: wp.float64,
    threshold_off: wp.float64,
    width: wp.int32,
    row_shift: wp.int32,
    time_shift: wp.int32,
    # In:
    first_pixel: wp.int32,
    end_pixel: wp.int32,
    log_radiance: wp.array2d[wp.float32],
    stamps: wp.array[wp.int64],
    frame_count: wp.int32,
    lead: wp.array[wp.int32],
    row_limit: wp.array[wp.int32],
    base: wp.array[wp.float32],
    last: wp.array[wp.float32],
    crossed: wp.array[wp.vec2i],
    tabulate: wp.bool,
    # Out:
    last_out: wp.array[wp.float32],
    crossed_out: wp.array[wp.vec2i],
    keys_out: wp.array[wp.int64],
    counters_out: wp.array[wp.int64],
    table_out: wp.array2d[wp.int32],
) -> None:
    """Take the pixels [first_pixel, end_pixel) over `frame_count` frames.

    Args:
        threshold_on: Step of log radiance upwards.
        threshold_off: Step of log radiance downwards.
        width: Pixels per row.
        row_shift: Bits of a key below its row.
        time_shift: Bits of a key below its microseconds.
        first_pixel: Pixel of thread 0.
        end_pixel: Threads at or past it (they fill the last CUDA block) have no pixel.
        log_radiance: Frames, shape [frame, pixel].
        stamps: Stamp of the state, then of each frame, from the keys' time origin [ns], shape [frame + 1].
        frame_count: Frames to scan.
        lead: Frames at the start that `screen` found quiet, or 0, shape [pixel].
        row_limit: Rows whose events are kept, for each frame, shape [frame].
        base: Log radiance of the reset, shape [pixel].
        last: Last sample, shape [pixel].
        crossed: Levels crossed upwards and downwards, shape [pixel].
        tabulate: Only add the number of events to `table_out`, and change nothing else.
        last_out: `last` after the scan.
        crossed_out: `crossed` after the scan.
        keys_out: Keys of the events, in no defined order; those past its end are not written.
        counters_out: Zeros before. Events kept (written or not); invalid samples; and the flat index of the
            first of these in the stack, as frame_count * pixel_count minus it.
        table_out: Events by frame and row, shape [frame, row], zeros before; used when `tabulate`.
    """
    thread = wp.tid()
    scan_pixel(
        threshold_on,
        threshold_off,
        width,
        row_shift,
        time_shift,
        first_pixel + thread,
        end_pixel,
        thread % BLOCK_SIZE,
        log_radiance,
        stamps,
        frame_count,
        lead,
        row_limit,
        base,
        last,
        crossed,
        tabulate,
        last_out,
        crossed_out,
        keys_out,
        counters_out,
        table_out,
    )


@wp.func
def mark(key: wp.int64, stamps: wp.array[wp.int64], stamp_count: wp.int32, time_shift: wp.int32) -> wp.int64:
    """Return a key with `late` set if it comes after a stamp within its microsecond; see `mark_late`."""
    time_us = key >> wp.int64(time_shift)
    low = wp.int32(0)
    high = stamp_count
    while low < high:
        middle = (low + high) // 2
        if stamps[middle] // _US < time_us:
            low = middle + 1
        else:
            high = middle
    if low < stamp_count:
        end_ns = stamps[low]
        sub_ns = key & wp.int64(1023)
        if end_ns // _US == time_us and sub_ns > end_ns - time_us * _US:
            return key | (wp.int64(1) << wp.int64(time_shift - 1))
    return key


@wp.kernel
def mark_late(
    # In:
    stamps: wp.array[wp.int64],
    stamp_count: wp.int32,
    time_shift: wp.int32,
    # In/out:
    keys: wp.array[wp.int64],
) -> None:
    """Set `late` on the keys that come after a stamp within its microsecond.

    Args:
        stamps: Ends of windows from the keys' time origin [ns], at least 1 us apart, increasing.
        stamp_count: How many there are.
        time_shift: Bits of a key below its microseconds.
        keys: Keys, in any order; overwritten.
    """
    event = wp.tid()
    keys[event] = mark(keys[event], stamps, stamp_count, time_shift)


@wp.func
def move_origin(key: wp.int64, step_us: wp.int64, time_shift: wp.int32) -> wp.int64:
    """Return a key with a time origin that is later, and without `late`."""
    return (key & ~(wp.int64(1) << wp.int64(time_shift - 1))) - (step_us << wp.int64(time_shift))


@wp.kernel
def carry_over(
    # In:
    keys: wp.array[wp.int64],
    first: wp.int32,
    origin_step_us: wp.int64,
    time_shift: wp.int32,
    # Out:
    keys_out: wp.array[wp.int64],
    first_out: wp.int32,
) -> None:
    """Copy keys, from and to a position, with a time origin that is later, and clear `late`."""
    event = wp.tid()
    keys_out[first_out + event] = move_origin(keys[first + event], origin_step_us, time_shift)


@wp.func
def count_until(
    end_ns: wp.int64, keys: wp.array[wp.int64], key_count: wp.int32, time_shift: wp.int32
) -> wp.int32:
    """Return how many of the sorted keys are in a window that ends then, or before it; see `find_ends`."""
    bound = ((end_ns // _US) << wp.int64(time_shift)) | (wp.int64(1) << wp.int64(time_shift - 1))
    low = wp.int32(0)
    high = key_count
    while low < high:
        middle = (low + high) // 2
        if keys[middle] < bound:
            low = middle + 1
        else:
            high = middle
    return low


@wp.kernel
def find_ends(
    # In:
    keys: wp.array[wp.int64],
    key_count: wp.int32,
    stamps: wp.array[wp.int64],
    time_shift: wp.int32,
    # Out:
    end_out: wp.array[wp.int32],
) -> None:
    """Find where each window ends in the sorted keys.

    Args:
        keys: Keys after `mark_late`, sorted.
        key_count: Number of keys.
        stamps: Ends of windows from the keys' time origin [ns], shape [window].
        time_shift: Bits of a key below its microseconds.
        end_out: Index of the first key after each window, shape [window].
    """
    window = wp.tid()
    end_out[window] = count_until(stamps[window], keys, key_count, time_shift)


@wp.struct
class Event:
    """What a key says."""

    time_us: wp.int64
    """From the keys' time origin."""
    x: wp.uint16
    y: wp.uint16
    polarity: wp.uint8


@wp.func
def take_apart(key: wp.int64, row_shift: wp.int32, time_shift: wp.int32) -> Event:
    """Return what a key says; parameters as for `decode`."""
    one = wp.int64(1)
    row_mask = (one << wp.int64(time_shift - 1 - row_shift)) - one
    column_mask = (one << (wp.int64(row_shift) - COLUMN_SHIFT)) - one
    found = Event()
    found.time_us = key >> wp.int64(time_shift)
    found.x = wp.uint16((key >> COLUMN_SHIFT) & column_mask)
    found.y = wp.uint16((key >> wp.int64(row_shift)) & row_mask)
    found.polarity = wp.uint8((key >> wp.int64(10)) & one)
    return found


@wp.kernel
def decode(
    # In:
    keys: wp.array[wp.int64],
    time_origin_us: wp.int64,
    row_shift: wp.int32,
    time_shift: wp.int32,
    # Out:
    t_out: wp.array[wp.int64],
    x_out: wp.array[wp.uint16],
    y_out: wp.array[wp.uint16],
    polarity_out: wp.array[wp.uint8],
) -> None:
    """Take keys apart into time [us], column, row and polarity, arrays of shape [event].

    Args:
        keys: Keys.
        time_origin_us: Origin of the keys' time [us].
        row_shift: Bits of a key below its row.
        time_shift: Bits of a key below its microseconds.
        t_out: Time [us].
        x_out: Column.
        y_out: Row.
        polarity_out: 1: brighter, 0: darker.
    """
    event = wp.tid()
    found = take_apart(keys[event], row_shift, time_shift)
    t_out[event] = time_origin_us + found.time_us
    x_out[event] = found.x
    y_out[event] = found.y
    polarity_out[event] = found.polarity


@wp.kernel
def decode_block(
    # In:
    keys: wp.array[wp.int64],
    room: wp.int32,
    time_origin_us: wp.int64,
    row_shift: wp.int32,
    time_shift: wp.int32,
    # Out:
    columns_8: wp.array[wp.int64],
    columns_2: wp.array[wp.uint16],
    columns_1: wp.array[wp.uint8],
) -> None:
    """Take keys apart like `decode`, into one block of memory that is given as three types.

    The columns are in it one after the other, each with room for `room` events, an even number.
    """
    event = wp.tid()
    found = take_apart(keys[event], row_shift, time_shift)
    columns_8[event] = time_origin_us + found.time_us
    columns_2[4 * room + event] = found.x
    columns_2[5 * room + event] = found.y
    columns_1[12 * room + event] = found.polarity
