"""The C++ nodes of `examples/ros2_cpp/`: they compile against ROS's headers, and their events decode."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from processes import ROOT

from cortex.cppgen import write_headers
from cortex_ros2_bridge.event_codec import decode_mono

EXAMPLE = ROOT / "examples" / "ros2_cpp"
INCLUDES = [
    path
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    if prefix and (Path(prefix) / "include").is_dir()
    for path in (Path(prefix, "include"), *Path(prefix, "include").iterdir())
    if path.name == "include" or (path / path.name).is_dir()
]
"""Since Humble, each package has its headers in a folder of its own: include/rclcpp/rclcpp/rclcpp.hpp."""
HAS_RCLCPP = any((path / "rclcpp" / "rclcpp.hpp").is_file() for path in INCLUDES)

pytestmark = pytest.mark.skipif(shutil.which("g++") is None, reason="g++ is not installed")

PROGRAM = """
#include <cstdio>
#include "mono.hpp"
struct Events {
  std::vector<std::int64_t> t;
  std::vector<std::uint16_t> x, y;
  std::vector<std::uint8_t> polarity;
  std::int64_t start_ns;
};
int main() {
  const Events events{
      {5000001, 5000001, 5000007, 9294968}, {0, 639, 65535, 3}, {0, 479, 32767, 4}, {1, 0, 1, 0}, 5};
  std::vector<std::uint8_t> bytes;
  const auto base_ns = neurosim_cpp_examples::encode_mono(events, bytes);
  std::fwrite(&base_ns, 8, 1, stdout);
  std::fwrite(bytes.data(), 1, bytes.size(), stdout);
  Events late = events;
  late.t[3] = 9294969;  // 4.294968 s after the first: more nanoseconds than 32 bits hold
  try {
    neurosim_cpp_examples::encode_mono(late, bytes);
  } catch (const std::out_of_range&) {
    return 0;
  }
  return 1;
}
"""


def test_events_of_the_component_are_those_of_the_bridge(tmp_path: Path) -> None:
    source, program = tmp_path / "mono.cpp", tmp_path / "mono"
    source.write_text(PROGRAM, encoding="utf-8")
    flags = ["-std=c++17", "-Wall", "-Wextra", "-Werror", f"-I{EXAMPLE / 'src'}"]
    subprocess.run(["g++", *flags, str(source), "-o", str(program)], check=True)
    said = subprocess.run([program], check=True, capture_output=True).stdout
    base_ns = int.from_bytes(said[:8], "little")
    columns = decode_mono(said[8:], base_ns=base_ns)
    assert base_ns == 5_000_001_000
    assert columns.x.tolist() == [0, 639, 65535, 3]
    assert columns.y.tolist() == [0, 479, 32767, 4]
    assert np.asarray(columns.t).tolist() == [*(5_000_001_000, 5_000_001_000, 5_000_007_000, 9_294_968_000)]
    assert columns.polarity.tolist() == [1, 0, 1, 0]


@pytest.mark.skipif(not HAS_RCLCPP, reason="no rclcpp: source a ROS installation")
@pytest.mark.parametrize("name", ["circle_controller", "cortex_events"])
def test_nodes_compile_against_the_headers_of_ros(name: str, tmp_path: Path) -> None:
    source = (EXAMPLE / "src" / f"{name}.cpp").read_text(encoding="utf-8")
    if "cortex/node.hpp" in source and not Path("/usr/include/zmq.hpp").is_file():
        pytest.skip("cppzmq is not installed")
    write_headers(tmp_path)  # as the build of the client does
    headers = [f"-isystem{path}" for path in INCLUDES]
    flags = ["-std=c++17", "-fsyntax-only", "-Wall", "-Wextra", "-Werror", f"-I{EXAMPLE / 'src'}"]
    subprocess.run(
        [
            "g++",
            *flags,
            f"-I{ROOT / 'cortex' / 'cpp' / 'include'}",
            f"-I{tmp_path}",
            *headers,
            "-x",
            "c++",
            "-",
        ],
        input=source,
        text=True,
        check=True,
    )
