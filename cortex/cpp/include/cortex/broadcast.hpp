// SPDX-License-Identifier: Apache-2.0
// The ring that carries a publisher's frames to the readers of its host; what it does is in `broadcast.h`.
#pragma once

#include <cerrno>
#include <cstddef>
#include <cstdint>
#include <map>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include <unistd.h>

#include "cortex/array.hpp"
#include "cortex/broadcast.h"

namespace cortex::detail {

constexpr std::size_t ring_bytes = 1 << 19;

// Where a node's local readers ask for rings. Without one they go on with ZeroMQ.
class Listener {
 public:
  explicit Listener(const std::string& path) : fd_(cortex_listen(path.c_str())) {}
  Listener(const Listener&) = delete;
  Listener& operator=(const Listener&) = delete;
  ~Listener() {
    for (const int fd : unheard_) ::close(fd);
    for (const auto& heard : heard_) cortex_hello_close(&heard.second);
    if (fd_ >= 0) ::close(fd_);
  }

  // What a reader has handed over, if it has asked for the ring of a publisher; now the caller's.
  bool take(std::uint64_t source, std::uint64_t reader, CortexHello& hello) {
    for (int fd = -1; fd_ >= 0 && (fd = cortex_accept(fd_)) >= 0;) unheard_.push_back(fd);
    for (const int fd : std::exchange(unheard_, {})) {
      CortexHello said;
      if (cortex_hear(fd, &said) == 0) {
        heard_[{said.source, said.reader}] = said;
      } else if (errno == EAGAIN && unheard_.size() < waiting_max) {
        unheard_.push_back(fd);
      } else {
        ::close(fd);
      }
    }
    const auto found = heard_.find({source, reader});
    if (found == heard_.end()) {
      if (heard_.size() > waiting_max) forget();
      return false;
    }
    hello = found->second;
    heard_.erase(found);
    return true;
  }

 private:
  static constexpr std::size_t waiting_max = 256;  // who have asked and not attached

  void forget() {
    for (const auto& heard : heard_) cortex_hello_close(&heard.second);
    heard_.clear();
  }

  int fd_;
  std::vector<int> unheard_;
  std::map<std::pair<std::uint64_t, std::uint64_t>, CortexHello> heard_;
};

// The publisher's end. Not for several threads at once.
class Broadcast {
 public:
  // Null if there is no memory.
  static std::unique_ptr<Broadcast> open(std::uint64_t source) {
    std::unique_ptr<Broadcast> made(new Broadcast);
    if (cortex_writer_open(&made->writer_, source, ring_bytes) < 0) return nullptr;
    made->open_ = true;
    return made;
  }
  Broadcast(const Broadcast&) = delete;
  Broadcast& operator=(const Broadcast&) = delete;
  ~Broadcast() {
    if (open_) cortex_writer_close(&writer_);
  }

  // The reader's number, -1 if it has left; the descriptors are ours in any case.
  int add(const CortexHello& hello, bool strict, std::uint64_t first) noexcept {
    return cortex_writer_add(&writer_, &hello, strict ? 1 : 0, first);
  }
  void remove(int member) noexcept { cortex_writer_remove(&writer_, member); }
  // CORTEX_WRITTEN, CORTEX_LATE, CORTEX_FULL or CORTEX_TOO_LARGE.
  int put(Span<const std::uint8_t> frame) noexcept { return cortex_writer_put(&writer_, frame.data(), frame.size(), 0); }
  // The last frame of all, of 64 bytes.
  void end(Span<const std::uint8_t> frame) noexcept { cortex_writer_end(&writer_, frame.data(), frame.size()); }
  // Whether a reliable reader has no room for a frame.
  bool is_full(int member, std::size_t size) noexcept {
    return cortex_member_is_full(&writer_, &writer_.members[member], cortex_entry_bytes(size) + CORTEX_SPARE_BYTES) != 0;
  }
  // Waits for it no more, until it has read half.
  void give_up(int member) noexcept { writer_.members[member].late = 1; }

 private:
  Broadcast() = default;
  CortexWriter writer_{};
  bool open_ = false;
};

// The subscriber's end. Not for several threads at once.
class RingReader {
 public:
  // Asks for a publisher's ring at its node; null if there is none to be had.
  static std::unique_ptr<RingReader> open(const std::string& path, std::uint64_t source, std::uint64_t number) {
    std::unique_ptr<RingReader> made(new RingReader);
    if (cortex_reader_open(&made->reader_, path.c_str(), source, number) < 0) return nullptr;
    made->open_ = true;
    return made;
  }
  RingReader(const RingReader&) = delete;
  RingReader& operator=(const RingReader&) = delete;
  ~RingReader() {
    if (open_) cortex_reader_close(&reader_);
  }

  int fd() const noexcept { return reader_.bell; }
  bool broken() const noexcept { return reader_.broken != 0; }
  // Whether the publisher has taken us in.
  bool welcomed() noexcept { return cortex_reader_welcomed(&reader_) != 0; }

  // The next frame, until the next call; empty if there is none: then the descriptor tells when one comes.
  Span<const std::uint8_t> next() {
    do {
      const std::uint8_t* data = nullptr;
      std::int64_t size = 0;
      while ((size = cortex_reader_peek(&reader_, &data)) > 0) {
        frame_.assign(data, data + size);
        if (cortex_reader_take(&reader_, size) == 0) continue;  // it was written over meanwhile
        cortex_reader_disarm(&reader_);
        return {frame_.data(), frame_.size()};
      }
    } while (!broken() && cortex_reader_arm(&reader_) == 0);
    return {};
  }

 private:
  RingReader() = default;
  CortexReader reader_{};
  bool open_ = false;
  std::vector<std::uint8_t> frame_;
};

}  // namespace cortex::detail
