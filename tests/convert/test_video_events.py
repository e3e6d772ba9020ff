"""Events of videos against closed forms, and against themselves however they come."""

from __future__ import annotations

import itertools

import h5py
import numpy as np
import pytest
import yaml
from frame_files import write_folder, write_video

from neurosim_core import cli
from neurosim_core.convert.convert import ConversionConfig, convert_video
from neurosim_core.convert.light import TRANSFERS, code_step, find_floor
from neurosim_core.flight import rerun_file
from neurosim_core.record import Recording

THRESHOLD = 0.2
SRGB = TRANSFERS["srgb"]


def events_of(file):
    with Recording(file) as flight:
        return flight.events("events", 0.0, 1e6)


def convert(source, out, *, stack_length=None, **settings):
    conversion = convert_video(
        source, out, ConversionConfig(**settings), device="cpu", stack_length=stack_length
    )
    return conversion, events_of(out)


def moving_pictures(count=9, *, width=24, height=10, seed=0):
    """Return a coloured pattern that drifts, as RGB."""
    rng = np.random.default_rng(seed)
    wave = rng.uniform(1.0, 4.0, (3, 2))
    row, col = np.mgrid[:height, :width]
    shown = []
    for frame in range(count):
        bands = [
            110 + 100 * np.sin(2 * np.pi * (a * (col - 2 * frame) / width + b * row / height))
            for a, b in wave
        ]
        shown.append(np.stack(bands, axis=2).round().astype(np.uint8))
    return shown


def same_events(one, other):
    return all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))


def test_a_ramp_of_log_radiance_fires_every_threshold_over_slope(tmp_path):
    """Event k of a pixel with slope s is at k C / s, to the quantisation of 16 bits (linear, >= 0.0497).

    Half a step is 0.5 / 65535 / 0.0497 = 1.54e-4 of the light, and as much of its logarithm.
    """
    slope = np.array([[3.0, -3.0], [1.0, 0.0]])
    begin = np.where(slope > 0.0, 0.0497, 1.0)
    time_s = np.arange(0.0, 1.0 + 1e-9, 0.01)
    light = begin * np.exp(slope * time_s[:, None, None])
    pictures = np.round(65535 * light).astype(np.uint16)
    config = {"fps": 100.0, "transfer": "linear", "dark_floor": 1e-9}
    conversion, events = convert(write_folder(tmp_path / "f", pictures), tmp_path / "e.h5", **config)
    for row, col in itertools.product(range(2), range(2)):
        mine = (events.y == row) & (events.x == col)
        steepness = abs(slope[row, col])
        count = int(steepness / THRESHOLD + 1e-6)  # 15, 15, 5, 0: a level is reached at the last frame
        if steepness:
            due_s = THRESHOLD / steepness * np.arange(1, count)
            found_s = 1e-6 * events.t[mine]
            np.testing.assert_allclose(found_s[: count - 1], due_s, atol=2 * 1.6e-4 / steepness + 1e-6)
            assert count - 1 <= mine.sum() <= count  # the last level may be missed by rounding
            assert (events.polarity[mine] == (slope[row, col] > 0.0)).all()
        else:
            assert not mine.any()
    assert conversion.halved_loss == pytest.approx(0.0, abs=0.05)  # linear in log: no frame is needed
    assert conversion.frame_count == 101
    assert conversion.duration_ns == 1_000_000_000


def test_a_step_fires_its_height_over_the_threshold_between_two_frames(tmp_path):
    """Codes 50 -> 200 -> 50: n events up, evenly spaced in the logarithm over the interval, and n down."""
    low, high = (np.full((3, 4), code, dtype=np.uint8) for code in (50, 200))
    folder = write_folder(tmp_path / "f", [low, low, high, high, low])
    _, events = convert(folder, tmp_path / "e.h5", fps=10.0, dark_floor=1e-3)
    height = np.log(SRGB(np.array(200 / 255)) + 1e-3) - np.log(SRGB(np.array(50 / 255)) + 1e-3)
    count = int(height / THRESHOLD)
    up = (events.x == 1) & (events.y == 2) & (events.polarity == 1)
    due_us = 1e5 + 1e5 * THRESHOLD * np.arange(1, count + 1) / height
    np.testing.assert_allclose(events.t[up], due_us, atol=1.5)  # floored to 1 us; float32 samples
    assert len(events.t) == 2 * count * 12


def test_events_are_those_of_each_pixel_on_its_own(tmp_path):
    """Every event of a coloured, moving video against a loop over pixels, frames and levels in float64."""
    shown = moving_pictures()
    _, events = convert(write_folder(tmp_path / "f", shown), tmp_path / "e.h5", fps=250.0, dark_floor=0.003)
    light = SRGB(np.array(shown) / 255.0) @ np.array([0.2126, 0.7152, 0.0722])
    log = np.log(light + 0.003)
    expected = []
    for row, col in np.ndindex(log.shape[1:]):
        level = log[0, row, col]
        for frame, (before, after) in enumerate(itertools.pairwise(log[:, row, col])):
            sign = 1 if after > before else -1
            while sign * (after - level) >= THRESHOLD - 1e-6:
                level += sign * THRESHOLD
                share = (level - before) / (after - before)
                expected.append((4000.0 * (frame + share), col, row, int(sign > 0)))
    found = sorted(zip(events.x, events.y, events.polarity, events.t, strict=True))
    expected.sort(key=lambda event: (event[1], event[2], event[3], event[0]))
    assert len(found) == len(expected) > 1000
    assert [event[:3] for event in found] == [event[1:] for event in expected]
    np.testing.assert_allclose([e[3] for e in found], [e[0] for e in expected], atol=1.5)


@pytest.mark.parametrize("stack_length", [1, 2, 3, 8, 100])
def test_events_do_not_depend_on_how_many_frames_are_in_memory(tmp_path, stack_length):
    folder = write_folder(tmp_path / "f", moving_pictures(11))
    noisy = {"preset": "v2e_noisy"}
    whole, expected = convert(folder, tmp_path / "a.h5", fps=30.0, pixel=noisy, seed=3)
    cut, found = convert(folder, tmp_path / "b.h5", fps=30.0, pixel=noisy, seed=3, stack_length=stack_length)
    assert same_events(found, expected)
    assert cut.halved_loss == whole.halved_loss
    with h5py.File(tmp_path / "a.h5") as a, h5py.File(tmp_path / "b.h5") as b:
        for name in ("stamp_ns", "start_ns", "event_end", "sequence"):
            np.testing.assert_array_equal(a[f"sensors/events/{name}"], b[f"sensors/events/{name}"])


def test_a_video_and_a_folder_give_the_same_events(tmp_path):
    """Uneven times: those in the video, and in a file of times beside the folder."""
    shown, shown_ms = moving_pictures(6), [5, 10, 11, 40, 41, 100]
    video = write_video(tmp_path / "v.mkv", shown, shown_ms)
    (tmp_path / "t.txt").write_text("\n".join(f"{ms / 1000}" for ms in shown_ms))
    folder = write_folder(tmp_path / "f", shown)
    found, of_video = convert(video, tmp_path / "a.h5")
    _, of_folder = convert(folder, tmp_path / "b.h5", timestamps=str(tmp_path / "t.txt"))
    assert len(of_video.t) > 500
    assert same_events(of_video, of_folder)
    assert (found.interval_min_ns, found.interval_max_ns, found.duration_ns) == (
        1_000_000,
        59_000_000,
        95_000_000,
    )


def test_slow_motion_divides_times(tmp_path):
    folder = write_folder(tmp_path / "f", moving_pictures(5))
    _, slow = convert(folder, tmp_path / "a.h5", fps=25.0)
    _, fast = convert(folder, tmp_path / "b.h5", fps=25.0, slow_motion=8.0)
    np.testing.assert_allclose(fast.t, slow.t / 8.0, atol=1.1)  # both are floored to 1 us
    assert len(fast.t) == len(slow.t) > 500


def test_fewer_pixels_see_the_average_of_the_light(tmp_path):
    """A fine checkerboard that turns into its negative is grey all the time, and no events come of it."""
    board = 255 * (np.indices((8, 16)).sum(axis=0) % 2).astype(np.uint8)
    folder = write_folder(tmp_path / "f", [board, 255 - board, board])
    _, sharp = convert(folder, tmp_path / "a.h5", fps=10.0)
    small, blurred = convert(folder, tmp_path / "b.h5", fps=10.0, size="4x2")
    assert len(sharp.t) > 0
    assert len(blurred.t) == 0
    assert (small.plan.width, small.plan.height) == (4, 2)
    stretched, _ = convert(folder, tmp_path / "c.h5", fps=10.0, size="4x4", fit="stretch")
    cropped, _ = convert(folder, tmp_path / "d.h5", fps=10.0, size="4x4")
    assert str(stretched.plan.crop) == "16x8+0+0"
    assert str(cropped.plan.crop) == "8x8+4+0"


def test_what_flickers_is_said_to_need_more_frames(tmp_path):
    low, high = (np.full((3, 4), code, dtype=np.uint8) for code in (50, 200))
    flicker, _ = convert(write_folder(tmp_path / "f", [low, high] * 4 + [low]), tmp_path / "e.h5", fps=10.0)
    assert flicker.halved_loss == 1.0
    assert flicker.burst_share == 1.0  # 13 events a step
    still, _ = convert(write_folder(tmp_path / "g", [low] * 3), tmp_path / "g.h5", fps=10.0)
    assert np.isnan(still.halved_loss)
    assert np.isnan(still.burst_share)
    # events: 1, 0, 14, 12 in the first row, 1, 2, 14, 12 in the second
    rise = np.array([[50, 60, 50, 60], [50, 60, 50, 60]], np.uint8)
    jump = np.array([[60, 60, 200, 200], [60, 75, 200, 200]], np.uint8)
    mixed, _ = convert(write_folder(tmp_path / "h", [rise, jump]), tmp_path / "h.h5", fps=10.0)
    assert mixed.burst_share == pytest.approx(4 / 7)


def test_the_size_of_a_preset_may_be_larger_than_the_video(tmp_path, capsys):
    """The pictures are enlarged, cropped to the shape of the sensor, and the command says so."""
    folder = write_folder(tmp_path / "f", moving_pictures(3, width=48, height=36))
    out = tmp_path / "e.h5"
    line = ["convert", str(folder), str(out), "--fps", "10"]
    line += ["--preset", "davis346", "--size", "preset", "--set", "pixel.readout=null"]
    assert cli.main(line) == 0
    assert "note: the pictures are enlarged from 48x36 to 346x260" in capsys.readouterr().out
    with Recording(out) as recording:
        events = next(recording.packets())
    assert (events.width, events.height) == (346, 260)
    assert len(events) > 0


def test_the_floor_keeps_one_step_of_the_numbers_below_half_a_threshold(tmp_path):
    codes = SRGB(np.arange(256) / 255.0)
    floor = find_floor(codes, 0.1, least=1e-3)
    # at black a step is 1 / 255 / 12.92, so log(1 + step / floor) = 0.1 where floor = 0.002886
    assert floor == pytest.approx(0.0029, abs=1e-9)
    assert code_step(codes, floor) <= 0.1 < code_step(codes, 0.95 * floor)
    assert find_floor(SRGB(np.linspace(0.0, 1.0, 65536)), 0.1, least=1e-3) == 1e-3
    shown, _ = convert(write_folder(tmp_path / "f", moving_pictures(3)), tmp_path / "e.h5", fps=10.0)
    assert shown.plan.dark_floor == floor


def test_lost_events_are_counted(tmp_path):
    folder = write_folder(tmp_path / "f", moving_pictures(5))
    _, every = convert(folder, tmp_path / "a.h5", fps=10.0)
    lossy, kept = convert(folder, tmp_path / "b.h5", fps=10.0, pixel={"event_count_max": 50})
    assert len(kept.t) == lossy.event_count
    assert lossy.event_count + lossy.dropped_count == len(every.t)
    assert lossy.dropped_count > 0


def test_bad_videos_are_refused_in_words(tmp_path):
    picture = moving_pictures(1)[0]
    with pytest.raises(ValueError, match="one has one frame only; events need two or more"):
        convert(write_folder(tmp_path / "one", [picture]), tmp_path / "e.h5", fps=10.0)
    folder = write_folder(tmp_path / "f", [picture] * 3)
    (tmp_path / "t.txt").write_text("0.1\n0.3\n0.2")
    with pytest.raises(ValueError, match=r"frame 2 of f is at 0\.1 s, after 0\.2 s"):
        convert(folder, tmp_path / "e.h5", timestamps=str(tmp_path / "t.txt"))
    with pytest.raises(
        ValueError, match=r"increase by at least 1 us.* frame 1 of f is at 5e-07 s, after 0 s"
    ):
        convert(folder, tmp_path / "e.h5", fps=1e6, slow_motion=2.0)
    with pytest.raises(ValueError, match=r"must be one of auto, srgb.* got 'log'"):
        ConversionConfig(transfer="log")
    with pytest.raises(ValueError, match="size preset needs a preset"):
        convert(folder, tmp_path / "e.h5", fps=10.0, size="preset")
    assert not (tmp_path / "e.h5").exists()


def test_times_in_another_unit_leave_nothing_behind(tmp_path):
    """Microseconds that are read as seconds; the next try needs no --overwrite."""
    folder = write_folder(tmp_path / "f", moving_pictures(3))
    for last, said in (
        ("9e8", r"frame 2 of f is 9e\+08 s after frame 0, at most"),
        ("1e11", "after the first"),
    ):
        (tmp_path / "t.txt").write_text(f"0\n33333\n{last}")
        with pytest.raises(ValueError, match=f"{said}.* --time-unit says which"):
            convert(folder, tmp_path / "e.h5", timestamps=str(tmp_path / "t.txt"))
        assert not (tmp_path / "e.h5").exists()


def test_who_stops_it_keeps_a_whole_file(tmp_path):
    folder = write_folder(tmp_path / "f", moving_pictures(6))
    config = ConversionConfig(fps=10.0)
    found = convert_video(
        folder, tmp_path / "e.h5", config, device="cpu", stack_length=2, stopped=lambda: True
    )
    assert (found.complete, found.frame_count) == (False, 2)
    with Recording(tmp_path / "e.h5") as flight:
        assert flight.clean
        assert flight.packet_count("events") == 1


def test_the_file_has_what_was_decided(tmp_path):
    """The dark floor that was chosen, and the part of the picture that was taken; again it is the same."""
    folder = write_folder(tmp_path / "f", moving_pictures(5, width=40, height=30))
    found, events = convert(folder, tmp_path / "a.h5", fps=10.0, size="16x16")
    with Recording(tmp_path / "a.h5") as flight:
        settings = yaml.safe_load(flight.header.config_yaml)["conversion"]
    assert settings["dark_floor"] == found.plan.dark_floor > 0.0
    assert settings["crop"] == str(found.plan.crop) == "30x30+5+0"
    again = ConversionConfig(**{key: settings[key] for key in ConversionConfig.model_fields})
    convert_video(folder, tmp_path / "b.h5", again, device="cpu")
    assert same_events(events_of(tmp_path / "b.h5"), events)


def test_the_summary_says_what_the_pixels_are(tmp_path, capsys):
    folder = write_folder(tmp_path / "f", moving_pictures(3))
    for preset, said in (
        (
            "davis346",
            "davis346, thresholds 0.1337 on, 0.2029 off, threshold_spread, leak, measured_noise, readout",
        ),
        ("voltmeter_dvs346", "voltmeter_dvs346, steps of about 0.19, stochastic, dark floor"),
    ):
        line = ["convert", str(folder), str(tmp_path / f"{preset}.h5"), "--fps", "10", "--preset", preset]
        assert cli.main([*line, "--device", "cpu"]) == 0
        assert said in " ".join(capsys.readouterr().out.split())
    assert cli.main(["convert", str(folder), str(tmp_path / "e.txt"), "--fps", "10"]) == 1
    assert f"events are written as HDF5: {tmp_path / 'e.h5'}" in capsys.readouterr().err


def test_what_was_converted_before_a_bad_frame_is_kept(tmp_path):
    shown = moving_pictures(5)
    folder = write_folder(tmp_path / "f", shown)
    (folder / "frame4.png").write_bytes(b"cut off")
    with pytest.raises(ValueError, match=r"frame4\.png is not a readable picture"):
        convert(folder, tmp_path / "e.h5", fps=10.0, stack_length=2)
    with Recording(tmp_path / "e.h5") as flight:
        assert not flight.clean
        assert flight.packet_count("events") == 3  # the intervals between the four frames before it


@pytest.mark.parametrize(
    ("times_s", "told"), [([0, 30, 60, 90], "every 30,000 ms"), ([0, 0.1, 0.4, 2], "every 100 to 1,600 ms")]
)
def test_the_command_says_long_intervals_in_full(tmp_path, capsys, times_s, told):
    """As of two pictures of a still surface."""
    folder = write_folder(tmp_path / "f", [moving_pictures(1, width=8, height=6)[0]] * 4)
    np.savetxt(tmp_path / "times.txt", times_s)
    line = ["convert", str(folder), str(tmp_path / "e.h5"), "--timestamps", str(tmp_path / "times.txt")]
    assert cli.main([*line, "--device", "cpu"]) == 0
    assert told in capsys.readouterr().out


def test_the_command_writes_a_file_that_says_where_it_is_from(tmp_path, capsys):
    video = write_video(tmp_path / "v.mkv", moving_pictures(4, width=40, height=30), [0, 20, 40, 60])
    out = tmp_path / "e.h5"
    line = ["convert", str(video), str(out), "--preset", "davis346", "--device", "cpu"]
    line += ["--set", "pixel.readout=null", "--set", "pixel.threshold_on=0.5", "--size", "20x15"]
    assert cli.main(line) == 0
    printed = capsys.readouterr().out
    assert "v.mkv: 40x30; bgr0, 8 bits, srgb" in printed
    assert "4 in 0.060 s, every 20 ms" in printed
    assert " % brighter), 0 dropped" in printed
    assert "does not name its transfer function" in printed
    with Recording(out) as flight:
        settings = yaml.safe_load(flight.header.config_yaml)["conversion"]
        assert flight.clean
        assert flight.header.scene == "v.mkv"
        packet = next(flight.packets())
    assert (packet.width, packet.height, packet.start_ns, packet.stamp_ns) == (20, 15, 0, 20_000_000)
    assert settings["pixel"]["threshold_on"] == 0.5
    assert settings["pixel"]["threshold_off"] == 0.2029  # of the preset
    assert settings["pixel"]["leak"] is not None
    assert settings["pixel"]["readout"] is None
    assert rerun_file(out, save=tmp_path / "e.rrd").stat().st_size > 1000


def test_the_command_replaces_nothing_unless_told_to(tmp_path, capsys):
    folder = write_folder(tmp_path / "f", moving_pictures(3))
    out = tmp_path / "e.h5"
    out.write_text("precious")
    line = ["convert", str(folder), str(out), "--fps", "10", "--device", "cpu"]
    assert cli.main(line) == 1
    printed = capsys.readouterr()
    assert f"{out} is already there: add --overwrite" in printed.err
    assert printed.out == ""
    assert out.read_text() == "precious"
    assert cli.main([*line, "--overwrite"]) == 0
    assert cli.main(["convert", str(folder), str(tmp_path), "--fps", "10", "--overwrite"]) == 1
    assert f"the events go to a file, got the folder {tmp_path}" in capsys.readouterr().err
    assert len(events_of(out).t) > 0


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["--preset", "dvs"], "pixel: unknown preset 'dvs', known: dvs128"),
        (
            ["--set", "pixel.threshold=1"],
            "pixel.threshold: unknown key; did you mean 'threshold_on'? known: ",
        ),
        (
            ["--set", "pixel.leak.rate=1"],
            "pixel.leak.rate: unknown key; did you mean 'rate_hz'? known: bright_factor",
        ),
        (["--set", "pixel.leak=1"], "pixel.leak: must be keys with values, such as {rate_hz: 0.1"),
        (["--transfer", "log"], "neurosim: transfer: must be one of auto, srgb"),
        (["--time-unit", "us"], "--time-unit is that of --timestamps, which are not given"),
        (
            ["--dark-floor", "0.1", "--set", "dark_floor=0.2"],
            "dark_floor is given twice: --dark-floor and --set",
        ),
        (["--slow-motion", "0"], "slow_motion: Input should be greater than 0, got 0.0"),
        (["--set", "seed.x=1", "--seed", "3"], "seed: Input should be a valid integer, got {'x': 1}"),
        (["--size", "9x9000"], "size must be at most 16 times the 24x10 pixels there are, got 9x9000"),
    ],
)
def test_the_command_says_what_is_wrong_in_one_line(tmp_path, capsys, given, said):
    folder = write_folder(tmp_path / "f", moving_pictures(2))
    assert cli.main(["convert", str(folder), str(tmp_path / "e.h5"), "--fps", "10", *given]) == 1
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
