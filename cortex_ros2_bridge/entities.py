"""Entities of `simulation_interfaces`: the vehicles, and the bodies that are in the scene.

Both come with the settings. Bodies are brought in and taken out: SpawnEntity takes `body:NAME` for one that
waits (`present: false`), and DeleteEntity sends it away.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any, NoReturn

import numpy as np
import scipy  # which imports its parts when they are used
import yaml

from cortex import messages as msg
from cortex_ros2_bridge import frames
from cortex_ros2_bridge.convert.commands import xyz
from cortex_ros2_bridge.frames import FrameNames, Vector
from cortex_ros2_bridge.msgs import message_class

PACKAGE = "simulation_interfaces"
UNSUPPORTED, OK, NOT_FOUND, INCORRECT_STATE, FAILED = range(5)
_NAME_NOT_UNIQUE, _NAME_INVALID, _UNSUPPORTED_FORMAT, _NO_RESOURCE = range(101, 105)
_SPAWN_POSE, _STATE_POSE = 109, 101
_ROBOT, _DYNAMIC, _STATIC = 1, 4, 5
_VEHICLES_STAY = "vehicles come and go with the settings"
_MOTIONS = ("velocity_m_s", "sway", "orbit", "spin_rad_s")
"""Parts of a motion that move a body by themselves."""


class Refused(Exception):
    """What was asked is not done: the code of the answer, and why."""


def refuse(code: int, reason: str) -> NoReturn:
    """Raise `Refused`."""
    raise Refused(code, reason)


class Entities:
    """Answers for vehicles and bodies.

    `call` calls a service of the simulator, and raises `Refused` if it does not do what was asked; `news`
    returns the newest message of a topic.
    """

    def __init__(
        self, call: Callable[[str, Any], None], news: Callable[[str, type[Any]], Any], frame_names: FrameNames
    ) -> None:
        self._call = call
        self._news = news
        self._frames = frame_names
        self.answers: dict[str, Callable[[Any, Any], None]] = {
            "GetEntities": self._entities,
            "GetEntitiesStates": self._entities_states,
            "GetEntityInfo": self._info,
            "GetEntityState": self._entity_state,
            "SetEntityState": self._set_entity_state,
            "GetSpawnables": self._spawnables,
            "SpawnEntity": self._spawn,
            "DeleteEntity": self._delete,
        }

    def _entities(self, request: Any, response: Any) -> None:
        response.entities = self._fitting(request.filters)

    def _entities_states(self, request: Any, response: Any) -> None:
        response.entities = [name for name in self._fitting(request.filters) if not self._moves(name)]
        response.states = [self._look_at(name) for name in response.entities]

    def _info(self, request: Any, response: Any) -> None:
        response.info.category.category = self._category(self._known(request.entity))
        response.info.description = "a body" if request.entity in self._bodies() else "a multirotor"

    def _entity_state(self, request: Any, response: Any) -> None:
        if self._moves(self._known(request.entity)):
            refuse(FAILED, f"{request.entity} moves by itself: /simulation has its motion")
        response.state = self._look_at(request.entity)

    def _set_entity_state(self, request: Any, response: Any) -> None:
        """Move a body; or begin the run with a vehicle elsewhere, whose time is 0 before and after."""
        name, state = self._known(request.entity), request.state
        is_body = name in self._bodies()
        if not is_body and self._news("/status", msg.SimulatorStatus).stamp_ns:
            refuse(INCORRECT_STATE, "the simulation runs: stop it first (SetSimulationState)")
        position, q = self._pose(state.pose, state.header.frame_id, _STATE_POSE)
        velocity, rate = xyz(state.twist.linear), frames.rotate_back(q, xyz(state.twist.angular))
        if not is_body:
            self._call("/reset", msg.Reset(None, name, position, q, velocity, rate))
        elif velocity.any() or rate.any():
            refuse(UNSUPPORTED, "a body is moved, and not pushed: its twist must be 0")
        else:
            self._place(name, position, q)

    def _spawnables(self, request: Any, response: Any) -> None:
        make = message_class(f"{PACKAGE}/msg/Spawnable")
        response.spawnables = [
            make(uri=f"body:{name}", description=f"a {body['shape']['kind']} that waits")
            for name, body in self._bodies().items()
            if not body["present"]
        ]

    def _spawn(self, request: Any, response: Any) -> None:
        bodies, name = self._bodies(), request.uri.removeprefix("body:")
        if not name:
            refuse(
                UNSUPPORTED if request.resource_string else _NO_RESOURCE, "a body of the settings: body:NAME"
            )
        if name not in bodies:
            known = ", ".join(bodies) or "none"
            refuse(_UNSUPPORTED_FORMAT, f"no body is called {name!r}, known: {known}; {_VEHICLES_STAY}")
        if request.name not in ("", name) and not request.allow_renaming:
            refuse(_NAME_INVALID, f"the body {name} keeps its name (allow_renaming)")
        if bodies[name]["present"]:
            refuse(_NAME_NOT_UNIQUE, f"{name} is there already: there is one of each body")
        where = request.initial_pose
        self._place(name, *self._pose(where.pose, where.header.frame_id, _SPAWN_POSE))
        response.entity_name = name

    def _delete(self, request: Any, response: Any) -> None:
        if self._known(request.entity) not in self._bodies():
            refuse(UNSUPPORTED, _VEHICLES_STAY)
        self._call("/set_parameters", msg.Parameters.of({f"bodies.{request.entity}.present": False}))

    def _place(self, name: str, position: Vector, q: Vector) -> None:
        values = {
            "position_m": position.tolist(),
            "rpy_rad": scipy.spatial.transform.Rotation.from_quat(q).as_euler("xyz").tolist(),
        }
        given = {f"bodies.{name}.motion.{key}": str(value) for key, value in values.items()}
        self._call("/set_parameters", msg.Parameters.of({f"bodies.{name}.present": True, **given}))

    def _pose(self, pose: Any, frame: str, code: int) -> tuple[Vector, Vector]:
        """Return position and orientation, which are checked."""
        if frame not in ("", self._frames.ros(frames.WORLD), frames.WORLD):
            refuse(FAILED, f"a pose in frame {frame!r}, known: the world")
        q = np.array([getattr(pose.orientation, axis) for axis in "xyzw"])
        if not abs(math.hypot(*q.tolist()) - 1.0) < 1e-3:  # also refuses nan
            refuse(code, f"the quaternion has not length 1: {q.tolist()}")
        return xyz(pose.position), q

    def _fitting(self, filters: Any) -> list[str]:
        """Return the names that filters leave."""
        if filters.tags.tags or filters.bounds.type:
            refuse(UNSUPPORTED, "entities have neither tags nor bounds")
        try:
            pattern = re.compile(filters.filter)
        except re.error as error:
            refuse(FAILED, f"the filter {filters.filter!r} is no regular expression: {error}")
        wanted = [each.category for each in filters.categories]
        found = [name for name in self._names() if pattern.search(name)]
        return [name for name in found if not wanted or self._category(name) in wanted]

    def _known(self, name: str) -> str:
        if name not in self._names():
            refuse(NOT_FOUND, f"no entity {name!r}, known: {', '.join(self._names())}")
        return name

    def _names(self) -> list[str]:
        there = [name for name, body in self._bodies().items() if body["present"]]
        return list(self._news("/simulation", msg.Simulation).vehicles) + there

    def _bodies(self) -> dict[str, Any]:
        """Return the settings of the bodies, by name."""
        settings = yaml.safe_load(self._news("/simulation", msg.Simulation).config) or {}
        return dict(settings.get("bodies") or {})

    def _moves(self, name: str) -> bool:
        motion = self._bodies().get(name, {}).get("motion", {})
        return any(np.any(part) for part in (motion.get(key) for key in _MOTIONS) if part is not None)

    def _category(self, name: str) -> int:
        return _ROBOT if name not in self._bodies() else _DYNAMIC if self._moves(name) else _STATIC

    def _look_at(self, name: str) -> Any:
        """Return the EntityState of a vehicle, or of a body at rest, in the map frame."""
        body = self._bodies().get(name)
        stamp_ns, zero = 0, np.zeros(3)
        if body is not None:
            stamp_ns = self._news("/status", msg.SimulatorStatus).stamp_ns
            motion = body["motion"]
            q = scipy.spatial.transform.Rotation.from_euler("xyz", motion["rpy_rad"]).as_quat()
            values = motion["position_m"], q, zero, zero
        else:
            seen = self._news(f"/{name}/odometry", msg.Odometry)
            stamp_ns, turning = seen.stamp_ns, frames.rotate(seen.orientation, seen.body_rate)
            values = seen.position, seen.orientation, seen.velocity, turning
        state = message_class(f"{PACKAGE}/msg/EntityState")()
        state.header.stamp.sec, state.header.stamp.nanosec = divmod(stamp_ns, 1_000_000_000)
        state.header.frame_id = self._frames.ros(frames.WORLD)
        parts = state.pose.position, state.pose.orientation, state.twist.linear, state.twist.angular
        for part, numbers in zip(parts, values, strict=True):
            for axis, value in zip("xyzw", np.asarray(numbers).tolist(), strict=False):
                setattr(part, axis, float(value))
        return state
