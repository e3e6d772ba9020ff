// SPDX-License-Identifier: Apache-2.0
// A node's XPUB sockets, which all its publishers share.
#pragma once

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdint>
#include <cstring>
#include <map>
#include <memory>
#include <mutex>
#include <set>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "cortex/broadcast.hpp"
#include "cortex/runtime.hpp"
#include "cortex/socket.hpp"
#include "cortex/wire.hpp"

namespace cortex::detail {

class PublisherCore;

// One XPUB socket. A strict one refuses a message for which some reader's queue is full; a lossy one drops it for
// that reader, which sees the gap in the sequence.
struct PubSocket {
  zmq::socket_t socket;
  bool strict = false;

  bool try_send(zmq::message_t message, zmq::send_flags flags = zmq::send_flags::none) {
    return socket.send(message, flags | zmq::send_flags::dontwait).has_value();
  }
  // To all readers with room in their queues; the others lose it.
  void send_anyway(zmq::message_t message, zmq::send_flags flags = zmq::send_flags::none) {
    socket.set(zmq::sockopt::xpub_nodrop, false);
    try_send(std::move(message), flags);
    socket.set(zmq::sockopt::xpub_nodrop, strict);
  }
};

inline zmq::message_t share(zmq::message_t& message) {
  zmq::message_t copy;
  copy.copy(message);  // counts references, beyond a few bytes
  return copy;
}

inline zmq::message_t message_of(const std::string& bytes) { return zmq::message_t(bytes.data(), bytes.size()); }

// Publishers that have closed and still wait for readers of sockets to say that they have everything. Calls are made
// under the lock of the sockets.
class EndedPublishers {
 public:
  struct Reader {
    std::string key;
    PubSocket* pub_socket = nullptr;
    std::uint64_t number = 0;  // the reader's own
  };

  // `last` is the frame that says how many messages there were.
  void add(std::uint64_t sequence, std::string last, std::vector<Reader> readers) {
    if (!readers.empty()) list_.push_back({sequence, std::move(last), std::move(readers)});
  }

  // A reader has left or died.
  void detach(const std::string& key) {
    settle([&](const Ended&, const Reader& reader) { return reader.key == key; });
  }

  // A reader has accounted for all below a sequence.
  void confirm(std::uint64_t number, std::uint64_t up_to) {
    settle([&](const Ended& ended, const Reader& reader) { return reader.number == number && up_to >= ended.sequence; });
  }

  // Says again how many messages there were: libzmq drops it where a queue is full.
  void repeat(std::int64_t now_ns) {
    if (now_ns - told_ns_ < repeat_ns) return;
    told_ns_ = now_ns;
    for (const auto& ended : list_) {
      std::set<PubSocket*> pub_sockets;
      for (const auto& reader : ended.readers) pub_sockets.insert(reader.pub_socket);
      for (PubSocket* pub_socket : pub_sockets) pub_socket->try_send(message_of(ended.last));
    }
  }

  bool empty() const noexcept { return list_.empty(); }

 private:
  static constexpr std::int64_t repeat_ns = 20'000'000;

  struct Ended {
    std::uint64_t sequence;  // of the message that would have come next
    std::string last;
    std::vector<Reader> readers;  // those that have not said so yet
  };

  template <class Settled>
  void settle(Settled settled) {
    for (auto& ended : list_) {
      const auto is_settled = [&](const Reader& reader) { return settled(ended, reader); };
      ended.readers.erase(std::remove_if(ended.readers.begin(), ended.readers.end(), is_settled), ended.readers.end());
    }
    const auto is_done = [](const Ended& ended) { return ended.readers.empty(); };
    list_.erase(std::remove_if(list_.begin(), list_.end(), is_done), list_.end());
  }

  std::vector<Ended> list_;
  std::int64_t told_ns_ = 0;
};

// Both sockets of a node under one lock, and the publishers whose readers come and go through them.
class PubSockets {
 public:
  PubSockets(zmq::context_t& context, bool tcp, const std::string& ring_path)
      : listener(ring_path),
        lossy{net::make_socket(context, zmq::socket_type::xpub, tcp, net::queue_max, 1000), false},
        strict{net::make_socket(context, zmq::socket_type::xpub, tcp, net::queue_max, 1000), true} {
    strict.socket.set(zmq::sockopt::xpub_nodrop, true);
  }

  // Reads who has come and gone; the caller holds the lock.
  inline void refresh();

  std::mutex mutex;
  Listener listener;  // where local readers ask for rings
  PubSocket lossy;
  PubSocket strict;
  std::map<std::uint64_t, PublisherCore*> publishers;
  std::map<std::string, PubSocket*> attached;
  EndedPublishers ended;
  bool closed = false;
};

// A pause that grows from 50 us to 1 ms, until a deadline.
class Backoff {
 public:
  explicit Backoff(std::int64_t timeout_ns) : deadline_ns_(monotonic_ns() + timeout_ns) {}
  bool wait() {
    const std::int64_t left_ns = deadline_ns_ - monotonic_ns();
    if (left_ns <= 0) return false;
    std::this_thread::sleep_for(std::chrono::nanoseconds(std::min(pause_ns_, left_ns)));
    pause_ns_ = std::min<std::int64_t>(pause_ns_ * 13 / 10, 1'000'000);
    return true;
  }

 private:
  std::int64_t deadline_ns_;
  std::int64_t pause_ns_ = 50'000;
};

using Lock = std::unique_lock<std::mutex>;

}  // namespace cortex::detail
