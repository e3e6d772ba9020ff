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


@dataclass(frozen=True)
class NoiseFigure:
    """What a source says of the noise of a still scene; `neurosim bench pixel` sets the preset beside it."""

    lux: float
    """Illuminance of the scene [lux]."""
    quantity: str
    """`ON rate`, `OFF rate`, `rate` (mean over the pixels, Hz), `ON share` of the events, or `spread` of the
    rates of pixels [decades]."""
    value: float
    spread: float
    """How far the source's own figures differ, or what "about" may mean there."""


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
    noise: tuple[NoiseFigure, ...] = ()
    """What the sources say of noise."""


def _contrast(share: float) -> float:
    return round(math.log1p(share), 4)


_JOUBERT = {
    "measured_noise": {
        "levels": [
            {"lux": 0.1, "on_hz": 4.96, "off_hz": 3.70, "spread_decades": 0.24},
            {"lux": 161.0, "on_hz": 0.0, "off_hz": 0.0005, "spread_decades": 0.24},
            {"lux": 3000.0, "on_hz": 0.0, "off_hz": 0.0},
        ]
    },
    "leak": {"rate_hz": 0.055, "bright_factor": 2.07, "spread_decades": 0.2},
    "hot_pixels": {"fraction": 0.02, "rate_hz": 5.2, "on_fraction": 1.0},
}
_JOUBERT_FIGURES = (
    NoiseFigure(0.1, "ON rate", 5.64, 0.56),
    NoiseFigure(0.1, "OFF rate", 4.24, 0.42),
    NoiseFigure(0.1, "ON share", 0.57, 0.02),
    NoiseFigure(0.1, "spread", 0.24, 0.02),
    NoiseFigure(161.0, "ON rate", 0.166, 0.04),
    NoiseFigure(161.0, "ON share", 0.996, 0.003),
    NoiseFigure(3000.0, "ON rate", 0.357, 0.09),
    NoiseFigure(3000.0, "ON share", 1.0, 0.003),
)
_JOUBERT_SOURCE = (
    " Noise: no rates by light were found for this sensor; these are those that Joubert et al. (2021), Event"
    " camera simulator improvements via characterized parameters, measured of another: the tables of their"
    " simulator, 2,500 pixels for 10 s at 0.1, 161 and 3,000 lux. The dark is shot noise; the rest is a leak"
    " of 0.064 and 0.23 Hz, and 2 % of the pixels."
)

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
        "readout": {"kind": "event", "bandwidth_hz": 1e6, "handshake": True},
    },
    sources="Gallego et al. (2022), Event-based vision: a survey, table 1: smallest contrast 17 %, 1 Meps,"
    " 0.05 ON events / s in a still scene. Lichtsteiner, Posch, Delbruck (2008): mismatch 2.1 % contrast, 3"
    " kHz bandwidth in bright light.",
    noise=(NoiseFigure(1000.0, "ON rate", 0.05, 0.005),),
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
        "readout": {"kind": "event", "bandwidth_hz": 12e6, "handshake": True},
    },
    sources="Brandli et al. (2014), A 240x180 130 dB 3 us latency global shutter spatiotemporal vision"
    " sensor: contrast threshold 11 %, contrast matching 3.5 %. Gallego et al. (2022), table 1: 12 Meps,"
    " 0.1 ON events / s.",
    noise=(NoiseFigure(1000.0, "ON rate", 0.1, 0.01),),
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
        "measured_noise": {
            "levels": [
                {"lux": 0.1, "on_hz": 5.0, "off_hz": 5.0, "spread_decades": 0.1},
                {"lux": 161.0, "on_hz": 0.0, "off_hz": 0.0},
            ]
        },
        "readout": {"kind": "event", "bandwidth_hz": 12e6, "handshake": True},
    },
    noise=(
        NoiseFigure(0.1, "rate", 10.0, 1.0),
        NoiseFigure(1000.0, "ON rate", 0.1, 0.1),
        NoiseFigure(1000.0, "ON share", 1.0, 0.01),
    ),
    sources="Gallego et al. (2022), table 1: smallest contrast 14.3 - 22.5 % (taken as ON and OFF, which the"
    " table does not say), 12 Meps, 0.1 ON events / s. Shot noise of about 10 Hz in dim light, and leak of"
    " about 0.2 Hz where it is bright: Guo, Delbruck (2022), Low cost and latency event camera background"
    " activity denoising; which light is dim is from Joubert et al. (2021): 0.1 lux, and none at 161."
    " Mismatch 0.03 and a spread of noise rates of 0.1 decades are the defaults of v2e (Hu, Liu, Delbruck"
    " 2021), not measurements of this sensor.",
)

_GEN3 = Preset(
    title="Prophesee Gen3 CD",
    width=640,
    height=480,
    pixel={
        "threshold_on": _contrast(0.12),
        "threshold_off": _contrast(0.12),
        **_JOUBERT,
        "readout": {"kind": "row", "bandwidth_hz": 66e6, "row_s": 0.24e-6, "handshake": True},
    },
    noise=_JOUBERT_FIGURES,
    sources="Gallego et al. (2022), table 1: smallest contrast 12 %, 66 Meps, 0.1 ON events / s. Rows are"
    " arbitrated and read one by one: support.prophesee.ai, Transfer latency." + _JOUBERT_SOURCE,
)

_GEN4 = Preset(
    title="Prophesee Gen4 CD",
    width=1280,
    height=720,
    pixel={
        "threshold_on": _contrast(0.11),
        "threshold_off": _contrast(0.11),
        **_JOUBERT,
        "readout": {"kind": "row", "bandwidth_hz": 1.066e9, "handshake": True},
    },
    noise=_JOUBERT_FIGURES,
    sources="Gallego et al. (2022), table 1: smallest contrast 11 %, 1066 Meps, 0.1 ON events / s. Finateu"
    " et al. (2020), A 1280x720 back-illuminated stacked temporal contrast event-based vision sensor with"
    " 4.86 um pixels, 1.066 GEPS readout: read row by row, 1.066 Geps." + _JOUBERT_SOURCE,
)

_IMX636 = Preset(
    title="Sony / Prophesee IMX636",
    width=1280,
    height=720,
    pixel=_GEN4.pixel,
    noise=_GEN4.noise,
    sources=f"The sensor of Finateu et al. (2020) in series, taken as Gen4. {_GEN4.sources}",
)

_V2E_CLEAN = Preset(
    title="v2e, clean",
    width=346,
    height=260,
    pixel={
        "threshold_spread": {"sigma_on": 0.02, "sigma_off": 0.02},
        "lin_log": {"linear_below": 20.0},
    },
    sources="Hu, Liu, Delbruck (2021), v2e; its code (SensorsINI/v2e, set_dvs_params), option clean:"
    " thresholds 0.2, mismatch 0.02, linear below 20 of 255, nothing else.",
)

_V2E_NOISY = Preset(
    title="v2e, noisy",
    width=346,
    height=260,
    pixel={
        "threshold_spread": {"sigma_on": 0.05, "sigma_off": 0.05},
        "low_pass": {"cutoff_hz": 30.0, "dark_radiance": round(20 / 255, 4)},
        "leak": {"rate_hz": 0.1, "spread_decades": 0.1},
        "lin_log": {"linear_below": 20.0},
        # 5 Hz ((0.25 - 1) (DN + 20) / 275 + 1), as a rate at DN 0 and a factor at DN 255
        "shot_noise": {
            "rate_hz": round(5.0 * (1.0 - 0.75 * 20 / 275), 4),
            "bright_factor": round(0.25 / (1.0 - 0.75 * 20 / 275), 5),
            "spread_decades": 0.0,
            "by_threshold": True,
        },
    },
    sources="Hu, Liu, Delbruck (2021), v2e; its code (SensorsINI/v2e, set_dvs_params), option noisy:"
    " thresholds 0.2, mismatch 0.05, 30 Hz at white with 20 of 255 added to the light, leak 0.1 Hz with"
    " noise_rate_cov_decades 0.1, linear below 20 of 255, shot noise of 5 Hz times nominal over own"
    " threshold, falling to a quarter at white, no refractory time (one old version has 10 ms). Its grey"
    " levels are those of linear light here. The spread of 0.1 decades is that of the leak alone there, as"
    " here; its jitter of the leak in time, a tenth, is left out.",
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
