// SPDX-License-Identifier: Apache-2.0
// How long a reader lets the messages of a flood gather before it looks for more.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <ctime>

#include "cortex/broadcast.hpp"
#include "cortex/policy.hpp"

namespace cortex::detail {

// Each look into a ring that was empty holds up whoever writes to it. A reader that is quicker than its publisher and looks whenever
// it has nothing to do takes few messages at a time, and slows the publisher down by a third. In a flood this lets it
// sleep in between (40 B from a Python publisher: 1.6 M/s instead of 1.0, for a quarter of the processor's time). What
// it takes in is older by that much. Not for several threads at once.
class Pace {
 public:
  explicit Pace(const Policy& policy) noexcept : policy_(policy) {}

  // A frame of so many bytes came through a ring; what comes through sockets is ZeroMQ's to gather.
  void count(std::size_t bytes) noexcept {
    ++frames_;
    bytes_ += bytes;
  }

  // All that was there by then has been counted.
  void looked(std::int64_t now_ns) noexcept {
    const std::int64_t elapsed_ns = now_ns - since_ns_;
    if (elapsed_ns < longest_ns) return;
    gather_ns_ = static_cast<std::int64_t>(frames_) * flood_ns < elapsed_ns ? 0 : gather_for(elapsed_ns);
    since_ns_ = now_ns;
    frames_ = bytes_ = 0;
  }

  // How long to wait from one look to the next; 0: there is no flood.
  std::int64_t gather_ns() const noexcept { return gather_ns_; }

  // Sleeps; a little longer than it says, as timers do.
  static void sleep(std::int64_t duration_ns) noexcept {
    const timespec duration{static_cast<time_t>(duration_ns / 1'000'000'000),
                            static_cast<long>(duration_ns % 1'000'000'000)};  // NOLINT: the type of tv_nsec
    ::nanosleep(&duration, nullptr);  // a signal ends it early: no harm
  }

 private:
  static constexpr std::int64_t longest_ns = 50'000;
  static constexpr std::int64_t late_ns = 60'000;  // so much longer a sleep may take: the usual slack of timers
  static constexpr std::int64_t flood_ns = 3'000;  // messages that follow each other more quickly are a flood

  // The ring must not be full meanwhile, nor a queue that drops what is too much.
  std::int64_t gather_for(std::int64_t elapsed_ns) const noexcept {
    const auto time_for = [elapsed_ns](std::size_t most, std::size_t came) {
      return static_cast<std::int64_t>(most) * elapsed_ns / static_cast<std::int64_t>(came) - late_ns;
    };
    std::int64_t gather_ns = std::min(longest_ns, time_for(ring_bytes / 8, bytes_));
    if (!policy_.is_reliable) gather_ns = std::min(gather_ns, time_for(policy_.depth / 2, frames_));
    return std::max<std::int64_t>(gather_ns, 0);
  }

  Policy policy_;
  std::size_t frames_ = 0;
  std::size_t bytes_ = 0;
  std::int64_t since_ns_ = 0;
  std::int64_t gather_ns_ = 0;
};

}  // namespace cortex::detail
