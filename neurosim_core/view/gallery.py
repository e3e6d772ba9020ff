"""`neurosim gallery`: sensors, pixel presets, lenses, scenes and films, with their settings, on one page."""

from __future__ import annotations

import base64
import importlib.util
import io
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from numpy.typing import NDArray

from neurosim_core import registry
from neurosim_core.config import load_config
from neurosim_core.flight import saved_flight
from neurosim_core.install import need
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


class Figure(NamedTuple):
    """What is shown of one thing."""

    title: str
    text: str
    """The settings or the command that make it."""
    picture: str = ""
    """Inside of the page: an address of kind `data:`; empty: there is none."""
    lines: Sequence[str] = ()
    """Numbers, where there is no picture."""


def save_gallery(path: Path, *, device: str = "auto", only: str | None = None) -> None:
    """Write the page; pictures are inside of it.

    `only`: name of a section; None: all.
    """
    made: dict[str, Callable[[], list[Figure]]] = {
        "sensors": lambda: _show_rig(sensors(), device),
        "pixels": lambda: _show_rig(_pixels(), device),
        "lenses": lambda: _show_rig(_views(), device),
        "scenes": lambda: [_show_scene(scene, device) for scene in _SCENES],
        "flights": lambda: _films(device),
    }
    if only is not None and only not in made:
        raise ValueError(f"unknown section {only!r}, known: {', '.join(made)}")
    jinja2 = need("the gallery needs jinja2", "view", "jinja2")
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    template = environment.from_string((Path(__file__).parent / "gallery.html.j2").read_text("utf-8"))
    sections = {name: make() for name, make in made.items() if only in (None, name)}
    path.write_text(template.render(sections=sections), encoding="utf-8")


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


def _show_scene(scene: Mapping[str, Any], device: str) -> Figure:
    """Return a figure of one look into a scene."""
    scene = {"kind": "apartment", **scene}
    rig = {"rgb": {"kind": "rgb", "lens": _LENS}}
    given = {"duration_s": 0.02, "scene": scene, "path": {"kind": "tour"}, "sensors": rig, "device": device}
    title = f"{scene['rooms']} room{'s' * (scene['rooms'] > 1)}, seed {scene['seed']}"
    return _figure(title, {"scene": scene}, list(run(load_config(given))))


def _films(device: str) -> list[Figure]:
    """Return figures of films: the default flight, and a throw that the policy of the package ends."""
    with tempfile.TemporaryDirectory() as folder:
        film = Path(folder) / "film.webp"
        model = make_model(load_config({"duration_s": _FILM_S, "device": device}))
        with saved_flight(film, model) as write:
            for packet in run_model(model, make_state(model)):
                write(packet)
        command = f"neurosim run --duration {_FILM_S:g} && neurosim view flight --save film.webp"
        figures = [Figure("the default flight", command, _inside(film.read_bytes(), "webp"))]
        if importlib.util.find_spec("onnxruntime") is not None:
            overrides = {"device": device}
            fly_policy("hover", duration_s=_FILM_S, overrides=overrides, save=film, say=lambda line: None)
            command = f"neurosim fly --policy hover --duration {_FILM_S:g} --save film.webp"
            figures.append(Figure("hover, learnt from events", command, _inside(film.read_bytes(), "webp")))
    return figures


def _show_rig(rig: Mapping[str, Any], device: str) -> list[Figure]:
    """Move a rig for a moment; return a figure for each sensor, those with pictures first."""
    packets = list(run(load_config({**_BASE, "sensors": rig, "device": device})))
    figures = [
        _figure(name, {"sensors": {name: settings}}, [p for p in packets if p.sensor == name])
        for name, settings in rig.items()
    ]
    return sorted(figures, key=lambda figure: not figure.picture)


def _figure(title: str, settings: Mapping[str, Any], packets: list[Packet]) -> Figure:
    from PIL import Image

    text = yaml.safe_dump(dict(settings), default_flow_style=None, sort_keys=False, width=36).rstrip()
    drawn = _picture(packets)
    if drawn is None:
        return Figure(title, text, lines=_numbers(packets))
    file = io.BytesIO()
    Image.fromarray(drawn).save(file, format="png")
    return Figure(title, text, _inside(file.getvalue(), "png"))


def _inside(content: bytes, kind: str) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def _picture(packets: list[Packet]) -> NDArray[np.uint8] | None:
    """Return the last picture of a sensor, the events of its last 20 ms, or its points from above."""
    events = [packet for packet in packets if isinstance(packet, Events)]
    if events:
        joined = join_events([packet.numpy() for packet in events])
        recent = joined.rows(slice(np.searchsorted(joined.t, packets[-1].stamp_ns // 1000 - 20_000), None))
        return event_picture(recent, width=events[0].width, height=events[0].height)
    if packets and isinstance(packets[-1], PointCloud):
        points = as_numpy(packets[-1].points)
        scale = 0.48 * _SIZE["height"] / max(1e-3, float(np.quantile(np.abs(points[:, :2]), 0.99)))
        middle = np.array([_SIZE["width"] / 2, _SIZE["height"] / 2])
        return _dots(middle + scale * points[:, :2] * (1.0, -1.0), _colored(points[:, 2]))
    if packets and isinstance(packets[-1], Corners):
        return _dots(as_numpy(packets[-1].pixels), np.array([30, 60, 150], np.uint8))
    try:
        kind, data = picture_of(packets[-1])
    except (ValueError, IndexError):
        return None
    return _colored(data) if kind in ("depth", "values") else color_picture(kind, data)


def _colored(values: NDArray[Any]) -> NDArray[np.uint8]:
    """Return values as colours from blue to red, shape [..., 3]."""
    from matplotlib import colormaps

    low, high = np.nanquantile(np.where(np.isfinite(values), values, np.nan), [0.01, 0.99])
    share = np.nan_to_num((values - low) / max(high - low, 1e-9))
    return np.asarray(colormaps["turbo"](np.clip(share, 0.0, 1.0), bytes=True)[..., :3])


def _dots(pixels: NDArray[Any], colors: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a white picture with dots of two by two pixels, at columns and rows, shape [n, 2]."""
    picture = np.full((_SIZE["height"], _SIZE["width"], 3), 255, np.uint8)
    column, row = pixels.astype(int).T
    for down, right in np.ndindex(2, 2):
        place = (row + down).clip(0, _SIZE["height"] - 1), (column + right).clip(0, _SIZE["width"] - 1)
        picture[place] = colors
    return picture


def _numbers(packets: list[Packet]) -> list[str]:
    """Return the fields of the last packet as text."""
    lines = []
    for field in schema_of(type(packets[-1])).fields[:_NUMBERS_MAX] if packets else ():
        value = np.array2string(as_numpy(getattr(packets[-1], field.name)), precision=4, threshold=6)
        lines.append(f"{field.name}: {value}")
    return lines or ["nothing within this time"]
