// SPDX-License-Identifier: Apache-2.0
// Steers away from the nearest obstacle: receives scans, publishes commands, ends after a number of scans.
#include <algorithm>
#include <chrono>
#include <cstdlib>
#include <iostream>

#include <cortex/node.hpp>

#include "scan.hpp"

int main(int argc, char** argv) {
  using namespace std::chrono_literals;
  int left = argc > 1 ? std::atoi(argv[1]) : 100;

  cortex::Node node{"steering"};
  auto scans = node.subscribe<example::Scan>("/scan", cortex::latest());
  auto commands = node.advertise<example::Cmd>("/cmd");

  int used = 0;
  while (left-- > 0) {
    const auto scan = scans.receive(60s);
    if (!scan) break;
    const auto& ranges = (*scan)->ranges;  // looks into the publisher's memory, as long as `scan` lives
    if (ranges.empty()) continue;
    const auto nearest = std::min_element(ranges.begin(), ranges.end()) - ranges.begin();
    const bool is_left = static_cast<std::size_t>(nearest) < ranges.size() / 2;
    commands.publish({(*scan)->stamp_ns, 1.0, is_left ? -0.5 : 0.5});
    ++used;
  }
  std::cout << "steered by " << used << " scans\n";
  return used > 0 ? 0 : 1;
}
