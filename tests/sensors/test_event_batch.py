"""Event cameras that are fed one frame per call."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

import neurosim_core as ns

WIDTH, HEIGHT = 37, 11
IDEAL = ns.EventCameraConfig(threshold_on=0.2, threshold_off=0.25)
NOISY = ns.EventCameraConfig(preset="davis346").model_copy(update={"readout": None})


def make_frames(count: int, seed: int, *, step: float = 0.15) -> np.ndarray:
    walk = np.random.default_rng(seed).normal(0.0, step, (count, HEIGHT, WIDTH))
    return np.cumsum(walk, axis=0).astype(np.float32)


def make_batch(count: int, device: str, config: ns.EventCameraConfig = IDEAL) -> ns.EventCameraBatch:
    return ns.EventCameraBatch(
        config, count=count, width=WIDTH, height=HEIGHT, device=device, sensor="e", seed=5
    )


def feed_alone(config, frames, stamps_ns, *, seed, start_ns=0):
    camera = ns.EventCamera(config, width=WIDTH, height=HEIGHT, device="cpu", sensor="e", seed=seed)
    camera.reset(frames[0], start_ns)
    return [
        camera.feed(frame[None], [stamp_ns]).numpy()
        for frame, stamp_ns in zip(frames[1:], stamps_ns, strict=True)
    ]


def assert_same(events, expected):
    for column, other in zip(events, expected, strict=True):
        np.testing.assert_array_equal(column, other)


@pytest.mark.parametrize("config", [IDEAL, NOISY], ids=["ideal", "davis346"])
@pytest.mark.parametrize("start_ns", [0, 7_000_000])
def test_each_camera_gives_the_events_of_one_alone(config, start_ns, device):
    """Also with stamps that fall between microseconds, where the distance of frames stays and changes."""
    stamps_ns = [start_ns + stamp for stamp in (1_000_000, 2_000_000, 3_000_333, 4_000_666, 9_000_000)]
    frames = np.stack([make_frames(6, seed) for seed in range(3)], axis=1)
    batch = make_batch(3, device, config)
    batch.reset(frames[0], start_ns)
    expected = [
        feed_alone(config, frames[:, camera], stamps_ns, seed=5 + camera, start_ns=start_ns)
        for camera in range(3)
    ]
    for number, stamp_ns in enumerate(stamps_ns):
        events = batch.step(wp.array(frames[number + 1], device=device), stamp_ns)
        assert events.counts == [len(expected[camera][number].t) for camera in range(3)]
        assert len(events) > 100
        for camera in range(3):
            assert_same(events.numpy(camera), expected[camera][number])


def test_a_camera_that_steps(device):
    """The same events as `feed`, read or not, and again after a reset; the two are not mixed."""
    frames = make_frames(5, 0)
    stamps_ns = [1_000_000, 2_000_000, 3_000_000, 4_000_000]
    expected = feed_alone(IDEAL, frames, stamps_ns, seed=0)
    camera = ns.EventCamera(IDEAL, width=WIDTH, height=HEIGHT, device=device, sensor="e")
    for read in (False, True):
        camera.reset(frames[0])
        for frame, stamp_ns, found in zip(frames[1:], stamps_ns, expected, strict=True):
            events = camera.step(frame, stamp_ns)
            assert events.counts == [len(found.t)]
            if read:
                assert_same(events.numpy(), found)
    with pytest.raises(RuntimeError, match="must not be mixed"):
        camera.feed(frames[:1], [5_000_000])
    camera.reset(frames[0])
    camera.feed(frames[1:2], [1_000_000])
    with pytest.raises(RuntimeError, match="must not be mixed"):
        camera.step(frames[2], 2_000_000)


def test_more_events_than_there_is_room_for(device):
    """Room for half an event in each pixel becomes room for nine; no event is lost."""
    frames = np.zeros((3, HEIGHT, WIDTH), np.float32)
    frames[1:] += np.float32([1.8, 3.6])[:, None, None]
    expected = feed_alone(IDEAL, frames, [1_000_000, 2_000_000], seed=0)
    batch = make_batch(2, device)
    batch.reset(np.stack([frames[0]] * 2))
    for number, stamp_ns in enumerate((1_000_000, 2_000_000)):
        events = batch.step(np.stack([frames[number + 1], frames[0]]), stamp_ns)
        assert events.counts == [9 * WIDTH * HEIGHT, 0]
        assert events.dropped_count == 0
        assert_same(events.numpy(0), expected[number])


def test_events_that_are_too_many_are_dropped_from_below(device):
    """As by a camera that is fed: whole rows, and they are counted; the frame after has all of its events."""
    config = IDEAL.model_copy(update={"event_count_max": 3 * WIDTH + 5})
    frames = make_frames(3, 1, step=0.02)
    frames[1] += np.float32(0.5)
    expected = feed_alone(config, frames, [1_000_000, 2_000_000], seed=0)
    batch = make_batch(1, device, config)
    batch.reset(frames[0])
    first = batch.step(frames[1], 1_000_000)
    assert first.dropped_count > 0
    assert_same(first.numpy(), expected[0])
    assert_same(batch.step(frames[2], 2_000_000).numpy(), expected[1])


def test_what_is_refused(device):
    frames = make_frames(2, 0)
    batch = make_batch(2, device)
    with pytest.raises(RuntimeError, match="reset"):
        batch.step(np.stack([frames[0]] * 2), 1)
    batch.reset(np.stack([frames[0]] * 2))
    with pytest.raises(ValueError, match="float32 of shape"):
        batch.step(frames[0], 1_000_000)
    with pytest.raises(ValueError, match="stamp_ns must be later than 0, that of the previous frame"):
        batch.step(np.stack([frames[0]] * 2), 0)
    events = batch.step(np.stack([frames[1]] * 2), 1_000_000)
    batch.step(np.stack([frames[1]] * 2), 2_000_000)
    with pytest.raises(RuntimeError, match="not read before the next frame"):
        events.numpy()
    bad = np.stack([frames[1]] * 2)
    bad[1, 3, 4] = np.nan
    with pytest.raises(ValueError, match=r"1 values are not, the first at \[1, 3, 4\]"):
        batch.step(bad, 3_000_000)
    with pytest.raises(RuntimeError, match="reset"):
        batch.step(np.stack([frames[1]] * 2), 4_000_000)
