"""A noise term of an outside package: compiled into the pixels, and named in settings."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import pytest
import warp as wp
import yaml

import neurosim_core as ns
from neurosim_core.random import normal2, random_bits
from neurosim_core.sensors import NoiseTermConfig, SignalTerm

WIDTH, HEIGHT = 12, 8


@wp.func
def ramp(
    term: SignalTerm, seed: wp.uint64, pixel: wp.int32, since_reset_ns: wp.int64, value: wp.float64
) -> wp.float64:
    """Rise at a rate of each pixel's own."""
    seconds = wp.float64(1e-9) * wp.float64(since_reset_ns)
    return term.numbers[0] * value + term.numbers[1] * wp.float64(pixel + 1) * seconds


@wp.func
def white(
    term: SignalTerm, seed: wp.uint64, pixel: wp.int32, since_reset_ns: wp.int64, value: wp.float64
) -> wp.float64:
    """Add numbers that stay and numbers that change."""
    stays = normal2(random_bits(term.seed, term.stream, wp.int64(0), pixel))[0]
    changes = normal2(random_bits(seed, term.stream, since_reset_ns, pixel))[1]
    return (wp.float64(1.0) + term.numbers[0] * stays) * value + term.numbers[1] * changes


@ns.register("noise", "test_ramp")
class RampConfig(NoiseTermConfig):
    """A ramp."""

    kind: Literal["test_ramp"] = "test_ramp"
    factor: float = 1.0
    rate_per_s: float = 0.0
    signal = ramp

    def numbers(self, white_radiance: float) -> tuple[float, ...]:
        """Return what `ramp` reads."""
        return self.factor, self.rate_per_s


@ns.register("noise", "test_white")
class WhiteConfig(NoiseTermConfig):
    """White noise."""

    kind: Literal["test_white"] = "test_white"
    sigma: float = 0.1
    signal = white

    def numbers(self, white_radiance: float) -> tuple[float, ...]:
        """Return what `white` reads."""
        return self.sigma, self.sigma


def camera_of(*noise: dict[str, Any], seed: int = 0, device: Any = "cpu", **pixel: Any) -> ns.EventCamera:
    config = ns.EventCameraConfig(noise=noise, **pixel)
    return ns.EventCamera(config, width=WIDTH, height=HEIGHT, device=device, seed=seed, sensor="front")


def walk(count: int = 9) -> tuple[np.ndarray, np.ndarray]:
    frames = np.random.default_rng(0).normal(scale=0.3, size=(count, HEIGHT, WIDTH)).cumsum(0)
    return frames.astype(np.float32), np.arange(count) * 1_700_123


def seen(camera: ns.EventCamera, parts: int = 1, begin_ns: int = 0) -> list[bytes]:
    """Return the events of a walk that is fed in parts."""
    frames, stamps = walk()
    stamps = stamps + begin_ns
    camera.reset(frames[0], int(stamps[0]))
    found = [camera.feed(frames[i], stamps[i]).numpy() for i in np.array_split(np.arange(1, 9), parts)]
    return [np.concatenate(column).tobytes() for column in zip(*found, strict=True)]


def test_twice_the_signal_is_half_the_threshold(device):
    """To the last bit: a factor of two rounds nothing."""
    doubled = camera_of(
        {"kind": "test_ramp", "factor": 2.0}, threshold_on=0.5, threshold_off=0.25, device=device
    )
    plain = camera_of(threshold_on=0.25, threshold_off=0.125, device=device)
    assert seen(doubled) == seen(plain)


def test_pixels_of_a_still_scene_fire_at_their_own_rates(device):
    """Pixel k sees a ramp of (k + 1) s: its event n is at n C / ((k + 1) s)."""
    camera = camera_of({"kind": "test_ramp", "rate_per_s": 0.5}, threshold_on=0.3, device=device)
    frames = np.full((20, HEIGHT, WIDTH), -1.0, np.float32)
    camera.reset(frames[0], 7_000_000_000)
    found = camera.feed(frames[1:], 7_000_000_000 + 100_000_000 * np.arange(1, 20)).numpy()
    assert found.polarity.all()
    for pixel in (0, 1, 41, WIDTH * HEIGHT - 1):
        mine = found.t[found.y * WIDTH + found.x == pixel]
        expected = 0.3 / (0.5 * (pixel + 1)) * np.arange(1, len(mine) + 1)
        assert len(mine) == int(1.9 * 0.5 * (pixel + 1) / 0.3 + 1e-9)
        assert np.abs(mine - 7e6 - 1e6 * expected).max() <= 1.0  # times are floored to the microsecond


def test_white_noise_is_addressed(device):
    """It depends on seed, camera and stamp since the reset, not on how frames are split."""
    camera = camera_of({"kind": "test_white"}, low_pass={}, device=device)
    first = seen(camera)
    assert seen(camera, parts=4) == first
    assert seen(camera_of({"kind": "test_white"}, seed=1, low_pass={}, device=device)) != first
    assert seen(camera_of(low_pass={}, device=device)) != first
    later = seen(camera, begin_ns=50_000_000)
    assert later[1:] != first[1:]  # another reset, other numbers in time


def test_many_cameras_see_what_one_sees(device):
    noise = [{"kind": "test_white"}, {"kind": "test_ramp", "rate_per_s": 0.01}]
    frames, stamps = walk()
    config = ns.EventCameraConfig(noise=noise, leak={"rate_hz": 5.0})
    batch = ns.EventCameraBatch(
        config, count=2, width=WIDTH, height=HEIGHT, sensor="front", seed=4, device=device
    )
    batch.reset(np.stack([frames[0]] * 2), 0)
    for camera in range(2):
        alone = camera_of(*noise, seed=4 + camera, leak={"rate_hz": 5.0}, device=device)
        alone.reset(frames[0], 0)
        batch.reset(np.stack([frames[0]] * 2), 0)
        for frame, stamp in zip(frames[1:], stamps[1:].tolist(), strict=True):
            together = batch.step(np.stack([frame] * 2), stamp).numpy(camera)
            one = alone.feed(frame[None], [stamp]).numpy()
            assert [column.tobytes() for column in together] == [column.tobytes() for column in one]


def test_settings_name_it_by_its_kind():
    config = ns.load_config(
        {
            "sensors": {
                "dvs": {"kind": "event_camera", "pixel": {"noise": [{"kind": "test_white", "sigma": 0.2}]}}
            }
        }
    )
    (term,) = config.sensors["dvs"].pixel.noise
    assert term == WhiteConfig(sigma=0.2)
    assert ns.load_config(yaml.safe_load(ns.to_yaml(config))) == config
    for noise, said in (
        ([{"kind": "test_whit"}], r"unknown noise kind 'test_whit', known: .*'test_white'"),
        ([{"kind": "test_white", "sigm": 1}], r"test_white: sigm: unknown key; did you mean 'sigma'"),
        ([{"kind": "low_pass"}], r"low_pass is a key of the pixel"),
        ([{"sigma": 1}], r"a term is \{kind: NAME"),
        ([{"kind": "test_white"}] * 2, r"each kind once, got test_white, test_white"),
    ):
        with pytest.raises(ns.ConfigError, match=rf"sensors\.dvs\.pixel.*: .*{said}"):
            ns.load_config({"sensors": {"dvs": {"kind": "event_camera", "pixel": {"noise": noise}}}})


def test_a_function_that_takes_something_else_is_refused():
    with pytest.raises(TypeError, match=r"signal must be a wp.func of \(SignalTerm, uint64"):

        @ns.register("noise", "test_nothing")
        class Nothing(NoiseTermConfig):
            kind: Literal["test_nothing"] = "test_nothing"

    with pytest.raises(ValueError, match="the noise kind 'low_pass' is taken by neurosim_core"):
        ns.register("noise", "low_pass")(RampConfig)
