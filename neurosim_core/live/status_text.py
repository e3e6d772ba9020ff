"""What a simulator says of itself, as the viewer shows it."""

from __future__ import annotations

from collections.abc import Mapping

from cortex import messages as msg


def status_text(
    status: msg.SimulatorStatus,
    before: msg.SimulatorStatus,
    lost: Mapping[tuple[str, str], int],
) -> str:
    """Return a status as Markdown.

    Args:
        status: The newest one.
        before: An earlier one, for rates; may be the same.
        lost: Messages that never came, by vehicle and sensor.
    """
    pace = f"{status.real_time_factor:.2f} x real time"
    if status.real_time_factor_wanted:
        pace += f" (wanted: {status.real_time_factor_wanted:g})"
    lines = [
        f"**{status.phase}**{f': {status.reason}' if status.reason else ''}",
        f"{status.mode}, {status.stamp_ns / 1e9:.2f} s, {pace}",
        f"{status.overrun_count:,} overruns, held back {status.slipped_ns / 1e9:.2f} s",
    ]
    if status.phase == "running":
        lines.append(
            f"step {status.step_median_ns / 1e6:.2f} ms (p99 {status.step_p99_ns / 1e6:.2f}), "
            f"late {status.late_median_ns / 1e6:.2f} ms (p99 {status.late_p99_ns / 1e6:.2f})"
        )
    many = len(status.vehicles) > 1
    for vehicle in status.vehicles:
        mode = vehicle.command_mode or "no command yet"
        doing = (
            f"**fail-safe**, last command {vehicle.command_age_ns / 1e6:.0f} ms ago"
            if vehicle.fail_safe
            else mode
        )
        bad = [
            f"{count:,} {what}"
            for count, what in (
                (vehicle.fail_safe_count, "fail-safes"),
                (vehicle.lost_count, "commands lost"),
                (vehicle.refused_count, "refused"),
                (vehicle.clamped_count, "clamped"),
                (vehicle.collision_count, "collisions"),
            )
            if count
        ]
        lines.append(f"{vehicle.name}: {', '.join([doing, *bad])}")
    lines = ["  \n".join(lines), "", "| sensor | Hz | dropped | by reader | lost here |"]
    lines.append("| :-- | --: | --: | --: | --: |")
    earlier = {(s.vehicle, s.name): s.published_count for s in before.sensors}
    elapsed_s = (status.stamp_ns - before.stamp_ns) / 1e9
    for sensor in status.sensors:
        key = (sensor.vehicle, sensor.name)
        name = f"{sensor.vehicle}/{sensor.name}" if many else sensor.name
        if not sensor.active:
            rate = "off"
        elif elapsed_s > 0.0 and key in earlier:
            rate = f"{max(sensor.published_count - earlier[key], 0) / elapsed_s:.0f}"
        else:
            rate = "-"
        lost_counts = (sensor.dropped_count, sensor.undelivered_count, lost.get(key, 0))
        lines.append(f"| {name} | {rate} | {' | '.join(f'{count:,}' for count in lost_counts)} |")
    return "\n".join(lines)
