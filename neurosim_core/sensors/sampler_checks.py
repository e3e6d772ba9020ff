"""State sensors as the engine makes and reads them; what their code lacks is said by the sensor's name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from numpy.typing import NDArray

from neurosim_core.packets import Packet
from neurosim_core.sensors.base import Sampler, SamplerContext, StateSensorConfig


def make_sampler(config: StateSensorConfig, context: SamplerContext) -> Sampler:
    """Return a state sensor at work, and check what it has allocated.

    Raises:
        TypeError: It has no arrays.
        ValueError: An array has another shape than it needs.
    """
    made, axes = config.make(context), (context.slot_count, context.vehicle.count)
    arrays = getattr(made, "arrays", None)
    if not isinstance(arrays, Mapping):
        raise TypeError(
            f"sensor {context.name!r}: {type(made).__qualname__} must set `self.arrays`, what it measures by "
            f"name: device arrays of shape [slot, world, ...], here {axes}; got {arrays!r}"
        )
    for field, array in arrays.items():
        if tuple(array.shape[:2]) != axes:
            raise ValueError(
                f"sensor {context.name!r}: arrays[{field!r}] needs shape [slot, world, ...], here "
                f"{axes}, got {tuple(array.shape)}: (context.slot_count, context.vehicle.count, ...)"
            )
    return made


class _Rows(dict[str, NDArray[Any]]):
    """The rows of a sample; one that is not there is said by the names of those that are."""

    sensor = ""

    def __missing__(self, key: str) -> NDArray[Any]:
        raise KeyError(f"sensor {self.sensor!r}: no array {key!r} was measured, known: {sorted(self)}")


def sample_packet(
    sampler: Sampler, rows: Mapping[str, NDArray[Any]], *, stamp_ns: int, sequence: int, sensor: str
) -> Packet | None:
    """Return one sample of a state sensor as a packet, and check that it has the header.

    Raises:
        KeyError: It asks for an array that it does not measure.
        TypeError: It gives something else than a packet.
        ValueError: The packet has not the header that it was given.
    """
    known = _Rows(rows)
    known.sensor = sensor
    packet = sampler.packet(known, stamp_ns=stamp_ns, sequence=sequence, sensor=sensor)
    if packet is None:
        return None
    if not isinstance(packet, Packet):
        raise TypeError(f"sensor {sensor!r}: packet() must return a packet or None, got {packet!r:.80}")
    if packet.sensor != sensor:
        raise ValueError(
            f"sensor {sensor!r}: packet() must pass the header on: {type(packet).__qualname__}(..., **header)"
        )
    return packet
