"""Add your own noise term to the pixels of an event camera: photon noise, which is larger in the dark.

It prints the events of a still grey wedge, by brightness. To install such a term as a package, name its
module in an entry point of the group `neurosim.plugins`.
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
import warp as wp
from pydantic import Field

import neurosim_core as ns


@wp.func
def add_photon_noise(
    term: ns.sensors.SignalTerm,
    seed: wp.uint64,
    pixel: wp.int32,
    since_reset_ns: wp.int64,
    log_radiance: wp.float64,
) -> wp.float64:
    """Return log radiance with photon noise: a relative error of one over the root of the photon count."""
    bits = ns.random.random_bits(seed, term.stream, since_reset_ns, pixel)
    photons = term.numbers[0] * wp.exp(log_radiance)
    return log_radiance + ns.random.normal2(bits)[0] / wp.sqrt(photons)


@ns.register("noise", "photons")
class PhotonNoiseConfig(ns.sensors.NoiseTermConfig):
    """Photons that a pixel counts up to a frame; between frames what it sees is linear in time."""

    kind: Literal["photons"] = "photons"
    count: Annotated[float, Field(gt=0.0)] = 1e4
    """Photons at white."""

    signal = add_photon_noise

    def numbers(self, white_radiance: float) -> tuple[float, ...]:
        """Return photons for each unit of radiance."""
        return (self.count / white_radiance,)


def main() -> list[int]:
    """Return the events of a second in eight steps of grey, from dark to white."""
    pixel = ns.EventCameraConfig(noise=[{"kind": "photons", "count": 500}])
    camera = ns.EventCamera(pixel, width=64, height=48)
    grey = np.repeat(np.linspace(0.125, 1.0, 8, dtype=np.float32), 8)
    frame = np.log(np.tile(grey, (48, 1)))
    camera.reset(frame)
    events = camera.feed(np.tile(frame, (100, 1, 1)), 10_000_000 * np.arange(1, 101)).numpy()
    counts = np.bincount(events.x // 8, minlength=8).tolist()
    print("events by brightness:", *counts)
    return counts


if __name__ == "__main__":
    main()
