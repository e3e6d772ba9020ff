// SPDX-License-Identifier: Apache-2.0
// Who reads one publisher, which way each reader gets its frames, and where large messages are written.
#pragma once

#include <algorithm>
#include <atomic>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "cortex/broadcast.hpp"
#include "cortex/pub_socket.hpp"
#include "cortex/wire.hpp"

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

// One subscriber's link to this publisher.
struct Reader {
  std::string key;
  wire::Key request;
  std::uint32_t timeout_ms = 0;  // the longest that it holds up the publisher
  PubSocket* pub_socket = nullptr;
  int member = -1;  // its number in the ring, through which its frames go; -1: through the socket
  std::uint64_t confirmed = 0;  // it has accounted for all below this; the end of the stream counts as one
  bool has_answer = false;      // whether it has confirmed its answer, or need not
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
  // Those that know from where on they count what they lose.
  std::size_t attached_count() const noexcept {
    const auto has_answer = [](const auto& reader) { return reader->has_answer; };
    return static_cast<std::size_t>(std::count_if(all_.begin(), all_.end(), has_answer));
  }
  // Those that the socket itself serves.
  std::size_t socket_count(const PubSocket& pub_socket) const noexcept { return pub_socket.strict ? strict_ : lossy_; }

  // Takes a reader in; through the ring, if it asks for that and there is room. `first` is the sequence of the first
  // message for it.
  const std::shared_ptr<Reader>& add(PubSocket& pub_socket, const std::string& key, const wire::Key& request,
                                     std::uint32_t max_wait_ms, std::uint64_t first, Listener& listener) {
    auto reader = std::make_shared<Reader>();
    reader->key = key;
    reader->request = request;
    reader->timeout_ms = std::min(request.timeout_ms(), max_wait_ms);
    reader->pub_socket = &pub_socket;
    if (request.has(wire::Key::shared_memory)) join(*reader, first, listener);
    reader->has_answer = reader->member >= 0 || !request.has(wire::Key::strict);
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
    if (reader->member >= 0) cortex_writer_remove(ring_.get(), reader->member);
    return reader;
  }

  // Sends a frame through the ring: CORTEX_WRITTEN, CORTEX_LAGGING, CORTEX_FULL or CORTEX_TOO_LARGE.
  int put(Span<const std::uint8_t> frame) noexcept {
    return has_members() ? cortex_writer_put(ring_.get(), frame.data(), frame.size(), 0) : CORTEX_WRITTEN;
  }
  // The last frame of all, of 64 bytes.
  void end(Span<const std::uint8_t> frame) noexcept {
    if (has_members()) cortex_writer_end(ring_.get(), frame.data(), frame.size());
  }

  // Sends all members of the ring to their sockets, for good.
  void dissolve() noexcept {
    cortex_writer_dissolve(ring_.get());
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
      return reader->is_moving && (reader->request.has(wire::Key::strict) || !strict_only);
    });
  }

  // What follows is of the ring; there is one if it has members.

  // Makes slots for bodies of a size, if need be; false if there is no memory for them.
  bool provide(std::size_t size, bool exact) noexcept {
    cortex_writer_provide(ring_.get(), size, exact ? 1 : 0, 0);
    return ring_->map->slot_bytes >= size;
  }
  // A slot to be written; without a buffer if none is free.
  Slot acquire() {
    int lagging = 0;
    if (cortex_writer_look(ring_.get(), &lagging) == 0 && lagging != 0) return {};
    const int index = cortex_slot_acquire(ring_.get());
    if (index < 0) return {};
    CortexMap* map = ring_->map;
    __atomic_fetch_add(&map->users, 1, __ATOMIC_RELAXED);
    const Span<std::uint8_t> buffer(cortex_slot_memory(map, index), static_cast<std::size_t>(map->slot_bytes));
    return {buffer, index, std::shared_ptr<CortexMap>(map, cortex_map_end), nullptr};
  }
  // Whether a slot's ring is still in use.
  bool has(const Slot& slot) const noexcept { return has_members() && slot.index >= 0 && slot.map.get() == ring_->map; }
  void abandon(const Slot& slot) noexcept {
    if (has(slot)) cortex_slot_abandon(ring_.get(), slot.index);
  }
  // Sends the header of what was written into a slot, as `put`.
  int commit(const Slot& slot, std::uint64_t sequence, Span<const std::uint8_t> header) noexcept {
    return cortex_slot_commit(ring_.get(), slot.index, sequence, header.data(), header.size(), 0);
  }
  // How long a reliable reader may still take that has no room for a frame, or with size 0 has not come to all slots
  // [ms]; -1: there is none.
  std::int64_t patience_ms(std::size_t size) noexcept { return has_members() ? cortex_writer_patience(ring_.get(), size) : -1; }
  // Waits no more for those that have held it up for their time.
  void give_up(std::size_t size, std::int64_t waited_ms) noexcept {
    if (has_members()) cortex_writer_give_up(ring_.get(), size, waited_ms);
  }

  // Keeps those only that have yet to say that they know of the end at a sequence, which come through sockets.
  void settle(std::uint64_t sequence) noexcept {
    ring_.reset();  // its readers keep what is in it
    const auto is_settled = [&](const auto& reader) {
      return reader->member >= 0 || reader->confirmed > sequence;
    };
    all_.erase(std::remove_if(all_.begin(), all_.end(), is_settled), all_.end());
    const auto strict = std::count_if(all_.begin(), all_.end(), [](const auto& reader) { return reader->pub_socket->strict; });
    members_ = 0;
    strict_ = static_cast<std::size_t>(strict);
    lossy_ = all_.size() - strict_;
  }

  // The longest that a reader which this socket itself serves may hold up the publisher.
  std::uint32_t timeout_ms(const PubSocket& pub_socket) const noexcept {
    std::uint32_t longest = 0;
    for (const auto& reader : all_) {
      if (reader->pub_socket == &pub_socket && reader->member < 0) longest = std::max(longest, reader->timeout_ms);
    }
    return longest;
  }

 private:
  struct Close {
    void operator()(CortexWriter* ring) const noexcept {
      cortex_writer_close(ring);
      delete ring;
    }
  };

  void join(Reader& reader, std::uint64_t first, Listener& listener) {
    CortexHello hello;
    const auto& request = reader.request;
    if (!listener.take(request.source, request.reader, hello)) return;
    if (ring_ == nullptr && !is_dissolved_) {
      auto made = std::make_unique<CortexWriter>();
      if (cortex_writer_open(made.get(), request.source, ring_bytes) == 0) ring_.reset(made.release());
    }
    if (ring_ == nullptr) {
      cortex_hello_close(&hello);
    } else {
      reader.member = cortex_writer_add(ring_.get(), &hello, request.has(wire::Key::strict) ? 1 : 0, reader.timeout_ms, first);
    }
  }

  List all_;
  std::unique_ptr<CortexWriter, Close> ring_;
  bool is_dissolved_ = false;
  std::size_t members_ = 0;
  std::size_t lossy_ = 0;
  std::size_t strict_ = 0;
};

}  // namespace cortex::detail
