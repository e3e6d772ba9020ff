"""Settings of LiDARs named after sensors, with the document that each number is attributed to.

Compared with the document itself were the firing cycle of the VLP-16 and the rings and beam of the OS1-128.
The other numbers were not: compare them with the data sheet of your sensor before you rely on them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any


def _spinning(first_deg: float, last_deg: float, count: int, *, columns: int, beam_rad: float) -> Any:
    step = (last_deg - first_deg) / (count - 1)
    rings = [round(math.radians(first_deg + k * step), 6) for k in range(count)]
    beam_rad = round(beam_rad, 6)
    return {"kind": "spinning", "elevations_rad": rings, "columns": columns, "divergence_rad": beam_rad}


PRESETS: Mapping[str, Mapping[str, Any]] = {
    # Velodyne, VLP-16 user manual, 63-9243 rev. D: 16 lasers from -15 to 15 degrees, a firing cycle of
    # 55.296 us (1808 columns in a turn at 600 rpm), 100 m, accuracy +-3 cm (taken as one standard
    # deviation), distances in steps of 2 mm, beam 3 mrad wide.
    "velodyne_vlp16": {
        "scan": _spinning(-15.0, 15.0, 16, columns=1808, beam_rad=0.003),
        "rate_hz": 10.0,
        "range_max_m": 100.0,
        "range_noise_m": 0.03,
        "range_resolution_m": 0.002,
    },
    # Ouster, OS1 data sheet, rev. D: 128 rings over 45 degrees, 1024 columns at 10 Hz, 0.3 to 120 m, beam
    # 0.18 degrees, precision 0.7 cm near and 5 cm beyond 50 m (grows as 0.1 % here), steps of 3 mm; at
    # 10 % reflectivity 90 % of the rays come back from 45 m and 50 % from 55 m: a speckle of 0.31.
    "ouster_os1_128": {
        "scan": _spinning(22.5, -22.5, 128, columns=1024, beam_rad=math.radians(0.18)),
        "rate_hz": 10.0,
        "range_min_m": 0.3,
        "range_max_m": 120.0,
        "range_noise_m": 0.007,
        "range_noise_ratio": 0.001,
        "range_resolution_m": 0.003,
        "detection": {"range_m": 55.0, "reflectivity": 0.1, "speckle": 0.31},
    },
    # Hesai, PandarXT-32 user manual: 32 rings from 15 to -16 degrees, 0.18 degrees apart at 10 Hz, 0.05
    # to 120 m, precision 0.5 cm, steps of 4 mm; 80 m at 10 % reflectivity (where half come back).
    "hesai_xt32": {
        "scan": _spinning(15.0, -16.0, 32, columns=2000, beam_rad=0.003),
        "rate_hz": 10.0,
        "range_min_m": 0.05,
        "range_max_m": 120.0,
        "range_noise_m": 0.005,
        "range_resolution_m": 0.004,
        "detection": {"range_m": 80.0, "reflectivity": 0.1},
    },
    # Livox, Mid series user manual: 38.4 degrees, 100,000 rays a second, beam 0.28 x 0.03 degrees, range
    # error 2 cm, 260 m, 90 m at 10 % reflectivity. Prisms at 7294 and -4664 rpm: Brazeal, Wilkinson,
    # Hochmair (2021), A rigorous observation model for the Risley prism-based Livox Mid-40 lidar sensor.
    "livox_mid40": {
        "scan": {
            "kind": "rosette",
            "half_angle_rad": round(math.radians(19.2), 6),
            "prism_rates_hz": (round(7294 / 60, 4), round(-4664 / 60, 4)),
            "sweep_s": 0.1,
            "ray_count": 10_000,
            "divergence_rad": round(math.radians(0.28), 6),
        },
        "rate_hz": 10.0,
        "range_min_m": 1.0,
        "range_max_m": 260.0,
        "range_noise_m": 0.02,
        "detection": {"range_m": 90.0, "reflectivity": 0.1},
    },
}
"""Presets by the name that `LidarConfig.preset` takes."""
