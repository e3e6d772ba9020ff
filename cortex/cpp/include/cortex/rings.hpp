// SPDX-License-Identifier: Apache-2.0
// The rings of one publisher: the newest, which it writes to, and older ones whose messages are still read.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <utility>
#include <vector>

#include "cortex/ring.hpp"
#include "cortex/wire.hpp"

namespace cortex::detail {

// Calls are made under the publisher's lock.
class Rings {
 public:
  using List = std::vector<std::shared_ptr<Ring>>;

  // Messages of a publisher that sends them `exact`ly have one size; else slots are made larger than the first.
  Rings(std::uint64_t source, bool exact) noexcept : source_(source), exact_(exact) {}

  // Null if there is none yet.
  std::shared_ptr<Ring> newest() const { return rings_.empty() ? nullptr : rings_.back(); }

  // The newest ring, made anew for larger messages or more readers. Throws ShmUnavailable.
  std::shared_ptr<Ring> with_room_for(std::size_t size, std::uint32_t shares) {
    const std::shared_ptr<Ring> current = newest();
    const std::uint64_t wanted = 2 * std::uint64_t{shares} + 2;
    const bool fits = current != nullptr && current->slot_bytes() >= size;
    if (fits && current->slots() >= wanted) return current;
    std::uint64_t slot_bytes = exact_ ? size : size + size / 4;
    if (current != nullptr) slot_bytes = std::max(slot_bytes, current->slot_bytes());
    slot_bytes = wire::round_up(slot_bytes, ring::page);
    std::uint64_t slots = std::max(std::clamp<std::uint64_t>(ring_bytes / slot_bytes, 4, 64), wanted);
    slots = std::max<std::uint64_t>(4, std::min(slots, ring_bytes_max / slot_bytes));
    if (fits && current->slots() >= slots) return current;
    try {
      rings_.push_back(std::make_shared<Ring>(source_, ++count_, static_cast<std::uint32_t>(slots), slot_bytes));
    } catch (const ShmUnavailable&) {
      if (fits) return current;
      throw;
    }
    if (rings_.size() > wire::rings_alive) rings_.erase(rings_.begin());
    return rings_.back();
  }

  // Lets older rings go that nobody reads any more.
  void tidy() noexcept {
    while (rings_.size() > 1 && rings_.front()->idle()) rings_.erase(rings_.begin());
  }

  // A reader left or died, or is given messages in another way.
  void free_column(std::uint32_t column) noexcept {
    for (const auto& ring : rings_) ring->free_column(column);
  }

  std::vector<wire::RingPlace> places() const {
    std::vector<wire::RingPlace> places;
    for (const auto& ring : rings_) places.push_back(ring->place());
    return places;
  }

  // Gives all rings away.
  List release() noexcept { return std::exchange(rings_, {}); }

 private:
  static constexpr std::uint64_t ring_bytes = 4u << 20;  // rings of small slots stay in cache
  static constexpr std::uint64_t ring_bytes_max = std::uint64_t{2} << 30;

  std::uint64_t source_;
  bool exact_;
  List rings_;
  std::uint32_t count_ = 0;
};

}  // namespace cortex::detail
