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
#include "cortex/broadcast.h"

namespace cortex::detail {

// Where a large message is written: a slot of the ring, or private memory where there is none.
struct Slot {
  Span<std::uint8_t> buffer;
  int index = -1;                  // of the slot; -1: there is none
  std::shared_ptr<CortexMap> map;  // the ring's memory
  std::shared_ptr<std::vector<std::uint8_t>> memory;
  std::int64_t waited_ns = 0;  // for how long readers have held it up
};

inline Slot private_slot(std::size_t size) {
  auto memory = std::make_shared<std::vector<std::uint8_t>>(size);
  return {{memory->data(), size}, -1, nullptr, std::move(memory), 0};
}

// Most bytes of bodies that wait in the strict sockets of a publisher: few enough to be sent from the cache.
constexpr std::size_t strict_bytes = 8 << 20;

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
