"""Sources of samples that are simulated while they are read, from the first window to the last."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from neurosim_core.config import SimulationConfig, as_config
from neurosim_core.data.batch import Sample
from neurosim_core.data.windows import PacketWindows, WindowConfig, choose_sensors, field_of
from neurosim_core.packets import Events, Packet, schema_of
from neurosim_core.sim.observation import Observation
from neurosim_core.sim.simulation import Simulation


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
    """Return the field that each sensor of a configuration gives: that of its recording."""
    return {name: _field_of(sensor) for name, sensor in config.sensors.items()}


def _field_of(sensor: Any) -> str | None:
    packet, encoding = sensor.packet_class, ""
    if any(field.name == "encoding" for field in schema_of(packet).fields):
        encoding = getattr(packet, "encoding", "") or getattr(sensor, "packet_encoding", "")
    return field_of(schema_of(packet), encoding)


class RunSource:
    """A configuration that is flown in this process, as `neurosim run` does.

    Args:
        config: What `load_config` returns or accepts.
    """

    def __init__(self, config: SimulationConfig | Mapping[str, Any]) -> None:
        self._config = as_config(config)
        self.skipped_count = 0

    def samples(self, config: WindowConfig) -> Iterator[Sample]:
        """See `SampleSource.samples`."""
        from neurosim_core.sim.rollout import run

        sensors = choose_sensors(fields_of(self._config), config, source="run")
        windows = PacketWindows(config, sensors, source="run")
        for packet in run(self._config):
            yield from windows.add(packet)
        yield from windows.end()
        self.skipped_count = windows.skipped_count


class WorldsSource:
    """Worlds that are stepped together along their paths; their windows alternate.

    Each call of `samples` resets the worlds. The first call takes the seeds of `simulation`; each later call
    takes new seeds. The worlds fly until the end of `duration_s`.
    """

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        self._calls = 0
        self.skipped_count = 0

    def samples(self, config: WindowConfig) -> Iterator[Sample]:
        """See `SampleSource.samples`."""
        worlds = self._simulation
        sensors = choose_sensors(fields_of(worlds.model.config), config, source="worlds")
        windows_of_worlds = [PacketWindows(config, sensors, source=f"world {n}") for n in range(worlds.count)]
        seeds = None if self._calls == 0 else np.array(worlds.seeds) + worlds.count
        self._calls += 1
        observation, now_ns = worlds.reset(seed=seeds), 0
        while True:
            packets = packets_of(worlds, observation, range(worlds.count), sensors.values())
            for windows, own in zip(windows_of_worlds, packets, strict=True):
                for packet in own:
                    yield from windows.add(packet)
            if now_ns >= worlds.model.duration_ns:
                break
            observation = worlds.rollout(1)
            now_ns += worlds.duration_ns
        for windows in windows_of_worlds:
            yield from windows.end()
        self.skipped_count = sum(windows.skipped_count for windows in windows_of_worlds)


def packets_of(
    simulation: Simulation, observation: Observation, worlds: Sequence[int], sensors: Iterable[str]
) -> list[list[Packet]]:
    """Return what some sensors yielded in a step, or at a reset, as packets of some worlds."""
    step_ns = simulation.duration_ns  # 0 at a reset
    stamps_ns = observation.clock_ns.numpy()[list(worlds)].tolist()
    packets: list[list[Packet]] = [[] for _ in worlds]
    for name in sensors:
        sensor: Any = simulation.model.config.sensors[name]
        events = observation.events.get(name)
        taken: Any = observation.samples.get(name)
        picture = observation.images[name].numpy() if name in observation.fresh else None
        arrays = {} if taken is None else {field: array.numpy() for field, array in taken.arrays.items()}
        dropped = [] if events is None else events.dropped.numpy().tolist()
        for own, world, stamp_ns in zip(packets, worlds, stamps_ns, strict=True):
            begin_ns = stamp_ns - step_ns
            header: dict[str, Any] = {"sensor": name, "sequence": stamp_ns // max(step_ns, 1)}
            if picture is not None:
                own.append(sensor.packet(picture[world].copy(), stamp_ns=stamp_ns, **header))
            for row, offset_ns in enumerate(() if taken is None else taken.offsets_ns):
                rows = {field: array[row, world] for field, array in arrays.items()}
                packet = taken.packet(rows, stamp_ns=begin_ns + offset_ns, **header)
                own += [] if packet is None else [packet]
            if events is not None and stamp_ns > 0:
                columns = events.numpy(world)
                order = np.argsort(columns[0], kind="stable")  # those of a `Simulation(sorted=False)` are not
                t, x, y, polarity = (column[order] for column in columns)
                own.append(
                    Events(
                        stamp_ns=stamp_ns, start_ns=begin_ns, t=t, x=x, y=y, polarity=polarity, **header,
                        width=events.width, height=events.height, dropped_count=dropped[world],
                    )
                )  # fmt: skip
    return packets
