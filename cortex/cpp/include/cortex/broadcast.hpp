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
#include "cortex/wire.hpp"

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
    for (std::size_t count = 0; fd_ >= 0 && count < waiting_max; ++count) {  // others may come faster than they can be taken in
      const int fd = cortex_accept(fd_);
      if (fd < 0) break;
      unheard_.push_back(fd);
    }
    for (const int fd : std::exchange(unheard_, {})) {
      CortexHello said;
      if (cortex_hear(fd, &said) == 0) {
        heard_[{said.source, said.reader}] = said;
      } else if (errno == EAGAIN && unheard_.size() < waiting_max) {
        unheard_.push_back(fd);
      } else {
        heard_other_version = heard_other_version || errno == EPROTONOSUPPORT;
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

  bool heard_other_version = false;  // of a reader that asked for a ring of another kind

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

  int fd() const noexcept { return reader_.wakeup; }
  // CORTEX_SOUND; CORTEX_BROKEN or CORTEX_ENDED if nothing more comes through it.
  int state() const noexcept { return reader_.state; }
  // 1 if the publisher has taken us in, -1 if we cannot map its ring, else 0.
  int welcomed() noexcept { return cortex_reader_welcomed(&reader_); }
  // The sequence of the first message for us, then.
  std::uint64_t first() const noexcept { return reader_.first; }
  // Whether the next message waits, because too many large ones are kept.
  bool is_crowded() const noexcept { return is_crowded_; }
  // Leaves it out.
  void pass_over() noexcept {
    if (is_crowded_) cortex_reader_pass_over(&reader_);
    is_crowded_ = false;
  }
  // The body that the last frame names, and what keeps it; null if it names none.
  std::shared_ptr<const void> take_body(Span<const std::uint8_t>& body) noexcept {
    body = body_;
    return std::move(owner_);
  }

  // The next frame, until the next call; empty if there is none: then the descriptor tells when one comes.
  Span<const std::uint8_t> next() {
    owner_.reset();
    is_crowded_ = false;
    do {
      const std::uint8_t* data = nullptr;
      std::int64_t size = 0;
      while ((size = cortex_reader_peek(&reader_, &data)) > 0) {
        frame_.assign(data, data + size);
        CortexBody found;
        const int counts = cortex_reader_finish(&reader_, frame_.data(), size, &found);
        is_crowded_ = counts < 0;
        if (is_crowded_) return {};
        if (counts == 0) continue;  // it was written over meanwhile
        if (found.data != nullptr) {
          owner_ = std::make_shared<Body>(found);
          body_ = {found.data, static_cast<std::size_t>(found.size)};
        }
        cortex_reader_disarm(&reader_);
        return {frame_.data(), frame_.size()};
      }
    } while (reader_.state == CORTEX_SOUND && cortex_reader_arm(&reader_) == 0);
    return {};
  }

 private:
  RingReader() = default;

  // Keeps the body of a message.
  struct Body {
    explicit Body(const CortexBody& taken) noexcept : body(taken) {}
    Body(const Body&) = delete;
    Body& operator=(const Body&) = delete;
    ~Body() { cortex_body_end(&body); }
    CortexBody body;
  };

  CortexReader reader_{};
  bool open_ = false;
  bool is_crowded_ = false;
  std::vector<std::uint8_t> frame_;
  Span<const std::uint8_t> body_;
  std::shared_ptr<const void> owner_;
};

}  // namespace cortex::detail
