"""Readers of frames: their order, times, numbers and errors."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from frame_files import write_folder, write_video
from PIL import Image

from neurosim_core.convert.frames import open_source, read_stamps
from neurosim_core.convert.light import TRANSFERS

SRGB = TRANSFERS["srgb"]


def pictures(count, *, seed=0):
    return list(np.random.default_rng(seed).integers(0, 256, (count, 12, 16, 3), dtype=np.uint8))


def stamps_of(source):
    return [frame.stamp_ns for frame in source.frames()]


def test_pictures_come_in_the_order_of_their_numbers(tmp_path):
    """frame10 comes after frame9, not after frame1."""
    levels = [np.full((4, 5), 10 * level, dtype=np.uint8) for level in range(12)]
    source = open_source(write_folder(tmp_path / "f", levels), fps=30.0)
    light = [frame.luminance[0, 0] for frame in source.frames()]
    np.testing.assert_allclose(light, TRANSFERS["srgb"](10 * np.arange(12) / 255), rtol=1e-6)
    assert stamps_of(source)[:4] == [0, 33_333_333, 66_666_666, 100_000_000]


def test_a_video_has_its_own_times(tmp_path):
    shown_ms = [40, 41, 60, 200]
    source = open_source(write_video(tmp_path / "v.mkv", pictures(4), shown_ms))
    assert stamps_of(source) == [1_000_000 * ms for ms in shown_ms]
    source = open_source(tmp_path / "v.mkv", fps=10.0)
    assert stamps_of(source) == [0, 100_000_000, 200_000_000, 300_000_000]


def test_a_video_without_loss_is_the_folder_to_the_bit(tmp_path):
    shown = pictures(3)
    folder = open_source(write_folder(tmp_path / "f", shown), fps=10.0)
    video = open_source(write_video(tmp_path / "v.mkv", shown, [0, 100, 200]))
    for one, other in zip(folder.frames(), video.frames(), strict=True):
        assert one.stamp_ns == other.stamp_ns
        np.testing.assert_array_equal(one.luminance, other.luminance)


def test_luma_of_more_than_eight_bits_keeps_them(tmp_path):
    """FFmpeg's RGB of such a video would be wrong by up to a step of eight bits, 0.004."""
    code = np.linspace(16 << 8, 235 << 8, 16 * 16).round().astype(np.uint16).reshape(16, 16)
    neutral = np.full_like(code, 128 << 8)
    planes = np.stack([code, neutral, neutral], axis=2)
    file = write_video(
        tmp_path / "v.mkv",
        [planes] * 2,
        [0, 10],
        pixels="yuv444p16le",
        given="yuv444p16le",
        color_trc=16,
        colorspace=9,
        color_primaries=9,
        color_range=1,
    )
    source = open_source(file)
    expected = TRANSFERS["pq"]((code - 4096.0) / 56064.0)
    first = next(iter(source.frames())).luminance
    # float32 codes (6e-8) through a table of 2^16 steps; PQ climbs by a factor of 50 in 1
    np.testing.assert_allclose(first, expected, rtol=2e-5, atol=1e-6)
    assert source.description.light == "yuv444p16le, 16 bits, pq, BT.2020 weights, video levels"
    assert source.description.notes == ()


def test_greys_of_sixteen_bits_are_read(tmp_path):
    code = np.linspace(0, 65535, 64).round().astype(np.uint16).reshape(8, 8)
    source = open_source(write_folder(tmp_path / "f", [code, code]), fps=1.0, transfer="linear")
    np.testing.assert_allclose(next(iter(source.frames())).luminance, code / 65535.0, rtol=1e-7)


def test_floats_are_light(tmp_path):
    light = np.linspace(0.0, 3.0, 12, dtype=np.float32).reshape(3, 4)
    (tmp_path / "f").mkdir()
    Image.fromarray(light).save(tmp_path / "f" / "a.tif")
    source = open_source(tmp_path / "f", fps=1.0)
    np.testing.assert_array_equal(next(iter(source.frames())).luminance, light)
    assert len(source.description.codes) == 0


def test_a_video_that_is_to_be_shown_turned_is_turned(tmp_path):
    """As a phone stores it: 90 degrees counter-clockwise takes the right border to the top."""
    import av

    picture = pictures(1)[0]
    file = tmp_path / "v.mp4"
    with av.open(str(file), "w") as container:
        stream = container.add_stream("png", rate=10)
        stream.width, stream.height, stream.pix_fmt = 16, 12, "rgb24"
        stream.set_display_rotation(90)
        for _ in range(2):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode(None))
    source = open_source(file)
    assert (source.description.width, source.description.height) == (12, 16)
    expected = SRGB(picture[:, ::-1].transpose(1, 0, 2) / 255.0) @ np.array([0.2126, 0.7152, 0.0722])
    np.testing.assert_allclose(next(iter(source.frames())).luminance, expected, rtol=2e-7)


def test_what_a_video_does_not_tell_is_said(tmp_path):
    source = open_source(write_video(tmp_path / "v.mkv", pictures(2), [0, 1]))
    assert source.description.light == "bgr0, 8 bits, srgb, BT.709 weights"
    assert "does not name its transfer function" in source.description.notes[0]
    assert open_source(tmp_path / "v.mkv", transfer="linear").description.notes == ()


@pytest.mark.parametrize(
    ("unit", "text"),
    [
        ("s", "# time name\n0.1 a.png\n\n0.100001 b.png\n"),
        ("ms", "100\n100.001\n"),
        ("us", "1e5, a\n100001, b\n"),
        ("ns", "100000000\n100001000"),
    ],
)
def test_times_are_read_exactly(tmp_path, unit, text):
    (tmp_path / "t.txt").write_text(text)
    assert read_stamps(tmp_path / "t.txt", unit=unit) == [100_000_000, 100_001_000]


@pytest.mark.parametrize("line", ["abc", "nan", "inf"])
def test_a_line_that_is_no_time_is_refused(tmp_path, line):
    (tmp_path / "t.txt").write_text(f"0.1\n{line} x.png\n")
    with pytest.raises(ValueError, match=rf"t\.txt, line 2: must begin with a time, got '{line}'"):
        read_stamps(tmp_path / "t.txt")


def test_a_folder_needs_times(tmp_path):
    folder = write_folder(tmp_path / "f", pictures(3))
    with pytest.raises(ValueError, match="give --fps or --timestamps"):
        open_source(folder)
    with pytest.raises(ValueError, match="has 3 pictures, got 2 times"):
        open_source(folder, stamps_ns=[0, 10])
    with pytest.raises(ValueError, match="a rate or a list of times, not both"):
        open_source(folder, fps=1.0, stamps_ns=[0, 10, 20])


def test_what_cannot_be_read_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no file or folder .*nothing"):
        open_source(tmp_path / "nothing")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match=r"empty has no pictures; names must end in one of \.png"):
        open_source(tmp_path / "empty", fps=1.0)
    (tmp_path / "v.mp4").write_bytes(b"no video at all")
    with pytest.raises(ValueError, match=r"v\.mp4 is not a readable video: Invalid data"):
        open_source(tmp_path / "v.mp4")
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "0.png").write_bytes(b"no picture at all")
    with pytest.raises(ValueError, match=r"0\.png is not a readable picture"):
        open_source(tmp_path / "bad", fps=1.0)


def test_a_file_with_sound_only_has_no_video_stream(tmp_path):
    import av

    file = tmp_path / "sound.wav"
    with av.open(str(file), "w") as container:
        stream = container.add_stream("pcm_s16le", rate=8000)
        sound = av.AudioFrame.from_ndarray(np.zeros((1, 800), dtype=np.int16), format="s16", layout="mono")
        sound.sample_rate = 8000
        container.mux(stream.encode(sound))
        container.mux(stream.encode(None))
    with pytest.raises(ValueError, match=r"sound\.wav has no video stream"):
        open_source(file)


def test_pictures_that_are_not_alike_are_refused(tmp_path):
    folder = write_folder(tmp_path / "f", [np.zeros((4, 5), np.uint8), np.zeros((5, 4), np.uint8)])
    with pytest.raises(ValueError, match=r"frame1\.png: the picture is 4x5, must be 5x4 as the first"):
        list(open_source(folder, fps=1.0).frames())


def test_transparent_pictures_are_refused(tmp_path):
    clear = np.full((4, 4, 4), 128, dtype=np.uint8)
    with pytest.raises(ValueError, match=r"frame0\.png has transparent pixels"):
        open_source(write_folder(tmp_path / "f", [clear]), fps=1.0)


def test_colours_of_sixteen_bits_are_not_halved_in_silence(tmp_path):
    import av

    deep = np.random.default_rng(0).integers(0, 1 << 16, (8, 8, 3), dtype=np.uint16)
    (tmp_path / "f").mkdir()
    with av.open(str(tmp_path / "f" / "0.png"), "w", format="image2", options={"update": "1"}) as container:
        stream = container.add_stream("png", rate=1)
        stream.width, stream.height, stream.pix_fmt = 8, 8, "rgb48be"
        container.mux(stream.encode(av.VideoFrame.from_ndarray(deep, format="rgb48le")))
        container.mux(stream.encode(None))
    with pytest.raises(ValueError, match="has colours of 16 bits"):
        open_source(tmp_path / "f", fps=1.0)


def test_without_pyav_the_line_to_install_it_is_said(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    (tmp_path / "v.mp4").touch()
    with pytest.raises(ImportError, match=r"videos need PyAV: pip install -e '.\[video\]'"):
        open_source(tmp_path / "v.mp4")
