"""Settings of event pixels named after sensors, with the source of each number.

A sensor's thresholds, bandwidth and refractory time are set by its biases, and no paper gives all of them at
one setting: each preset holds what its sources say at the default or the most sensitive setting, and leaves
out what they do not say. A contrast c stands for the threshold ln(1 + c).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any


@dataclass(frozen=True, kw_only=True)
class Preset:
    """A sensor: what its pixels are like, and who says so."""

    title: str
    """Name of the sensor."""
    width: int
    """Columns [px]."""
    height: int
    """Rows [px]."""
    pixel: Mapping[str, Any]
    """Settings of `EventCameraConfig` that differ from the ideal."""
    sources: str
    """Where each number is from."""


def _contrast(share: float) -> float:
    return round(math.log1p(share), 4)


_DVS128 = Preset(
    title="DVS128",
    width=128,
    height=128,
    pixel={
        "threshold_on": _contrast(0.17),
        "threshold_off": _contrast(0.17),
        "threshold_spread": {"sigma_on": 0.021, "sigma_off": 0.021},
        "low_pass": {"cutoff_hz": 3000.0},
        "leak": {"rate_hz": 0.05},
        "readout": {"kind": "event", "bandwidth_hz": 1e6},
    },
    sources="Gallego et al. (2022), Event-based vision: a survey, table 1: smallest contrast 17 %, 1 Meps,"
    " 0.05 ON events / s in a still scene. Lichtsteiner, Posch, Delbruck (2008): mismatch 2.1 % contrast, 3"
    " kHz bandwidth in bright light.",
)

_DAVIS240C = Preset(
    title="DAVIS240C",
    width=240,
    height=180,
    pixel={
        "threshold_on": _contrast(0.11),
        "threshold_off": _contrast(0.11),
        "threshold_spread": {"sigma_on": 0.035, "sigma_off": 0.035},
        "leak": {"rate_hz": 0.1},
        "readout": {"kind": "event", "bandwidth_hz": 12e6},
    },
    sources="Brandli et al. (2014), A 240x180 130 dB 3 us latency global shutter spatiotemporal vision"
    " sensor: contrast threshold 11 %, contrast matching 3.5 %. Gallego et al. (2022), table 1: 12 Meps,"
    " 0.1 ON events / s.",
)

_DAVIS346 = Preset(
    title="DAVIS346",
    width=346,
    height=260,
    pixel={
        "threshold_on": _contrast(0.143),
        "threshold_off": _contrast(0.225),
        "threshold_spread": {"sigma_on": 0.03, "sigma_off": 0.03},
        "leak": {"rate_hz": 0.1, "spread_decades": 0.1},
        "readout": {"kind": "event", "bandwidth_hz": 12e6},
    },
    sources="Gallego et al. (2022), table 1: smallest contrast 14.3 - 22.5 % (taken as ON and OFF, which the"
    " table does not say), 12 Meps, 0.1 ON events / s. Mismatch 0.03 and a spread of noise rates of 0.1"
    " decades are the defaults of v2e (Hu, Liu, Delbruck 2021), not measurements of this sensor.",
)

_GEN3 = Preset(
    title="Prophesee Gen3 CD",
    width=640,
    height=480,
    pixel={
        "threshold_on": _contrast(0.12),
        "threshold_off": _contrast(0.12),
        "leak": {"rate_hz": 0.1},
        "readout": {"kind": "row", "bandwidth_hz": 66e6},
    },
    sources="Gallego et al. (2022), table 1: smallest contrast 12 %, 66 Meps, 0.1 ON events / s. Rows are"
    " arbitrated and read one by one: support.prophesee.ai, Transfer latency.",
)

_GEN4 = Preset(
    title="Prophesee Gen4 CD",
    width=1280,
    height=720,
    pixel={
        "threshold_on": _contrast(0.11),
        "threshold_off": _contrast(0.11),
        "leak": {"rate_hz": 0.1},
        "readout": {"kind": "row", "bandwidth_hz": 1.066e9},
    },
    sources="Gallego et al. (2022), table 1: smallest contrast 11 %, 1066 Meps, 0.1 ON events / s. Finateu"
    " et al. (2020), A 1280x720 back-illuminated stacked temporal contrast event-based vision sensor with"
    " 4.86 um pixels, 1.066 GEPS readout: read row by row, 1.066 Geps.",
)

_IMX636 = Preset(
    title="Sony / Prophesee IMX636",
    width=1280,
    height=720,
    pixel=_GEN4.pixel,
    sources=f"The sensor of Finateu et al. (2020) in series, taken as Gen4. {_GEN4.sources}",
)

_V2E_CLEAN = Preset(
    title="v2e, clean",
    width=346,
    height=260,
    pixel={"threshold_spread": {"sigma_on": 0.02, "sigma_off": 0.02}},
    sources="Hu, Liu, Delbruck (2021), v2e; its code (SensorsINI/v2e, set_dvs_params), option clean:"
    " thresholds 0.2, mismatch 0.02, nothing else.",
)

_V2E_NOISY = Preset(
    title="v2e, noisy",
    width=346,
    height=260,
    pixel={
        "threshold_spread": {"sigma_on": 0.05, "sigma_off": 0.05},
        "low_pass": {"cutoff_hz": 30.0, "dark_radiance": round(20 / 255, 4)},
        "leak": {"rate_hz": 0.1, "spread_decades": 0.1},
        "shot_noise": {"rate_hz": 5.0, "bright_factor": 0.25, "spread_decades": 0.0},
    },
    sources="Hu, Liu, Delbruck (2021), v2e; its code (SensorsINI/v2e, set_dvs_params), option noisy:"
    " thresholds 0.2, mismatch 0.05, 30 Hz at white with 20 of 255 added to the light, leak 0.1 Hz with"
    " noise_rate_cov_decades 0.1, shot noise 5 Hz falling to a quarter at white, no refractory time (one old"
    " version has 10 ms). The spread of 0.1 decades is that of the leak alone there, as here; its jitter of"
    " the leak in time, a tenth, is left out.",
)


def _voltmeter(title: str, width: int, height: int, *k: float) -> Preset:
    return Preset(
        title=title,
        width=width,
        height=height,
        pixel={"stochastic": {f"k{index}": value for index, value in enumerate(k, start=1)}},
        sources="Lin, Ma, Guo, Wen (2022), DVS-Voltmeter, parameters of its published code.",
    )


PRESETS: Mapping[str, Preset] = MappingProxyType(
    {
        "dvs128": _DVS128,
        "davis240c": _DAVIS240C,
        "davis346": _DAVIS346,
        "gen3": _GEN3,
        "gen4": _GEN4,
        "imx636": _IMX636,
        "v2e_clean": _V2E_CLEAN,
        "v2e_noisy": _V2E_NOISY,
        "voltmeter_dvs240": _voltmeter(
            "DAVIS240, DVS-Voltmeter", 240, 180, 0.000094 * 47065, 23.0, 2e-4, 1e-7, 5e-8, 1e-5
        ),
        "voltmeter_dvs346": _voltmeter(
            "DAVIS346, DVS-Voltmeter", 346, 260, 0.00018 * 29250, 20.0, 1e-4, 1e-7, 5e-9, 1e-5
        ),
    }
)
"""Presets by the name that `EventCameraConfig.preset` takes."""
