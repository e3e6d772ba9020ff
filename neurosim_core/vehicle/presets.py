"""Airframes by name, with the source of each parameter."""

from __future__ import annotations

from typing import Any

from neurosim_core.frames import Vector3
from neurosim_core.vehicle.airframe import MultirotorConfig

_DIAGONAL = 0.70710678118  # cos 45 degrees, with the digits of RotorPy's tables


def _diagonal(moments: Vector3) -> tuple[Vector3, Vector3, Vector3]:
    x, y, z = moments
    return ((x, 0.0, 0.0), (0.0, y, 0.0), (0.0, 0.0, z))


def _cross(x_m: float, y_m: float, z_m: float = 0.0) -> tuple[Vector3, ...]:
    """Front left, front right, rear right, rear left."""
    return ((x_m, y_m, z_m), (x_m, -y_m, z_m), (-x_m, -y_m, z_m), (-x_m, y_m, z_m))


CRAZYFLIE = MultirotorConfig(
    # Foerster (2015), "System Identification of the Crazyflie 2.0 Nano Quadrocopter"; Crazyflie firmware,
    # which carries its figures; Bitcraze, "Measuring propeller RPM: part 3" (2015); mass and arm as in
    # RotorPy 3.0.0, crazyflie_params.py. `neurosim bench replay` flies it through logs of real flights.
    # Identified: from the two flights in the repository of Eschmann et al. (2024), arXiv 2404.07837, each
    # alone; what the other gives stands beside.
    mass_kg=0.03,
    inertia_kg_m2=_diagonal(
        (1.66e-5, 1.66e-5, 2.93e-5)
    ),  # firmware, physical_constants.c, without its products
    rotor_position_m=_cross(0.043 * _DIAGONAL, 0.043 * _DIAGONAL, 0.05),
    # Height of the hubs: identified by prediction errors; 48 and 53 mm about x and y in one flight, 44 and
    # 58 mm in the other. Far more than the rotors are above the centre of mass: it stands for all torque that
    # air speed in their plane gives (22 rad/s^2 for 1 m/s), such as by lift that the front rotors gain and
    # the rear ones lose.
    rotor_direction=(1, -1, 1, -1),
    thrust_coefficient_n_s2=2.3e-8,  # Foerster (2015); Bitcraze: 14.5 g at 2500 rad/s
    # Identified by prediction errors, which a controller in the loop does not bias: 1.9 and 2.0 mm of torque
    # over thrust for speeds that change in flight. Firmware, thrustToTorque, of a load cell: 5.96 mm.
    torque_coefficient_n_m_s2=0.0019 * 2.3e-8,
    rotor_drag_kg=10.2506e-07,  # Foerster (2015)
    rotor_inflow_kg=7.553e-07,  # Foerster (2015)
    # Identified by prediction errors as that which agrees with the inertia above, behind a delay of 9 ms in
    # the log; Eschmann et al.: 0.072 s, without a delay.
    motor_time_constant_s=0.055,
    rotor_speed_max_rad_s=2500.0,  # Bitcraze
)
"""Bitcraze Crazyflie 2.x."""

HUMMINGBIRD = MultirotorConfig(
    # RotorPy 3.0.0, hummingbird_params.py, which names a thesis (digitalrepository.unm.edu, ece_etds 1189)
    # and Svacha et al. (2017), IEEE 7991501, for the aerodynamic coefficients
    mass_kg=0.500,
    inertia_kg_m2=_diagonal((3.65e-3, 3.68e-3, 7.03e-3)),
    rotor_position_m=_cross(0.17 * _DIAGONAL, 0.17 * _DIAGONAL),
    rotor_direction=(1, -1, 1, -1),
    thrust_coefficient_n_s2=5.57e-06,
    torque_coefficient_n_m_s2=1.36e-07,
    rotor_drag_kg=1.19e-04,
    rotor_inflow_kg=2.32e-04,
    translational_lift_kg_m=3.39e-3,
    parasitic_drag_kg_m=(0.5e-2, 0.5e-2, 1e-2),
    motor_time_constant_s=0.005,
    rotor_speed_max_rad_s=1500.0,
)
"""AscTec Hummingbird."""

RACER = MultirotorConfig(
    # Bauersfeld, Kaufmann, Foehn, Sun, Scaramuzza (2021), "NeuroBEM": mass, motor lag, 33 N of static thrust;
    # its data set: inertia. The parameter files of Foehn et al. (2022), "Agilicious", for the same airframe:
    # the rest.
    mass_kg=0.752,  # NeuroBEM
    inertia_kg_m2=_diagonal((2.5e-3, 2.1e-3, 4.3e-3)),  # NeuroBEM, data set
    rotor_position_m=_cross(0.075, 0.10),  # Agilicious
    rotor_direction=(1, -1, 1, -1),
    thrust_coefficient_n_s2=1.562522e-6,  # Agilicious
    torque_coefficient_n_m_s2=0.022 * 1.562522e-6,  # Agilicious: ratio of torque to thrust 0.022 m
    motor_time_constant_s=0.033,  # NeuroBEM
    rotor_speed_min_rad_s=150.0,  # Agilicious
    rotor_speed_max_rad_s=2300.0,  # at which four rotors give NeuroBEM's 33 N
)
"""A racing quadrotor with 5-inch propellers; no drag, as neither source has coefficients of this form."""

_PRESETS = {"crazyflie": CRAZYFLIE, "hummingbird": HUMMINGBIRD, "racer": RACER}


def preset(name: str, **overrides: Any) -> MultirotorConfig:
    """Return the parameters of an airframe.

    Args:
        name: crazyflie, hummingbird or racer.
        **overrides: Parameters to change, such as `mass_kg=0.6`; checked like all others.

    Raises:
        ValueError: The name or a parameter is unknown, or a value is out of range.
    """
    if name not in _PRESETS:
        raise ValueError(f"unknown airframe {name!r}, known: {sorted(_PRESETS)}")
    return MultirotorConfig(**{**_PRESETS[name].model_dump(), **overrides})
