"""Running simulators as a source: `neurosim serve` in other processes, over Cortex."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import yaml

from neurosim_core.config import load_config
from neurosim_core.data.batch import Sample
from neurosim_core.data.sources import fields_of
from neurosim_core.data.windows import PacketWindows, WindowConfig, choose_sensors

_QUEUE = 256
_POLL_S = 0.002


class LiveSource:
    """The vehicles of running simulators, over Cortex; each yields one flight after the other.

    Subscriptions block the simulator for a short time to avoid losses; lost messages are counted in
    `Sample.lost_count`. A reset of the simulator begins its next flight. To get a flight from its first
    window, start the simulator with `--lockstep`, or reset it.

    Args:
        namespaces: Prefix of the topics of each simulator; by default the only simulator.
        vehicles: Names of vehicles; None: all.
        timeout_s: The source ends after this time without a message, once a flight has begun [s].
        start_s: Longest wait for a simulator [s].
        on_join: Called when all sensors are subscribed; start controllers there.
    """

    def __init__(
        self,
        namespaces: Sequence[str] = ("",),
        *,
        vehicles: Sequence[str] | None = None,
        timeout_s: float = 2.0,
        start_s: float = 120.0,
        on_join: Callable[[], object] | None = None,
    ) -> None:
        self._on_join = on_join
        self._namespaces, self._vehicles = namespaces, vehicles
        self._timeout_s, self._start_s = timeout_s, start_s
        self.skipped_count = 0

    def samples(self, config: WindowConfig) -> Iterator[Sample]:
        """See `SampleSource.samples`; ends after `timeout_s` without a message.

        Raises:
            TimeoutError: There is no simulator, or it sends nothing.
            ValueError: The simulator lacks a field.
        """
        from cortex import Node

        with Node("data") as node:
            flights = [flight for space in self._namespaces for flight in self._join(node, space, config)]
            if self._on_join is not None:
                self._on_join()
            last_s, started = time.monotonic(), False
            while True:
                before = last_s
                for flight in flights:
                    for packet in flight.take():
                        last_s, started = time.monotonic(), True
                        yield from flight.add(packet)
                if last_s == before:
                    silent_s = time.monotonic() - last_s
                    if silent_s > (self._timeout_s if started else self._start_s):
                        break
                    time.sleep(_POLL_S)
            if not started:
                raise TimeoutError(
                    "no simulator publishes the requested sensors; a streaming simulator waits for its first "
                    "command, which `neurosim fly` sends"
                )
            for flight in flights:
                yield from flight.windows.end()
            self.skipped_count = sum(flight.skipped_count() for flight in flights)

    def _join(self, node: Any, namespace: str, config: WindowConfig) -> Iterator[_Flight]:
        from cortex import latest, reliable
        from cortex.messages import Simulation
        from neurosim_core.live.messages import message_type
        from neurosim_core.live.topics import SIMULATION, stream_topic

        announced = node.subscriber(namespace + SIMULATION, Simulation, policy=latest())
        simulation = announced.recv(self._start_s)
        announced.close()
        whole = load_config(yaml.safe_load(simulation.config))
        for vehicle in self._vehicles or simulation.vehicles:
            rig = whole.of(vehicle)
            name = f"{namespace}/{vehicle}"
            chosen = choose_sensors(fields_of(rig), config, source=name)
            subscribers = {
                sensor: node.subscriber(
                    namespace + stream_topic(vehicle, sensor),
                    message_type(rig.sensors[sensor].packet_class),
                    policy=reliable(_QUEUE),
                )
                for field, sensor in chosen.items()
                if config.takes(field) or field == "events"
            }
            yield _Flight(name, config, chosen, subscribers)


class _Flight:
    """One vehicle."""

    def __init__(
        self, name: str, config: WindowConfig, sensors: dict[str, str], subscribers: dict[str, Any]
    ) -> None:
        self._name, self._config, self._sensors, self._subscribers = name, config, sensors, subscribers
        self._last_ns: dict[str, int] = {}
        self._past_skipped = 0
        self.windows = PacketWindows(config, sensors, source=name)

    def take(self) -> Iterator[Any]:
        """Yield the packets that have arrived."""
        from neurosim_core.live.messages import to_packet

        for sensor, subscriber in self._subscribers.items():
            while True:
                try:
                    message = subscriber.recv(0.0)
                except TimeoutError:
                    break
                yield to_packet(message, sensor)

    def add(self, packet: Any) -> Iterator[Sample]:
        """Take a packet, and yield the windows that are complete with it."""
        if packet.stamp_ns < self._last_ns.get(packet.sensor, packet.stamp_ns):
            yield from self.windows.end()
            self._past_skipped += self.windows.skipped_count
            self.windows = PacketWindows(self._config, self._sensors, source=self._name)
            self._last_ns.clear()
        self._last_ns[packet.sensor] = packet.stamp_ns
        yield from self.windows.add(packet)

    def skipped_count(self) -> int:
        """Windows without their ground truth, in all flights."""
        return self._past_skipped + self.windows.skipped_count
