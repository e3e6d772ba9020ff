// SPDX-License-Identifier: Apache-2.0
// One time for all hosts: that of the registry's host, estimated from the answers to heartbeats.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <deque>

namespace cortex::detail {

// The answer that tells most counts: one that was quick, or came just now.
class ClockEstimate {
 public:
  // CLOCK_REALTIME of the registry's host less CLOCK_MONOTONIC of this one; 0 before the first answer.
  std::int64_t offset_ns() const noexcept { return offset_ns_; }

  // Takes an answer into account: when it was asked for and when it came by CLOCK_MONOTONIC of this host, and what it
  // said by CLOCK_REALTIME of the registry's.
  void add(std::int64_t asked_ns, std::int64_t told_ns, std::int64_t answered_ns) {
    const std::int64_t trip_ns = answered_ns - asked_ns, at_ns = asked_ns + trip_ns / 2;
    const auto error_ns = [&](const Sample& each) { return each.trip_ns / 2 + (at_ns - each.at_ns) / apart; };
    const Sample sample{at_ns, told_ns - at_ns, trip_ns};
    if (!samples_.empty()) {
      const Sample& last = samples_.back();
      const std::int64_t step_ns = std::abs(sample.offset_ns - last.offset_ns);
      if (step_ns > trip_ns / 2 + last.trip_ns / 2 + (at_ns - last.at_ns) / apart_most) samples_.clear();  // a clock was set
    }
    samples_.push_back(sample);
    if (samples_.size() > sample_count) samples_.pop_front();
    offset_ns_ = std::min_element(samples_.begin(), samples_.end(), [&](const Sample& a, const Sample& b) {
                   return error_ns(a) < error_ns(b);
                 })->offset_ns;
  }

  // Another registry answers from now on: begins anew, from where we are.
  void forget() noexcept { samples_.clear(); }

 private:
  static constexpr std::size_t sample_count = 64;
  static constexpr std::int64_t apart = 10'000;      // clocks that nobody sets run apart by 1 ns in so many,
  static constexpr std::int64_t apart_most = 2'000;  // and none of two computers by more than this

  struct Sample {
    std::int64_t at_ns;
    std::int64_t offset_ns;
    std::int64_t trip_ns;
  };

  std::deque<Sample> samples_;
  std::int64_t offset_ns_ = 0;
};

}  // namespace cortex::detail
