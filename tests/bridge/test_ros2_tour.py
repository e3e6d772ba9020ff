"""What the tutorial of ROS 2 uses is there, and fits the bridge: rows, settings, a layout, a container."""

from __future__ import annotations

import importlib.util
import json
import re
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import fake_rclpy
import numpy as np
import pytest
from processes import ROOT

from cortex.messages import Events
from cortex_ros2_bridge import cdr
from cortex_ros2_bridge.convert import RULES, Context
from cortex_ros2_bridge.convert.measurements import MEASUREMENTS
from cortex_ros2_bridge.typestore import definitions, service_types, typestore
from neurosim_core.config import load_config

TOUR = ROOT / "examples" / "ros2_tour"
EVENTS = "event_camera_msgs/msg/EventPacket"


@pytest.fixture
def demonstrate(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The script, which can be read without ROS."""
    fake_rclpy.install(monkeypatch)
    return _script("demonstrate", monkeypatch)


def _script(name: str, monkeypatch: pytest.MonkeyPatch) -> Any:
    spec = importlib.util.spec_from_file_location(name, TOUR / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, name, module)
    spec.loader.exec_module(module)
    return module


def test_latencies_are_measured_of_all_messages(monkeypatch: pytest.MonkeyPatch) -> None:
    """All messages of a short run arrive, and take longer than nothing."""
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    latency = _script("latency", monkeypatch)
    result = latency.end_to_end(("imu",), latency.Load(seconds=0.2))["imu"]
    assert result.sent == result.received == 200
    assert result.lost_in_bridge == 0
    latencies = list(result.latency_ms.values())
    assert latencies[0] > 0.0
    assert latencies == sorted(latencies)


def test_every_type_of_the_bridge_has_a_row(demonstrate: Any) -> None:
    shown = {kind.replace("/", "/msg/") for _, _, kind, _ in demonstrate.OUT}
    shown |= {kind.replace("/", "/msg/") for _, _, kind, _, _ in demonstrate.IN} | {"neurosim/msg/Collision"}
    wanted = {rule.ros_type for rule in RULES if rule.default and rule.direction != "call"}
    wanted |= {each.ros_type for each in MEASUREMENTS.values()}
    assert wanted == shown
    assert shown <= typestore().fielddefs.keys()
    for name, kind, fields, _ in demonstrate.CALLS:
        request, _ = service_types(kind.replace("/", "/srv/"))
        assert request in definitions(), name
        known = {field for field, _ in typestore().fielddefs[request][1]}
        assert fields.keys() <= known


def test_the_settings_have_a_sensor_for_each_row(demonstrate: Any) -> None:
    sensors = set(load_config(TOUR / "tour.yaml").sensors)
    of_vehicle = {"odometry", "rotor_speeds", "path"}
    rows = {name.split("/")[0] for _, name, _, _ in demonstrate.OUT if not name.startswith("/")}
    assert rows - of_vehicle == sensors


def test_the_layout_shows_topics_that_exist(demonstrate: Any) -> None:
    layout = json.loads((TOUR / "foxglove.json").read_text(encoding="utf-8"))

    def leaves(node: Any) -> set[str]:
        return {node} if isinstance(node, str) else leaves(node["first"]) | leaves(node["second"])

    assert leaves(layout["layout"]) == layout["configById"].keys()
    topics = set(re.findall(r'"(/[\w/]+)', json.dumps(layout)))
    known = {name if name.startswith("/") else f"/drone/{name}" for _, name, _, _ in demonstrate.OUT}
    assert topics <= known


def test_the_container_has_what_the_package_depends_on() -> None:
    text = (TOUR / "Dockerfile").read_text(encoding="utf-8")
    apt = set(re.findall(r"ros-jazzy-([a-z0-9-]+)", text))
    root = ElementTree.parse(Path(ROOT, "package.xml")).getroot()
    wanted = {each.text or "" for each in root.findall("exec_depend")}
    in_the_image = {"rclpy", "launch", "ros2launch", "rosidl_default_runtime", "rosgraph_msgs", "sensor_msgs"}
    assert {name.replace("_", "-") for name in wanted - in_the_image - {"std_srvs"}} <= apt


def test_the_tutorial_decodes_the_events_of_the_bridge() -> None:
    page = (ROOT / "docs" / "tutorials" / "ros2.md").read_text(encoding="utf-8")
    (code,) = [
        block for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "Evt3Decoder" in block
    ]
    namespace: dict[str, Any] = {}
    exec(code, namespace)
    t = np.arange(100, 200, dtype=np.int64)
    events = Events(
        200_000, (t % 5).astype(np.uint16), (t % 3).astype(np.uint16), t, (t % 2).astype(np.uint8), 5, 3
    )
    convert = next(rule.convert for rule in RULES if rule.ros_type == EVENTS)
    seen = namespace["on_packet"](cdr.decode(convert(events, Context(vehicle="drone")), EVENTS))
    for mine, read in zip((t, events.x, events.y, events.polarity), seen, strict=True):
        np.testing.assert_array_equal(read, mine)
