# mypy: disable-error-code="misc,attr-defined"
"""Noise of event pixels: the law of each term, its parameters, and the base of its settings.

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

from collections.abc import Iterable, Mapping
from typing import Any, ClassVar

import warp as wp
from pydantic import ValidationError

from neurosim_core.config_errors import explain
from neurosim_core.registry import find
from neurosim_core.settings import BaseConfig

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
class SignalTerm:
    """What the device function of a term reads that stays."""

    numbers: wp.vec4d  # `NoiseTermConfig.numbers`
    seed: wp.uint64  # Seed of what stays in the pixels
    stream: wp.uint32  # Of the random numbers of the term in this camera


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
    phase_stream: wp.uint32
    random_phase: wp.bool  # voltages begin at random ones
    thresholds: wp.array[wp.vec2d]  # ON, OFF
    leak: wp.array[wp.vec2d]  # cycles per ns, phase in cycles
    rates: wp.array[wp.vec2d]  # shot noise in the dark, or at most, and hot pixel, per ns
    noise_light: wp.array[wp.float64]  # log radiance at which noise was measured, rising
    noise_rates: wp.array2d[wp.vec2]  # ON and OFF, shape [light, pixel], per ns


_SIGNAL = (SignalTerm, wp.uint64, wp.int32, wp.int64, wp.float64)


class NoiseTermConfig(BaseConfig):
    """Base class of the settings of noise terms. Plug-ins register theirs in the category `noise`.

    A term of a plug-in changes the input of a pixel. It adds `kind`, its fields, `numbers` and `signal` to
    this class, and settings list it under `noise` of the pixel. It acts on log radiance after `lin_log` and
    before the photoreceptor; several terms act in the alphabetical order of their kinds.
    """

    compiled: ClassVar[tuple[str, ...]] = ()
    """Built-in terms that it needs, a subset of `TERMS`; empty: `signal` is compiled."""
    signal: ClassVar[Any] = None
    """Device function (`wp.func`) that returns the input of the pixel (float64). Its parameters are a
    `SignalTerm`, the seed of numbers that change with time (uint64), the row-major index of the pixel
    (int32), the time since the reset [ns] (int64) and log radiance (float64). Its result is linear in time
    between two frames. Warp does not convert numbers: write `wp.float64(0.5)` in float64 expressions.
    Random numbers: `random_bits(seed, term.stream, since_reset_ns, pixel)` differs for every frame,
    `random_bits(term.seed, term.stream, 0, pixel)` is constant in a run."""

    def numbers(self, white_radiance: float) -> tuple[float, ...]:
        """Return the values of `SignalTerm.numbers`, at most four.

        Args:
            white_radiance: Radiance that counts as white (`EventCameraConfig.white_radiance`).
        """
        return ()

    def terms(self) -> tuple[str, ...]:
        """Return the names of the compiled terms."""
        return self.compiled or (type(self).model_fields["kind"].default,)

    @classmethod
    def check_class(cls) -> None:
        """Check the class when it is registered.

        Raises:
            TypeError: `signal` is missing or has wrong parameters, or there is no field `kind`.
        """
        if cls.compiled:
            return
        taken = getattr(cls.signal, "input_types", None)
        if taken is None or tuple(taken.values()) != _SIGNAL:
            wanted = ", ".join(kind.__name__ for kind in _SIGNAL)
            raise TypeError(f"{cls.__qualname__}.signal must be a wp.func of ({wanted}), got {taken}")
        if "kind" not in cls.model_fields:
            raise TypeError(f'{cls.__qualname__} must have a field `kind`, such as kind: Literal["flicker"]')


def parse_terms(given: Any) -> Any:
    """Return terms that settings name by their kind, for validators of mode "before".

    Raises:
        ValueError: There is no such kind, or a key is wrong.
    """
    if not isinstance(given, Iterable) or isinstance(given, str | Mapping):
        return given
    return tuple(_parse(each) for each in given)


def _parse(given: Any) -> Any:
    if not isinstance(given, Mapping):
        return given
    if not isinstance(given.get("kind"), str):
        raise ValueError("a term is {kind: NAME, ...}")
    kind: type[NoiseTermConfig] = find("noise", given["kind"])
    if kind.compiled:
        raise ValueError(f"{given['kind']} is a key of the pixel: {{{given['kind']}: {{...}}}}")
    try:
        return kind.model_validate(given)
    except ValidationError as error:
        raise ValueError(f"{given['kind']}: {'; '.join(explain(kind, error))}") from None
