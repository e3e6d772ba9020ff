"""The layout of the viewer: where the eye is at first, and what has a place."""

from __future__ import annotations

import numpy as np
import pytest
import rerun.blueprint as rrb
from hypothesis import given, settings
from hypothesis import strategies as st

from neurosim_core.packets import PACKET_CLASSES, schema_of
from neurosim_core.record import describe_sensors
from neurosim_core.registry import find
from neurosim_core.view.rerun_layout import make_blueprint, overlays, sensor_panels

SIZES = st.floats(0.5, 200.0)


RIG = (
    ("dvs", "Events", "events"),
    ("z", "Image", "depth"),
    ("rgb", "Image", "colour"),
    ("imu", "ImuSample", "time series"),
    ("truth", "Odometry", "pose"),
)


def rig(vehicle: str = "drone", *, live: bool = False, links: bool = False):
    """Panels of a vehicle, as its sensors declare them."""
    sensors = (*RIG, ("imu_link", "Delivery", "delay")) if links else RIG
    found = [
        sensor_panels(vehicle, name, schema_of(PACKET_CLASSES[cls]), kind, live=live)
        for name, cls, kind in sensors
    ]
    return [panel for panels in found for panel in panels]


def views(part: object) -> list[rrb.View]:
    """All views below a container."""
    return [part] if isinstance(part, rrb.View) else [v for p in part.contents for v in views(p)]  # type: ignore[attr-defined]


def origins(blueprint: rrb.Blueprint) -> list[str]:
    return [str(view.origin) for view in views(blueprint.root_container)]


@settings(deadline=None, max_examples=50)
@given(size=st.tuples(SIZES, SIZES, SIZES), middle=st.tuples(*[st.floats(-50.0, 50.0)] * 3))
def test_the_whole_scene_is_seen_at_first(size, middle):
    """Every corner is in a picture of 55 degrees, half as wide again as high; and the scene fills it."""
    bounds_m = np.array(middle) + np.array([[-0.5], [0.5]]) * np.array(size)
    space = views(make_blueprint({"drone": ()}, bounds_m).root_container)[0]
    eye = space.properties["EyeControls3D"]
    position, target = (
        np.array(part.as_arrow_array().to_pylist()[0]) for part in (eye.position, eye.look_target)
    )
    assert target == pytest.approx(np.array(middle), abs=1e-3)  # float32, and 50 m away
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    corners = bounds_m[np.indices((2, 2, 2)).reshape(3, -1).T, range(3)] - position
    depth = corners @ forward
    assert (depth > 0.0).all()
    half = np.tan(np.radians(55.0) / 2)
    high = np.abs(corners @ up / depth / half).max()
    wide = np.abs(corners @ right / depth / half / 1.6).max()
    assert 0.85 < max(high, wide) < 1.0


def test_nothing_has_an_empty_place():
    """A file has what sensors measure, a stream also commands, timing and status; links if there are any."""
    file = origins(make_blueprint({"drone": rig()}))
    pictures = [
        f"world/vehicles/drone/{name}" for name in ("rgb", "dvs", "dvs", "z")
    ]  # events: a surface, too
    plots = [
        "plots/drone/dvs/rate",
        "plots/drone/imu/specific_force",
        "plots/drone/imu/angular_rate",
        "plots/drone/truth",
        "plots/drone/truth/rotor_speed",
    ]
    assert file == ["world", plots[0], "events/drone/dvs", *plots[1:], *pictures]
    live = origins(make_blueprint({"drone": rig(live=True)}, live=True))
    simulator = ["simulator/timing", "simulator/real_time_factor", "simulator/losses"]
    commands = ["plots/drone/command", "simulator/timing"]
    assert live == ["world", *plots, *commands, *simulator, *pictures, "status"]
    assert "plots/drone/links" in origins(make_blueprint({"drone": rig(live=True, links=True)}, live=True))
    assert origins(make_blueprint({"drone": ()})) == ["world"]
    assert origins(make_blueprint({"drone": ()}, live=True))[-1] == "status"


def test_an_overlay_has_a_panel_with_the_picture_below_and_is_not_in_the_scene():
    image, events = schema_of(PACKET_CLASSES["Image"]), schema_of(PACKET_CLASSES["Events"])
    panels = [
        *sensor_panels("drone", "rgb", image, "colour", live=False),
        *sensor_panels("drone", "ids", image, "segmentation", live=False, below="rgb"),
        *sensor_panels("drone", "dvs", events, "events", live=False),
    ]
    shown = {str(view.name): view for view in views(make_blueprint({"drone": panels}).root_container)}
    assert shown["ids over rgb"].origin == "world/vehicles/drone/rgb"
    assert shown["ids over rgb"].contents == ["$origin/image", "$origin/ids/**"]
    assert shown["surface"].contents == ["$origin/surface"]
    hidden = {rule for rule in shown["scene"].contents if rule.startswith("- ")}
    assert hidden == {"- /world/vehicles/drone/rgb/ids/**", "- /world/vehicles/drone/dvs/**"}


def test_labels_and_flow_are_drawn_over_the_colour_camera_with_the_same_view():
    lens = {"kind": "pinhole", "width": 32, "height": 24, "horizontal_fov_rad": 1.0}
    kinds = ("depth", "instance", "semantic", "optical_flow", "edges", "imu", "odometry", "lidar")
    for colored in ("rgb", "frame_camera"):
        rig = {kind: find("sensor", kind)() for kind in (*kinds, colored)}
        rig["elsewhere"] = find("sensor", "instance")(lens=lens)
        over = overlays(describe_sensors(rig))
        assert over == dict.fromkeys(("instance", "semantic", "optical_flow", "edges"), colored)
    assert not overlays(describe_sensors({"ids": rig["instance"]}))


def test_several_vehicles_have_tabs():
    blueprint = make_blueprint({name: rig(name, live=True) for name in ("alpha", "beta")}, live=True)
    found = origins(blueprint)
    assert len([o for o in found if o.startswith("world/vehicles/beta/")]) == 4
    assert len([o for o in found if o.startswith("plots/alpha/")]) == 6
    left, right = blueprint.root_container.contents
    for tabs, names in (
        (left.contents[1], ["alpha", "beta", "simulator"]),
        (right.contents[0], ["alpha", "beta"]),
    ):
        assert isinstance(tabs, rrb.Tabs)
        assert [tab.name for tab in tabs.contents] == names


def test_what_rolls_shows_the_last_seconds():
    """A stream in a viewer; a file shows all of it."""
    for rolling in (False, True):
        blueprint = make_blueprint({"drone": rig(live=True)}, live=True, rolling=rolling)
        plots = [view for view in views(blueprint.root_container) if isinstance(view, rrb.TimeSeriesView)]
        assert len(plots) == 10
        assert all(("VisibleTimeRanges" in plot.properties) == rolling for plot in plots)
        assert (blueprint.time_panel.play_state is not None) == rolling
