"""Fly your own sensor with one kernel and with errors: an anemometer in a gust. It prints the readings."""

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
import warp as wp
from numpy.typing import NDArray

import neurosim_core as ns


@dataclass(frozen=True, kw_only=True, eq=False)
class Airflow(ns.Packet):
    """A reading of the anemometer."""

    air: Annotated[NDArray[np.float64], ns.packets.FieldSpec(3, unit="m/s", frame="body")]
    """Velocity of the air relative to the vehicle, in B [m/s]."""


@wp.func
def _read_air(scale: wp.float64, motion: ns.sensors.Motion, world: int, output: int) -> wp.vec3d:
    against = motion.air_velocity[world] - motion.velocity[world]
    return scale * wp.quat_rotate_inv(motion.orientation[world], against)


@ns.register("sensor", "anemometer")
class AnemometerConfig(ns.sensors.StateSensorConfig):
    """Reads the velocity of the air."""

    kind: Literal["anemometer"] = "anemometer"
    rate_hz: ns.sensors.RateHz = 100.0
    """Readings a second [Hz]."""
    errors: ns.sensors.ErrorConfig = ns.sensors.ErrorConfig(white=0.05, markov=0.1)
    """Errors of the velocity [m/s]."""

    scale: float = 1.0
    """Factor of all readings."""

    packet_type = Airflow

    def make(self, context: ns.sensors.SamplerContext) -> ns.sensors.StateSampler:
        """Return the sampler."""
        scale, errors = wp.float64(self.scale), {"air": self.errors}
        return ns.sensors.make_reader(context, _read_air, scale, errors, Airflow, rate_hz=self.rate_hz)


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
