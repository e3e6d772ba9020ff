// SPDX-License-Identifier: Apache-2.0
// A node's XPUB sockets, which all its publishers share.
#pragma once

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdint>
#include <map>
#include <memory>
#include <mutex>
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
  // Tells readers again of the end of publishers that have closed, unless they have confirmed it; whether there are such.
  inline bool repeat_ends(std::int64_t now_ns);

  std::mutex mutex;
  Listener listener;  // where local readers ask for rings
  PubSocket lossy;
  PubSocket strict;
  std::map<std::uint64_t, std::shared_ptr<PublisherCore>> publishers;  // also those that wait for somebody at their end
  std::map<std::string, PubSocket*> attached;
  std::atomic<bool> changed{false};  // a publisher has closed
  bool closed = false;

 private:
  static constexpr std::int64_t look_max_ns = 5'000'000;
  std::int64_t told_ns_ = 0;
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
