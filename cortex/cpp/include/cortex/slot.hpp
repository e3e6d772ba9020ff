// SPDX-License-Identifier: Apache-2.0
// Where a publisher writes a large message, and messages of ZeroMQ that read it there.
#pragma once

#include <atomic>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <utility>
#include <vector>

#include <zmq.hpp>

#include "cortex/array.hpp"
#include "cortex/ring.hpp"

namespace cortex::detail {

// Where a large message is written: a slot of a ring, or private memory where there is none.
struct Slot {
  Span<std::uint8_t> buffer;
  std::shared_ptr<Ring> ring;
  int index = -1;
  std::shared_ptr<std::vector<std::uint8_t>> memory;
};

inline Slot private_slot(std::size_t size) {
  auto memory = std::make_shared<std::vector<std::uint8_t>>(size);
  return {{memory->data(), size}, nullptr, -1, std::move(memory)};
}

// The body where it lies in its ring; the slot is not written again before ZeroMQ's thread has let go of it.
inline zmq::message_t pinned_message(const Slot& slot, std::size_t size) {
  struct Pin {
    std::shared_ptr<Ring> ring;
    int index;
    ~Pin() { ring->unpin(index); }
  };
  slot.ring->pin(slot.index);
  auto* held = new Pin{slot.ring, slot.index};
  return {slot.buffer.data(), size, [](void*, void* hint) { delete static_cast<Pin*>(hint); }, held};
}

// The body in memory of its own, which counts in `total` as long as ZeroMQ has it.
inline zmq::message_t private_message(const Slot& slot, std::size_t size,
                                      const std::shared_ptr<std::atomic<std::size_t>>& total) {
  struct Pin {
    std::shared_ptr<const std::vector<std::uint8_t>> memory;
    std::shared_ptr<std::atomic<std::size_t>> total;
    ~Pin() { *total -= memory->size(); }
  };
  auto memory = slot.memory;
  if (memory == nullptr) {
    memory = std::make_shared<std::vector<std::uint8_t>>(slot.buffer.data(), slot.buffer.data() + size);
  }
  *total += memory->size();
  std::uint8_t* const data = memory->data();
  auto* held = new Pin{std::move(memory), total};
  return {data, size, [](void*, void* hint) { delete static_cast<Pin*>(hint); }, held};
}

}  // namespace cortex::detail
