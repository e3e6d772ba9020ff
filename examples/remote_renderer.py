"""Render in another process: pyrender runs there, the simulator here, and Cortex connects them.

Replace `render` by your own engine: it takes poses and returns frames. The example prints the number of
pictures, and whether the renderer conforms.
"""

from __future__ import annotations

import multiprocessing
import threading
from typing import Any

import numpy as np
import warp as wp

import neurosim_core as ns

SCENE = {"kind": "apartment", "rooms": 1}
LENS = ("width", "height", "fx", "fy", "cx", "cy")


def render_process(topic: str, ready: Any, done: Any) -> None:
    """Run the other process: answer requests for frames with pyrender."""
    config = ns.load_config({"scene": SCENE})
    try:
        scene = ns.upload_scene(config.scene.load(), config.render, device="cpu", renderer="pyrender")
    except RuntimeError as error:  # pyrender or OpenGL is missing
        raise SystemExit(error) from None
    cameras: dict[ns.PinholeConfig, Any] = {}

    def render(request: Any) -> ns.Frames:
        lens = ns.PinholeConfig(**{name: getattr(request, name) for name in LENS})
        if lens not in cameras:
            cameras[lens] = ns.make_renderer(scene, lens, outputs=["depth", "rgb"], instant_count=1)
        camera, depths, pictures = cameras[lens], [], []
        for position, orientation in zip(request.position, request.orientation, strict=True):
            p_WC = wp.array([position], dtype=wp.vec3, device="cpu")
            q_WC = wp.array([orientation], dtype=wp.quat, device="cpu")
            camera.render(p_WC, q_WC, wp.zeros(1, dtype=int, device="cpu"), instant_count=1)
            depths.append(camera.depth.numpy()[0].copy())
            pictures.append(camera.rgb.numpy()[0].copy())
        return ns.Frames(srgb=np.array(pictures), depth=np.array(depths))

    stop = threading.Event()
    threading.Thread(target=lambda: (done.wait(), stop.set()), daemon=True).start()
    ns.serve_frames(render, topic=topic, stop=stop, on_ready=ready.set)


def main() -> tuple[int, list[str]]:
    """Fly with frames of the other process; return the number of pictures and the defects found."""
    spawn = multiprocessing.get_context("spawn")
    ready, done = spawn.Event(), spawn.Event()
    process = spawn.Process(target=render_process, args=("/example/renderer", ready, done), daemon=True)
    process.start()
    try:
        while not ready.wait(0.1):
            if not process.is_alive():
                raise SystemExit("the process that renders has ended")
        lens = {"width": 160, "height": 120, "horizontal_fov_rad": 1.2}
        sensors = {kind: {"kind": kind, "rate_hz": 20, "lens": lens} for kind in ("rgb", "depth")}
        config = {"duration_s": 0.2, "device": "cpu", "scene": SCENE, "sensors": sensors}
        renderer = {"kind": "remote", "topic": "/example/renderer"}
        model = ns.make_model(ns.load_config({**config, "renderer": renderer}))
        pictures = [p for p in ns.run_model(model, ns.make_state(model)) if isinstance(p, ns.Image)]
        complaints = ns.check_renderer(
            model.scene_on_device,
            ns.PinholeConfig(**lens),
            position=model.path.evaluate([0]).position[0],
            orientation=[-0.5, 0.5, -0.5, 0.5],
        )
        print(f"{len(pictures)} pictures; {complaints or 'conforms'}")
        return len(pictures), complaints
    finally:
        done.set()
        process.join(10.0)


if __name__ == "__main__":
    main()
