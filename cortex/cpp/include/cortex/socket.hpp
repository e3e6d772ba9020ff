// SPDX-License-Identifier: Apache-2.0
// How ZeroMQ sockets are set up, and a way to wake a thread that sleeps in poll.
#pragma once

#include <algorithm>
#include <cerrno>
#include <cstdint>
#include <functional>
#include <mutex>
#include <set>
#include <string>
#include <system_error>

#include <fcntl.h>
#include <poll.h>
#include <unistd.h>

#include <zmq.hpp>

#include "cortex/wire.hpp"

namespace cortex {

// Where warnings go: rejected frames, silent registries, memory that cannot be shared. Called from any thread.
using Log = std::function<void(const std::string&)>;

namespace net {

constexpr int queue_max = 1000;

inline bool is_tcp(const std::string& address) { return address.rfind("tcp://", 0) == 0; }
// The host of a tcp address, without the brackets of IPv6.
inline std::string host_of(const std::string& address) {
  std::string host = address.substr(6, address.rfind(':') - 6);
  host.erase(std::remove_if(host.begin(), host.end(), [](char c) { return c == '[' || c == ']'; }), host.end());
  return host;
}

inline bool is_loopback(const std::string& host) {
  return host.rfind("127.", 0) == 0 || host == "::1" || host == "localhost";
}

inline bool is_ipc(const std::string& address) { return address.rfind("ipc://", 0) == 0; }

// A socket that never blocks its owner at close, and over tcp notices a peer that is gone. On ipc the kernel reports
// a dead peer at once, and a stopped one may still hold leases of shared memory.
//
// Of a SUB socket only the receiving queue is short: its subscriptions go through the sending one, which drops what
// exceeds it.
inline zmq::socket_t make_socket(zmq::context_t& context, zmq::socket_type type, bool tcp, int high_water_mark,
                                 int linger_ms) {
  zmq::socket_t socket(context, type);
  socket.set(zmq::sockopt::linger, linger_ms);
  socket.set(zmq::sockopt::sndhwm, std::max(high_water_mark, queue_max));
  socket.set(zmq::sockopt::rcvhwm, high_water_mark);
  socket.set(zmq::sockopt::reconnect_ivl, 20);
  socket.set(zmq::sockopt::reconnect_ivl_max, 500);
  if (tcp) {
    socket.set(zmq::sockopt::ipv6, 1);
    socket.set(zmq::sockopt::heartbeat_ivl, 500);
    socket.set(zmq::sockopt::heartbeat_timeout, 2000);
    socket.set(zmq::sockopt::heartbeat_ttl, 2000);
    socket.set(zmq::sockopt::tcp_keepalive, 1);
  }
  return socket;
}

inline Span<const std::uint8_t> bytes(const zmq::message_t& message) {
  return {static_cast<const std::uint8_t*>(message.data()), message.size()};
}

// Takes in the parts of a message after the one that was read; returns how many there were.
inline std::size_t drop_parts(zmq::socket_t& socket) {
  std::size_t dropped = 0;
  zmq::message_t part;
  while (socket.get(zmq::sockopt::rcvmore) && socket.recv(part, zmq::recv_flags::dontwait)) ++dropped;
  return dropped;
}

// Wakes a thread that polls `fd`.
class Waker {
 public:
  Waker() {
    if (::pipe(fds_) != 0) throw std::system_error(errno, std::generic_category(), "pipe");
    for (const int fd : fds_) {
      ::fcntl(fd, F_SETFL, O_NONBLOCK);
      ::fcntl(fd, F_SETFD, FD_CLOEXEC);
    }
  }
  Waker(const Waker&) = delete;
  Waker& operator=(const Waker&) = delete;
  ~Waker() {
    ::close(fds_[0]);
    ::close(fds_[1]);
  }
  int fd() const noexcept { return fds_[0]; }
  void set() const noexcept {
    const char byte = 0;
    [[maybe_unused]] const auto written = ::write(fds_[1], &byte, 1);  // a full pipe wakes as well
  }
  void clear() const noexcept {
    char bytes[64];
    while (::read(fds_[0], bytes, sizeof bytes) > 0) {
    }
  }

 private:
  int fds_[2] = {-1, -1};
};

// Says each thing once, and a bounded number of things.
class Complaints {
 public:
  explicit Complaints(Log log) : log_(std::move(log)) {}
  void once(const std::string& key, const std::string& text) {
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      if (said_.size() >= 64 || !said_.insert(key).second) return;
    }
    if (log_) log_(text);
  }

 private:
  Log log_;
  std::mutex mutex_;
  std::set<std::string> said_;
};

}  // namespace net
}  // namespace cortex
