// SPDX-License-Identifier: Apache-2.0
// Takes one flood of bench/Sample messages from Python, and prints what it counted as JSON.
#include <chrono>
#include <cstdint>
#include <cstdio>
#include <cstdlib>

#include "cortex/node.hpp"
#include "sample.hpp"

int main(int argc, char** argv) {
  if (argc != 3) return 2;
  cortex::Node node("bench_cpp_subscriber");
  auto subscription = node.subscribe<bench::Sample>(
      argv[1], cortex::reliable(static_cast<std::size_t>(std::atoll(argv[2])), std::chrono::milliseconds(30000)));
  std::int64_t received = 0, misordered = 0, corrupt = 0, next = 0;
  std::chrono::steady_clock::time_point first, last;
  for (bool connected = false; auto message = subscription.receive(std::chrono::seconds(30)); connected = true) {
    const std::int64_t sequence = (**message).stamp_ns;  // -1: nothing but a greeting; -2: the end
    if (!connected) {
      std::printf("connected\n");
      std::fflush(stdout);
    }
    if (sequence == -2) break;
    if (sequence < 0) continue;
    if (sequence < next) ++misordered;
    if ((sequence & 63) == 0) {  // as in Python, of small messages every 64th is looked at
      if ((**message).data.back() != 1.0F) ++corrupt;
      last = std::chrono::steady_clock::now();
      if (received == 0) first = last;
    }
    next = sequence + 1;
    ++received;
  }
  const double seconds = std::chrono::duration<double>(last - first).count();
  std::printf("{\"rate\": %.3f, \"received\": %lld, \"misordered\": %lld, \"corrupt\": %lld, \"grown_kb\": 0}\n",
              seconds > 0.0 ? static_cast<double>((received - 1) / 64 * 64) / seconds : 0.0,
              static_cast<long long>(received), static_cast<long long>(misordered), static_cast<long long>(corrupt));
}
