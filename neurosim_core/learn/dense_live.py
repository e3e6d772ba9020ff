"""Processes that fly and stream over Cortex what networks learn from, each scene after scene.

`python -m neurosim_core.learn.dense_live NAMESPACE SETTINGS SEED CORES` is one of them: flight k has the
seeds SEED + k of scene, path and noise. It flies as fast as its readers take what it sends.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping
from typing import Any

from neurosim_core.data.ray_source import SEEDS_APART
from neurosim_core.render.launch import single_threaded_blas


def flight_settings(
    size_px: int, seed: int, *, field: str = "depth", duration_s: float = 6.0, device: str = "cpu"
) -> dict[str, Any]:
    """Return the settings of a flight through an apartment of its own; one camera has events and a field."""
    lens = {"width": size_px, "height": size_px, "horizontal_fov_rad": 1.5}
    truth: dict[str, dict[str, Any]] = {
        "events": {},
        "depth": {"depth": {"kind": "depth", "lens": lens, "rate_hz": 20.0}},
        "flow": {"flow": {"kind": "optical_flow", "lens": lens, "rate_hz": 20.0, "occlusion": False}},
    }
    return {
        "duration_s": duration_s,
        "device": device,
        "seed": seed,
        "scene": {"kind": "apartment", "rooms": 1, "seed": seed},
        "path": {"kind": "tour", "seed": seed},
        "vehicle": {"on_collision": "report"},
        "sensors": {
            "events": {
                "kind": "event_camera", "lens": lens, "sampling_rate_hz": 200.0, "packet_rate_hz": 20.0,
            },
            **truth[field],
        },
    }  # fmt: skip


@contextlib.contextmanager
def live_flights(count: int, settings: Mapping[str, Any], *, seed: int = 0) -> Iterator[list[str]]:
    """Run processes that stream flights, and end them; yield their namespaces, for `ns.data.LiveSource`.

    They end, too, when this process is killed: their input ends.
    """
    from neurosim_core.render.launch import core_count

    names = [f"/flight{index}" for index in range(count)]
    program, cores = [sys.executable, "-m", __name__], str(core_count() // count)
    commands = [
        [*program, name, json.dumps(settings), str(seed + SEEDS_APART * index), cores]
        for index, name in enumerate(names)
    ]
    with contextlib.ExitStack() as stack:
        for command in commands:
            process = subprocess.Popen(command, env=single_threaded_blas(), stdin=subprocess.PIPE)
            stack.callback(stack.enter_context(process).terminate)
        yield names


def stream_flights(namespace: str, settings: Mapping[str, Any], seed: int, cores: int) -> None:
    """Fly and publish until the process is ended, on so many cores."""
    from cortex import Node
    from cortex.messages import Simulation
    from neurosim_core import __version__
    from neurosim_core.config import load_config, to_yaml
    from neurosim_core.data.sources import numbered
    from neurosim_core.live.messages import message_type, to_message
    from neurosim_core.live.topics import SIMULATION, stream_topic
    from neurosim_core.render.launch import limit_cores
    from neurosim_core.sim.rollout import run

    limit_cores(cores)
    config = load_config(dict(settings))
    (vehicle,) = config.vehicles
    with Node(f"flights{namespace.replace('/', '_')}") as node:
        publishers = {
            name: node.publisher(
                namespace + stream_topic(vehicle, name), message_type(sensor.packet_type), max_wait_s=600.0
            )
            for name, sensor in config.sensors.items()
        }
        announcement = Simulation(
            config=to_yaml(config),
            version=__version__,
            vehicles=[vehicle],
            mode="streaming",
            control_rate_hz=100.0,
        )
        node.publisher(namespace + SIMULATION, Simulation, latch=True).publish(announcement)
        for number in itertools.count(seed):
            for packet in run(numbered(config, number)):
                for publisher in publishers.values():
                    publisher.wait_for_subscribers(1, timeout_s=600.0)
                publishers[packet.sensor].publish(to_message(packet))


def _end_with_input() -> None:
    sys.stdin.buffer.read()
    os._exit(0)


if __name__ == "__main__":
    threading.Thread(target=_end_with_input, daemon=True).start()
    stream_flights(sys.argv[1], json.loads(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]))
