// SPDX-License-Identifier: Apache-2.0
// One time for all hosts: that of the registry's host, estimated from the answers to heartbeats, as `cortex/clock.py` does.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <deque>

namespace cortex::detail {

// Of each second the quickest answer counts, and a line through those of a minute gives the drift.
class ClockEstimate {
 public:
  // CLOCK_REALTIME of the registry's host less CLOCK_MONOTONIC of this one, which is given; 0 before the first answer.
  std::int64_t offset_ns(std::int64_t now_ns) const {
    return offset_ns_ + std::llround(drift_ * static_cast<double>(now_ns - at_ns_));
  }

  // Takes an answer into account: when it was asked for and when it came by CLOCK_MONOTONIC of this host, and what it
  // said by CLOCK_REALTIME of the registry's.
  void add(std::int64_t asked_ns, std::int64_t told_ns, std::int64_t answered_ns) {
    const std::int64_t at_ns = asked_ns + (answered_ns - asked_ns) / 2;
    const Sample sample{at_ns, told_ns - at_ns, static_cast<double>(answered_ns - asked_ns)};
    if (!samples_.empty()) {
      const Sample& last = samples_.back();
      const double error = (sample.trip + last.trip) / 2.0 + drift_max * static_cast<double>(at_ns - last.at_ns);
      if (std::abs(static_cast<double>(sample.offset_ns - last.offset_ns)) > error) samples_.clear();  // it was set
    }
    if (samples_.empty() || at_ns - window_ns_ > 1'000'000'000) {
      window_ns_ = at_ns;
      samples_.push_back(sample);
      if (samples_.size() > window_count) samples_.pop_front();
    } else if (sample.trip < samples_.back().trip) {
      samples_.back() = sample;
    } else {
      return;
    }
    fit();
  }

  // Another registry answers from now on: begins anew, from where we are.
  void forget() noexcept { samples_.clear(); }

 private:
  static constexpr std::size_t window_count = 64;
  static constexpr std::size_t drift_windows = 16;     // a drift is estimated from so many on
  static constexpr double jitter = 20e3;               // answers that took so much longer count half
  static constexpr double drift_error_max = 20e-6;     // a drift is used once its standard error is smaller
  static constexpr double drift_max = 500e-6;          // no two clocks of computers run further apart
  static constexpr double drift_usual = 100e-6;        // clocks that nobody sets run apart by so much

  struct Sample {
    std::int64_t at_ns;
    std::int64_t offset_ns;
    double trip;
  };

  void fit() {
    const std::int64_t now_ns = samples_.back().at_ns;
    const auto error = [&](const Sample& each) { return each.trip / 2.0 + drift_usual * static_cast<double>(now_ns - each.at_ns); };
    const Sample best = *std::min_element(samples_.begin(), samples_.end(),
                                          [&](const auto& a, const auto& b) { return error(a) < error(b); });
    at_ns_ = best.at_ns;
    offset_ns_ = best.offset_ns;
    drift_ = 0.0;
    if (samples_.size() < drift_windows) return;
    const double quickest = std::min_element(samples_.begin(), samples_.end(), [](const auto& a, const auto& b) {
                              return a.trip < b.trip;
                            })->trip;
    double s = 0.0, st = 0.0, sy = 0.0, stt = 0.0, sty = 0.0, syy = 0.0;  // of weights, times and offsets
    for (const auto& each : samples_) {
      const double weight = 1.0 / ((each.trip - quickest + jitter) * (each.trip - quickest + jitter));
      const auto t = static_cast<double>(each.at_ns - best.at_ns), y = static_cast<double>(each.offset_ns - best.offset_ns);
      s += weight, st += weight * t, sy += weight * y;
      stt += weight * t * t, sty += weight * t * y, syy += weight * y * y;
    }
    const double determinant = s * stt - st * st;
    const double slope = (s * sty - st * sy) / determinant, level = (sy - slope * st) / s;
    const double residual = (syy - level * sy - slope * sty) / static_cast<double>(samples_.size() - 2);
    const double variance = s / determinant * residual;
    if (!(variance < drift_error_max * drift_error_max) || std::abs(slope) > drift_max) return;
    offset_ns_ += std::llround(level);
    drift_ = slope;
  }

  std::deque<Sample> samples_;
  std::int64_t window_ns_ = 0;
  std::int64_t at_ns_ = 0;
  std::int64_t offset_ns_ = 0;  // at that time
  double drift_ = 0.0;          // in 1 ns
};

}  // namespace cortex::detail
