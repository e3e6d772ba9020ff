"""An anemometer in a gust: a sensor of your own that is one kernel, with errors. It prints what it read."""

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
import warp as wp
from numpy.typing import NDArray

import neurosim_core as ns
from neurosim_core.sensors import ErrorConfig, Errors, Motion, StateSampler, error_adder, make_errors


@dataclass(frozen=True, kw_only=True, eq=False)
class Airflow(ns.Packet):
    """What the anemometer reads."""

    air: Annotated[NDArray[np.float64], ns.packets.FieldSpec(3, unit="m/s", frame="body")]
    """Velocity of the air against the vehicle, in B [m/s]."""


def _make_kernel(terms: tuple[str, ...]) -> Any:
    add_errors = error_adder(terms)

    # annotations must be objects: a file with such a kernel has no `from __future__ import annotations`
    @wp.kernel(module="unique", enable_backward=False)
    def measure(
        model: Errors, motion: Motion, seeds: wp.array[wp.uint64], active: wp.array[wp.int32],
        sample: wp.array[wp.int64], memory: wp.array2d[wp.vec3d], slot: int, air_out: wp.array2d[wp.vec3d],
    ):  # fmt: skip
        world = wp.tid()
        if active[world] != 0:
            against = motion.air_velocity[world] - motion.velocity[world]
            value = wp.quat_rotate_inv(motion.orientation[world], against)
            air_out[slot, world] = add_errors(model, seeds[world], sample[world], value, memory, world, 0)
            sample[world] += wp.int64(1)

    return measure


class Anemometer(StateSampler):
    """The anemometers of all worlds."""

    def packet(self, rows: Any, **header: Any) -> Airflow:
        """Return one sample as a packet."""
        return Airflow(air=np.array(rows["air"]), **header)


@ns.register("sensor", "anemometer")
class AnemometerConfig(ns.sensors.StateSensorConfig):
    """Reads the velocity of the air."""

    kind: Literal["anemometer"] = "anemometer"
    rate_hz: ns.sensors.RateHz = 100.0
    """Readings a second [Hz]."""
    errors: ErrorConfig = ErrorConfig(white=0.05, markov=0.1)
    """In m/s."""

    packet_type = Airflow

    def make(self, context: ns.sensors.SamplerContext) -> Anemometer:
        """Return the sensor at work."""
        terms = self.errors.terms()
        model = make_errors(self.errors, rate_hz=self.rate_hz, name=f"{context.name}/air")
        return Anemometer(context, _make_kernel(terms), model, outputs={"air": wp.vec3d}, terms=terms)


def main() -> float:
    """Hover in a gust; return the strongest wind that was read [m/s]."""
    gust = {"velocity_m_s": [5.0, 0.0, 0.0], "start_s": 0.2, "rise_s": 0.3, "hold_s": 0.1}
    config = {"duration_s": 1.0, "scene": {"rooms": 1}, "device": "cpu", "path": {"kind": "hover"}}
    config |= {"vehicle": {"parameters": {"gusts": [gust]}}, "sensors": {"wind": {"kind": "anemometer"}}}
    readings = [float(np.linalg.norm(packet.air)) for packet in ns.run(config)]
    print(f"{len(readings)} readings of the wind, at most {max(readings):.2f} m/s")
    return max(readings)


if __name__ == "__main__":
    main()
