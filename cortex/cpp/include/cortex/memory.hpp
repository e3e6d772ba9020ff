// SPDX-License-Identifier: Apache-2.0
// Memory that two processes share: how a ring is laid out, its file and its mappings (WIRE.md, section 6).
#pragma once

#include <cerrno>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <stdexcept>
#include <string>
#include <utility>

#include "cortex/runtime.hpp"
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

// The publisher's descriptors can be seen, but this one is closed, or something else by now.
class RingGone : public ShmUnavailable {
 public:
  using ShmUnavailable::ShmUnavailable;
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
}  // namespace cortex
