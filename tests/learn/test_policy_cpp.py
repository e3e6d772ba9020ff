"""The policy in C++ of `examples/policy_cpp/`: it commands what a policy in Python does."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys

import numpy as np
import pytest
from processes import ROOT, SOON_S

from cortex import Node, reliable
from cortex.messages import Events, Odometry, RateThrustCommand
from cortex.registry import ensure_registry

pytest.importorskip("onnxruntime", reason="needs the extra learn")

RUNTIME = os.environ.get("ONNXRUNTIME_ROOT", "/usr")
STEPS = 5


@pytest.mark.skipif(shutil.which("cmake") is None, reason="no cmake")
@pytest.mark.skipif(
    not any(
        os.path.exists(f"{RUNTIME}/include/{folder}onnxruntime_cxx_api.h") for folder in ("", "onnxruntime/")
    ),
    reason="no ONNX Runtime for C++: unpack a release, and say where by ONNXRUNTIME_ROOT",
)
def test_a_policy_in_cpp_commands_what_one_in_python_does(tmp_path, runtime):
    """In two episodes; events that are stamped anew, and a state that is sent again, included."""
    from neurosim_core.learn.pilot import Pilot, shipped_policy

    source, file = ROOT / "examples" / "policy_cpp", shipped_policy("hover")
    options = (f"-DONNXRUNTIME_ROOT={RUNTIME}", f"-DPython3_EXECUTABLE={sys.executable}")
    subprocess.run(["cmake", "-S", source, "-B", tmp_path, *options], check=True, capture_output=True)
    subprocess.run(["cmake", "--build", tmp_path], check=True, capture_output=True)
    _refuses_surfaces_of_bytes(file, tmp_path)
    ensure_registry(0)
    rng, pilot = np.random.default_rng(0), Pilot(file)
    program = subprocess.Popen(
        [tmp_path / "policy", file, "drone", str(2 * STEPS + 1)], stdout=subprocess.PIPE, text=True
    )
    try:
        with Node("vehicle") as node:
            states = node.publisher("/drone/odometry", Odometry)
            seen = node.publisher("/drone/events", Events)
            commands = node.subscriber("/drone/command/rates", RateThrustCommand, policy=reliable(16))
            assert states.wait_for_subscribers(timeout_s=SOON_S)
            assert seen.wait_for_subscribers(timeout_s=SOON_S)
            acted, still = [], np.zeros(3)
            for step in (*range(STEPS), *range(STEPS)):
                if step == 0:
                    pilot.reset()
                stamp_ns, q, rate = 20_000_000 * step, rng.normal(size=4), rng.normal(size=3)
                q /= np.linalg.norm(q)
                t = np.sort(rng.integers(20_000 * (step - 1) + 1, 20_000 * step + 1, 900 * (step > 0)))
                x, y = (rng.integers(0, 48, len(t)).astype(np.uint16) for _ in range(2))
                polarity = rng.integers(0, 2, len(t)).astype(np.uint8)
                if step:
                    window = {"t": t, "x": x, "y": y, "polarity": polarity}
                    seen.publish(Events(stamp_ns=stamp_ns, **window, width=48, height=48))
                state = Odometry(
                    stamp_ns=stamp_ns, position=still, orientation=q, velocity=still, body_rate=rate
                )
                states.publish(state)
                command = commands.recv(SOON_S)
                expected = pilot.act(t, x, y, polarity, stamp_ns=stamp_ns, orientation=q, body_rate=rate)
                assert command.stamp_ns == stamp_ns
                acted.append(np.array([command.thrust_n, *command.body_rate]))
                np.testing.assert_allclose(acted[-1], [expected.thrust_n, *expected.body_rate], atol=1e-5)
            states.publish(state)
            again = commands.recv(SOON_S)
            np.testing.assert_array_equal([again.thrust_n, *again.body_rate], acted[-1])
        assert program.communicate(timeout=SOON_S)[0] == f"{2 * STEPS + 1} commands\n"
    finally:
        program.kill()
        program.communicate()
    assert np.ptp(acted, axis=0).min() > 0.05  # a constant would agree, too


def _refuses_surfaces_of_bytes(policy, folder):
    onnx = pytest.importorskip("onnx")
    model = onnx.load(policy)
    (card,) = (each for each in model.metadata_props if each.key == "neurosim")
    card.value = json.dumps({**json.loads(card.value), "surface": {"kind": "LeakySurface", "dtype": "uint8"}})
    onnx.save(model, folder / "bytes.onnx")
    done = subprocess.run([folder / "policy", folder / "bytes.onnx"], capture_output=True, text=True)
    assert done.returncode != 0
    assert "only surfaces of float32 are known here" in done.stderr
