"""The card of a data set: what is in it, in words, numbers and pictures."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image as Picture
from PIL import ImageDraw

from neurosim_core import __version__
from neurosim_core.data.make import DEPTH_EDGES_M, SPEED_EDGES_M_S, DatasetPlan, FlightStats, write_whole
from neurosim_core.data.stream import Dataset
from neurosim_core.view.pictures import BACKGROUND_SRGB, color_picture, event_picture

_SHEET_FLIGHTS = 6
_TILE_PX = 240
_GAP_PX = 6
_WINDOW_S = 0.02


def write_card(plan: DatasetPlan, *, command: str) -> None:
    """Write README.md and sheet.png."""
    numbers = range(plan.flight_count)
    stats = [_read_stats(plan.path(number).with_suffix(".json")) for number in numbers]
    picture = _draw_sheet(plan)
    if picture is not None:
        buffer = io.BytesIO()
        picture.save(buffer, "PNG")
        write_whole(plan.folder / "sheet.png", buffer.getvalue())
    text = _write_text(plan, stats, command=command, has_sheet=picture is not None)
    write_whole(plan.folder / "README.md", text.encode())


def _read_stats(path: Path) -> FlightStats:
    return FlightStats(**json.loads(path.read_text("utf-8")))


def _write_text(plan: DatasetPlan, stats: list[FlightStats], *, command: str, has_sheet: bool) -> str:
    config = plan.config
    duration_s = sum(one.duration_s for one in stats)
    events, on = sum(one.event_count for one in stats), sum(one.on_count for one in stats)
    size = sum(plan.path(number).stat().st_size for number in range(plan.flight_count))
    rates = [one.event_count / max(one.duration_s, 1e-9) / 1e6 for one in stats]
    rows = [
        ("flights", f"{len(stats)}, {duration_s:.1f} s in all, {size / 1e6:,.0f} MB"),
        ("events", f"{events:,}; {np.mean(rates):.2f} M/s, {min(rates):.2f} to {max(rates):.2f} by flight"),
        ("brighter", f"{100.0 * on / max(events, 1):.1f} % of the events"),
        ("dropped", f"{sum(one.dropped_count for one in stats):,} events"),
        ("collisions", f"in {sum(one.collided for one in stats)} flights"),
        ("ended early", f"{sum(bool(one.failure) for one in stats)} flights"),
    ]
    for name, counts, edges, unit in (
        ("speed", np.sum([one.speeds for one in stats], axis=0), SPEED_EDGES_M_S, "m/s"),
        ("depth", np.sum([one.depths for one in stats], axis=0), DEPTH_EDGES_M, "m"),
    ):
        if counts.sum():
            low, middle, high = (_quantile(counts, edges, share) for share in (0.05, 0.5, 0.95))
            rows.append((name, f"median {middle:.2g} {unit}, 90 % from {low:.2g} to {high:.2g} {unit}"))
    sensors = "\n".join(
        f"| {name} | {sensor.kind} | {sum(one.packet_counts.get(name, 0) for one in stats):,} |"
        for name, sensor in config.sensors.items()
    )
    table = "\n".join(f"| {name} | {value} |" for name, value in rows)
    scene = "k" if plan.flights_per_scene == 1 else f"k // {plan.flights_per_scene}"
    sheet = "\n![Event windows, pictures and depth of some flights](sheet.png)\n" if has_sheet else ""
    return f"""# {plan.folder.resolve().name}

Flights of {config.vehicle.title!r} simulated by Neurosim {__version__}. Made by

    {command}

| | |
| --- | --- |
{table}
{sheet}
| sensor | kind | packets |
| --- | --- | --- |
{sensors}

## Use

    import neurosim_core as ns

    for batch in ns.data.Stream("{plan.folder.name}", window_s=0.05, batch=32, shuffle=True):
        batch.events.voxel(5), batch.stamp_ns

`flights/NNNNN.h5` are recordings: HDF5 with events as in DSEC (`/events/x`, `y`, `t`, `p`, `/ms_to_idx`),
and one group for each sensor. `NNNNN.json` has the statistics of a flight. `dataset.yaml` has all settings.
Flight k has the seeds `seed + k` and `path.seed + k`, and a generated scene `scene.seed + {scene}`.
`sha256sum --check SHA256SUMS` checks the files.

## Licence

The recordings belong to who made them. A scene that was loaded from a file keeps its own licence, which
holds for pictures of it, too: scene `{config.scene.kind}`.
"""


def _quantile(counts: NDArray[np.int64], edges: tuple[float, ...], share: float) -> float:
    total = np.concatenate([[0], np.cumsum(counts)]) / counts.sum()
    return float(np.interp(share, total, edges))


def _draw_sheet(plan: DatasetPlan) -> Picture.Image | None:
    """Draw the middle of some flights: events, picture and depth; None if they have neither."""
    chosen = np.unique(np.linspace(0, plan.flight_count - 1, _SHEET_FLIGHTS).round().astype(int)).tolist()
    columns = [_tiles(plan.path(number), f"{number:05d}") for number in chosen]
    columns = [column for column in columns if column]
    if not columns:
        return None
    rows = max(len(column) for column in columns)
    height = max(tile.height for column in columns for tile in column)
    step_x, step_y = _TILE_PX + _GAP_PX, height + _GAP_PX
    sheet = Picture.new("RGB", (step_x * len(columns) + _GAP_PX, step_y * rows + _GAP_PX), (233, 236, 239))
    for x, column in enumerate(columns):
        for y, tile in enumerate(column):
            sheet.paste(tile, (_GAP_PX + x * step_x, _GAP_PX + y * step_y))
    return sheet


def _tiles(path: Path, label: str) -> list[Picture.Image]:
    tiles = []
    for field in ("events", "rgb", "depth"):
        try:
            ends = None if field == "events" else field
            data = Dataset(path, window_s=_WINDOW_S, fields=[field], ends=ends)
        except ValueError:  # this flight has no such sensor, or at other times
            continue
        if len(data):
            sample = data[len(data) // 2]
            if sample.events is not None:
                picture = event_picture(sample.events, width=sample.width, height=sample.height)
            elif sample.rgb is not None:
                picture = color_picture("colour", sample.rgb)
            else:
                assert sample.depth is not None
                picture = _colour_depth(sample.depth)
            tiles.append(_tile(picture, label if field == "events" else ""))
    return tiles


def _colour_depth(depth: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return depth as grey, near is bright; where nothing was hit, the background."""
    known = np.isfinite(depth)
    near = np.where(known, 1.0 / np.maximum(np.where(known, depth, 1.0), 0.1), 0.0)
    grey = np.sqrt(near / max(float(near.max()), 1e-9)) * 230.0
    picture = np.repeat(grey[..., None], 3, axis=-1)
    return np.where(known[..., None], picture, BACKGROUND_SRGB).astype(np.uint8)


def _tile(picture: NDArray[np.uint8], label: str) -> Picture.Image:
    image = Picture.fromarray(np.ascontiguousarray(picture))
    height = max(1, round(_TILE_PX * image.height / image.width))
    image = image.resize((_TILE_PX, height), Picture.Resampling.BOX if image.width >= _TILE_PX else 0)
    if label:
        ImageDraw.Draw(image).text((6, 4), label, fill=(60, 60, 60), stroke_width=2, stroke_fill="white")
    return image
