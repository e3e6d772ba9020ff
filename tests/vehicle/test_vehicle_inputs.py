"""NaN, infinite, negative and absurd inputs of the vehicle: refused with their name, or a DynamicsError.

Whatever is refused leaves the vehicle as it was; whatever is finite but absurd ends in a typed error, never
in a state that is not finite.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from neurosim_core.settings_file import ConfigError
from neurosim_core.vehicle import DynamicsError, Multirotor, MultirotorConfig, preset
from neurosim_core.vehicle.motor import lag_constants

MS = 1_000_000
NAN, INF = math.nan, math.inf
HUMMINGBIRD = preset("hummingbird")
WIDTHS = {"position": 3, "velocity": 3, "orientation": 4, "body_rate": 3, "rotor_speed": 4}
NUMBERS = [
    name
    for name, field in MultirotorConfig.model_fields.items()
    if isinstance(getattr(HUMMINGBIRD, name), float)
]
MAY_BE_ZERO = set(NUMBERS) - {"mass_kg", "rotor_speed_max_rad_s"}


@pytest.mark.parametrize("bad", [NAN, INF, -INF, -1e-9, "fast", None])
@pytest.mark.parametrize("name", NUMBERS)
def test_parameters_are_finite_and_not_negative(name, bad):
    with pytest.raises(ConfigError, match=name):
        preset("hummingbird", **{name: bad})


@pytest.mark.parametrize("name", ["mass_kg", "rotor_speed_max_rad_s"])
def test_what_must_not_be_zero(name):
    with pytest.raises(ConfigError, match=name):
        preset("hummingbird", **{name: 0.0})


@pytest.mark.parametrize("name", sorted(MAY_BE_ZERO))
def test_what_may_be_zero_flies(name, device):
    vehicle = Multirotor(preset("hummingbird", **{name: 0.0}), device=device, terms=HUMMINGBIRD.terms())
    vehicle.step(np.full(4, 500.0), 5 * MS)
    assert np.isfinite(np.concatenate(vehicle.state, axis=1)).all()


@pytest.mark.parametrize("bad", [NAN, INF, -INF])
@pytest.mark.parametrize(
    "name", ["wind_m_s", "parasitic_drag_kg_m", "rotor_position_m", "inertia_kg_m2", "rotor_direction"]
)
def test_vectors_of_parameters_are_finite(name, bad):
    value = np.array(getattr(HUMMINGBIRD, name), dtype=np.float64)
    value.flat[0] = bad
    with pytest.raises(ConfigError, match=name):
        preset("hummingbird", **{name: value.tolist()})


@pytest.mark.parametrize("bad", [NAN, INF, -INF])
@pytest.mark.parametrize("field", WIDTHS)
def test_states_are_finite(field, bad, device):
    vehicle = Multirotor(HUMMINGBIRD, device=device)
    before = vehicle.state
    value = np.ones(WIDTHS[field])
    value[-1] = bad
    with pytest.raises(ValueError, match=f"{field} must be finite"):
        vehicle.reset(**{field: value})
    assert all(np.array_equal(a, b) for a, b in zip(vehicle.state, before, strict=True))


@pytest.mark.parametrize("field", WIDTHS)
def test_states_have_a_shape(field):
    vehicle = Multirotor(HUMMINGBIRD, count=3)
    for shape in ((2, WIDTHS[field]), (WIDTHS[field] + 1,), (), (3, 1, WIDTHS[field])):
        with pytest.raises(ValueError, match=f"{field} must have shape"):
            vehicle.reset(**{field: np.ones(shape)})


@pytest.mark.parametrize("size", [1e300, 1e308])
def test_attitudes_too_large_to_be_normalised(size):
    with pytest.raises(ValueError, match="orientation must not be 0, nor too large"):
        Multirotor(HUMMINGBIRD).reset(orientation=(size, 0.0, 0.0, size))


def outcome(vehicle: Multirotor, command) -> DynamicsError | None:
    try:
        vehicle.step(command, 5 * MS)
    except DynamicsError as error:
        return error
    return None


@pytest.mark.parametrize("integrator", ["rkmk4", "dormand_prince"])
@pytest.mark.parametrize("field", ["position", "velocity", "body_rate"])
@pytest.mark.parametrize("size", [1e6, 1e80, 1e160, 1e308])
def test_absurd_states_fly_or_are_held(field, size, integrator, device):
    vehicle = Multirotor(HUMMINGBIRD, device=device, integrator=integrator, evaluation_count_max=2000)
    vehicle.reset(**{field: (size, -size, 0.5 * size)})
    before = vehicle.state
    error = outcome(vehicle, np.full(4, 500.0))
    if error is not None:
        assert error.stamp_ns == 0
        assert all(np.array_equal(a, b) for a, b in zip(vehicle.state, before, strict=True))
    assert np.isfinite(np.concatenate(vehicle.state, axis=1)).all()


@pytest.mark.parametrize(
    "override",
    [
        {"mass_kg": 5e-324},
        {"mass_kg": 1e308},
        {"inertia_kg_m2": ((1e-300, 0, 0), (0, 1e-300, 0), (0, 0, 1e-300))},
        {"thrust_coefficient_n_s2": 1e308},
        {"motor_time_constant_s": 5e-324},
        {"motor_time_constant_s": 1e308},
        {"gravity_m_s2": 1e308},
        {"rotor_position_m": ((1e308, 0, 0), (0, 1e308, 0), (-1e308, 0, 0), (0, -1e308, 0))},
    ],
    ids=lambda override: "_".join(override),
)
@pytest.mark.filterwarnings("ignore:overflow:RuntimeWarning", "ignore:invalid value:RuntimeWarning")
@pytest.mark.filterwarnings("ignore:divide by zero:RuntimeWarning")
def test_absurd_vehicles_fly_or_are_held(override, device):
    vehicle = Multirotor(preset("hummingbird", **override), device=device, evaluation_count_max=2000)
    error = outcome(vehicle, (500.0, 520.0, 480.0, 510.0))
    assert error is None or error.term in ("velocity", "body_rate")
    assert np.isfinite(np.concatenate(vehicle.state, axis=1)).all()


@pytest.mark.parametrize("bad", [NAN, INF, -INF])
def test_commands_are_finite(bad, device):
    vehicle = Multirotor(HUMMINGBIRD, device=device)
    held = vehicle.arrays.rotor_speed_command.numpy().copy()
    for give in (vehicle.command, lambda command: vehicle.step(command, MS)):
        with pytest.raises(ValueError, match="rotor_speed_command must be finite"):
            give((500.0, bad, 500.0, 500.0))
    assert np.array_equal(vehicle.arrays.rotor_speed_command.numpy(), held)
    assert vehicle.stamp_ns == 0


@pytest.mark.parametrize(
    ("duration_ns", "error", "message"),
    [
        (0, ValueError, "duration_ns must be > 0, got 0"),
        (-1, ValueError, "duration_ns must be > 0"),
        (1.0, TypeError, "duration_ns must be an integer, got 1.0"),
        (NAN, TypeError, "duration_ns must be an integer, got nan"),
        (None, TypeError, "duration_ns must be an integer, got None"),
        (2**63, ValueError, r"duration_ns must be at most 2\^31 steps"),
        ((2**31) * MS, ValueError, r"duration_ns must be at most 2\^31 steps"),
    ],
)
def test_durations(duration_ns, error, message):
    vehicle = Multirotor(HUMMINGBIRD)
    for move in (vehicle.advance, lambda ns: vehicle.step(np.full(4, 500.0), ns)):
        with pytest.raises(error, match=message):
            move(duration_ns)
    assert vehicle.stamp_ns == vehicle.arrays.stamp_ns.numpy()[0] == 0


@pytest.mark.parametrize("name", ["count", "max_step_ns", "evaluation_count_max", "seed"])
@pytest.mark.parametrize("bad", [-1, 2**64, 1.0, NAN, "3", None, True])
def test_what_counts_is_an_integer_in_range(name, bad):
    error = ValueError if type(bad) is int else TypeError
    with pytest.raises(error, match=f"{name} must be"):
        Multirotor(HUMMINGBIRD, **{name: bad})


def test_devices_exist():
    with pytest.raises(ValueError, match="cuda:77"):
        Multirotor(HUMMINGBIRD, device="cuda:77")


@pytest.mark.parametrize("bad", [NAN, INF, -INF, -1e-3])
def test_lags_are_finite_and_not_negative(bad):
    with pytest.raises(ValueError, match="step_s must be > 0 and finite"):
        lag_constants(bad, 0.01)
    with pytest.raises(ValueError, match="time_constant_s must be >= 0 and finite"):
        lag_constants(1e-3, bad)
    with pytest.raises(ValueError, match="step_s must be > 0"):
        lag_constants(0.0, 0.01)
