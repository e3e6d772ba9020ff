"""Fly the vehicle of another library: RotorPy's equations with the same sensors and path.

It prints the largest distance between the two vehicles in a second of the same flight. A vehicle of an
installed package registers through an entry point of the group `neurosim.plugins`.
"""

from __future__ import annotations

import importlib
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

import neurosim_core as ns

try:
    from rotorpy.vehicles.multirotor import Multirotor
except ImportError as error:
    raise SystemExit(f"this example needs RotorPy ({error}): pip install -e '.[dev]'") from None

State = ns.vehicle.MultirotorState
_NAMES = dict(zip(State._fields, ("x", "v", "q", "w", "rotor_speeds"), strict=True))


@ns.register("vehicle", "rotorpy")
class RotorPyVehicleConfig(ns.vehicle.VehicleConfig):
    """RotorPy's multirotor, with its own parameters of an airframe."""

    kind: Literal["rotorpy"] = "rotorpy"
    preset: str = "hummingbird"
    """Name of the airframe: hummingbird, or crazyflie, whose parameters differ in RotorPy and Neurosim."""

    def airframe(self) -> ns.MultirotorConfig:
        """Return the multirotor that controllers assume."""
        return ns.preset(self.preset)

    def make(self, context: ns.vehicle.VehicleContext) -> RotorPyVehicle:
        """Return the vehicles of all worlds."""
        return RotorPyVehicle(self.preset, context)


class RotorPyVehicle(ns.vehicle.HostVehicle):
    """Integrates with RotorPy, one vehicle after the other."""

    def __init__(self, airframe: str, context: ns.vehicle.VehicleContext) -> None:
        super().__init__(ns.preset(airframe), context)
        self._vehicle = Multirotor(importlib.import_module(f"rotorpy.vehicles.{airframe}_params").quad_params)

    def move(self, state: State, command: NDArray[np.float64], duration_s: float) -> State:
        """Let RotorPy integrate."""
        later = self._vehicle.step(self._told(state), {"cmd_motor_speeds": command}, duration_s)
        return State(*(later[name] for name in _NAMES.values()))

    def acceleration(self, state: State, command: NDArray[np.float64]) -> ns.vehicle.Acceleration:
        """Ask RotorPy for the derivatives; IMUs need them."""
        rates = self._vehicle.statedot(self._told(state), {"cmd_motor_speeds": command}, 0.0)
        return ns.vehicle.Acceleration(linear=rates["vdot"], angular=rates["wdot"])

    def _told(self, state: State) -> dict[str, Any]:
        return {_NAMES[name]: value for name, value in state._asdict().items()} | {"wind": np.zeros(3)}


def fly(vehicle: str) -> NDArray[np.float64]:
    """Return the positions of a flight through a generated flat, shape [200, 3]."""
    sensors = {"imu": {"kind": "imu"}, "odometry": {"kind": "odometry"}}
    scene = {"kind": "apartment", "rooms": 1}
    config = {"duration_s": 1.0, "device": "cpu", "scene": scene, "vehicle": vehicle, "sensors": sensors}
    return np.array([packet.position for packet in ns.run(config) if isinstance(packet, ns.Odometry)])


def main() -> float:
    """Fly both; return the largest distance between them [m]."""
    apart = np.linalg.norm(fly("rotorpy") - fly("multirotor"), axis=1)
    print(f"{len(apart)} positions, at most {1e6 * apart.max():.3f} um apart")
    return float(apart.max())


if __name__ == "__main__":
    main()
