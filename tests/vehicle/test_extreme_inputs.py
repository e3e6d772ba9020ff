"""NaN, infinite, negative and absurd inputs of what feeds the dynamics: clock, frames, control, trajectory.

Each is refused where it enters, with its name, or gives something finite: never a NaN that flies on.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from controller_commands import command_of

from neurosim_core.clock import Rate, to_ns
from neurosim_core.control import MODES, Controller, PathFollower, Se3Config, mode_kernel
from neurosim_core.frames import Mount, as_rows, heading_rad
from neurosim_core.trajectory import Path, TourConfig
from neurosim_core.trajectory.feasibility import FlightLimits
from neurosim_core.trajectory.path import PathCursor, upload_paths
from neurosim_core.trajectory.planner import WaypointsConfig
from neurosim_core.trajectory.shapes import (
    CircleConfig,
    FigureEightConfig,
    HoverConfig,
    LineConfig,
    LissajousConfig,
    circle,
    figure_eight,
    hover,
    line,
    lissajous,
)
from neurosim_core.vehicle import DynamicsError, Multirotor, preset

NAN, INF = math.nan, math.inf
BAD = [NAN, INF, -INF]
HUMMINGBIRD = preset("hummingbird")
ORIGIN = np.zeros(3)
STATE = {
    "position": np.zeros(3),
    "velocity": np.zeros(3),
    "orientation": np.array([0.0, 0.0, 0.0, 1.0]),
    "body_rate": np.zeros(3),
    "rotor_speed": np.full(4, 500.0),
}


@pytest.fixture(scope="module")
def path() -> Path:
    return figure_eight(FigureEightConfig(laps=1.0), center=ORIGIN)


def controller(mode: str, path: Path):
    return Controller(mode, HUMMINGBIRD, device="cpu", paths=path if mode == "path" else None)


# Clock


@pytest.mark.parametrize("bad", BAD)
def test_seconds_must_be_finite(bad):
    with pytest.raises(ValueError, match="time_s must be finite"):
        to_ns(bad)


@pytest.mark.parametrize("bad", [*BAD, 0.0, -1.0, 1.1e9])
def test_rates_must_be_possible(bad):
    with pytest.raises(ValueError, match="rate_hz must be in"):
        Rate(bad)


@pytest.mark.parametrize("bad", [NAN, INF, 1.5])
def test_ticks_and_stamps_are_integers(bad):
    """A float of nanoseconds would be right for 104 days, and then off."""
    rate = Rate(30.0)
    for ask in (rate.stamp_ns, rate.first_tick, rate.has_tick, lambda t: list(rate.stamps(0, t))):
        with pytest.raises(TypeError, match="interpreted as an integer"):
            ask(bad)


def test_stamps_of_centuries_are_exact():
    tick = 30 * 10**12  # 31,709 years
    assert Rate(30.0).stamp_ns(tick) == 10**21
    assert Rate(30.0).first_tick(10**21) == tick
    assert Rate(30.0).stamp_ns(-1) == -33_333_334  # floor


# Frames


@pytest.mark.parametrize("bad", [(NAN, 0, 0, 1), (INF, 0, 0, 0), (0, 0, 0, 0), (0, 0, 0, 2), (0, 0, 1)])
def test_headings_are_of_unit_quaternions(bad):
    with pytest.raises(ValueError, match="q_WB must be a unit quaternion"):
        heading_rad(bad)


@pytest.mark.parametrize("bad", BAD)
def test_mounts_and_rows_are_finite(bad):
    with pytest.raises(ValueError, match="finite"):
        Mount(position_m=(bad, 0.0, 0.0))
    with pytest.raises(ValueError, match="finite"):
        Mount(rpy_rad=(0.0, bad, 0.0))
    with pytest.raises(ValueError, match="x must be finite"):
        as_rows([0.0, bad], name="x", count=3, width=2)


# Control


@pytest.mark.parametrize("bad", [*BAD, -1.0, 1e300])
@pytest.mark.parametrize("name", [n for n, f in Se3Config.model_fields.items() if f.annotation is not bool])
def test_gains_are_finite_and_in_range(name, bad):
    with pytest.raises(ValueError, match=name):
        Se3Config(**{name: bad})


@pytest.mark.parametrize("bad", BAD)
@pytest.mark.parametrize("mode", [mode for mode in MODES if mode != "path"])
def test_setpoints_are_finite(mode, bad, path):
    one = controller(mode, path)
    row = np.ones(len(one.layout))
    row[-1] = bad
    with pytest.raises(ValueError, match=f"mode '{mode}' takes rows of"):
        one.set(row)


@pytest.mark.parametrize("mode", [mode for mode in MODES if mode != "path"])
def test_absurd_setpoints_saturate(mode, path):
    one = controller(mode, path)
    for size in (1e12, 1e308):
        command = command_of(one, [size] * len(one.layout), **STATE)
        assert (command >= 0.0).all()
        assert (command <= HUMMINGBIRD.rotor_speed_max_rad_s).all()


def test_what_a_device_controller_cannot_command_the_vehicle_reports(path):
    vehicle = Multirotor(HUMMINGBIRD)
    vehicle.reset(velocity=(1e308, 0.0, 0.0))
    controller("path", path).update(vehicle.arrays)
    vehicle.advance(1_000_000)
    with pytest.raises(DynamicsError, match="rotor_speed_command"):
        vehicle.check()


def test_stamps_of_a_controller_have_64_bits(path):
    one = controller("path", path)
    before, after = (command_of(one, **STATE, stamp_ns=ns) for ns in (-(2**63), 2**63 - 1))
    assert np.isfinite([before, after]).all()  # a path rests at its ends


def test_batches_and_modes_exist():
    for bad, error in ((0, ValueError), (-3, ValueError), (1.5, TypeError), (NAN, TypeError)):
        with pytest.raises(error):
            Controller("rates", HUMMINGBIRD, count=bad)
    with pytest.raises(ValueError, match="unknown command mode 'fly'"):
        mode_kernel("fly")


@pytest.mark.parametrize("bad", BAD)
@pytest.mark.parametrize(
    ("mode", "field"),
    [("motor_speeds", field) for field in STATE] + [("velocity", "position"), ("velocity", "orientation")],
)
@pytest.mark.filterwarnings("ignore:invalid value encountered:RuntimeWarning")  # infinite times 0
def test_a_follower_gives_no_command_that_is_not_finite(mode, field, bad, path):
    state = {**STATE, field: np.full(len(STATE[field]), bad)}
    with pytest.raises(ValueError, match=r"finite|unit quaternion"):
        PathFollower(path, HUMMINGBIRD, mode=mode).command(stamp_ns=0, **state)


@pytest.mark.parametrize("mode", ["motor_speeds", "velocity", "position"])
def test_stamps_of_a_follower_are_integers(mode, path):
    follower = PathFollower(path, HUMMINGBIRD, mode=mode)
    for bad in (0.5, NAN, None):
        with pytest.raises(TypeError):
            follower.command(stamp_ns=bad, **STATE)
    with pytest.raises(OverflowError):
        follower.command(stamp_ns=2**63, **STATE)


# Trajectory


def test_paths_are_finite_polynomials(path):
    knots = [0, 10**9]
    for coefficients in (np.full((1, 4, 2), NAN), np.full((1, 4, 2), INF)):
        with pytest.raises(ValueError, match="coefficients must be finite"):
            Path(knots, coefficients)
    for bad in ([0.0, NAN], [10, 10]):
        with pytest.raises(ValueError, match="increasing integers"):
            Path(bad, np.zeros((1, 4, 1)))
    with pytest.raises(ValueError, match="empty"):
        upload_paths([], "cpu")
    with pytest.raises(ValueError, match="finite"):
        path.with_yaw(np.full((len(path.coefficients), 1), INF))


def test_paths_are_evaluated_at_integers_of_64_bits(path):
    for bad in ([NAN], [1.5], [2**63], [2**70], [None]):
        with pytest.raises(TypeError, match="stamps_ns must be integers"):
            path.evaluate(bad)
    ends = path.evaluate([-(2**63), 2**63 - 1])
    assert not ends.velocity.any()
    assert np.isfinite(ends.position).all()
    for bad in (NAN, 1.5, None):
        with pytest.raises(TypeError):
            PathCursor(path).at(bad)


@pytest.mark.parametrize("bad", [*BAD, -1.0])
@pytest.mark.parametrize(
    ("config", "given"),
    [
        (CircleConfig, {}),
        (FigureEightConfig, {}),
        (LissajousConfig, {}),
        (LineConfig, {"start_m": (0, 0, 0), "end_m": (1, 0, 0)}),
        (FlightLimits, {}),
        (TourConfig, {}),
        (WaypointsConfig, {"points_m": ((0, 0, 0), (1, 0, 0))}),
    ],
)
def test_numbers_of_path_settings_are_finite_and_positive(config, given, bad):
    numbers = [name for name, field in config.model_fields.items() if field.annotation is float]
    assert numbers
    for name in numbers:
        with pytest.raises(ValueError, match=name):
            config(**given, **{name: bad})


@pytest.mark.parametrize("bad", BAD)
def test_places_of_path_settings_are_finite(bad):
    place = (bad, 0.0, 0.0)
    for make in (
        lambda: HoverConfig(position_m=place),
        lambda: CircleConfig(center_m=place),
        lambda: LineConfig(start_m=place, end_m=(0, 0, 0)),
        lambda: LissajousConfig(amplitude_m=place),
        lambda: LissajousConfig(phase_rad=place),
        lambda: WaypointsConfig(points_m=((0, 0, 0), place)),
        lambda: CircleConfig(yaw=bad),
        lambda: hover(HoverConfig(), position=np.array(place)),
        lambda: circle(CircleConfig(), center=np.array(place)),
    ):
        with pytest.raises(ValueError, match="finite"):
            make()


@pytest.mark.parametrize(
    "settings",
    [{"ramp_s": 1e-12}, {"laps": 1e-300}, {"speed_max_m_s": 1e-300}, {"speed_max_m_s": 1e6, "laps": 1e6}],
)
def test_curves_that_no_path_can_hold_are_refused(settings):
    """Neither a division by 0 nor a million years of pieces."""
    with pytest.raises(ValueError, match="pieces of path"):
        circle(CircleConfig(**settings), center=ORIGIN)
    with pytest.raises(ValueError, match="pieces of path"):
        lissajous(LissajousConfig(**settings), center=ORIGIN)


@pytest.mark.parametrize("settings", [{"radius_m": 1e300}, {"speed_max_m_s": 1e300}, {"laps": 1e300}])
def test_curves_of_absurd_size_are_refused(settings):
    with pytest.raises(ValueError, match="less than or equal"):
        CircleConfig(**settings)
    with pytest.raises(ValueError, match="at most"):
        LissajousConfig(amplitude_m=(1e300, 0.0, 0.0))


@pytest.mark.parametrize("settings", [{"speed_max_m_s": 1e-300}, {"end_m": (1e300, 0.0, 0.0)}])
def test_lines_that_take_longer_than_stamps_last_are_refused(settings):
    given = {"start_m": (0.0, 0.0, 0.0), "end_m": (1.0, 0.0, 0.0), **settings}
    with pytest.raises(ValueError, match="increasing integers"):
        line(LineConfig(**given))
