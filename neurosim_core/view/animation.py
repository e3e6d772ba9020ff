"""A short animation of a recording, as WebP or GIF: picture, events, and the path in the plan."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from PIL import Image as Pillow
from PIL import ImageDraw

from neurosim_core.config import load_config
from neurosim_core.io.transfer import as_recording
from neurosim_core.packets import Events, Image, Odometry
from neurosim_core.record import Recording
from neurosim_core.record.disk import naming_file
from neurosim_core.scene.scene import Scene
from neurosim_core.view.pictures import event_picture
from neurosim_core.view.plan import cut_plan

SUFFIXES = (".webp", ".gif")
_HEIGHT_PX = 220
_GAP_PX = 6
_EVENT_WINDOW_S = 0.02
_PATH_SRGB = (240, 110, 20)


def save_animation(recorded: Path, out: Path, *, rate_hz: float = 10.0) -> None:
    """Draw the first colour camera and the first event camera of a recording side by side, with the path.

    `rate_hz`: pictures a second of simulated time, and of the animation [Hz].
    """
    with as_recording(recorded) as file, Recording(file) as flight:
        first = {name: next(flight.packets(name), None) for name in flight.sensors}
        colored = [name for name, p in first.items() if isinstance(p, Image) and p.data.ndim == 3]
        if not colored:
            raise ValueError(
                f"an animation needs pictures in colour, and {recorded} has none: add a sensor {{kind: rgb}} "
                f"to the flight, or save a file for Rerun, as {out.with_suffix('.rrd')}"
            )
        pictures = list(flight.packets(colored[0]))
        events = next((p for p in first.values() if isinstance(p, Events)), None)
        tracked = [name for name, p in first.items() if isinstance(p, Odometry)]
        poses = [p for p in (flight.packets(*tracked) if tracked else ()) if isinstance(p, Odometry)]
        pose_stamps_ns = [p.stamp_ns for p in poses]
        settings = yaml.safe_load(flight.header.config_yaml)
        way = None
        if poses and "conversion" not in settings:  # what was converted has no scene
            way = _Way(load_config(settings).scene.load(), np.array([pose.position for pose in poses]))
        frames = []
        for stamp_ns in range(0, pictures[-1].stamp_ns + 1, round(1e9 / rate_hz)):
            picture = min(pictures, key=lambda p: abs(p.stamp_ns - stamp_ns))
            assert isinstance(picture, Image)
            panels = [_scaled(picture.data)]
            if events is not None:
                end_s = (stamp_ns // 1000 + 1) * 1e-6
                window = flight.events(events.sensor, end_s - _EVENT_WINDOW_S, end_s)
                panels.append(_scaled(event_picture(window, width=events.width, height=events.height)))
            if way is not None:
                panels.append(way.drawn(int(np.searchsorted(pose_stamps_ns, stamp_ns))))
            frames.append(_beside(panels))
    options: dict[str, Any] = {"quality": 60} if out.suffix == ".webp" else {}
    try:
        with naming_file(out):
            frames[0].save(
                out, save_all=True, append_images=frames[1:], duration=round(1e3 / rate_hz), loop=0, **options
            )
    except BaseException:
        out.unlink(missing_ok=True)  # what was cut off looks like an animation
        raise


def _scaled(picture: NDArray[np.uint8]) -> Pillow.Image:
    height, width = picture.shape[:2]
    kernel = Pillow.Resampling.NEAREST if height < _HEIGHT_PX else Pillow.Resampling.BICUBIC
    return Pillow.fromarray(picture).resize((round(width * _HEIGHT_PX / height), _HEIGHT_PX), kernel)


def _beside(panels: list[Pillow.Image]) -> Pillow.Image:
    gap = np.full((_HEIGHT_PX, _GAP_PX, 3), 255, np.uint8)
    parts = [part for panel in panels for part in (gap, np.asarray(panel.convert("RGB")))]
    return Pillow.fromarray(np.hstack(parts[1:]))


class _Way:
    """The plan of a scene, and a path in it."""

    def __init__(self, scene: Scene, position: NDArray[np.float64]) -> None:
        plan = cut_plan(scene, height_m=float(np.median(position[:, 2])))
        self._low, size = plan.bounds[0], plan.bounds[1] - plan.bounds[0]
        self._scale = (_HEIGHT_PX - 2) / size[1]
        self._picture = Pillow.new("RGB", (round(self._scale * size[0]) + 2, _HEIGHT_PX), (255, 255, 255))
        draw = ImageDraw.Draw(self._picture)
        for triangle, color in zip(plan.triangles, 1.0 - 0.7 * (1.0 - plan.colors), strict=True):
            draw.polygon(self._at(triangle), fill=tuple((255 * color).astype(int).tolist()))
        for line in plan.outlines:
            draw.line(self._at(line), fill=(40, 40, 40))
        self._path = self._at(position[:, :2])

    def _at(self, points: NDArray[np.float64]) -> list[tuple[float, float]]:
        x, y = (self._scale * (points - self._low)).T
        return list(zip((1 + x).tolist(), (_HEIGHT_PX - 1 - y).tolist(), strict=True))

    def drawn(self, count: int) -> Pillow.Image:
        """Return the plan with the first places of the path."""
        picture = self._picture.copy()
        draw = ImageDraw.Draw(picture)
        count = min(max(count, 1), len(self._path))
        draw.line(self._path[:count], fill=_PATH_SRGB, width=2)
        x, y = self._path[count - 1]
        draw.ellipse((x - 4, y - 4, x + 4, y + 4), fill=_PATH_SRGB)
        return picture
