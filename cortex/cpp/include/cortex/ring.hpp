// SPDX-License-Identifier: Apache-2.0
// Rings of message slots in shared memory (WIRE.md, section 6): the publisher's side and the reader's.
#pragma once

#include <atomic>
#include <cerrno>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <memory>
#include <mutex>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "cortex/array.hpp"
#include "cortex/wire.hpp"

#if defined(__linux__)
#include <fcntl.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>
#endif

namespace cortex {

// This memory cannot be made or cannot be trusted; messages still go through sockets.
class ShmUnavailable : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

namespace ring {

constexpr std::size_t page = 4096;
constexpr std::size_t slot_head = 64;  // bytes of a slot's header
constexpr std::uint32_t slots_max = 4096;
constexpr std::uint64_t slot_bytes_max = std::uint64_t{1} << 32;
constexpr std::size_t header_bytes = 72;

struct Layout {
  std::uint64_t leases, headers, slots, total;
};

inline Layout layout(std::uint32_t slots, std::uint64_t slot_bytes) noexcept {
  Layout result{};
  result.leases = page;
  result.headers = page + std::uint64_t{slots} * wire::column_count;
  result.slots = wire::round_up(result.headers + std::uint64_t{slots} * slot_head, page);
  result.total = result.slots + slots * slot_bytes;
  return result;
}

inline void write_header(std::uint8_t* out, std::uint32_t ring, std::uint64_t source, std::uint32_t slots,
                         std::uint64_t slot_bytes) noexcept {
  const Layout places = layout(slots, slot_bytes);
  std::memcpy(out, "CTXRING1", 8);
  wire::store<std::uint32_t>(out + 8, 1);
  wire::store(out + 12, ring);
  wire::store(out + 16, source);
  wire::store(out + 24, slots);
  wire::store(out + 28, wire::column_count);
  wire::store(out + 32, slot_bytes);
  wire::store(out + 40, places.leases);
  wire::store(out + 48, places.headers);
  wire::store(out + 56, places.slots);
  wire::store(out + 64, places.total);
}

#if defined(__linux__)

[[noreturn]] inline void unavailable(const std::string& what) { throw ShmUnavailable(what + ": " + std::strerror(errno)); }

class Descriptor {
 public:
  explicit Descriptor(int fd = -1) noexcept : fd_(fd) {}
  Descriptor(Descriptor&& other) noexcept : fd_(std::exchange(other.fd_, -1)) {}
  Descriptor& operator=(Descriptor&& other) noexcept {
    std::swap(fd_, other.fd_);
    return *this;
  }
  ~Descriptor() {
    if (fd_ >= 0) ::close(fd_);
  }
  int get() const noexcept { return fd_; }

 private:
  int fd_;
};

class Mapping {
 public:
  Mapping() noexcept = default;
  Mapping(int fd, std::uint64_t offset, std::uint64_t size, bool writable) : size_(static_cast<std::size_t>(size)) {
    void* at = ::mmap(nullptr, size_, writable ? PROT_READ | PROT_WRITE : PROT_READ, MAP_SHARED | MAP_POPULATE, fd,
                      static_cast<off_t>(offset));
    if (at == MAP_FAILED) unavailable("cannot map " + std::to_string(size) + " bytes");
    data_ = static_cast<std::uint8_t*>(at);
  }
  Mapping(Mapping&& other) noexcept : data_(std::exchange(other.data_, nullptr)), size_(other.size_) {}
  Mapping& operator=(Mapping&& other) noexcept {
    std::swap(data_, other.data_);
    std::swap(size_, other.size_);
    return *this;
  }
  ~Mapping() {
    if (data_ != nullptr) ::munmap(data_, size_);
  }
  std::uint8_t* data() const noexcept { return data_; }

 private:
  std::uint8_t* data_ = nullptr;
  std::size_t size_ = 0;
};

#endif

}  // namespace ring

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
    fd_ = ring::Descriptor(::memfd_create(name, MFD_CLOEXEC | MFD_ALLOW_SEALING));
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
  ring::Descriptor fd_;
  ring::Mapping memory_;
  std::uint32_t last_ = 0;
  std::vector<std::uint8_t> busy_;
  std::vector<std::uint64_t> state_;    // readers could write to the one in the ring
  std::vector<std::uint64_t> granted_;  // columns of a slot's message, some given back
  std::vector<std::uint32_t> held_;     // slots of a column, some given back
  std::vector<std::atomic<std::uint32_t>> pins_;
  std::atomic<std::uint32_t> pinned_{0};
};

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
    const ring::Descriptor fd = open(place, layout_.total);
    std::uint8_t expected[ring::header_bytes];
    std::uint8_t found[ring::header_bytes];
    ring::write_header(expected, place.ring, source, slots_, slot_bytes_);
    if (::pread(fd.get(), found, sizeof found, 0) != static_cast<ssize_t>(sizeof found) ||
        std::memcmp(found, expected, sizeof found) != 0) {
      throw ShmUnavailable("ring " + std::to_string(place.ring) + " has another header than announced");
    }
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

  // Copies a message that is not leased to this reader; false if it is gone, or goes meanwhile.
  bool copy(std::uint32_t slot, std::uint64_t sequence, std::uint64_t size, std::uint8_t* out) {
    const std::lock_guard<std::mutex> lock(mutex_);
    check(slot, size);
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

  static ring::Descriptor open(const wire::RingPlace& place, std::uint64_t total) {
    const std::string path = "/proc/" + std::to_string(place.pid) + "/fd/" + std::to_string(place.fd);
    struct stat status {};
    const auto trusted = [&] {
      return S_ISREG(status.st_mode) && status.st_uid == ::geteuid() &&
             static_cast<std::uint64_t>(status.st_size) == total;
    };
    if (::stat(path.c_str(), &status) != 0) ring::unavailable(path);
    if (!trusted()) throw ShmUnavailable(path + " is not memory of ours in this size");
    ring::Descriptor fd(::open(path.c_str(), O_RDWR | O_CLOEXEC | O_NOCTTY | O_NONBLOCK));
    if (fd.get() < 0 || ::fstat(fd.get(), &status) != 0) ring::unavailable(path);
    if (!trusted()) throw ShmUnavailable(path + " is not memory of ours in this size");
    const int wanted = F_SEAL_SHRINK | F_SEAL_GROW;
    const int seals = ::fcntl(fd.get(), F_GET_SEALS);
    if (seals < 0 || (seals & wanted) != wanted) throw ShmUnavailable(path + " is not sealed: its size could change");
    return fd;
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
    if (closed_ || slot >= slots_ || size > slot_bytes_) {
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
  bool idle() noexcept { return true; }
};

class RingView {
 public:
  RingView(std::uint64_t, const wire::RingPlace&, std::uint32_t) { throw ShmUnavailable("memfd needs Linux"); }
  Span<const std::uint8_t> take(std::uint32_t, std::uint64_t, std::uint64_t, std::shared_ptr<const void>&) {
    return {};
  }
  void heal(std::uint64_t) {}
  bool copy(std::uint32_t, std::uint64_t, std::uint64_t, std::uint8_t*) { return false; }
  void close() noexcept {}
};

#endif

}  // namespace cortex
