# mypy: disable-error-code="misc,attr-defined"
"""How event pixels depart from the ideal: the base of the settings of a noise term, and the terms by kind."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, ClassVar

import warp as wp
from pydantic import ValidationError

from neurosim_core.config_errors import explain
from neurosim_core.registry import find
from neurosim_core.settings import Settings


@wp.struct
class SignalTerm:
    """What the device function of a term reads that stays."""

    numbers: wp.vec4d  # `NoiseTermConfig.numbers`
    seed: wp.uint64  # Seed of what stays in the pixels
    stream: wp.uint32  # Of the random numbers of the term in this camera


_SIGNAL = (SignalTerm, wp.uint64, wp.int32, wp.int64, wp.float64)


class NoiseTermConfig(Settings):
    """A way in which pixels depart from the ideal; a package registers its own as `noise`, by kind.

    A term of another package changes what a pixel sees: it extends this class by its `kind`, its keys,
    `numbers` and `signal`, and is asked for under `noise` of the pixel. It acts on log radiance after
    `lin_log` and before the photoreceptor; of several, in the alphabetical order of their kinds.
    """

    compiled: ClassVar[tuple[str, ...]] = ()
    """Terms of `event_noise_model.TERMS` that are compiled in for it; none: `signal` is, under its kind."""
    signal: ClassVar[Any] = None
    """Device function (`wp.func`): from a `SignalTerm`, the seed of numbers that change with time (uint64),
    the index of the pixel, row by row (int32), the time since the reset [ns] (int64) and log radiance
    (float64) to what the pixel sees at that time (float64). Between two frames that is linear in time.
    A number that meets a float64 is written `wp.float64(0.5)`: Warp converts none.
    Random numbers are addressed: `random_bits(seed, term.stream, since_reset_ns, pixel)` for what changes
    with every frame, `random_bits(term.seed, term.stream, 0, pixel)` for what stays."""

    def numbers(self, white_radiance: float) -> tuple[float, ...]:
        """Return what `SignalTerm.numbers` holds, at most four.

        Args:
            white_radiance: Radiance that counts as white (`EventCameraConfig.white_radiance`).
        """
        return ()

    def terms(self) -> tuple[str, ...]:
        """Return the names of what is compiled in."""
        return self.compiled or (type(self).model_fields["kind"].default,)

    @classmethod
    def check_class(cls) -> None:
        """Refuse a term of which there is nothing to compile.

        Raises:
            TypeError: `signal` is missing, or takes something else.
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
