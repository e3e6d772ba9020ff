// SPDX-License-Identifier: Apache-2.0
// Publishes scans of a room, written where the readers will find them, for a number of turns.
#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdlib>
#include <iostream>
#include <thread>

#include <cortex/node.hpp>

#include "scan.hpp"

int main(int argc, char** argv) {
  using namespace std::chrono_literals;
  const int turns = argc > 1 ? std::atoi(argv[1]) : 1000;
  constexpr std::uint32_t rays = 10'000;

  cortex::Node node{"lidar"};
  auto scans = node.advertise<example::Scan>("/scan");
  for (int turn = 0; turn < turns; ++turn) {
    auto scan = scans.loan({{"n", rays}});
    scan->stamp_ns = cortex::monotonic_ns();
    auto ranges = scan->ranges.writable();
    for (std::uint32_t ray = 0; ray < rays; ++ray) {
      const double angle_rad = 6.283185307179586 * ray / rays;
      ranges[ray] = static_cast<float>(3.0 / std::max(std::abs(std::cos(angle_rad)), std::abs(std::sin(angle_rad))));
    }
    ranges[static_cast<std::size_t>(turn) % rays] = 0.5f;  // somebody walks around
    scan.publish();
    std::this_thread::sleep_for(10ms);
  }
  std::cout << "published " << scans.counters().published << " scans\n";
}
