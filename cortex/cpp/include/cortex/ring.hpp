// SPDX-License-Identifier: Apache-2.0
// Rings of message slots in shared memory (WIRE.md, section 6): the publisher's side.
#pragma once

#include <atomic>
#include <cerrno>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <stdexcept>
#include <string>
#include <vector>

#include "cortex/array.hpp"
#include "cortex/memory.hpp"
#include "cortex/wire.hpp"

namespace cortex {

#if defined(__linux__)

// The publisher's side. Its calls are made under the publisher's lock; the memory that `buffer` names is written
// without it, between `acquire` and `commit`.
class Ring {
 public:
  Ring(std::uint64_t source, std::uint32_t number, std::uint32_t slots, std::uint64_t slot_bytes)
      : number_(number),
        slots_(slots),
        slot_bytes_(wire::round_up(slot_bytes, ring::page)),
        layout_(ring::layout(slots, slot_bytes_)),
        busy_(slots, 0),
        state_(slots, 0),
        granted_(slots, 0),
        held_(wire::column_count, 0),
        pins_(slots) {
    if (slots == 0 || slots > ring::slots_max || slot_bytes == 0 || slot_bytes > ring::slot_bytes_max) {
      throw std::invalid_argument("a ring of " + std::to_string(slots) + " slots of " + std::to_string(slot_bytes) +
                                  " bytes is not possible");
    }
    char name[64];
    std::snprintf(name, sizeof name, "cortex-%016llx-%u", static_cast<unsigned long long>(source), number);
    fd_ = runtime::Descriptor(::memfd_create(name, MFD_CLOEXEC | MFD_ALLOW_SEALING));
    if (fd_.get() < 0) ring::unavailable("memfd_create");
    const auto total = static_cast<off_t>(layout_.total);
    // The pages are taken now: one that is missing is an error here, instead of SIGBUS later.
    const int missing = ::fchmod(fd_.get(), 0600) != 0 || ::ftruncate(fd_.get(), total) != 0
                            ? errno
                            : ::posix_fallocate(fd_.get(), 0, total);
    if (missing != 0) {
      errno = missing;
      ring::unavailable("a ring of " + std::to_string(total) + " bytes");
    }
    if (::fcntl(fd_.get(), F_ADD_SEALS, F_SEAL_SHRINK | F_SEAL_GROW | F_SEAL_SEAL) != 0) ring::unavailable("seal");
    memory_ = ring::Mapping(fd_.get(), 0, layout_.total, true);
    ring::write_header(memory_.data(), number, source, slots, slot_bytes_);
    last_ = slots - 1;
  }

  wire::RingPlace place() const noexcept {
    return {number_, slots_, slot_bytes_, static_cast<std::uint32_t>(::getpid()), fd_.get()};
  }
  std::uint32_t number() const noexcept { return number_; }
  std::uint32_t slots() const noexcept { return slots_; }
  std::uint64_t slot_bytes() const noexcept { return slot_bytes_; }

  // A free slot, the longest written first, or -1. It is being written until `commit` or `abandon`.
  int acquire() noexcept {
    std::uint32_t slot = last_;
    for (std::uint32_t tried = 0; tried < slots_; ++tried) {
      slot = slot + 1 == slots_ ? 0 : slot + 1;
      if (busy_[slot] != 0 || pins_[slot].load(std::memory_order_acquire) != 0 || !is_free(slot)) continue;
      last_ = slot;
      busy_[slot] = 1;
      __atomic_store_n(word(slot, 0), ++state_[slot], __ATOMIC_RELAXED);
      std::atomic_thread_fence(std::memory_order_release);  // odd before the content changes
      return static_cast<int>(slot);
    }
    return -1;
  }

  Span<std::uint8_t> buffer(int slot) const noexcept {
    return {memory_.data() + layout_.slots + static_cast<std::uint64_t>(slot) * slot_bytes_,
            static_cast<std::size_t>(slot_bytes_)};
  }

  // Finishes a slot and leases it to the columns of `mask`.
  void commit(int slot, std::uint64_t sequence, std::uint64_t size, std::uint64_t mask) noexcept {
    const auto index = static_cast<std::uint32_t>(slot);
    __atomic_store_n(word(index, 1), sequence, __ATOMIC_RELAXED);
    __atomic_store_n(word(index, 2), size, __ATOMIC_RELAXED);
    __atomic_store_n(word(index, 0), ++state_[index], __ATOMIC_RELEASE);
    for (std::uint32_t column = 0; mask >> column != 0; ++column) {
      if ((mask >> column & 1) != 0) {
        __atomic_store_n(lease(index, column), std::uint8_t{1}, __ATOMIC_RELEASE);
        ++held_[column];
      }
      if (column == 63) break;
    }
    granted_[index] = mask;
    busy_[index] = 0;
  }

  void abandon(int slot) noexcept { commit(slot, ~std::uint64_t{0}, 0, 0); }

  // Takes back the leases of a message that could not be sent.
  void revoke(int slot, std::uint64_t mask) noexcept {
    const auto index = static_cast<std::uint32_t>(slot);
    for (std::uint32_t column = 0; column < wire::column_count; ++column) {
      if ((mask >> column & 1) != 0) __atomic_store_n(lease(index, column), std::uint8_t{0}, __ATOMIC_RELEASE);
    }
    is_free(index);
  }

  // Keeps a slot from being written, because a socket still reads from it; pins are counted, and end in any thread.
  void pin(int slot) noexcept {
    pins_[static_cast<std::size_t>(slot)].fetch_add(1, std::memory_order_relaxed);
    pinned_.fetch_add(1, std::memory_order_relaxed);
  }
  void unpin(int slot) noexcept {
    pins_[static_cast<std::size_t>(slot)].fetch_sub(1, std::memory_order_release);
    pinned_.fetch_sub(1, std::memory_order_relaxed);
  }
  std::uint32_t pinned() const noexcept { return pinned_.load(std::memory_order_relaxed); }

  // Slots that a column holds now, messages on the way included.
  std::uint32_t outstanding(std::uint32_t column, std::uint32_t enough) noexcept {
    if (held_[column] >= enough) {  // granted is an upper bound of held: most calls need no look at the table
      for (std::uint32_t slot = 0; slot < slots_; ++slot) prune(slot);
    }
    return held_[column];
  }

  // Its reader left or died.
  void free_column(std::uint32_t column) noexcept {
    for (std::uint32_t slot = 0; slot < slots_; ++slot) {
      __atomic_store_n(lease(slot, column), std::uint8_t{0}, __ATOMIC_RELEASE);
      prune(slot);
    }
  }

  // Whether some reader has a message of it, or will have one.
  bool is_leased() noexcept {
    for (std::uint32_t slot = 0; slot < slots_; ++slot) {
      if (!is_free(slot)) return true;
    }
    return false;
  }

  bool idle() noexcept {
    for (std::uint32_t slot = 0; slot < slots_; ++slot) {
      if (busy_[slot] != 0 || pins_[slot].load(std::memory_order_acquire) != 0 || !is_free(slot)) return false;
    }
    return true;
  }

 private:
  std::uint8_t* lease(std::uint32_t slot, std::uint32_t column) const noexcept {
    return memory_.data() + layout_.leases + slot * wire::column_count + column;
  }
  std::uint64_t* word(std::uint32_t slot, std::uint32_t index) const noexcept {
    return reinterpret_cast<std::uint64_t*>(memory_.data() + layout_.headers + slot * ring::slot_head) + index;
  }
  // Forgets grants that were given back.
  void prune(std::uint32_t slot) noexcept {
    std::uint64_t left = granted_[slot];
    for (std::uint32_t column = 0; left >> column != 0; ++column) {
      if ((left >> column & 1) != 0 && __atomic_load_n(lease(slot, column), __ATOMIC_ACQUIRE) == 0) {
        left &= ~(std::uint64_t{1} << column);
        --held_[column];
      }
      if (column == 63) break;
    }
    granted_[slot] = left;
  }
  bool is_free(std::uint32_t slot) noexcept {
    if (granted_[slot] != 0) prune(slot);
    return granted_[slot] == 0;
  }

  std::uint32_t number_;
  std::uint32_t slots_;
  std::uint64_t slot_bytes_;
  ring::Layout layout_;
  runtime::Descriptor fd_;
  ring::Mapping memory_;
  std::uint32_t last_ = 0;
  std::vector<std::uint8_t> busy_;
  std::vector<std::uint64_t> state_;    // readers could write to the one in the ring
  std::vector<std::uint64_t> granted_;  // columns of a slot's message, some given back
  std::vector<std::uint32_t> held_;     // slots of a column, some given back
  std::vector<std::atomic<std::uint32_t>> pins_;
  std::atomic<std::uint32_t> pinned_{0};
};

#else

// Without memfd there are no rings: large messages go through sockets.
class Ring {
 public:
  Ring(std::uint64_t, std::uint32_t, std::uint32_t, std::uint64_t) { throw ShmUnavailable("memfd needs Linux"); }
  wire::RingPlace place() const noexcept { return {}; }
  std::uint32_t number() const noexcept { return 0; }
  std::uint32_t slots() const noexcept { return 0; }
  std::uint64_t slot_bytes() const noexcept { return 0; }
  int acquire() noexcept { return -1; }
  Span<std::uint8_t> buffer(int) const noexcept { return {}; }
  void commit(int, std::uint64_t, std::uint64_t, std::uint64_t) noexcept {}
  void abandon(int) noexcept {}
  void revoke(int, std::uint64_t) noexcept {}
  void pin(int) noexcept {}
  void unpin(int) noexcept {}
  std::uint32_t pinned() const noexcept { return 0; }
  std::uint32_t outstanding(std::uint32_t, std::uint32_t) noexcept { return 0; }
  void free_column(std::uint32_t) noexcept {}
  bool is_leased() noexcept { return false; }
  bool idle() noexcept { return true; }
};

#endif

}  // namespace cortex
