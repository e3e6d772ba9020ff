// SPDX-License-Identifier: Apache-2.0
// Events of Cortex as the encoding "mono" of event_camera_msgs/EventPacket: 8 bytes an event, with nanoseconds.
#pragma once
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <stdexcept>
#include <vector>

namespace neurosim_cpp_examples {

// Returns the time from which the words count [ns]: the first event's. Throws std::out_of_range for a packet of over 4.2 s.
template <typename Events>
std::uint64_t encode_mono(const Events& events, std::vector<std::uint8_t>& out) {
  const std::size_t count = events.t.size();
  const std::int64_t base_us = count > 0 ? events.t.data()[0] : events.start_ns / 1000;
  out.resize(8 * count);
  for (std::size_t n = 0; n < count; ++n) {
    const std::uint64_t later_ns = 1000 * static_cast<std::uint64_t>(events.t.data()[n] - base_us);
    if (later_ns >> 32U) throw std::out_of_range("a packet of events is longer than 4.2 s, or not in the order of time");
    const std::uint64_t word = static_cast<std::uint64_t>(events.polarity.data()[n] != 0) << 63U |
                               static_cast<std::uint64_t>(events.y.data()[n]) << 48U |
                               static_cast<std::uint64_t>(events.x.data()[n]) << 32U | later_ns;
    std::memcpy(out.data() + 8 * n, &word, sizeof word);  // little endian, as all that runs ROS 2
  }
  return 1000 * static_cast<std::uint64_t>(base_us);
}

}  // namespace neurosim_cpp_examples
