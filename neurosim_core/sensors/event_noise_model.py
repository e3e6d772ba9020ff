"""What is not ideal in event pixels: the law of each term, its parameters, and what pixels remember of it.

**Photoreceptor** (term low_pass). tau(I) dy/dt = L - y, solved exactly for log radiance L that is linear in
time and tau that is constant; an interval is cut where L moves by more than 1/8, and tau is taken in the
middle of each piece. One pole is what measurements show (v2e).

**Lin-log** (lin_log). In the dark the pixel sees light itself in place of its logarithm, as in v2e; what it
sees is linear in time between frames.

**Mismatch** (spread). Thresholds of each pixel are normal numbers, drawn once, at least `minimum`.

**Jitter** (jitter). After each event the thresholds of a pixel are drawn anew, normal around its own ones,
and count from the level crossed.

**Leak** (leak). The reference falls by rate times ON threshold, so a still pixel fires ON events at `rate`. A
pixel begins at a random phase, as if it had been on for long. Where light leaks through the switch (term
light_leak), the rate grows linearly with it; what has leaked is integrated over each frame.

**Refractory time** (refractory). After an event a pixel is held in reset, and its reference is the signal at
the end of that: a ramp of slope s fires every t_ref + C / s.

**Shot noise, hot pixels** (spontaneous). One Poisson process for each pixel, drawn as waiting times of its
largest rate and thinned to the rate at the light of that instant. A noise event resets a pixel like any
other: its reference becomes the signal. Rates that were measured in several lights (term measured) give each
polarity its own rate.

**First passage** (stochastic). DVS-Voltmeter: voltage is a Brownian motion with constant drift and spread
between frames. Its increment is drawn, then whether the bridge between its ends touched a threshold, and
when: with t the first time in an interval of length T, t / (T - t) is inverse Gaussian. This is the law in
continuous time, whatever the frames, but that a piece of at most a quarter of a threshold of noise is taken
to touch one threshold only (an error below e^-32).

Reference: Hu, Liu, Delbruck (2021), v2e: from video frames to realistic DVS events, CVPRW; Nozaki, Delbruck
(2017), Temperature and parasitic photocurrent effects in dynamic vision sensors; Lin et al. (2022),
DVS-Voltmeter, ECCV; Beghin, Orsingher (1999), On the maximum of the generalized Brownian bridge; Michael,
Schucany, Haas (1976), Generating random variates using transformations with multiple roots.
"""

import warp as wp

from neurosim_core.sensors.event_config import EventCameraConfig
from neurosim_core.sensors.event_terms import NoiseTermConfig, SignalTerm

wp.set_module_options({"enable_backward": False})

TERMS = (
    "spread", "jitter", "lin_log", "low_pass", "refractory", "leak", "light_leak", "spontaneous", "measured",
    "stochastic",
)  # fmt: skip
"""All terms of our own that may be compiled in; those of other packages have the names of their kinds."""
CAUSE = "cause"
"""A further term: the column of an event is eight times the column plus its cause."""
CAUSES = ("signal", "leak", "shot noise", "hot pixel", "threshold noise")
"""Why pixels fire."""
CAUSE_BITS = 3


@wp.struct
class PixelModel:
    """Parameters as the kernel reads them, times in ns; arrays of absent terms are empty."""

    threshold_on: wp.float64
    threshold_off: wp.float64
    white_radiance: wp.float64
    log_white: wp.float64
    jitter: wp.vec2d  # standard deviations ON, OFF
    jitter_least: wp.float64
    refractory_ns: wp.float64
    signals: wp.array[SignalTerm]  # what changes what pixels see, in the order of `signal_terms`
    corner_per_ns: wp.float64  # 1 / tau at white
    dark_radiance: wp.float64
    bright_factor: wp.float64
    leak_growth: wp.float64  # of the leak from dark to white, as a share
    shot_on_fraction: wp.float64
    shot_by_threshold: wp.bool
    hot_on_fraction: wp.float64
    k1: wp.float64
    k2: wp.float64
    k3: wp.float64  # per root ns
    k4: wp.float64  # per ns
    k5: wp.float64
    k6: wp.float64
    seed: wp.uint64  # of numbers in time
    spontaneous_stream: wp.uint32
    step_stream: wp.uint32
    touch_stream: wp.uint32
    jitter_stream: wp.uint32
    thresholds: wp.array[wp.vec2d]  # ON, OFF
    leak: wp.array[wp.vec2d]  # cycles per ns, phase in cycles
    rates: wp.array[wp.vec2d]  # shot noise in the dark, or at most, and hot pixel, per ns
    noise_light: wp.array[wp.float64]  # log radiance at which noise was measured, rising
    noise_rates: wp.array2d[wp.vec2]  # ON and OFF, shape [light, pixel], per ns


@wp.struct
class Memory:
    """What pixels remember beside their last sample and the levels they crossed, shape [pixel]."""

    reference: wp.array[wp.float64]
    """What `base` is to an ideal pixel; changes at resets (refractory, spontaneous) and events (jitter)."""
    event_count: wp.array[wp.int32]  # Events since the reset, which number the draws of thresholds
    filtered: wp.array[wp.float64]  # Output of the photoreceptor
    exposure_ns: wp.array[wp.float64]  # Light since the reset, in units of white, times time
    held_ns: wp.array[wp.float64]  # Time in reset that is left; negative: not in reset
    next_ns: wp.array[wp.int64]  # Time of the next noise event that may be, since the reset
    noise_count: wp.array[wp.int32]  # Its number
    voltage: wp.array[wp.float64]  # Of the Brownian motion, in thresholds


def terms_of(config: EventCameraConfig) -> tuple[str, ...]:
    """Return the terms that a configuration asks for; none: the pixels are ideal."""
    groups = [getattr(config, name) for name in type(config).model_fields]
    terms = [each for each in (*groups, *config.noise) if isinstance(each, NoiseTermConfig)]
    present = {name for term in terms for name in term.terms()}
    if config.refractory_s > 0.0:
        present.add("refractory")
    return (*(term for term in TERMS if term in present), *sorted(present - set(TERMS)))
