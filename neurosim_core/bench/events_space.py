"""Events over rays per pixel: a camera turns on the spot and flies along a planned path.

Pictures are rendered at 500 Hz with several numbers of rays per pixel; the events of 64 rays are the
reference. Another pattern of 64 rays shows how well that is known: no other picture can be nearer. As many
events as possible are matched within a window; see `matching`.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from neurosim_core.bench import engine
from neurosim_core.bench.matching import match
from neurosim_core.bench.options import Options
from neurosim_core.bench.report import Claim, Plot, Row, panel
from neurosim_core.scene.solids import box

WINDOWS_MS = (1.0, 5.0, 20.0)
"""Within which events are matched."""
SAMPLES = (1, 2, 4, 8, 16, 64)
REFERENCE_SAMPLES = 64
SPACE_HZ = 500.0
_COLOURS = {
    "wall": (0.75, 0.73, 0.7),
    "slat": (0.2, 0.2, 0.22),
    "bar": (0.05, 0.05, 0.05),
    "leaf": (0.1, 0.3, 0.08),
}


def sample_in_space(
    lenses: Sequence[engine.PinholeConfig], samples: Sequence[int], options: Options
) -> list[Row]:
    """Return a row for each scene, motion, size and number of rays per pixel, the default among them."""
    device, quick = options.device, options.quick
    seconds = 0.06 if quick else 0.2
    options.progress("plan a flight")
    settings = {
        "duration_s": 2.0 + seconds,
        "device": device,
        **engine.scene_settings(options.scene, quick=quick),
    }
    flown = engine.fly(engine.load_config(settings), SPACE_HZ)
    last = round(2.0 * SPACE_HZ)  # it is fast by then
    position, orientation = (values[last:] for values in flown.poses())
    views = [(flown.model.scene, "planned flight", (position, orientation))]
    for shown, start in ((flown.model.scene, flown.states[0, :3]), (thin_structures(), np.zeros(3))):
        for rate_deg_s in (200.0,) if quick else (30.0, 200.0):
            views.append((shown, f"yaw at {rate_deg_s:g} deg/s", _turn(start, rate_deg_s, seconds)))
    config = engine.RenderConfig()
    lit = {id(shown): engine.upload_scene(shown, config, device=device) for shown, _, _ in views}
    rows = []
    for (shown, motion, poses), lens in itertools.product(views, lenses):
        pixels = f"{lens.width}x{lens.height}"
        for count in dict.fromkeys((REFERENCE_SAMPLES, *samples, config.samples_per_pixel)):
            options.progress(f"{shown.name}, {motion}, {pixels}, {count} rays per pixel")
            row, events = events_of(lit[id(shown)], lens, poses, count)
            if count == REFERENCE_SAMPLES:
                options.progress(f"{shown.name}, {motion}, {pixels}, another pattern of {count} rays")
                other, its = events_of(lit[id(shown)], engine.ShiftedLens(lens, (0.382, 0.618)), poses, count)
                truth, row, events = events, {**other, "rays per pixel": f"{count}, another pattern"}, its
            all_its, all_true = max(len(events.t), 1), max(len(truth.t), 1)
            row["events / reference"] = len(events.t) / all_true
            for w in WINDOWS_MS:
                found = match(truth, events, width=lens.width, window_us=1e3 * w)
                row[f"spurious, {w:g} ms [%]"] = 100.0 * found.spurious_count / all_its
                row[f"missed, {w:g} ms [%]"] = 100.0 * found.missing_count / all_true
            rows.append({"scene": shown.name, "motion": motion, "pixels": pixels, **row})
    return rows


def _turn(position: NDArray[Any], rate_deg_s: float, seconds: float) -> engine.Poses:
    """Return the poses of a camera that turns about the vertical, looking forward."""
    yaw = np.radians(rate_deg_s) * np.arange(round(seconds * SPACE_HZ) + 1) / SPACE_HZ
    return engine.camera_poses(np.tile(position, (len(yaw), 1)), Rotation.from_euler("z", yaw[:, None]))


def events_of(
    lit: Any, lens: Any, poses: engine.Poses, count: int | Literal["adaptive"]
) -> tuple[Row, engine.EventArrays]:
    """Render poses in an uploaded scene with a number of rays per pixel; return a row and the events."""
    device, config = lit.device, engine.RenderConfig(samples_per_pixel=count)
    view = engine.View(dataclasses.replace(lit, config=config), lens, count=16)
    size = {"width": lens.width, "height": lens.height}
    camera = engine.EventCamera(engine.EventCameraConfig(), **size, device=device)
    stamps_ns = np.rint(np.arange(len(poses[0])) * (1e9 / SPACE_HZ)).astype(np.int64)
    camera.reset(view.render((poses[0][:1], poses[1][:1]))[0])  # compiles, too
    parts, spent_s, begin_s = [], 0.0, engine.busy_s(device)
    for rows, frames in view.stacks((poses[0][1:], poses[1][1:])):
        spent_s += engine.busy_s(device) - begin_s
        stamps = stamps_ns[1:][rows]
        parts.append(camera.feed(frames[: len(stamps)], stamps).numpy())
        begin_s = engine.busy_s(device)
    events = engine.join_events(parts)
    default = count == engine.RenderConfig().samples_per_pixel
    row: Row = {
        "rays per pixel": f"{count} (default)" if default else str(count),
        "time of a picture [ms]": 1e3 * spent_s / (len(poses[0]) - 1),
        "events": len(events.t),
    }
    return row, events


def case_of(row: Row) -> tuple[str, ...]:
    """Return what a row is of: scene, motion and size of the pictures."""
    return row["scene"], row["motion"], row["pixels"]


def space_claims(rows: Sequence[Row]) -> list[Claim]:
    """Judge the default: each share within its limit, or twice that of another pattern of 64 rays.

    Pictures of less than 120 columns are not judged: in 4 x 4 of their pixels too many faces meet.
    """
    claims = []
    for row in (row for row in rows if row["rays per pixel"].endswith("(default)")):
        case = case_of(row)
        floor = next(r for r in rows if "pattern" in r["rays per pixel"] and case_of(r) == case)
        columns = int(row["pixels"].partition("x")[0])
        limits = {20.0: 12.0, 5.0: 12.0} if columns < 346 else {20.0: 5.0, 5.0: 8.0}
        shares = {(kind, w): f"{kind}, {w:g} ms [%]" for kind in ("spurious", "missed") for w in limits}
        text = (
            f"default rays per pixel, {', '.join(case)}: spurious and missed events are <= {limits[20.0]:g} "
            f"% within 20 ms and <= {limits[5.0]:g} % within 5 ms, or twice the floor"
        )
        reference = "the box filter of a pixel's area by 64 rays; floor: another pattern of 64"
        said = ", ".join(f"{h} {row[h]:.1f} (floor {floor[h]:.1f})" for h in shares.values())
        met = all(row[h] <= max(limits[w], 2.0 * floor[h]) for (_, w), h in shares.items())
        claims.append(Claim(text, reference, said, met if columns >= 120 else None))
    return claims


def space_plot(rows: list[Row]) -> Plot:
    """Draw shares against the time of a picture, from 0 %, with the floor as a line."""
    panels, time_ms, share = [], "time of a picture [ms]", "share of events [%]"
    for case in dict.fromkeys(map(case_of, rows)):
        floor, *mine = [row for row in rows if case_of(row) == case]
        own = next(row for row in mine if row["rays per pixel"].endswith("(default)"))
        shares = []
        for kind, w in itertools.product(("spurious", "missed"), WINDOWS_MS):
            series = {"what": f"{kind} within {w:g} ms"}
            for row in mine:
                if row is own:
                    shares.append({time_ms: row[time_ms], share: None, **series})  # no line leads to it
                shares.append({time_ms: row[time_ms], share: row[f"{kind}, {w:g} ms [%]"], **series})
        x_lines = {"time of the default": own[time_ms]}
        y_lines = {"spurious within 20 ms of another pattern of 64 rays": floor["spurious, 20 ms [%]"]}
        more: dict[str, Any] = {"title": ", ".join(case), "log": "x", "x_lines": x_lines, "y_lines": y_lines}
        panels.append(panel(shares, time_ms, share, by="what", y_min=0.0, **more))
    title = "In space: false events against run time; marks are numbers of rays per pixel, as in the table"
    return Plot("events-space", title, panels, 2)


def thin_structures(*, seed: int = 0) -> engine.Scene:
    """Return a room of 8 m with blinds, railings and plants around the origin, at 1 to 3 m, evenly lit.

    Slats are 25 mm high, bars 12 mm wide, leaves about 40 x 8 mm: at 2 m and 346 pixels over 86 degrees a
    pixel is 11 mm wide.
    """
    rng = np.random.default_rng(seed)
    boxes = [(box((8.0, 8.0, 3.0)), 0)]  # and material
    for side, angle in enumerate(np.arange(4) * np.pi / 2):
        along, ahead = np.array([-np.sin(angle), np.cos(angle)]), np.array([np.cos(angle), np.sin(angle)])
        if side % 2 == 0:  # blinds
            slat = box((0.02, 2.5, 0.025))
            places = [(*(3.0 * ahead), z) for z in np.arange(-1.2, 1.2, 0.05)]
        else:  # railings
            slat = box((0.012, 0.012, 1.6))
            places = [(*(2.0 * ahead + shift * along), -0.5) for shift in np.arange(-2.0, 2.0, 0.1)]
        boxes += [(slat.moved(place, yaw_rad=float(angle)), 1 + side % 2) for place in places]
    parts = [part.vertices[part.faces] for part, _ in boxes]
    materials = [np.full(len(part.faces), material) for part, material in boxes]
    for angle in np.pi / 4 * np.array([1, 3, 5, 7]):  # plants
        base = np.array([1.5 * np.cos(angle), 1.5 * np.sin(angle), -0.3])
        tips = base + rng.normal(0.0, 0.25, (150, 1, 3))
        parts.append(tips + rng.normal(0.0, 0.02, (150, 3, 3)))
        materials.append(np.full(150, 3))
    triangles = np.concatenate(parts)
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    vertices = triangles.reshape(-1, 3).astype(np.float32)
    return engine.Scene(
        name="thin structures",
        vertices=vertices,
        faces=np.arange(len(vertices), dtype=np.int32).reshape(-1, 3),
        normals=np.repeat(normal, 3, axis=0).astype(np.float32),
        uv=vertices[:, :2],
        face_material=np.concatenate(materials).astype(np.int32),
        face_instance=np.zeros(len(triangles), dtype=np.int32),
        instance_names=("thin structures",),
        materials=tuple(engine.Material(name=name, base_color=colour) for name, colour in _COLOURS.items()),
        ambient=engine.Ambient(up=(1.0, 1.0, 1.0), down=(1.0, 1.0, 1.0)),
    )
