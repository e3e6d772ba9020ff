"""Which cameras share a render group, and which must not."""

from __future__ import annotations

import pytest

from neurosim_core.clock import Rate
from neurosim_core.config import load_config
from neurosim_core.sensors.render_plan import plan_render_groups

LENS = {"width": 32, "height": 24, "horizontal_fov_rad": 1.5}
OTHER = {"width": 32, "height": 24, "horizontal_fov_rad": 1.0}
EVENTS = {"kind": "event_camera", "lens": LENS, "sampling_rate_hz": 240, "packet_rate_hz": 120}


def groups(sensors):
    return plan_render_groups(load_config({"sensors": sensors}).sensors)


def test_one_ray_answers_all_cameras_that_share_pose_lens_and_clock():
    (group,) = groups(
        {
            "rgb": {"kind": "rgb", "lens": LENS, "rate_hz": 20},
            "events": EVENTS,
            "depth": {"kind": "depth", "lens": LENS, "rate_hz": 30},
        }
    )
    assert group.rate == Rate(240.0)
    assert group.frame_sensors == ("events",)
    assert set(group.image_sensors) == {"rgb", "depth"}
    assert group.outputs == {"log_radiance", "rgb", "depth"}


@pytest.mark.parametrize(
    "camera",
    [
        {"kind": "rgb", "lens": OTHER, "rate_hz": 20},
        {"kind": "rgb", "lens": LENS, "mount": {"position_m": [0, 0, 1]}, "rate_hz": 20},
        {"kind": "rgb", "lens": LENS, "rate_hz": 25},  # 240 / 25 is no integer
        {**EVENTS, "sampling_rate_hz": 480},
    ],
    ids=["lens", "mount", "clock", "event clock"],
)
def test_cameras_that_differ_have_groups_of_their_own(camera):
    both = groups({"events": EVENTS, "other": camera})
    assert len(both) == 2
    assert both[0].outputs == {"log_radiance"}


def test_two_event_cameras_with_other_pixels_share_a_group():
    (group,) = groups({"a": EVENTS, "b": {**EVENTS, "pixel": {"threshold_on": 0.4}}})
    assert group.frame_sensors == ("a", "b")


ADAPTIVE = {**EVENTS, "max_displacement_px": 0.5}


@pytest.mark.parametrize(
    "camera",
    [
        EVENTS,
        {**ADAPTIVE, "max_displacement_px": 1.0},
        {**ADAPTIVE, "packet_rate_hz": 60},
        {"kind": "rgb", "lens": LENS, "rate_hz": 20},
    ],
    ids=["every tick", "displacement", "packets", "pictures"],
)
def test_an_adaptive_camera_shares_its_renders_with_none_that_needs_others(camera):
    adaptive, other = groups({"adaptive": ADAPTIVE, "other": camera})
    assert adaptive.frame_sensors == ("adaptive",)
    assert (adaptive.max_displacement_px, adaptive.outputs) == (0.5, {"log_radiance"})
    assert other.max_displacement_px == camera.get("max_displacement_px")


def test_adaptive_cameras_that_need_the_same_renders_share_them():
    (group,) = groups({"a": ADAPTIVE, "b": {**ADAPTIVE, "pixel": {"threshold_on": 0.4}}})
    assert group.frame_sensors == ("a", "b")


@pytest.mark.parametrize("value", [0.0, -1.0, 101.0, float("nan")])
def test_a_displacement_out_of_range_is_refused(value):
    with pytest.raises(ValueError, match="max_displacement_px"):
        groups({"events": {**EVENTS, "max_displacement_px": value}})


def test_slow_image_sensors_join_fast_ones():
    (group,) = groups({"slow": {"kind": "rgb", "lens": LENS, "rate_hz": 10},
                     "fast": {"kind": "depth", "lens": LENS, "rate_hz": 30}})  # fmt: skip
    assert group.rate == Rate(30.0)


def test_sensors_that_need_no_picture_need_no_cast():
    assert groups({"imu": {"kind": "imu"}, "odometry": {"kind": "odometry"}}) == ()
