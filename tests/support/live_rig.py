"""A simulator in a thread of the test, and a node that talks to it."""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest
from processes import SOON_S, wait_for

from cortex import Node, Publisher, Subscriber, reliable
from cortex.messages import Odometry, Parameters, SimulatorReply, SimulatorStatus
from neurosim_core.config import SimulationConfig, load_config
from neurosim_core.live import streaming
from neurosim_core.live.config import LiveConfig
from neurosim_core.live.messages import command_of
from neurosim_core.live.simulator import Simulator
from neurosim_core.live.topics import COMMANDS, SERVICES, command_topic
from neurosim_core.packets import Packet
from neurosim_core.sim import Batch, Model, State, make_fleet
from neurosim_core.vehicle.multirotor import MultirotorVehicleConfig

IMU = {"kind": "imu", "rate_hz": 400.0, "accelerometer_noise_density": 0.01}
RGB = {"kind": "rgb", "rate_hz": 50.0, "lens": {"width": 64, "height": 48, "horizontal_fov_rad": 1.5}}
EVENTS = {
    "kind": "event_camera",
    "sampling_rate_hz": 200.0,
    "lens": {"width": 64, "height": 48, "horizontal_fov_rad": 1.5},
}
ODOMETRY = {"kind": "odometry", "rate_hz": 100.0}

_models: dict[str, dict[str, Model]] = {}


def make_config(*, sensors: Any = None, **overrides: Any) -> SimulationConfig:
    """A vehicle that hovers in a small flat, with an IMU, odometry, a colour camera and an event camera."""
    rig = {"imu": IMU, "odometry": ODOMETRY, "rgb": RGB, "events": EVENTS}
    base = {
        "scene": {"kind": "apartment", "rooms": 2},
        "device": "cpu",
        "renderer": "synthetic",
        "duration_s": 1.0,
        "path": {"kind": "hover"},
        "sensors": rig if sensors is None else sensors,
        "vehicle": {"on_collision": "report"},
        "live": {"command_timeout_s": 10.0, "command_deadline_s": SOON_S},
    }
    return load_config(base, overrides=overrides)


def models_of(config: SimulationConfig) -> dict[str, Model]:
    """The models of a configuration; what takes time to make is made once for all that share it."""
    common = {
        "live": LiveConfig(),
        "links": {},
        "seed": 0,
        "duration_s": 1.0,
        "vehicle": MultirotorVehicleConfig(),
    }
    key = config.model_copy(update=common).model_dump_json()
    if key not in _models:
        _models[key] = make_fleet(config)
    return {name: dataclasses.replace(model, config=config.of(name)) for name, model in _models[key].items()}


class LiveRig:
    """A context manager: a simulator that runs in a thread, and a node beside it."""

    def __init__(self, config: SimulationConfig, **options: Any) -> None:
        self.simulator = Simulator(config, models=models_of(config), **options)
        self.config = config
        self.node = Node("test")
        self.stop = threading.Event()
        self.code: int | None = None
        self.error: BaseException | None = None
        self._publishers: dict[tuple[str, str], Publisher[Any]] = {}
        self._status = self.node.subscriber("/status", SimulatorStatus, policy=reliable(1024))
        self._thread = threading.Thread(target=self._run, name="simulator", daemon=True)
        self._thread.start()
        assert self._status.wait_for_publisher(SOON_S)

    def _run(self) -> None:
        try:
            self.code = self.simulator.run(self.stop)
        except BaseException as error:
            self.error = error

    def __enter__(self) -> LiveRig:
        return self

    def __exit__(self, *error: object) -> None:
        self.stop.set()
        self._thread.join(SOON_S)
        self.simulator.close()
        self.node.close()
        assert not self._thread.is_alive()
        if self.error is not None and error[1] is None:
            raise self.error

    def join(self) -> int | None:
        """Wait until the run is over; return its exit status."""
        self._thread.join(SOON_S)
        assert not self._thread.is_alive()
        return self.code

    def listen(self, topic: str, message: type[Any], depth: int = 4096) -> Subscriber[Any]:
        """Subscribe to every message of a topic."""
        subscriber = self.node.subscriber(topic, message, policy=reliable(depth))
        assert subscriber.wait_for_publisher(SOON_S)
        return subscriber

    def send(
        self, setpoint: Any, *, mode: str = "motor_speeds", stamp_ns: int = 0, vehicle: str = "drone"
    ) -> None:
        """Command a vehicle."""
        key = (vehicle, mode)
        if key not in self._publishers:
            publisher = self.node.publisher(command_topic(*key), COMMANDS[mode])
            self._publishers[key] = publisher
            assert publisher.wait_for_subscribers(1, SOON_S)
        self._publishers[key].publish(command_of(mode, setpoint, stamp_ns=stamp_ns))

    def fly(
        self,
        odometry: Subscriber[Any],
        count: int,
        law: Callable[[Odometry], tuple[str, Any]] | None = None,
        *,
        vehicle: str = "drone",
    ) -> list[Odometry]:
        """Answer so many odometry messages, by default with hover speeds; return them and the one after.

        One that comes again, as a new publisher was connected, is answered once.
        """
        states: list[Odometry] = []

        def following() -> Odometry:
            while True:
                state: Odometry = odometry.recv(SOON_S)
                if not states or state.stamp_ns > states[-1].stamp_ns:
                    return state

        for _ in range(count):
            state = following()
            states.append(state)
            mode, setpoint = ("motor_speeds", self.hover(vehicle)) if law is None else law(state)
            self.send(setpoint, mode=mode, stamp_ns=state.stamp_ns, vehicle=vehicle)
        return [*states, following()]

    def hover(self, vehicle: str = "drone") -> np.ndarray:
        """Rotor speeds that carry the vehicle."""
        airframe = self.config.of(vehicle).vehicle.airframe()
        return np.full(airframe.rotor_count, airframe.hover_rotor_speed_rad_s)

    def call(self, service: str, request: Any) -> SimulatorReply:
        """Call a service."""
        return self.node.client(service, *SERVICES[service]).call(request, SOON_S)

    def set(self, values: Mapping[str, Any]) -> SimulatorReply:
        """Change parameters."""
        return self.call("/set_parameters", Parameters.of(values))

    def wait_for_status(self, condition: Callable[[SimulatorStatus], object]) -> SimulatorStatus:
        """Wait for a status that fits."""
        found: list[SimulatorStatus] = []

        def look() -> bool:
            status = self._status.recv(SOON_S)
            if condition(status):
                found.append(status)
            return bool(found)

        wait_for(look)
        return found[0]


def drain(subscriber: Subscriber[Any], timeout_s: float = 0.2, *, least: int = 0) -> list[Any]:
    """Everything that has arrived, and what comes until nothing does for a while; `least` is waited for."""
    messages: list[Any] = []
    while True:
        try:
            messages.append(subscriber.recv(SOON_S if len(messages) < least else timeout_s))
        except TimeoutError:
            return messages


def before_looks(monkeypatch: pytest.MonkeyPatch, action: Callable[[State, Batch], object]) -> None:
    """Have something done each time before cameras look at a batch: it takes time, waits or fails."""
    render = streaming.render_batch

    def act_and_render(model: Model, state: State, batch: Batch) -> list[Packet]:
        action(state, batch)
        return render(model, state, batch)

    monkeypatch.setattr(streaming, "render_batch", act_and_render)
