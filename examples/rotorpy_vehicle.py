"""Fly another library's vehicle: the equations of RotorPy in place of ours, under the same sensors and path.

It prints how far the two vehicles get from each other in a second of the same flight. A vehicle of an
installed package registers through an entry point of the group `neurosim.plugins`.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

import neurosim_core as ns

_NAMES = dict(zip(ns.vehicle.MultirotorState._fields, ("x", "v", "q", "w", "rotor_speeds"), strict=True))


def rotorpy_parameters(config: ns.MultirotorConfig) -> dict[str, Any]:
    """Return the parameters of an airframe under RotorPy's names."""
    inertia = np.array(config.inertia_kg_m2)
    return {
        "mass": config.mass_kg,
        **{f"I{'xyz'[i]}{'xyz'[j]}": inertia[i, j] for i in range(3) for j in range(i, 3)},
        **{f"c_D{axis}": drag for axis, drag in zip("xyz", config.parasitic_drag_kg_m, strict=True)},
        "num_rotors": config.rotor_count,
        "rotor_pos": {f"r{k + 1}": np.array(hub) for k, hub in enumerate(config.rotor_position_m)},
        "rotor_directions": np.array(config.rotor_direction),
        "rotor_speed_min": config.rotor_speed_min_rad_s,
        "rotor_speed_max": config.rotor_speed_max_rad_s,
        "k_eta": config.thrust_coefficient_n_s2,
        "k_m": config.torque_coefficient_n_m_s2,
        "k_d": config.rotor_drag_kg,
        "k_z": config.rotor_inflow_kg,
        "k_h": config.translational_lift_kg_m,
        "k_flap": config.flapping_kg_m,
        "tau_m": config.motor_time_constant_s,
    }


@ns.register("vehicle", "rotorpy")
class RotorPyVehicleConfig(ns.vehicle.VehicleConfig):
    """RotorPy's multirotor, with the parameters of one of our airframes."""

    kind: Literal["rotorpy"] = "rotorpy"
    preset: str = "hummingbird"
    """Name of the airframe."""

    def airframe(self) -> ns.MultirotorConfig:
        """Return the multirotor that controllers assume."""
        return ns.preset(self.preset)

    def make(self, context: ns.vehicle.VehicleContext) -> RotorPyVehicle:
        """Return the vehicles of all worlds."""
        return RotorPyVehicle(self.airframe(), context)


class RotorPyVehicle(ns.vehicle.HostVehicle):
    """Integrates with RotorPy, one vehicle after the other."""

    def __init__(self, config: ns.MultirotorConfig, context: ns.vehicle.VehicleContext) -> None:
        super().__init__(config, context)
        from rotorpy.vehicles.multirotor import Multirotor

        self._vehicle = Multirotor(rotorpy_parameters(config))

    def move(
        self, state: ns.vehicle.MultirotorState, command: NDArray[np.float64], duration_s: float
    ) -> ns.vehicle.MultirotorState:
        """Let RotorPy integrate."""
        later = self._vehicle.step(self._told(state), {"cmd_motor_speeds": command}, duration_s)
        return ns.vehicle.MultirotorState(
            *(later[_NAMES[name]] for name in ns.vehicle.MultirotorState._fields)
        )

    def acceleration(
        self, state: ns.vehicle.MultirotorState, command: NDArray[np.float64]
    ) -> ns.vehicle.Acceleration:
        """Ask RotorPy for the derivatives; IMUs need them."""
        rates = self._vehicle.statedot(self._told(state), {"cmd_motor_speeds": command}, 0.0)
        return ns.vehicle.Acceleration(linear=rates["vdot"], angular=rates["wdot"])

    def _told(self, state: ns.vehicle.MultirotorState) -> dict[str, Any]:
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
