"""What a slow controller does to a flight in real time, and what lockstep predicts."""

from __future__ import annotations

import csv
import io

import numpy as np
import pytest
from rich.console import Console

from neurosim_core.bench import delay
from neurosim_core.bench.delay import DelayResult, bench_delay, predicted_settings, print_delays
from neurosim_core.packets import Delivery, Odometry
from neurosim_core.record import RecordingHeader, RecordingWriter


@pytest.fixture
def console() -> Console:
    return Console(file=io.StringIO(), width=200)


def test_lockstep_asks_as_rarely_and_delays_as_long():
    """At 200 Hz, 20 ms are 4 control periods; with what else it takes, a command misses the fourth."""
    settings = predicted_settings(0.02, control_rate_hz=200.0, transport_s=5e-4)
    assert settings == {
        "live.mode": "lockstep",
        "live.command_every": 4,
        "links.command.latency_s": pytest.approx(0.0205, abs=1e-12),
    }
    assert predicted_settings(0.0, control_rate_hz=200.0, transport_s=5e-4)["live.command_every"] == 1
    assert predicted_settings(0.012, control_rate_hz=1000.0, transport_s=0.0)["live.command_every"] == 12


def test_a_recording_gives_the_distance_from_the_path(tmp_path):
    """3 cm beside the path half of the time, 5 cm the other half, and commands 20 ms apart."""
    stamps = np.arange(0, 1_000_000_001, 5_000_000)
    header = RecordingHeader(
        config_yaml="",
        seed=0,
        version="0",
        path_stamp_ns=np.array([0, 1_000_000_000]),
        path_position=np.array([[0.0, 0.0, 1.0], [2.0, 0.0, 1.0]]),
    )
    with RecordingWriter(tmp_path / "flight.h5", header) as writer:
        for tick, stamp_ns in enumerate(stamps.tolist()):
            beside_m = 0.03 if tick % 2 else 0.05
            writer.write(
                Odometry(
                    sensor="odometry",
                    stamp_ns=stamp_ns,
                    sequence=tick,
                    position=np.array([2e-9 * stamp_ns, beside_m, 1.0]),
                    orientation=np.array([0.0, 0.0, 0.0, 1.0]),
                    velocity=np.zeros(3),
                    body_rate=np.zeros(3),
                    rotor_speed=np.zeros(4),
                )
            )
            if tick % 4 == 0:
                writer.write(
                    Delivery(
                        sensor="command_link",
                        stamp_ns=stamp_ns,
                        sequence=tick // 4,
                        delivered_ns=stamp_ns,
                        size_bytes=40,
                    )
                )
    error_m, interval_s = delay._read(tmp_path / "flight.h5")
    assert error_m == pytest.approx(np.sqrt((101 * 0.05**2 + 100 * 0.03**2) / 201), rel=1e-12)
    assert interval_s == pytest.approx(0.02, rel=1e-12)


def test_the_table_says_what_it_comes_to(console):
    results = [
        DelayResult(
            tour=tour,
            delay_s=0.02,
            predicted_m=0.2,
            measured_m=0.2 * ratio,
            predicted_interval_s=0.02,
            measured_interval_s=0.0201,
        )
        for tour, ratio in enumerate((1.01, 0.98, 1.2))
    ]
    print_delays(results, console, mode="velocity")
    text = " ".join(console.file.getvalue().split())
    assert "2 20 ms 20.00 cm 24.00 cm 1.200 20.1 ms 20.0 ms" in text
    assert "20 ms: measured / predicted 1.010, from 0.980 to 1.200" in text


@pytest.mark.alone
def test_a_slow_controller_flies_as_predicted(tmp_path, console):
    """With 50 ms of sleep, on a circle, at half speed so that the machine's own delays count for less.

    Without the delay the error is 0.7 of that: see `neurosim bench delay`. A machine that is so busy that it
    cannot hold half speed, or that stands still during the tour, is asked again.
    """
    for _ in range(6):
        (result,) = bench_delay(
            tmp_path,
            console,
            delays_s=(0.05,),
            tours=1,
            seconds=1.5,
            real_time_factor=0.5,
            settings={"scene.rooms": 2, "path": {"kind": "circle", "ramp_s": 0.5}},
        )
        # it sleeps 50 ms, and then waits for at most one control period
        in_time = 0.05 <= result.measured_interval_s <= 0.055 + 1e-9
        if in_time and result.ratio == pytest.approx(1.0, abs=0.08):
            break
    assert in_time, result.measured_interval_s
    assert result.predicted_interval_s == pytest.approx(0.05, abs=1e-9)
    assert result.ratio == pytest.approx(1.0, abs=0.08)  # half a control period more or less is 0.02
    with (tmp_path / "delay.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert float(row["measured_m"]) == result.measured_m


@pytest.mark.parametrize(
    ("options", "mistake"),
    [
        ({"tours": 0}, "tours must be >= 1, got 0"),
        ({"delays_s": ()}, r"delays must be from 0 to less than 10 s, got \[\]"),
        ({"delays_s": (-0.01,)}, r"delays must be from 0 to less than 10 s, got \[-0.01\]"),
        ({"seconds": 0.0}, "seconds must be > 0, got 0.0"),
        ({"real_time_factor": 0.0}, "factor must be > 0, got 0.0"),
    ],
)
def test_wrong_options_are_refused(tmp_path, console, options, mistake):
    with pytest.raises(ValueError, match=mistake):
        bench_delay(tmp_path, console, **options)
