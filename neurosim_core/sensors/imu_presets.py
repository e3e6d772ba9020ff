"""Settings of inertial measurement units named after sensors, with the document of each number.

Compared with the document itself were the accelerometer of the ICM-20948, and ranges and steps of the BMI088.
The other numbers were not: compare them with the data sheet of your sensor before you rely on them.

Data sheets give the least Allan deviation as the bias stability: B of `ImuConfig` is that over 0.664. They do
not give random walks of the bias, which stay 0.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

_G = 9.80665
_DEG = math.pi / 180.0
_FLOOR = 0.664


_COLUMNS = (
    "accelerometer_noise_density",
    "accelerometer_bias_instability_m_s2",
    "accelerometer_range_m_s2",
    "accelerometer_resolution_m_s2",
    "gyroscope_noise_density",
    "gyroscope_bias_instability_rad_s",
    "gyroscope_range_rad_s",
    "gyroscope_resolution_rad_s",
)
_SHEETS: Mapping[str, tuple[tuple[float, ...], tuple[float, ...]]] = {
    # Bosch, BMI088 data sheet, BST-BMI088-DS001: 190 ug / sqrt(Hz) (z; 160 along x and y), 24 g in 16 bits;
    # 0.014 deg/s / sqrt(Hz), 2000 deg/s in 16 bits, bias instability below 2 deg/h (taken as 2).
    "bmi088": (
        (190e-6 * _G, 0.0, 24.0 * _G, 24.0 * _G / 2**15),
        (0.014 * _DEG, 2.0 / 3600.0 * _DEG / _FLOOR, 2000.0 * _DEG, 2000.0 * _DEG / 2**15),
    ),
    # TDK InvenSense, ICM-20948 data sheet, DS-000189: 230 ug / sqrt(Hz), 16 g, 2048 steps a g; 0.015
    # deg/s / sqrt(Hz), 2000 deg/s, 16.4 steps a deg/s.
    "icm20948": (
        (230e-6 * _G, 0.0, 16.0 * _G, _G / 2048.0),
        (0.015 * _DEG, 0.0, 2000.0 * _DEG, _DEG / 16.4),
    ),
    # Analog Devices, ADIS16448 data sheet: velocity random walk 0.11 m/s / sqrt(h), in-run bias stability
    # 0.25 mg, 18 g, steps of 0.833 mg; angular random walk 0.66 deg / sqrt(h), 14.5 deg/h, 1000 deg/s, steps
    # of 0.04 deg/s.
    "adis16448": (
        (0.11 / 60.0, 0.25e-3 * _G / _FLOOR, 18.0 * _G, 0.833e-3 * _G),
        (0.66 / 60.0 * _DEG, 14.5 / 3600.0 * _DEG / _FLOOR, 1000.0 * _DEG, 0.04 * _DEG),
    ),
}
PRESETS: Mapping[str, Mapping[str, Any]] = {
    name: {
        column: float(f"{value:.6g}")
        for column, value in zip(_COLUMNS, (*force, *rate), strict=True)
        if value
    }
    for name, (force, rate) in _SHEETS.items()
}
"""Presets by the name that `ImuConfig.preset` takes."""
