"""Logs of real flights against the vehicle model: does it turn and push as the real vehicle did?

Each log is flown open loop from the measured body rate with the commands that the motors got, through windows
of 0.3 s (`vehicle.replay`). Beside it stand the guess that the body rate does not change, the same vehicle
without what the flight before a window tells of torque that the model misses, and the model with the
parameters of RotorPy's table.
"""

from __future__ import annotations

from neurosim_core.bench.engine import MultirotorConfig, preset
from neurosim_core.bench.options import Options
from neurosim_core.bench.report import Chapter, Claim, Row, Table
from neurosim_core.vehicle.replay import read_crazyflie_log, replay

_WINDOW_S = 0.3
_CRAZYFLIE = "crazyflie"


def _vehicles() -> dict[str, tuple[MultirotorConfig, bool]]:
    """Return vehicles, and whether the torque that they miss is estimated from the flight before a window."""
    table = {
        "inertia_kg_m2": ((1.43e-5, 0.0, 0.0), (0.0, 1.43e-5, 0.0), (0.0, 0.0, 2.89e-5)),
        "torque_coefficient_n_m_s2": 7.8e-10,
        "motor_time_constant_s": 0.072,
        "rotor_position_m": tuple((x, y, 0.0) for x, y, _ in preset("crazyflie").rotor_position_m),
    }
    return {
        _CRAZYFLIE: (preset("crazyflie"), True),
        "crazyflie, missing torque not estimated": (preset("crazyflie"), False),
        "RotorPy 3.0.0's table": (preset("crazyflie", **table), True),
    }


def measure(options: Options) -> Chapter:
    """Fly the logs that `--logs` names."""
    if not options.logs:
        raise ValueError("name the logs to replay: --logs flight.csv,other.csv.gz")
    rows: list[Row] = []
    claims = []
    for path in options.logs:
        log = read_crazyflie_log(path)
        for name, (config, missing_torque) in _vehicles().items():
            options.progress(f"{path.name}, {name}")
            found = replay(log, config, window_s=_WINDOW_S, missing_torque=missing_torque)
            share = found.rate_rms_rad_s / found.unchanged_rms_rad_s
            row: Row = {"log": path.name, "vehicle": name, "windows": found.window_count}
            for what, values in (("rate", found.rate_rms_rad_s), ("unchanged", found.unchanged_rms_rad_s)):
                row |= {f"{what} {axis} [rad/s]": float(v) for axis, v in zip("xyz", values, strict=True)}
            rows.append(row | {"specific force, share": found.force_error})
            if name == _CRAZYFLIE:
                shares = ", ".join(f"{value:.2f}" for value in share)
                measured = f"{shares} of unchanged rates; {100.0 * found.force_error:.1f} % of specific force"
                met = bool((share < 1.0).all() and found.force_error < 0.08)
                text = f"{path.name}: {_WINDOW_S:g} s ahead the rates are nearer than unchanged ones about "
                text += "all axes, and the specific force is within 8 %"
                claims.append(Claim(text, "the log", measured, met))
    summary = (
        "Rates are the RMS of the error over all windows. What the flight before a window tells, the thrust "
        "for a command and the torque that the model misses, is used in it; what was measured within it is "
        "not. A vehicle without control amplifies what no model knows, such as gusts."
    )
    tables = [Table("replay", "Open-loop replay of logs", rows)]
    return Chapter(name="replay", title="Replay of flights", summary=summary, claims=claims, tables=tables)
