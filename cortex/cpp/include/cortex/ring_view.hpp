// SPDX-License-Identifier: Apache-2.0
// Rings of message slots in shared memory (WIRE.md, section 6): the reader's side.
#pragma once

#include <atomic>
#include <cerrno>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <memory>
#include <mutex>
#include <string>
#include <utility>
#include <vector>

#include "cortex/array.hpp"
#include "cortex/memory.hpp"
#include "cortex/wire.hpp"

namespace cortex {

#if defined(__linux__)

// The reader's side: slots are mapped read-only. Thread-safe; leases may end in any thread.
class RingView : public std::enable_shared_from_this<RingView> {
 public:
  RingView(std::uint64_t source, const wire::RingPlace& place, std::uint32_t column)
      : slots_(place.slots), slot_bytes_(place.slot_bytes), column_(column), layout_{} {
    if (place.slots == 0 || place.slots > ring::slots_max || place.slot_bytes == 0 ||
        place.slot_bytes > ring::slot_bytes_max || place.slot_bytes % ring::page != 0 ||
        column >= wire::column_count || place.pid == 0 || place.fd < 0) {
      throw ShmUnavailable("a ring of " + std::to_string(place.slots) + " slots of " +
                           std::to_string(place.slot_bytes) + " bytes is not possible");
    }
    held_.assign(slots_, false);
    layout_ = ring::layout(slots_, slot_bytes_);
    const runtime::Descriptor fd = open(source, place, layout_.total);
    head_ = ring::Mapping(fd.get(), 0, layout_.slots, true);
    body_ = ring::Mapping(fd.get(), layout_.slots, layout_.total - layout_.slots, false);
  }

  ~RingView() { close(); }
  RingView(const RingView&) = delete;
  RingView& operator=(const RingView&) = delete;

  // The message in a slot that was granted to this reader; it is given back with the last copy of `owner`.
  Span<const std::uint8_t> take(std::uint32_t slot, std::uint64_t sequence, std::uint64_t size,
                                std::shared_ptr<const void>& owner) {
    const std::lock_guard<std::mutex> lock(mutex_);
    check(slot, size);
    if (held_[slot] || __atomic_load_n(lease(slot), __ATOMIC_ACQUIRE) != 1 ||
        __atomic_load_n(word(slot, 1), __ATOMIC_RELAXED) != sequence ||
        __atomic_load_n(word(slot, 2), __ATOMIC_RELAXED) != size) {
      throw MalformedMessage("slot " + std::to_string(slot) + " does not hold message " + std::to_string(sequence) +
                             " of " + std::to_string(size) + " bytes for this reader");
    }
    owner = std::make_shared<Lease>(shared_from_this(), slot);
    held_[slot] = true;
    return {body_.data() + slot * slot_bytes_, static_cast<std::size_t>(size)};
  }

  // Gives back the slots of messages older than one that has arrived, and which therefore never come.
  void heal(std::uint64_t before_sequence) {
    const std::lock_guard<std::mutex> lock(mutex_);
    if (closed_) return;
    for (std::uint32_t slot = 0; slot < slots_; ++slot) {
      if (!held_[slot] && __atomic_load_n(lease(slot), __ATOMIC_ACQUIRE) == 1 &&
          __atomic_load_n(word(slot, 1), __ATOMIC_RELAXED) < before_sequence) {
        __atomic_store_n(lease(slot), std::uint8_t{0}, __ATOMIC_RELEASE);
      }
    }
  }

  // Whether the ring has such a slot, and room for so much in it.
  bool has(std::uint32_t slot, std::uint64_t size) const noexcept { return slot < slots_ && size <= slot_bytes_; }

  // Whether this reader holds no slot: no message is in use, and none that was granted is on its way.
  bool idle() { return count(false) == 0; }

  // Whether a granted message has not been taken yet.
  bool is_awaited() { return count(true) > 0; }

  // Copies a message that is not leased to this reader; false if it is gone, or goes meanwhile.
  bool copy(std::uint32_t slot, std::uint64_t sequence, std::uint64_t size, std::uint8_t* out) {
    const std::lock_guard<std::mutex> lock(mutex_);
    if (closed_ || !has(slot, size)) return false;
    const std::uint64_t state = __atomic_load_n(word(slot, 0), __ATOMIC_ACQUIRE);
    if (state == 0 || (state & 1) != 0 || __atomic_load_n(word(slot, 1), __ATOMIC_RELAXED) != sequence ||
        __atomic_load_n(word(slot, 2), __ATOMIC_RELAXED) != size) {
      return false;
    }
    std::memcpy(out, body_.data() + slot * slot_bytes_, static_cast<std::size_t>(size));
    std::atomic_thread_fence(std::memory_order_acquire);
    return __atomic_load_n(word(slot, 0), __ATOMIC_RELAXED) == state;
  }

  // Gives everything back, before the publisher is told to free the column. Messages that are still in use stay
  // valid: their slots become private copies in place.
  void close() noexcept {
    const std::lock_guard<std::mutex> lock(mutex_);
    if (closed_) return;
    closed_ = true;
    for (std::uint32_t slot = 0; slot < slots_; ++slot) {
      if (held_[slot] && !make_private(slot)) continue;  // no memory: the slot stays leased, rather than change
      __atomic_store_n(lease(slot), std::uint8_t{0}, __ATOMIC_RELEASE);
    }
  }

 private:
  struct Lease {
    Lease(std::shared_ptr<RingView> from, std::uint32_t index) noexcept : view(std::move(from)), slot(index) {}
    Lease(const Lease&) = delete;
    Lease& operator=(const Lease&) = delete;
    ~Lease() { view->give_back(slot); }
    std::shared_ptr<RingView> view;
    std::uint32_t slot;
  };

  static runtime::Descriptor open(std::uint64_t source, const wire::RingPlace& place, std::uint64_t total) {
    const std::string folder = "/proc/" + std::to_string(place.pid) + "/fd";
    const std::string path = folder + "/" + std::to_string(place.fd);
    struct stat status {};
    if (::stat(path.c_str(), &status) != 0) missing(folder, path);  // before opening: to open a device may do something
    check_file(folder, path, status, total);
    runtime::Descriptor fd(::open(path.c_str(), O_RDWR | O_CLOEXEC | O_NOCTTY | O_NONBLOCK));
    if (fd.get() < 0 || ::fstat(fd.get(), &status) != 0) missing(folder, path);
    check_file(folder, path, status, total);
    const int wanted = F_SEAL_SHRINK | F_SEAL_GROW | F_SEAL_SEAL;
    const int seals = ::fcntl(fd.get(), F_GET_SEALS);
    if (seals < 0 || (seals & wanted) != wanted) other(folder, path + " is not sealed: its size could change");
    std::uint8_t expected[ring::header_bytes];
    std::uint8_t found[ring::header_bytes];
    ring::write_header(expected, place.ring, source, place.slots, place.slot_bytes);
    if (::pread(fd.get(), found, sizeof found, 0) != static_cast<ssize_t>(sizeof found) ||
        std::memcmp(found, expected, sizeof found) != 0) {
      other(folder, path + " has another header than ring " + std::to_string(place.ring));
    }
    return fd;
  }

  static void check_file(const std::string& folder, const std::string& path, const struct stat& status,
                         std::uint64_t total) {
    if (!S_ISREG(status.st_mode) || status.st_uid != ::geteuid() ||
        static_cast<std::uint64_t>(status.st_size) != total) {
      other(folder, path + " is not memory of ours in this size");
    }
  }

  // What is there is not what it was, if the publisher can be reached from here.
  [[noreturn]] static void other(const std::string& folder, const std::string& what) {
    if (::access(folder.c_str(), R_OK | X_OK) == 0) throw RingGone(what);
    throw ShmUnavailable(what);
  }

  [[noreturn]] static void missing(const std::string& folder, const std::string& path) {
    if (errno == ENOENT) other(folder, path + " is closed");
    ring::unavailable(path);
  }

  // Slots that are leased to this reader, or only those that it has not taken yet.
  std::uint32_t count(bool awaited) {
    const std::lock_guard<std::mutex> lock(mutex_);
    std::uint32_t result = 0;
    for (std::uint32_t slot = 0; slot < slots_ && !closed_; ++slot) {
      if (__atomic_load_n(lease(slot), __ATOMIC_ACQUIRE) == 1 && !(awaited && held_[slot])) ++result;
    }
    return result;
  }

  void give_back(std::uint32_t slot) noexcept {
    const std::lock_guard<std::mutex> lock(mutex_);
    held_[slot] = false;
    if (!closed_) __atomic_store_n(lease(slot), std::uint8_t{0}, __ATOMIC_RELEASE);
  }

  bool make_private(std::uint32_t slot) noexcept {
    const auto size = static_cast<std::size_t>(slot_bytes_);
    void* copy = ::mmap(nullptr, size, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
    if (copy == MAP_FAILED) return false;
    std::uint8_t* place = body_.data() + slot * slot_bytes_;
    std::memcpy(copy, place, size);
    if (::mremap(copy, size, size, MREMAP_MAYMOVE | MREMAP_FIXED, place) == MAP_FAILED) {
      ::munmap(copy, size);
      return false;
    }
    return true;
  }

  void check(std::uint32_t slot, std::uint64_t size) const {
    if (closed_ || !has(slot, size)) {
      throw MalformedMessage("slot " + std::to_string(slot) + " of " + std::to_string(slots_) + " cannot hold " +
                             std::to_string(size) + " bytes");
    }
  }
  std::uint8_t* lease(std::uint32_t slot) const noexcept {
    return head_.data() + layout_.leases + slot * wire::column_count + column_;
  }
  std::uint64_t* word(std::uint32_t slot, std::uint32_t index) const noexcept {
    return reinterpret_cast<std::uint64_t*>(head_.data() + layout_.headers + slot * ring::slot_head) + index;
  }

  std::uint32_t slots_;
  std::uint64_t slot_bytes_;
  std::uint32_t column_;
  ring::Layout layout_;
  std::vector<bool> held_;
  ring::Mapping head_;
  ring::Mapping body_;
  std::mutex mutex_;
  bool closed_ = false;
};

#else

// Without memfd there is nothing to look at.
class RingView {
 public:
  RingView(std::uint64_t, const wire::RingPlace&, std::uint32_t) { throw ShmUnavailable("memfd needs Linux"); }
  Span<const std::uint8_t> take(std::uint32_t, std::uint64_t, std::uint64_t, std::shared_ptr<const void>&) {
    return {};
  }
  void heal(std::uint64_t) {}
  bool copy(std::uint32_t, std::uint64_t, std::uint64_t, std::uint8_t*) { return false; }
  bool has(std::uint32_t, std::uint64_t) const noexcept { return false; }
  bool idle() { return true; }
  bool is_awaited() { return false; }
  void close() noexcept {}
};

#endif

}  // namespace cortex
