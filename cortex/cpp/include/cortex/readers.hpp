// SPDX-License-Identifier: Apache-2.0
// Who reads one publisher, and which way each reader gets its frames.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "cortex/pub_socket.hpp"
#include "cortex/broadcast.hpp"
#include "cortex/wire.hpp"

namespace cortex::detail {

// One subscriber's link to this publisher.
struct Reader {
  std::string key;
  wire::AttachKey request;
  PubSocket* pub_socket = nullptr;
  int member = -1;  // its number in the ring, through which its frames go; -1: through the socket
  std::uint64_t confirmed = 0;  // it has accounted for all below this
  bool is_moving = false;       // it was sent from the ring to its socket, and has not come there yet
};

// Calls are made under the publisher's lock. Readers are shared so that one may leave while the publisher, having let
// go of the lock, waits for it.
class Readers {
 public:
  using List = std::vector<std::shared_ptr<Reader>>;

  const List& all() const noexcept { return all_; }
  bool has_members() const noexcept { return members_ > 0; }
  bool empty() const noexcept { return all_.empty(); }
  std::size_t size() const noexcept { return all_.size(); }
  // Those that the socket itself serves.
  std::size_t socket_count(const PubSocket& pub_socket) const noexcept { return pub_socket.strict ? strict_ : lossy_; }

  // Takes a reader in; through the ring, if it asks for that and there is room. `first` is the sequence of the first
  // message for it.
  const std::shared_ptr<Reader>& add(PubSocket& pub_socket, const std::string& key, const wire::AttachKey& request,
                                     std::uint64_t first, Listener& listener) {
    auto reader = std::make_shared<Reader>();
    reader->key = key;
    reader->request = request;
    reader->pub_socket = &pub_socket;
    if (request.shared_memory) join(*reader, first, listener);
    ++(reader->member >= 0 ? members_ : pub_socket.strict ? strict_ : lossy_);
    return all_.emplace_back(std::move(reader));
  }

  // Null if there is no such reader.
  std::shared_ptr<Reader> remove(const std::string& key) {
    const auto found =
        std::find_if(all_.begin(), all_.end(), [&](const auto& reader) { return reader->key == key; });
    if (found == all_.end()) return nullptr;
    const std::shared_ptr<Reader> reader = std::move(*found);
    all_.erase(found);
    --(reader->member >= 0 ? members_ : reader->pub_socket->strict ? strict_ : lossy_);
    if (reader->member >= 0) ring_->remove(reader->member);
    return reader;
  }

  // Sends a frame through the ring, see `Broadcast`.
  int put(Span<const std::uint8_t> frame) noexcept { return has_members() ? ring_->put(frame) : CORTEX_WRITTEN; }
  void end(Span<const std::uint8_t> frame) noexcept {
    if (has_members()) ring_->end(frame);
  }

  // Sends all members of the ring to their sockets, for good.
  void dissolve() noexcept {
    ring_->dissolve();
    ring_.reset();
    is_dissolved_ = true;
    for (const auto& reader : all_) {
      if (reader->member < 0) continue;
      reader->member = -1;
      reader->is_moving = true;
      --members_;
      ++(reader->pub_socket->strict ? strict_ : lossy_);
    }
  }
  // Whether some reader has still to come to its socket; a reliable one misses what is sent meanwhile.
  bool is_moving(bool strict_only) const noexcept {
    return std::any_of(all_.begin(), all_.end(), [&](const auto& reader) {
      return reader->is_moving && (reader->request.strict || !strict_only);
    });
  }

  // The ring; there is one if it has members.
  Broadcast& ring() noexcept { return *ring_; }

  // The shortest time for which a reliable reader that has no room in the ring, or with size 0 has not come to all slots,
  // may hold up the publisher; UINT32_MAX: there is none.
  std::uint32_t patience_ms(std::size_t frame_size) const noexcept {
    std::uint32_t shortest = UINT32_MAX;
    for (const auto& reader : all_) {
      if (is_full(*reader, frame_size)) shortest = std::min(shortest, reader->request.timeout_ms);
    }
    return shortest;
  }

  // Waits no more for those that have held it up for their time.
  void give_up(std::size_t frame_size, std::int64_t waited_ns) noexcept {
    for (const auto& reader : all_) {
      const bool is_over = std::int64_t{reader->request.timeout_ms} * 1'000'000 <= waited_ns;
      if (is_over && is_full(*reader, frame_size)) ring_->give_up(reader->member);
    }
  }

  // Gives all readers away.
  List release() noexcept {
    ring_.reset();
    members_ = lossy_ = strict_ = 0;
    return std::exchange(all_, {});
  }

  // The longest that a reader which this socket itself serves may hold up the publisher.
  std::uint32_t timeout_ms(const PubSocket& pub_socket) const noexcept {
    std::uint32_t longest = 0;
    for (const auto& reader : all_) {
      if (reader->pub_socket == &pub_socket && reader->member < 0) longest = std::max(longest, reader->request.timeout_ms);
    }
    return longest;
  }

 private:
  bool is_full(const Reader& reader, std::size_t frame_size) const noexcept {
    if (reader.member < 0) return false;
    return frame_size == 0 ? ring_->is_behind(reader.member) : ring_->is_full(reader.member, frame_size);
  }

  void join(Reader& reader, std::uint64_t first, Listener& listener) {
    CortexHello hello;
    if (!listener.take(reader.request.source, reader.request.reader, hello)) return;
    if (ring_ == nullptr && !is_dissolved_) ring_ = Broadcast::open(reader.request.source);
    if (ring_ == nullptr) {
      cortex_hello_close(&hello);
    } else {
      reader.member = ring_->add(hello, reader.request.strict, first);
    }
  }

  List all_;
  std::unique_ptr<Broadcast> ring_;
  bool is_dissolved_ = false;
  std::size_t members_ = 0;
  std::size_t lossy_ = 0;
  std::size_t strict_ = 0;
};

}  // namespace cortex::detail
