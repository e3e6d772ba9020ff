"""Fly a sensor that this file defines: a switch that closes near the ground.

It prints how often the switch was closed, and writes a recording for `neurosim view proximity`. To install
such a sensor as a package, name its module in an entry point of the group `neurosim.plugins`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import warp as wp
from numpy.typing import NDArray

import neurosim_core as ns


@dataclass(frozen=True, kw_only=True, eq=False)
class Proximity(ns.Packet):
    """A reading of the switch. These fields define its recording, its plot and its messages."""

    closed: bool
    height_m: Annotated[float, ns.packets.FieldSpec(unit="m")]


@ns.register("sensor", "proximity")
class ProximityConfig(ns.sensors.StateSensorConfig):
    """A switch that closes below a height."""

    kind: Literal["proximity"] = "proximity"
    rate_hz: ns.sensors.RateHz = 100.0
    """Readings a second [Hz]."""
    threshold_m: float = 1.0
    """Height below which it closes [m]."""

    packet_type = Proximity

    def make(self, context: ns.sensors.SamplerContext) -> ProximitySampler:
        """Return the sampler."""
        return ProximitySampler(self.threshold_m, context)


class ProximitySampler(ns.sensors.Sampler):
    """Copies the heights of the vehicles of all worlds on the device; the host compares them."""

    def __init__(self, threshold_m: float, context: ns.sensors.SamplerContext) -> None:
        self._threshold_m, self._position = threshold_m, context.vehicle.arrays.position
        shape = (context.slot_count, context.vehicle.count)
        self.arrays = {"position": wp.zeros(shape, dtype=wp.vec3d, device=self._position.device)}

    def measure(self, slot: int) -> None:
        """Copy the present positions into a slot."""
        wp.copy(self.arrays["position"][slot], self._position)

    def packet(self, rows: Mapping[str, NDArray[Any]], **header: Any) -> Proximity:
        """Return one sample as a packet."""
        height_m = float(rows["position"][2])
        return Proximity(closed=height_m < self._threshold_m, height_m=height_m, **header)


def main(out: Path = Path("proximity")) -> int:
    """Fly a descent; return how many readings said that the switch was closed."""
    sensors = {"proximity": {"kind": "proximity", "threshold_m": 1.45}}
    config = {"duration_s": 2.0, "device": "cpu", "scene": {"rooms": 1}, "sensors": sensors}
    ns.fly(ns.load_config(config), out)
    with ns.Recording(out / "flight.h5") as flight:
        readings = [packet for packet in flight.packets() if isinstance(packet, Proximity)]
    closed = sum(reading.closed for reading in readings)
    heights = [reading.height_m for reading in readings]
    print(f"{len(readings)} readings, {closed} closed, heights {min(heights):.2f} to {max(heights):.2f} m")
    return closed


if __name__ == "__main__":
    main()
