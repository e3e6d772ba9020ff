# mypy: disable-error-code="arg-type,call-overload,assignment"
"""What a controller knows of the air: the vehicle's own aerodynamic model, without wind.

Reference: Svacha, Mohta, Kumar (2017), Improving quadrotor trajectory tracking by compensating for
aerodynamic effects.
"""

from typing import Any

import numpy as np
import warp as wp

from neurosim_core.vehicle.aerodynamics import (
    AIR_TERMS,
    Airframe,
    lift_moments,
    linear_weights,
    vec8d,
    vec10d,
)
from neurosim_core.vehicle.multirotor import MultirotorConfig


def air_terms(vehicle: MultirotorConfig) -> frozenset[str]:
    """Return the aerodynamic terms that a vehicle has."""
    return frozenset(vehicle.terms()) & frozenset(AIR_TERMS)


def make_air_model(vehicle: MultirotorConfig, device: Any) -> tuple[Any, Any]:
    """Return the airframe, with its aerodynamic parameters only, and the linear weights of the rotors [R]."""
    position = np.array(vehicle.rotor_position_m)
    drag = np.array([vehicle.rotor_drag_kg, vehicle.rotor_drag_kg, vehicle.rotor_inflow_kg])
    airframe = Airframe()
    airframe.rotor_drag = wp.vec3d(drag)
    airframe.flapping = vehicle.flapping_kg_m
    airframe.translational_lift = vehicle.translational_lift_kg_m
    airframe.lift_force = vec8d(lift_moments(position, np.ones(len(position))))
    airframe.lift_torque_x = vec8d(lift_moments(position, position[:, 1]))
    airframe.lift_torque_y = vec8d(lift_moments(position, -position[:, 0]))
    airframe.parasitic_drag = wp.vec3d(*vehicle.parasitic_drag_kg_m)
    return airframe, wp.array(linear_weights(position, drag), dtype=vec10d, device=device)
