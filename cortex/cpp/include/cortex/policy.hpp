// SPDX-License-Identifier: Apache-2.0
// What a subscriber asks of its stream, and what it counts.
#pragma once

#include <array>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <sstream>
#include <stdexcept>
#include <string>

namespace cortex {

// How messages are queued for one subscriber; made by `keep_last`, `latest` or `reliable`.
struct Policy {
  std::size_t depth = 64;  // most messages that wait in the subscriber's process
  bool is_reliable = false;
  std::chrono::milliseconds timeout{0};  // longest time that a full queue holds up one `publish`

  std::string text() const {
    if (is_reliable) {
      std::ostringstream out;
      out << "reliable(depth=" << depth << ", timeout_s=" << static_cast<double>(timeout.count()) / 1000.0 << ")";
      return out.str();
    }
    return depth == 1 ? "latest()" : "keep_last(" + std::to_string(depth) + ")";
  }
};

namespace detail {
inline void check_depth(std::size_t depth) {
  if (depth < 1 || depth > 65536) {
    throw std::invalid_argument("depth must be 1 to 65536, got " + std::to_string(depth));
  }
}
}  // namespace detail

// The last messages; older ones that were not fetched in time are dropped and counted.
inline Policy keep_last(std::size_t depth = 64) {
  detail::check_depth(depth);
  return {depth, false, std::chrono::milliseconds(0)};
}

// Only the newest message: what a controller wants of a sensor.
inline Policy latest() { return keep_last(1); }

// Every message: a full queue holds up the publisher, at most `timeout` for one message; then it is lost for this
// subscriber, and counted on both sides.
inline Policy reliable(std::size_t depth = 64, std::chrono::milliseconds timeout = std::chrono::milliseconds(1000)) {
  detail::check_depth(depth);
  if (timeout.count() < 0 || timeout.count() > 4'000'000'000) {
    throw std::invalid_argument("timeout must be 0 to 4e9 ms, got " + std::to_string(timeout.count()));
  }
  return {depth, true, timeout};
}

struct SubscriberCounters {
  std::uint64_t received = 0;
  std::uint64_t lost = 0;       // gaps in the sequence
  std::uint64_t rejected = 0;   // frames that were malformed or of another type
  std::uint64_t overtaken = 0;  // dropped here for newer ones
  std::uint64_t cut_off = 0;    // publishers that ended without saying how many messages there were; of reliable ones
  std::array<std::uint64_t, 40> latency{};  // sampled; bucket k counts latencies of k bits in ns
};

struct PublisherCounters {
  std::uint64_t published = 0;
  std::uint64_t bytes = 0;
  std::uint64_t timeouts = 0;  // messages that a reliable subscriber lost
  std::uint64_t skipped = 0;   // messages that some subscriber was not given, as it held its share of slots
};

}  // namespace cortex
