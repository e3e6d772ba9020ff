"""Conversion of a simulator's status."""

from __future__ import annotations

import dataclasses
from typing import Any

from cortex import messages
from cortex_ros2_bridge import frames
from cortex_ros2_bridge.convert.context import Context
from cortex_ros2_bridge.convert.records import header, point, record, status_record
from cortex_ros2_bridge.convert.registry import LATCHED, standard

DIAGNOSTICS_INTERVAL_NS = 900_000_000
"""Shortest wall-clock time between two arrays of one phase [ns]: about one a second, as others send them."""

_OK, _WARN, _ERROR = 0, 1, 2


@standard(messages.Text, "std_msgs/String")
def text(message: messages.Text, context: Context) -> Any:
    """Convert to std_msgs/String."""
    return record("std_msgs/msg/String")(message.text)


@standard(messages.Simulation, "std_msgs/String", "{topic}", LATCHED)
def simulation(message: messages.Simulation, context: Context) -> Any:
    """Convert to std_msgs/String: the settings, as YAML."""
    return record("std_msgs/msg/String")(message.config)


@standard(messages.Collision, "neurosim/Collision")
def collision(message: messages.Collision, context: Context) -> Any:
    """Convert to neurosim/Collision, in the map frame."""
    return record("neurosim/msg/Collision")(
        header(message.stamp_ns, frames.WORLD, context), point(message.position), float(message.clearance_m)
    )


@standard(messages.SimulatorStatus, "neurosim/SimulatorStatus")
def simulator_status(message: messages.SimulatorStatus, context: Context) -> Any:
    """Convert to neurosim/SimulatorStatus; counts are sums over sensors and vehicles."""
    second, nanosecond = divmod(message.slipped_ns, 1_000_000_000)
    return record("neurosim/msg/SimulatorStatus")(
        header(message.stamp_ns, "", context),
        message.phase,
        message.reason,
        message.mode,
        message.real_time_factor,
        message.real_time_factor_wanted,
        message.step_count,
        message.overrun_count,
        record("builtin_interfaces/msg/Duration")(second, nanosecond),
        sum(sensor.dropped_count for sensor in message.sensors),
        sum(vehicle.refused_count for vehicle in message.vehicles),
        sum(vehicle.collision_count for vehicle in message.vehicles),
        any(vehicle.fail_safe for vehicle in message.vehicles),
    )


@standard(messages.SimulatorStatus, "diagnostic_msgs/DiagnosticArray", "/diagnostics")
def simulator_diagnostics(message: messages.SimulatorStatus, context: Context) -> Any:
    """Convert to diagnostic_msgs/DiagnosticArray: of the simulator, of each sensor and vehicle.

    What is counted is judged over the time since the array before, and said in `message`; `values` are sums.

    Returns:
        None, if the array before is not a second old and the phase is the same.
    """
    before: messages.SimulatorStatus | None = context.memory.get("judged")
    if before is not None:
        waited_ns = abs(message.wall_ns - before.wall_ns)
        if message.phase == before.phase and waited_ns < DIAGNOSTICS_INTERVAL_NS:
            return None
    context.memory["judged"] = message
    judged = _Judged(message, before)
    statuses = [_of_simulator(message, judged)]
    statuses += [_of_sensor(sensor, judged) for sensor in message.sensors]
    statuses += [_of_vehicle(vehicle, judged) for vehicle in message.vehicles]
    array = record("diagnostic_msgs/msg/DiagnosticArray")
    return array(header(message.stamp_ns, "", context), statuses)


class _Judged:
    """Compares a status with the one before."""

    def __init__(self, now: messages.SimulatorStatus, before: messages.SimulatorStatus | None) -> None:
        self._before: dict[str, Any] = {}
        if before is not None:
            self._before = {"": before}
            self._before |= {f"{sensor.vehicle}/{sensor.name}": sensor for sensor in before.sensors}
            self._before |= {vehicle.name: vehicle for vehicle in before.vehicles}
        elapsed_s = 0.0 if before is None else abs(now.wall_ns - before.wall_ns) / 1e9
        self.period = f"in {elapsed_s:.1f} s" if before is not None else "so far"

    def more(self, now: Any, name: str, of: str = "") -> int:
        """Return by how much a count has grown; all of it, if it is new or began anew."""
        count: int = getattr(now, name)
        then = getattr(self._before.get(of), name, 0)
        return count - then if count >= then else count


def _of_simulator(message: messages.SimulatorStatus, judged: _Judged) -> Any:
    late, slipped_ns = judged.more(message, "overrun_count"), judged.more(message, "slipped_ns")
    said = f"{message.phase}: {message.reason}" if message.reason else message.phase
    if message.phase == "running":
        said += f", {message.real_time_factor:.3g} x real time"
    if late or slipped_ns:
        said += f"; {late} steps were late, and {slipped_ns / 1e9:.3f} s slipped {judged.period}"
    level = _ERROR if message.phase == "ended" else _WARN if late or slipped_ns else _OK
    return status_record(level, "simulator", said, "simulator", _pairs(message))


def _of_sensor(sensor: messages.SensorStatus, judged: _Judged) -> Any:
    name = f"{sensor.vehicle}/{sensor.name}"
    dropped = judged.more(sensor, "dropped_count", name)
    unwanted = dropped > judged.more(sensor, "injected_lost_count", name)
    said = "ok" if sensor.active else "idle"
    if dropped:
        said = f"{dropped} dropped {judged.period}" + ("" if unwanted else ", as its link is configured")
    undelivered = judged.more(sensor, "undelivered_count", name)
    if undelivered:
        said = f"{'' if said == 'ok' else f'{said}; '}{undelivered} lost by reliable readers {judged.period}"
    level = _WARN if unwanted or undelivered else _OK
    return status_record(level, f"sensor {name}", said, sensor.vehicle, _pairs(sensor))


def _of_vehicle(vehicle: messages.VehicleStatus, judged: _Judged) -> Any:
    trouble = ["no command has come in time: the fail-safe flies"] if vehicle.fail_safe else []
    counts = (
        ("refused_count", "commands refused", vehicle.refused_reason),
        ("clamped_count", "commands clamped", vehicle.clamped_reason),
        ("collision_count", "collisions", ""),
        ("undelivered_count", "messages lost by reliable readers", ""),
    )
    for name, what, reason in counts:
        if count := judged.more(vehicle, name, vehicle.name):
            trouble.append(f"{count} {what} {judged.period}" + (f" ({reason})" if reason else ""))
    mode = f"commands: {vehicle.command_mode}" if vehicle.command_mode else "no command yet"
    said = "; ".join([*trouble, mode])
    level, values = _WARN if trouble else _OK, _pairs(vehicle)
    return status_record(level, f"vehicle {vehicle.name}", said, vehicle.name, values)


def _pairs(source: Any) -> list[tuple[str, str]]:
    """Return the numbers and texts of a status."""
    values = ((each.name, getattr(source, each.name)) for each in dataclasses.fields(source))
    return [(name, str(value)) for name, value in values if isinstance(value, int | float | str)]
