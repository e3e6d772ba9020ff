"""Flights that come once, from the first window to the last: simulated while they are read."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from typing import Any, Protocol

import numpy as np

from neurosim_core.config import SimulationConfig, load_config
from neurosim_core.data.batch import Sample
from neurosim_core.data.flights import no_ground_truth
from neurosim_core.data.windows import AT_STAMP, PacketWindows, WindowConfig, choose_sensors
from neurosim_core.packets import Events, Image, ImuSample, Odometry, Packet
from neurosim_core.sim.simulation import Simulation

_KINDS = {
    "event_camera": "events",
    "depth": "depth",
    "optical_flow": "flow",
    "rgb": "rgb",
    "imu": "imu",
    "odometry": "pose",
}
_IN_VAIN = 20
"""After so many windows without ground truth, and none with it, an error says why."""


class SampleSource(Protocol):
    """Gives the samples of some flights, in the order in which they come."""

    def samples(self, config: WindowConfig) -> Iterator[Sample]:
        """Yield the windows of the next flights; a new call begins new flights."""

    @property
    def skipped_count(self) -> int:
        """Windows of the last call that were left out, as their ground truth is missing."""


def numbered(config: SimulationConfig, number: int, *, flights_per_scene: int = 1) -> SimulationConfig:
    """Return the settings of a flight: seeds of noise and path are `number` further.

    That of the scene is further by one whenever `flights_per_scene` flights have been in a scene.
    """
    changes: dict[str, Any] = {"seed": (config.seed + number) % 2**63}
    for name, step in (("path", number), ("scene", number // flights_per_scene)):
        part = getattr(config, name)
        if hasattr(part, "seed"):
            changes[name] = part.model_copy(update={"seed": part.seed + step})
    return config.model_copy(update=changes)


def fields_of(config: SimulationConfig) -> dict[str, str | None]:
    """Return the field that each sensor of a configuration gives."""
    return {name: _KINDS.get(sensor.kind) for name, sensor in config.sensors.items()}


def checked(
    samples: Iterator[Sample], windows: PacketWindows, config: WindowConfig, source: str
) -> Iterator[Sample]:
    """Yield samples; raise ValueError if windows are cut, but none has its ground truth."""
    found = False
    for sample in samples:
        found = True
        yield sample
    if not found and windows.skipped_count >= _IN_VAIN:
        names = [name for name in AT_STAMP if config.takes(name)]
        raise ValueError(no_ground_truth(source, " or ".join(names), config))


class RunSource:
    """A configuration that is flown in this process, as `neurosim run` does.

    Args:
        config: What `load_config` returns or accepts.
    """

    def __init__(self, config: SimulationConfig | Mapping[str, Any]) -> None:
        self._config = config if isinstance(config, SimulationConfig) else load_config(config)
        self.skipped_count = 0

    def samples(self, config: WindowConfig) -> Iterator[Sample]:
        """See `SampleSource.samples`."""
        from neurosim_core.sim.rollout import run

        name = "run"
        windows = PacketWindows(
            config, choose_sensors(fields_of(self._config), config, source=name), source=name
        )
        cut = itertools.chain.from_iterable(
            itertools.chain((windows.add(packet) for packet in run(self._config)), [windows.end()])
        )
        yield from checked(cut, windows, config, name)
        self.skipped_count = windows.skipped_count


class WorldsSource:
    """Worlds that are stepped together along their paths; their windows come in turns.

    Each call of `samples` resets the worlds; the second and later ones with new seeds. `simulation`: the
    worlds; they are used up to the end of `duration_s`.
    """

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        self._calls = 0
        self.skipped_count = 0

    def samples(self, config: WindowConfig) -> Iterator[Sample]:
        """See `SampleSource.samples`."""
        worlds = self._simulation
        sensors = choose_sensors(fields_of(worlds.model.config), config, source="worlds")
        cutters = [PacketWindows(config, sensors, source=f"world {n}") for n in range(worlds.count)]
        seeds = None if self._calls == 0 else np.array(worlds.seeds) + worlds.count
        self._calls += 1
        now_ns, sequences = 0, dict.fromkeys(sensors.values(), 0)
        observation = worlds.reset(seed=seeds)
        while True:
            packets = _packets(worlds, observation, sensors, now_ns, sequences)
            for cutter, own in zip(cutters, packets, strict=True):
                for packet in own:
                    yield from checked(cutter.add(packet), cutter, config, "worlds")
            if now_ns >= worlds.model.duration_ns:
                break
            observation = worlds.rollout(1)
            now_ns += worlds.duration_ns
        for cutter in cutters:
            yield from cutter.end()
        self.skipped_count = sum(cutter.skipped_count for cutter in cutters)


def _packets(
    worlds: Simulation, observation: Any, sensors: Mapping[str, str], now_ns: int, sequences: dict[str, int]
) -> list[list[Packet]]:
    """Return the packets of a step, world by world."""
    begin_ns = now_ns - worlds.duration_ns
    packets: list[list[Packet]] = [[] for _ in range(worlds.count)]
    for field, sensor in sensors.items():
        if field in ("imu", "pose") and sensor in observation.samples:
            taken = observation.samples[sensor]
            arrays = {name: array.numpy() for name, array in taken.arrays.items()}
            kind: Any = ImuSample if field == "imu" else Odometry
            for row, offset_ns in enumerate(taken.offsets_ns):
                for world, own in enumerate(packets):
                    values = {name: array[row, world] for name, array in arrays.items()}
                    own.append(kind(stamp_ns=begin_ns + offset_ns, sensor=sensor, **values))
        elif field in ("depth", "flow", "rgb") and sensor in observation.fresh:
            pictures = observation.images[sensor].numpy()
            encoding: Any = {"depth": "32FC1", "flow": "32FC2", "rgb": "rgb8"}[field]
            if field == "flow":
                pictures = pictures[..., :2]  # the mask is behind it
            for world, own in enumerate(packets):
                data = pictures[world].copy()
                own.append(Image(stamp_ns=now_ns, sensor=sensor, data=data, encoding=encoding))
        elif field == "events" and now_ns > 0:
            frames = observation.frames[sensor]
            dropped = frames.dropped.numpy()
            for world, own in enumerate(packets):
                t, x, y, polarity = frames.numpy(world)
                own.append(
                    Events(
                        stamp_ns=now_ns, start_ns=begin_ns, sequence=sequences[sensor], sensor=sensor,
                        t=t, x=x, y=y, polarity=polarity, width=frames.width, height=frames.height,
                        dropped_count=int(dropped[world]),
                    )
                )  # fmt: skip
            sequences[sensor] += 1
    return packets
