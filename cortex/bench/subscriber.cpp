// SPDX-License-Identifier: Apache-2.0
// Counts one flood of bench/Sample messages as cortex/bench/tally.py does, and prints the result as JSON.
#include <chrono>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <ctime>

#include "cortex/node.hpp"
#include "sample.hpp"

namespace {

constexpr std::int64_t warm = -1;
constexpr std::int64_t end = -2;
constexpr auto patience = std::chrono::seconds(5);

double now_s() {
  return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch()).count();
}

struct Tally {
  std::size_t floats;
  std::int64_t mask;  // of small messages every 64th is looked at, as in Python
  std::int64_t expected = 0, lost = 0, misordered = 0, corrupt = 0;
  std::int64_t first_count = -1, last_count = -1;
  double first_s = 0.0, last_s = 0.0;

  void take(std::int64_t sequence, const float* data, std::size_t size) {
    if (sequence < expected) {
      ++misordered;
      return;
    }
    lost += sequence - expected;
    expected = sequence + 1;
    if ((sequence & mask) != 0) return;
    const float tag = 1.0F + static_cast<float>(sequence & 1);
    if (size != floats || data[0] != tag || data[size / 2] != tag || data[size - 1] != tag) ++corrupt;
    last_count = sequence - lost;
    last_s = now_s();
    if (first_count < 0) {
      first_count = last_count;
      first_s = last_s;
    }
  }

  void print() const {
    const double rate = last_s > first_s ? static_cast<double>(last_count - first_count) / (last_s - first_s) : 0.0;
    std::printf(
        "{\"rate\": %.3f, \"received\": %lld, \"lost\": %lld, \"misordered\": %lld, \"corrupt\": %lld, "
        "\"grown_kb\": 0, \"cpu_s\": %.6f}\n",
        rate, static_cast<long long>(expected - lost), static_cast<long long>(lost),
        static_cast<long long>(misordered), static_cast<long long>(corrupt),
        static_cast<double>(std::clock()) / CLOCKS_PER_SEC);
    std::fflush(stdout);
  }
};

}  // namespace

int main(int argc, char** argv) {
  if (argc != 4) {
    std::fprintf(stderr, "usage: subscriber TOPIC FLOATS DEPTH\n");
    return 2;
  }
  const auto floats = static_cast<std::size_t>(std::atoll(argv[2]));
  const auto depth = static_cast<std::size_t>(std::atoll(argv[3]));
  cortex::Node node("bench_cpp_subscriber");
  auto subscription =
      node.subscribe<bench::Sample>(argv[1], cortex::reliable(depth, std::chrono::milliseconds(5000)));
  Tally tally{floats, floats >= 8192 ? 0 : 63};
  bool connected = false;
  while (auto received = subscription.receive(patience)) {
    const bench::Sample& sample = **received;
    if (!connected) {
      connected = true;
      std::printf("connected\n");
      std::fflush(stdout);
    }
    if (sample.stamp_ns == end) {
      tally.print();
      return 0;
    }
    if (sample.stamp_ns != warm) tally.take(sample.stamp_ns, sample.data.data(), sample.data.size());
  }
  std::fprintf(stderr, "nothing came for 5 s\n");
  return 1;
}
