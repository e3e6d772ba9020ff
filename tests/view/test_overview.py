"""The overview: what it collects, against brute force; and that its picture has something where it should."""

from __future__ import annotations

import dataclasses
import re
import sys
import weakref
from typing import Any

import numpy as np
import PIL.Image
import pytest
import trimesh
from test_plan import make_scene

from neurosim_core.packets import Events, Image, ImuSample, Odometry
from neurosim_core.view.overview import FlightSummary
from neurosim_core.view.overview_plot import save_overview

MS = 1_000_000
WIDTH, HEIGHT = 40, 30


def odometry(k: int, *, period_ns: int = 5 * MS) -> Odometry:
    angle = 0.01 * k
    return Odometry(
        stamp_ns=k * period_ns,
        sequence=k,
        sensor="truth",
        position=np.array([np.cos(angle), np.sin(angle), 1.2]),
        orientation=np.array([0.0, 0.0, np.sin(0.5 * angle), np.cos(0.5 * angle)]),
        velocity=np.array([-np.sin(angle), np.cos(angle), 0.0]),
        body_rate=np.zeros(3),
        rotor_speed=np.zeros(4),
    )


def events(rng, k: int, count: int, *, sensor: str = "dvs") -> Events:
    """Events of the window from 10 k ms to 10 (k + 1) ms."""
    return Events(
        stamp_ns=(k + 1) * 10 * MS,
        start_ns=k * 10 * MS,
        sequence=k,
        sensor=sensor,
        t=np.sort(rng.integers(k * 10_000 + 1, (k + 1) * 10_000 + 1, count)),
        x=rng.integers(0, WIDTH, count).astype(np.uint16),
        y=rng.integers(0, HEIGHT, count).astype(np.uint16),
        polarity=rng.integers(0, 2, count).astype(np.uint8),
        width=WIDTH,
        height=HEIGHT,
    )


def picture(stamp_ns: int, contrast: int, *, sensor: str = "rgb") -> Image:
    data = np.full((HEIGHT, WIDTH, 3), 100, dtype=np.uint8)
    data[:, ::2] += np.uint8(contrast)
    return Image(stamp_ns=stamp_ns, sensor=sensor, data=data, encoding="rgb8")


def test_snapshot_holds_exactly_the_window_before_the_picture():
    """Also when the packets of the picture's own stamp come after it."""
    rng = np.random.default_rng(0)
    summary = FlightSummary()
    packets = [events(rng, k, 100) for k in range(8)]
    for packet in packets:
        packet.t[-1] = packet.stamp_ns // 1000  # on the border: belongs to the window that ends there
    for k, packet in enumerate(packets):
        if k in (3, 6):  # pictures at 40 and 70 ms, before the events of the same stamp
            summary.log(picture(packet.stamp_ns, 90 if k == 3 else 10))
        summary.log(packet)
    snapshot = summary.snapshot()
    assert snapshot.stamp_ns == 40 * MS  # the one with the greater contrast
    t = np.concatenate([p.t for p in packets])
    view = snapshot.packets["dvs"]
    assert isinstance(view, Events)
    assert view.t.tolist() == t[(t > 20_000) & (t <= 40_000)].tolist()
    assert (view.width, view.height, view.start_ns) == (WIDTH, HEIGHT, 20 * MS)
    assert summary.event_count == 800


def test_moment_with_more_events_and_wider_view_is_chosen():
    rng = np.random.default_rng(0)
    near = np.full((HEIGHT, WIDTH), 0.5, dtype=np.float32)
    far = np.geomspace(1.0, 10.0, HEIGHT * WIDTH, dtype=np.float32).reshape(HEIGHT, WIDTH)
    far[0] = np.inf
    for counts, depths, wanted_ns in (
        ((10, 500), (near, near), 20 * MS),
        ((100, 100), (far, near), 10 * MS),
    ):
        summary = FlightSummary(event_window_ns=10 * MS)
        for k, (count, depth) in enumerate(zip(counts, depths, strict=True)):
            stamp_ns = (k + 1) * 10 * MS
            summary.log(events(rng, k, count))
            summary.log(picture(stamp_ns, 50))
            summary.log(Image(stamp_ns=stamp_ns, sensor="z", data=depth, encoding="32FC1"))
        assert summary.snapshot().stamp_ns == wanted_ns


def test_every_camera_of_a_kind_is_shown(tmp_path):
    """Two event cameras and two others: each has a panel, and nothing else has."""
    rng = np.random.default_rng(0)
    summary = FlightSummary()
    summary.log(events(rng, 0, 70, sensor="left"))
    summary.log(events(rng, 0, 50, sensor="right"))
    summary.log(picture(10 * MS, 10, sensor="a"))
    summary.log(picture(10 * MS, 90, sensor="b"))
    snapshot = summary.snapshot()
    counts = {name: len(view) for name, view in snapshot.packets.items() if isinstance(view, Events)}
    assert counts == {"left": 70, "right": 50}
    assert list(snapshot.packets) == ["a", "b", "left", "right"]
    found = draw(tmp_path / "o.png", summary)
    assert found.shape == (900, 1600, 3)
    for x in (60, 560):
        for y in (150, 550):
            panel = found[y : y + 250, x : x + 350]
            assert (panel != 255).any(axis=-1).mean() > 0.02, (x, y)


def test_memory_is_bounded():
    """Events: those of one window. Odometry: at most so many rows, evenly spread over the whole flight."""
    rng = np.random.default_rng(0)
    summary = FlightSummary()
    logged = []
    for k in range(100):
        packet = events(rng, k, 10)
        logged.append(weakref.ref(packet))
        summary.log(packet)
        del packet
        assert sum(each() is not None for each in logged) <= 3  # and what is shown best so far
    for k in range(45_000):
        summary.log(odometry(k, period_ns=MS))
    track = summary.track()
    assert 10_000 < len(track.stamp_ns) <= 20_000
    assert np.unique(np.diff(track.stamp_ns)).tolist() == [4 * MS]
    assert track.stamp_ns[-1] >= 44_996 * MS


def test_track_is_the_state():
    """Heading of a level camera is its yaw."""
    summary = FlightSummary()
    for k in range(100):
        summary.log(odometry(k))
    track = summary.track()
    angle = 0.01 * np.arange(100)
    assert track.stamp_ns.tolist() == [k * 5 * MS for k in range(100)]
    assert track.position[:, 2].tolist() == [1.2] * 100
    heading = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    assert track.heading == pytest.approx(heading, abs=1e-12)  # rounding


def room() -> trimesh.Trimesh:
    return trimesh.util.concatenate(
        [trimesh.creation.box(extents=(6, 4, 2.5)), trimesh.creation.box(extents=(1, 1, 1))]
    )


def draw(path, summary: FlightSummary, **options) -> np.ndarray:
    save_overview(path, summary, scene=make_scene(room()), **options)
    with PIL.Image.open(path) as image:
        return np.asarray(image.convert("RGB"))


def test_picture_has_its_size_and_its_parts(tmp_path):
    """1600 x 900, and each panel shows more than paper, where about it is, in pixels."""
    rng = np.random.default_rng(0)
    summary = FlightSummary()
    for k in range(101):
        summary.log(odometry(k))
    for k in range(4):
        summary.log(events(rng, k, 500))
        summary.log(picture((k + 1) * 10 * MS, 90))
        depth = np.geomspace(1.0, 10.0, HEIGHT * WIDTH, dtype=np.float32).reshape(HEIGHT, WIDTH)
        summary.log(Image(stamp_ns=(k + 1) * 10 * MS, sensor="z", data=depth, encoding="32FC1"))
    found = draw(tmp_path / "o.png", summary, real_time_factor=0.5)
    assert found.shape == (900, 1600, 3)
    panels = {
        "title": (slice(20, 90), slice(40, 500)),
        "rgb": (slice(150, 430), slice(60, 440)),
        "events": (slice(150, 430), slice(560, 930)),
        "depth": (slice(510, 800), slice(60, 440)),
        "profile": (slice(480, 820), slice(560, 930)),
        "plan": (slice(150, 800), slice(1060, 1500)),
    }
    for name, place in panels.items():
        assert (found[place] != 255).any(axis=-1).mean() > 0.02, name
        assert found[place].reshape(-1, 3).std() > 10.0, name
    border = np.ones((900, 1600), dtype=bool)
    border[6:-6, 6:-6] = False
    assert (found[border] == 255).all()  # nothing is cut off
    between = found[150:430, 440:560]
    assert (between == 255).all(axis=(0, 2)).any()  # panels do not run into each other
    events_panel = found[panels["events"]].astype(int)
    red = (events_panel[..., 0] > events_panel[..., 2] + 60).mean()
    blue = (events_panel[..., 2] > events_panel[..., 0] + 60).mean()
    assert 0.1 < red < 0.9
    assert 0.1 < blue < 0.9


def test_flight_without_cameras_or_motion_is_drawn(tmp_path):
    """What is missing is said, not drawn; nothing fails."""
    assert draw(tmp_path / "a.png", FlightSummary()).shape == (900, 1600, 3)
    summary = FlightSummary()
    summary.log(odometry(0))
    assert draw(tmp_path / "b.png", summary).shape == (900, 1600, 3)
    for _ in range(3):
        summary.log(odometry(0))
    nothing = np.full((4, 4), np.inf, np.float32)
    summary.log(Image(stamp_ns=0, sensor="z", data=nothing, encoding="32FC1"))
    assert draw(tmp_path / "c.png", summary).shape == (900, 1600, 3)


def test_numbers_are_collected_by_field():
    summary = FlightSummary()
    for k in range(5):
        summary.log(
            ImuSample(stamp_ns=k, sensor="imu", specific_force=np.full(3, k), angular_rate=np.arange(3.0))
        )
    force, rate = summary.series()
    assert (force.sensor, force.field.name, force.field.unit) == ("imu", "specific_force", "m/s^2")
    assert force.stamp_ns.tolist() == [0, 1, 2, 3, 4]
    assert force.values[:, 2].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert rate.values.shape == (5, 3)


def test_missing_matplotlib_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(ImportError, match=r"pip install -e '\.\[view\]'"):
        save_overview(tmp_path / "o.png", FlightSummary(), scene=make_scene(room()))


def test_a_vehicle_that_stands_is_drawn_at_zero(tmp_path, monkeypatch):
    """Rounding, as of an IMU that stands, is not spread over the whole strip."""
    shown = texts_of(tmp_path, monkeypatch, room(), velocity=1e-13)
    assert not [text for text in shown if re.search(r"\de.\d", text)]  # no 1e-13 above an axis
    assert "1.0" in shown


def test_titles_of_a_narrow_plan_stand_beside_each_other(tmp_path, monkeypatch):
    hall = trimesh.creation.box(extents=(8, 3, 2.5))
    boxes = texts_of(tmp_path, monkeypatch, hall, velocity=0.1)
    name, cut = boxes["Path"], next(box for text, box in boxes.items() if text.startswith("plan cut"))
    assert name.x1 < cut.x0
    assert cut.x1 < 1600


def texts_of(tmp_path, monkeypatch, mesh: trimesh.Trimesh, *, velocity: float) -> dict[str, Any]:
    """Return the texts of the overview of a vehicle that hardly moves, and where they stand [px]."""
    from matplotlib.figure import Figure
    from matplotlib.text import Text

    figures: list[Figure] = []
    save = Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda self, path: (figures.append(self), save(self, path)))
    summary = FlightSummary()
    for k in range(20):
        stands = dataclasses.replace(
            odometry(k), position=np.array([0.0, 0.0, 1.2]), velocity=np.array([velocity, 0.0, 0.0])
        )
        summary.log(stands)
        summary.log(
            ImuSample(
                stamp_ns=k * 5 * MS,
                sensor="imu",
                specific_force=np.array([0, 0, 9.8]),
                angular_rate=np.full(3, 1e-16 * (-1) ** k),
            )
        )
    save_overview(tmp_path / "o.png", summary, scene=make_scene(mesh))
    texts = [text for text in figures[0].findobj(Text) if text.get_text() and text.get_visible()]
    return {text.get_text(): text.get_window_extent() for text in texts}
