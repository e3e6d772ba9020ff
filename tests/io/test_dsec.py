"""Sequences of DSEC: events in rectified pixels, depth of disparity, and flow, from files made by hand."""

from __future__ import annotations

import contextlib
import shutil
import struct
import zlib

import h5py
import numpy as np
import pytest
import yaml

import neurosim_core as ns
from neurosim_core.io import EventFileError, create_events, open_events
from neurosim_core.io.transfer import transfer

WIDTH, HEIGHT, BEGIN_US = 8, 6, 49_599_000
FOCAL_PX, BASELINE_M = 500.0, 0.6


def png(pixels) -> bytes:
    """Return a picture of 16 bit, by the text of the standard."""
    rows = np.asarray(pixels, ">u2")
    head = struct.pack(">IIBBBBB", rows.shape[1], rows.shape[0], 16, 0 if rows.ndim == 2 else 2, 0, 0, 0)
    parts = [
        (b"IHDR", head),
        (b"IDAT", zlib.compress(b"".join(b"\0" + row.tobytes() for row in rows))),
        (b"IEND", b""),
    ]
    chunks = [struct.pack(">I", len(d)) + t + d + struct.pack(">I", zlib.crc32(t + d)) for t, d in parts]
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    """Events every millisecond for 0.4 s; depth at 0.1, 0.2, 0.3 s; flow at 0.2 and 0.3 s."""
    folder = tmp_path_factory.mktemp("dsec") / "thun_00_a"
    for name in ("events/left", "disparity/event", "flow/backward", "calibration"):
        (folder / name).mkdir(parents=True)
    count = 400
    with h5py.File(folder / "events/left/events.h5", "w") as file:
        columns = {"t": 1000 * np.arange(1, count + 1), "x": np.arange(count) % WIDTH}
        columns |= {"y": np.arange(count) // 16 % HEIGHT, "p": np.arange(count) % 2}
        for name, kind in (("t", "u4"), ("x", "u2"), ("y", "u2"), ("p", "u1")):
            file[f"events/{name}"] = columns[name].astype(kind)
        file["ms_to_idx"] = np.arange(count + 2).clip(1) - 1
        file["t_offset"] = np.int64(BEGIN_US)
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    with h5py.File(folder / "events/left/rectify_map.h5", "w") as file:
        file["rectify_map"] = np.stack([x + 0.7, y - 0.3], -1)  # a pixel to the right, none down
    disparity = np.full((HEIGHT, WIDTH), 256 * 30, np.uint16)
    disparity[0, :3] = 0, 256 * 60, 128
    flow = np.zeros((HEIGHT, WIDTH, 3), np.uint16)
    flow[...] = 2**15 + 128 * 3, 2**15 - 64, 1
    flow[1, 2] = 0
    for number in range(3):
        (folder / f"disparity/event/{2 * number:06d}.png").write_bytes(png(disparity))
    for number in range(2):
        (folder / f"flow/backward/{2 * number:06d}.png").write_bytes(png(flow))
    stamps = [BEGIN_US + 100_000 * k for k in (1, 2, 3)]
    (folder / "disparity/timestamps.txt").write_text("".join(f"{s}\n" for s in stamps))
    lines = [f"{s}, {s - 100_000}\n" for s in stamps[1:]]
    (folder / "flow/backward_timestamps.txt").write_text(
        "# from_timestamp_us, to_timestamp_us\n" + "".join(lines)
    )
    matrix = [[1, 0, 0, -4], [0, 1, 0, -3], [0, 0, 0, FOCAL_PX], [0, 0, 1 / BASELINE_M, 0]]
    (folder / "calibration/cam_to_cam.yaml").write_text(
        yaml.safe_dump({"disparity_to_depth": {"cams_03": matrix}})
    )
    return folder


def test_windows_of_a_sequence(sequence):
    """Windows end at depth; events are in rectified pixels, and z = f b / disparity."""
    stream = ns.data.Stream(sequence, window_s=0.05, ends="depth", fields=["events", "depth"], batch=3)
    (batch,) = stream
    assert (np.diff(batch.stamp_ns) == 100_000_000).all()
    assert batch.depth.shape == (3, HEIGHT, WIDTH)
    assert batch.depth[1, 0, :3] == pytest.approx(
        [np.inf, FOCAL_PX * BASELINE_M / 60, FOCAL_PX * BASELINE_M / 0.5]
    )
    assert batch.depth[2, 3, 3] == pytest.approx(FOCAL_PX * BASELINE_M / 30)
    events = batch.events.raw
    # 50 events end with each window; those of the last column, a pixel to the right, leave the picture
    kept = [k for k in range(300) if k % 100 >= 50 and k % WIDTH != WIDTH - 1]
    assert (events.t % 1_000_000 - events.t[0] % 1_000_000 == 1000 * (np.array(kept) - kept[0])).all()
    assert events.x.min() == 1


def test_flow_and_notes(sequence, tmp_path):
    done = transfer(sequence, tmp_path / "a.h5")
    assert done.event_count == 350
    assert done.notes == ["50 of 400 events are beyond the rectified picture"]
    assert (done.begin_us, done.width, done.height) == (BEGIN_US + 1000, WIDTH, HEIGHT)
    (batch,) = ns.data.Stream(tmp_path / "a.h5", window_s=0.1, ends="flow", fields=["flow"], batch=2)
    assert batch.flow[:, 0, 0].tolist() == [[3.0, -0.5]] * 2
    assert np.isnan(batch.flow[:, 1, 2]).all()


def test_what_is_wrong_is_said(sequence, tmp_path):
    with pytest.raises(EventFileError, match="dsec is only read"):
        create_events(tmp_path / "x", width=4, height=4, format="dsec")

    def broken(name, content):
        folder = tmp_path / str(len([*tmp_path.iterdir()]))
        shutil.copytree(sequence, folder)
        (folder / name).write_bytes(content)
        return folder

    for name, content, said in (
        ("disparity/timestamps.txt", b"1\n2\n", "tells 2 times of 3 pictures"),
        ("disparity/timestamps.txt", b"now\n", "does not tell the times"),
        ("disparity/event/000002.png", png(np.ones((4, 4)))[:60], "000002.png is damaged"),
        ("calibration/cam_to_cam.yaml", b"{}", "must tell disparity_to_depth"),
        ("events/left/rectify_map.h5", b"", "not a readable HDF5"),
    ):
        with pytest.raises(EventFileError, match=said):
            transfer(broken(name, content), tmp_path / "out.h5")
    small = broken("flow/backward_timestamps.txt", b"")
    with h5py.File(small / "events/left/rectify_map.h5", "w") as file:
        file["rectify_map"] = np.zeros((3, 4, 2), np.float32)
    with (
        pytest.raises(EventFileError, match="outside 4 x 3 pixels"),
        contextlib.closing(open_events(small)) as reader,
    ):
        list(reader.blocks())
