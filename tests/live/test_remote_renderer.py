"""A renderer in another process: its frames arrive, are converted, and what goes wrong is said."""

from __future__ import annotations

import gc
import logging
import threading
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp
from processes import wait_for

import neurosim_core as ns
from neurosim_core.live.remote_renderer import Frames, RemoteRendererConfig, RemoteRendererError, serve_frames
from neurosim_core.render.conformance import check_renderer
from neurosim_core.render.renderer import RenderConfig

LENS = ns.PinholeConfig(width=40, height=30, horizontal_fov_rad=1.2)
UPRIGHT = [-0.5, 0.5, -0.5, 0.5]  # looks along x, its x to the right


def wall(request, *, depth=True):
    """Return frames of a wall at x = 3 m that is brighter at the top, seen by cameras that look along +x."""
    n, (height, width) = len(request.position), (request.height, request.width)
    rows = np.arange(height, dtype=np.float32)[:, None, None]
    linear = np.broadcast_to((height - rows) / height, (n, height, width, 3))
    z = 3.0 - request.position[:, 0].astype(np.float32)
    return Frames(
        linear=linear, depth=np.broadcast_to(z[:, None, None], (n, height, width)) if depth else None
    )


@contextmanager
def served(topic, render):
    """Answer requests on a thread, as another process would."""
    ready, stop = threading.Event(), threading.Event()
    thread = threading.Thread(
        target=lambda: serve_frames(render, topic=topic, stop=stop, on_ready=ready.set), daemon=True
    )
    thread.start()
    assert ready.wait(20.0)
    try:
        yield RemoteRendererConfig(topic=topic, timeout_s=20.0)
    finally:
        stop.set()
        thread.join(20.0)
        assert not thread.is_alive()


def opened(settings):
    return settings.upload(None, RenderConfig(exposure=0.5, dark_floor=0.01), device="cpu", bodies=())


def rendered(scene, outputs, poses=((0.0, 0.0, 0.0),), slots=(0,)):
    renderer = ns.make_renderer(
        scene, LENS, outputs=outputs, instant_count=len(poses), image_count=max(slots) + 1
    )
    renderer.render(
        wp.array(list(poses), dtype=wp.vec3, device="cpu"),
        wp.array([UPRIGHT] * len(poses), dtype=wp.quat, device="cpu"),
        wp.array(list(slots), dtype=int, device="cpu"),
        instant_count=len(poses),
    )
    return renderer


def test_linear_frames_become_log_radiance_pictures_and_depth():
    with served("/test/linear", wall) as settings:
        renderer = rendered(
            opened(settings), ["log_radiance", "rgb", "depth"], [(0, 0, 0), (1, 0, 0)], (-1, 0)
        )
    top = renderer.log_radiance.numpy()[:, 0, 0]
    assert top == pytest.approx(np.log(1.01), abs=1e-6)  # both instants, luma 1 and the dark floor
    assert renderer.depth.numpy()[0] == pytest.approx(2.0)  # the picture is of the second
    assert renderer.rgb.numpy()[0, 0, 0].tolist() == [188, 188, 188]  # 0.5 in sRGB


def test_the_connection_ends_with_the_scene():
    """Nothing of it stays: neither its threads nor its memory shared with the renderer."""

    def threads():
        return [thread.name for thread in threading.enumerate() if "frames of /test/end" in thread.name]

    with served("/test/end", wall) as settings:
        renderer = rendered(opened(settings), ["depth"])
        assert threads()
        del renderer
        gc.collect()
        wait_for(lambda: not threads())


def test_8_bit_frames_are_taken_with_a_warning(caplog):
    def render(request):
        return Frames(srgb=np.full((len(request.position), request.height, request.width, 3), 188, np.uint8))

    with served("/test/srgb", render) as settings, caplog.at_level(logging.WARNING):
        renderer = rendered(opened(settings), ["log_radiance", "rgb"])
    assert "8-bit sRGB" in caplog.text
    assert renderer.rgb.numpy().min() == renderer.rgb.numpy().max() == 188
    assert renderer.log_radiance.numpy()[0] == pytest.approx(np.log(0.5029 + 0.01), abs=1e-3)


def test_what_is_wrong_is_said():
    answers = {
        "/test/raises": (lambda request: 1 / 0, "failed: ZeroDivisionError"),
        "/test/nothing": (lambda request: Frames(), "sent no depth, radiance"),
        "/test/shape": (lambda request: Frames(depth=np.ones((1, 2, 3), np.float32)), "depth of shape"),
    }
    for topic, (render, said) in answers.items():
        with served(topic, render) as settings, pytest.raises(RemoteRendererError, match=said):
            rendered(opened(settings), ["rgb", "depth"])
    with pytest.raises(RemoteRendererError, match="no renderer serves /test/absent"):
        opened(RemoteRendererConfig(topic="/test/absent", timeout_s=0.2))


def test_what_it_cannot_do_is_refused():
    bodies = [SimpleNamespace(name="ball")]
    with pytest.raises(ValueError, match="sees no bodies, and there are some: ball"):
        RemoteRendererConfig().upload(None, RenderConfig(), device="cpu", bodies=bodies)
    with pytest.raises(ns.ConfigError, match=r"renderer\.topic"):
        ns.load_config({"renderer": {"kind": "remote", "topic": "no slash"}})


def test_the_checks_of_conformance_find_planted_faults():
    room = ns.load_config({"scene": {"kind": "apartment", "rooms": 1, "seed": 2}}).scene.load()
    scene = ns.upload_scene(room, RenderConfig(lighting={"mode": "unshadowed"}), device="cpu")
    view = {"position": [0.0, 0.0, 1.2], "orientation": UPRIGHT}
    assert check_renderer(scene, LENS, **view) == []

    def turned(request):  # y up in place of down
        frames = seen(request)
        return Frames(linear=frames.linear[:, ::-1], depth=frames.depth[:, ::-1])

    def long(request):  # the length of rays in place of planar z
        fx, fy, cx, cy = LENS.intrinsics()
        rows, cols = np.indices((LENS.height, LENS.width)) + 0.5
        frames = seen(request)
        length = np.sqrt(1.0 + ((cols - cx) / fx) ** 2 + ((rows - cy) / fy) ** 2)
        return Frames(linear=frames.linear, depth=frames.depth * length.astype(np.float32))

    def seen(request):
        renderer = ns.make_renderer(scene, LENS, outputs=["depth", "rgb"], instant_count=1)
        renderer.render(
            wp.array(request.position, dtype=wp.vec3, device="cpu"),
            wp.array(request.orientation, dtype=wp.quat, device="cpu"),
            wp.zeros(1, dtype=int, device="cpu"),
            instant_count=1,
        )
        return Frames(linear=renderer.rgb.numpy() / np.float32(255.0), depth=renderer.depth.numpy())

    for topic, render, said in (
        ("/test/sound", seen, ""),
        ("/test/up", turned, "down"),
        ("/test/long", long, "turned"),
    ):
        with served(topic, render) as settings:
            complaints = check_renderer(opened(settings), LENS, **view)
        assert bool(complaints) == bool(said), complaints
        assert said in " ".join(complaints)
