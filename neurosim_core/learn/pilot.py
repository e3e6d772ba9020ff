"""A policy of a file as a pilot of one vehicle: events and attitude in, thrust and body rates out."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from neurosim_core.learn import need, surfaces
from neurosim_core.vehicle import MultirotorConfig

CARD = "neurosim"
"""Key of the metadata of a file: JSON that says what the policy was trained for."""
CAMERA = "events"
"""Name of the event camera in `pilot_settings`."""
_COLOUR = {"kind": "rgb", "rate_hz": 20.0, "lens": {"width": 320, "height": 240, "horizontal_fov_rad": 1.5}}
"""Sensors of an animation of a flight."""
_VECTOR_SIZE = 10
"""Numbers that a policy sees besides events: gravity, body rates, the last action."""


class Command(NamedTuple):
    """The command of a pilot."""

    thrust_n: float
    """Collective thrust [N]."""
    body_rate: NDArray[np.float64]
    """In B [rad/s], [3]."""


class _EventsOfStep(NamedTuple):
    t: Any
    x: Any
    y: Any
    polarity: Any
    offsets: Any


class Pilot:
    """Flies one vehicle by a policy, step by step.

    `file`: `policy.onnx` of a run.

    Attributes:
        card: What the policy was trained for.
        action: The last action, in [-1, 1], float32, [4].
    """

    def __init__(self, file: str | Path) -> None:
        onnxruntime = need("onnxruntime")
        if not Path(file).is_file():
            raise ValueError(f"there is no policy {file}")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        self._session = onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
        metadata = self._session.get_modelmeta().custom_metadata_map
        if CARD not in metadata:
            raise ValueError(
                f"{file} is no policy of `neurosim learn`: it has no description of its training"
            )
        self.card: dict[str, Any] = json.loads(metadata[CARD])
        if (mode := self.card.get("mode", "rates")) != "rates":
            raise ValueError(f"{file} commands {mode}, and only thrust and body rates are flown here")
        shown = dict(self.card["surface"])
        if "tau_s" in shown:
            shown["tau_s"] = tuple(shown["tau_s"])
        camera = self.card["camera"]
        self._surface = surfaces.EventSurface(
            getattr(surfaces, shown.pop("kind"))(**shown),
            world_count=1,
            width=camera["width"],
            height=camera["height"],
            step_s=1.0 / self.card["rate_hz"],
            device="cpu",
        )
        sizes = {each.name: each.shape for each in self._session.get_inputs()}
        if sizes["vector"] != [1, _VECTOR_SIZE]:
            raise ValueError(
                f"{file} was trained for {self.card['task']!r}, and needs more than events, gravity and body "
                "rates: fly it by `neurosim learn eval`"
            )
        self._memory: NDArray[np.float32] = np.zeros(sizes["memory"], np.float32)
        self.action: NDArray[np.float32] = np.zeros(4, np.float32)

    def reset(self) -> None:
        """Forget everything."""
        self._memory[:] = 0.0
        self.action = np.zeros(4, np.float32)
        self._surface.forget(wp.ones(1, dtype=wp.int32, device="cpu"))

    def act(
        self,
        t: ArrayLike,
        x: ArrayLike,
        y: ArrayLike,
        polarity: ArrayLike,
        *,
        stamp_ns: int,
        orientation: ArrayLike,
        body_rate: ArrayLike,
    ) -> Command:
        """Return what to do for the next step.

        Args:
            t: Time of the events since the last step, which the sensor sent [us].
            x: Column [px].
            y: Row [px].
            polarity: 1: brighter, 0: darker.
            stamp_ns: Now [ns].
            orientation: q_WB, xyzw; only the direction of gravity in it is used.
            body_rate: w_WB in B, as a gyroscope measures it [rad/s].
        """
        self._show(t, x, y, polarity, stamp_ns)
        q = np.asarray(orientation, dtype=np.float64)
        xyz, w = q[:3], q[3]
        down = np.array([0.0, 0.0, -1.0])
        turn = 2.0 * np.cross(xyz, down)
        gravity = down - w * turn + np.cross(xyz, turn)  # rotated by the inverse
        vector = np.concatenate([gravity, 0.3 * np.asarray(body_rate), self.action]).astype(np.float32)
        surface = self._surface.array.numpy().astype(np.float32, copy=False)
        inputs = {"events": surface, "vector": vector[None], "memory": self._memory}
        action, self._memory = self._session.run(None, inputs)
        self.action = action[0]
        card = self.card
        return Command(
            thrust_n=float(card["hover_thrust_n"] * (1.0 + card["thrust_span"] * self.action[0])),
            body_rate=np.asarray(card["rate_max_rad_s"], dtype=np.float64) * self.action[1:],
        )

    def _show(self, t: ArrayLike, x: ArrayLike, y: ArrayLike, polarity: ArrayLike, stamp_ns: int) -> None:
        height, width = self._surface.array.shape[2:]
        if np.max(x, initial=0) >= width or np.max(y, initial=0) >= height:
            raise ValueError(f"the policy was trained with {width}x{height} pixels, and got events of others")
        columns: list[Any] = [
            wp.array(np.ascontiguousarray(column, dtype=kind), device="cpu")
            for column, kind in ((t, np.int64), (x, np.uint16), (y, np.uint16), (polarity, np.uint8))
        ]
        offsets: Any = wp.array(np.array([0, len(columns[0])], np.int32), device="cpu")
        now_ns: Any = wp.array(np.array([stamp_ns], np.int64), device="cpu")
        events = _EventsOfStep(columns[0], columns[1], columns[2], columns[3], offsets)
        self._surface.update(events, now_ns)


def pilot_settings(card: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings of a simulator in which a policy finds what it was trained with."""
    rate_hz = card["rate_hz"]
    return {
        "control": {"rate_hz": rate_hz},
        "vehicle": dict(card["vehicle"]),
        "path": {"kind": "hover"},
        "render": {"samples_per_pixel": card["rays_per_pixel"]},
        "sensors": {
            CAMERA: {
                "kind": "event_camera",
                "lens": dict(card["camera"]),
                "mount": dict(card["mount"]),
                "sampling_rate_hz": rate_hz * card["renders_per_step"],
                "packet_rate_hz": rate_hz,
                "pixel": {"threshold_on": card["threshold"], "threshold_off": card["threshold"]},
            },
            "odometry": {"kind": "odometry", "rate_hz": rate_hz},
        },
    }


def card_airframe(card: Mapping[str, Any]) -> MultirotorConfig:
    """Return the airframe that a policy was trained with."""
    from neurosim_core.config import load_config

    return load_config(pilot_settings(card)).vehicle.airframe()


def shipped_policy(name: str) -> Path:
    """Return the file of a policy: one that comes with the package by its name, or a path."""
    folder = Path(__file__).parent / "policies_shipped"
    known = sorted(file.stem for file in folder.glob("*.onnx"))
    if name in known:
        return folder / f"{name}.onnx"
    if Path(name).is_file():
        return Path(name)
    raise ValueError(
        f"unknown policy {name!r}, known: {', '.join(known) or 'none'}; or the path of a .onnx file"
    )


def fly_policy(
    policy: str,
    *,
    duration_s: float = 6.0,
    seed: int = 0,
    overrides: Mapping[str, Any] | None = None,
    save: Path | None = None,
    say: Callable[[str], None] = print,
) -> float:
    """Throw a vehicle into the default apartment, and let a policy fly it, in this process.

    Returns the mean speed of the last two seconds, or of all if it is shorter [m/s]; inf after a collision.

    Args:
        policy: Name of a policy that comes with the package, or a file.
        duration_s: For how long [s].
        seed: Of the throw: 1 m/s in some direction.
        overrides: Further settings by dotted key, such as {"scene.seed": 3}.
        save: Record the flight to this file, with a colour camera beside what the policy sees;
            where it ends in .webp or .gif, an animation of it.
        say: Told how it goes, line by line.
    """
    from neurosim_core import sim
    from neurosim_core.config import load_config
    from neurosim_core.flight import saved_flight

    pilot = Pilot(shipped_policy(policy))
    settings = {**pilot_settings(pilot.card), "duration_s": duration_s}
    if save is not None:
        settings["sensors"]["rgb"] = _COLOUR
    model = sim.make_model(load_config(settings, overrides=dict(overrides or {})))
    with saved_flight(save, model) if save is not None else contextlib.nullcontext() as write:
        return _fly(pilot, model, seed=seed, duration_s=duration_s, write=write, say=say)


def _fly(
    pilot: Pilot,
    model: Any,
    *,
    seed: int,
    duration_s: float,
    write: Callable[[Any], None] | None,
    say: Callable[[str], None],
) -> float:
    """Throw a vehicle, let a pilot fly it, and return its mean speed at the end, as `fly_policy`."""
    from neurosim_core import sim
    from neurosim_core.packets import Events, Odometry

    angle = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi)
    start = sim.StartState(position=model.free_space.seed_m, velocity=[np.cos(angle), np.sin(angle), 0.0])
    state = sim.make_state(model, start=start)
    packets = sim.start(model, state)
    speeds: list[float] = []
    for step in range(round(duration_s * pilot.card["rate_hz"])):
        if write is not None:
            for packet in packets:
                write(packet)
        odometry = next(p for p in packets if isinstance(p, Odometry))
        found = [p.numpy() for p in packets if isinstance(p, Events)]
        events = found[0] if found else (np.empty(0),) * 4
        command = pilot.act(
            *events,
            stamp_ns=odometry.stamp_ns,
            orientation=odometry.orientation,
            body_rate=odometry.body_rate,
        )
        speeds.append(float(np.linalg.norm(odometry.velocity)))
        if step % round(pilot.card["rate_hz"]) == 0:
            say(f"{1e-9 * odometry.stamp_ns:4.1f} s  {speeds[-1]:.2f} m/s  {len(events[0])} events")
        packets = sim.step(model, state, [command.thrust_n, *command.body_rate], mode="rates")
        if state.ended or state.failure is not None:
            say(f"{1e-9 * state.stamp_ns:4.1f} s  collision")
            return float("inf")
    last = speeds[-2 * round(pilot.card["rate_hz"]) :]
    speed = float(np.mean(last))
    say(f"mean speed of the last {len(last) / pilot.card['rate_hz']:g} s: {speed:.2f} m/s")
    return speed
