"""`neurosim gallery`: sensors, pixel presets, lenses, scenes and films, with their settings, on one page."""

from __future__ import annotations

import base64
import html
import importlib.util
import io
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from neurosim_core import registry
from neurosim_core.config import load_config
from neurosim_core.flight import saved_flight
from neurosim_core.learn.pilot import fly_policy
from neurosim_core.packets import Events, Packet, PointCloud, as_numpy, join_events, schema_of
from neurosim_core.sensors.corners import Corners
from neurosim_core.sensors.event_config import event_presets
from neurosim_core.sim.model import make_model
from neurosim_core.sim.rollout import run, run_model
from neurosim_core.sim.state import make_state
from neurosim_core.view.pictures import color_picture, event_picture, picture_of

_SIZE = {"width": 240, "height": 180}
_LENS = {**_SIZE, "horizontal_fov_rad": 1.5}
_BASE: dict[str, Any] = {
    "duration_s": 0.12,
    "scene": {"kind": "apartment", "rooms": 1},
    "path": {
        "kind": "poses",
        "keyframes": [
            {"time_s": 0.0, "position_m": [0.0, 0.0, 1.3]},
            {"time_s": 0.12, "position_m": [0.06, 0.12, 1.31], "rpy_rad": [0.01, 0.02, 0.12]},
        ],
    },
}
_MORE: Mapping[str, Mapping[str, Any]] = {
    "frame_camera": {"color": "bayer_rggb", "full_well_e": 400, "shot_noise": True, "read_noise_e": 6},
    "lidar": {"preset": "velodyne_vlp16", "deskew": True},
    "optical_flow": {"window_s": 0.02},
    "range_finder": {"lens": {"width": 5, "height": 5, "horizontal_fov_rad": 0.07}},
}
"""What a kind of sensor is shown with, besides its lens."""
_LENSES = (
    {"kind": "pinhole", **_SIZE, "horizontal_fov_rad": 0.7},
    {"kind": "equidistant", **_SIZE, "fx": 70.0, "fy": 70.0, "cx": 120.0, "cy": 90.0},
)
_SCENES = (
    {"rooms": 1, "seed": 3},
    {"rooms": 4, "seed": 7},
    {"rooms": 3, "seed": 11},
    {"rooms": 2, "seed": 5},
)
_NUMBERS_MAX = 6
_FILM_S = 4.0
_STYLE = """body{font:15px/1.5 system-ui,sans-serif;margin:2rem auto;max-width:75rem;
padding:0 1rem;color:#222}
h1,h2{font-weight:300}section{display:grid;grid-template-columns:repeat(auto-fill,minmax(16rem,1fr));gap:1.2rem}
figure:has(img[src^='data:image/webp']){grid-column:1 / -1}
figure{margin:0;border:1px solid #ddd;border-radius:4px;overflow:hidden}figure img{width:100%;display:block}
figcaption{padding:.4rem .7rem;font-weight:600}pre{margin:0;padding:.5rem .7rem;background:#f5f5f5;
font-size:12px;white-space:pre-wrap;overflow-wrap:anywhere}
.numbers{padding:.7rem;font:12px/1.6 monospace;min-height:5rem}"""


def save_gallery(path: Path, *, device: str = "auto", only: str | None = None) -> None:
    """Write the page; pictures are inside of it.

    `only`: name of a section; None: all.
    """
    made: dict[str, Callable[[], list[str]]] = {
        "sensors": lambda: _show_rig(sensors(), device),
        "pixels": lambda: _show_rig(_pixels(), device),
        "lenses": lambda: _show_rig(_views(), device),
        "scenes": lambda: [_show_scene(scene, device) for scene in _SCENES],
        "flights": lambda: _films(device),
    }
    if only is not None and only not in made:
        raise ValueError(f"unknown section {only!r}, known: {', '.join(made)}")
    sections = {name: make() for name, make in made.items() if only in (None, name)}
    body = "".join(
        f"<h2>{title.capitalize()}</h2><section>{''.join(items)}</section>"
        for title, items in sections.items()
    )
    page = f"<!doctype html><meta charset=utf-8><title>Neurosim</title><style>{_STYLE}</style>"
    intro = (
        "<h1>Neurosim: gallery</h1><p>Each picture is above the settings or the commands that make it.</p>"
    )
    path.write_text(f"{page}{intro}{body}", encoding="utf-8")


def sensors() -> dict[str, Any]:
    """One sensor of each kind."""
    shown = {}
    for kind, config in registry.kinds("sensor").items():
        lens = {"lens": _LENS} if "lens" in getattr(config, "model_fields", {}) else {}
        shown[kind] = {"kind": kind, **lens, **_MORE.get(kind, {})}
    return shown


def _pixels() -> dict[str, Any]:
    """One event camera with each preset of pixels."""
    ideal = {"kind": "event_camera", "lens": _LENS}
    return {"ideal": ideal} | {name: {**ideal, "pixel": {"preset": name}} for name in event_presets()}


def _views() -> dict[str, Any]:
    return {str(lens["kind"]): {"kind": "rgb", "lens": lens} for lens in _LENSES}


def _show_scene(scene: Mapping[str, Any], device: str) -> str:
    """Return a figure of one look into a scene."""
    scene = {"kind": "apartment", **scene}
    rig = {"rgb": {"kind": "rgb", "lens": _LENS}}
    given = {"duration_s": 0.02, "scene": scene, "path": {"kind": "tour"}, "sensors": rig, "device": device}
    title = f"{scene['rooms']} room{'s' * (scene['rooms'] > 1)}, seed {scene['seed']}"
    return _figure(title, {"scene": scene}, list(run(load_config(given))))


def _films(device: str) -> list[str]:
    """Return figures of films: the default flight, and a throw that the policy of the package ends."""
    with tempfile.TemporaryDirectory() as folder:
        film = Path(folder) / "film.webp"

        def shown(title: str, command: str) -> str:
            return _framed(title, _image(title, film.read_bytes(), "webp"), command)

        model = make_model(load_config({"duration_s": _FILM_S, "device": device}))
        with saved_flight(film, model) as write:
            for packet in run_model(model, make_state(model)):
                write(packet)
        command = f"neurosim run --duration {_FILM_S:g} && neurosim view flight --save film.webp"
        figures = [shown("the default flight", command)]
        if importlib.util.find_spec("onnxruntime") is not None:
            overrides = {"device": device}
            fly_policy("hover", duration_s=_FILM_S, overrides=overrides, save=film, say=lambda line: None)
            command = f"neurosim fly --policy hover --duration {_FILM_S:g} --save film.webp"
            figures.append(shown("hover, learnt from events", command))
    return figures


def _show_rig(rig: Mapping[str, Any], device: str) -> list[str]:
    """Move a rig for a moment; return a figure for each sensor, those with pictures first."""
    packets = list(run(load_config({**_BASE, "sensors": rig, "device": device})))
    figures = [
        _figure(name, {"sensors": {name: settings}}, [p for p in packets if p.sensor == name])
        for name, settings in rig.items()
    ]
    return sorted(figures, key=lambda figure: "<img" not in figure)


def _figure(title: str, settings: Mapping[str, Any], packets: list[Packet]) -> str:
    text = yaml.safe_dump(dict(settings), default_flow_style=None, sort_keys=False, width=36)
    drawn = _picture(packets)
    shown = f'<div class="numbers">{_numbers(packets)}</div>'
    if drawn is not None:
        from PIL import Image

        file = io.BytesIO()
        Image.fromarray(drawn).save(file, format="png")
        shown = _image(title, file.getvalue(), "png")
    return _framed(title, shown, text)


def _image(title: str, content: bytes, kind: str) -> str:
    """Return a picture that is inside of the page."""
    return f'<img alt="{title}" src="data:image/{kind};base64,{base64.b64encode(content).decode()}">'


def _framed(title: str, shown: str, text: str) -> str:
    return f"<figure>{shown}<figcaption>{title}</figcaption><pre>{html.escape(text.rstrip())}</pre></figure>"


def _picture(packets: list[Packet]) -> NDArray[np.uint8] | None:
    """Return the last picture of a sensor, the events of its last 20 ms, or its points from above."""
    events = [packet for packet in packets if isinstance(packet, Events)]
    if events:
        joined = join_events([packet.numpy() for packet in events])
        recent = joined.rows(slice(np.searchsorted(joined.t, packets[-1].stamp_ns // 1000 - 20_000), None))
        return event_picture(recent, width=events[0].width, height=events[0].height)
    if packets and isinstance(packets[-1], PointCloud):
        return _from_above(as_numpy(packets[-1].points))
    if packets and isinstance(packets[-1], Corners):
        column, row = as_numpy(packets[-1].pixels).astype(int).T
        return _dots(row, column, np.array([30, 60, 150], np.uint8))
    try:
        kind, data = picture_of(packets[-1])
    except (ValueError, IndexError):
        return None
    if kind not in ("depth", "values"):
        return color_picture(kind, data)
    low, high = np.nanquantile(np.where(np.isfinite(data), data, np.nan), [0.01, 0.99])
    share = np.nan_to_num(np.clip((data - low) / max(high - low, 1e-9), 0.0, 1.0))
    colors: NDArray[np.uint8] = (255 * _turbo(share)).round().astype(np.uint8)
    return colors


def _turbo(share: NDArray[Any]) -> NDArray[Any]:
    """Return colours from blue over green to red, shape [..., 3]."""
    centres = np.array([0.85, 0.5, 0.15])
    colors: NDArray[np.float64] = np.clip(1.6 - 4.0 * np.abs(share[..., None] - centres), 0.05, 1.0)
    return colors


def _from_above(points: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return points in the plan, dark on white, coloured by height."""
    scale = 0.48 * _SIZE["height"] / max(1e-3, float(np.quantile(np.abs(points[:, :2]), 0.99)))
    row = (_SIZE["height"] / 2 - scale * points[:, 1]).astype(int)
    column = (_SIZE["width"] / 2 + scale * points[:, 0]).astype(int)
    height = np.clip((points[:, 2] + 1.3) / 2.6, 0.0, 1.0)
    return _dots(row, column, (230 * _turbo(height)).astype(np.uint8))


def _dots(row: NDArray[Any], column: NDArray[Any], colors: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a white picture with dots of two by two pixels."""
    picture = np.full((_SIZE["height"], _SIZE["width"], 3), 255, np.uint8)
    for down, right in np.ndindex(2, 2):
        place = (row + down).clip(0, _SIZE["height"] - 1), (column + right).clip(0, _SIZE["width"] - 1)
        picture[place] = colors
    return picture


def _numbers(packets: list[Packet]) -> str:
    """Return the fields of the last packet as text."""
    if not packets:
        return "nothing within this time"
    lines = []
    for field in schema_of(type(packets[-1])).fields[:_NUMBERS_MAX]:
        value = np.array2string(as_numpy(getattr(packets[-1], field.name)), precision=4, threshold=6)
        lines.append(f"{field.name}: {html.escape(value)}")
    return "<br>".join(lines)
