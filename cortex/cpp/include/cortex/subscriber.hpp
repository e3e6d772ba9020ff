// SPDX-License-Identifier: Apache-2.0
// Subscribing: a bounded queue that is read where the message is wanted; no thread between socket and user.
#pragma once

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdint>
#include <deque>
#include <memory>
#include <mutex>
#include <optional>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

#include "cortex/codec.hpp"
#include "cortex/link.hpp"
#include "cortex/policy.hpp"
#include "cortex/records.hpp"
#include "cortex/socket.hpp"

namespace cortex {

// A publisher of the topic sends another type; the text shows both schemas.
class TypeMismatch : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

// What is known of a message besides its content.
struct Info {
  std::uint64_t source = 0;
  std::uint64_t sequence = 0;
  std::optional<std::int64_t> stamp_ns;  // the message's own time, if its type has one
  std::int64_t publish_ns = 0;           // when it was published, on this host's CLOCK_MONOTONIC
  std::size_t size = 0;                  // bytes of the body
};

// A received message. Its arrays look into the frame, or into the publisher's slot, which is given back when this
// object goes; a copy of the message, or of one of its arrays, owns its items and may stay.
template <class T>
class Received {
 public:
  Received(Received&&) noexcept = default;
  Received& operator=(Received&& other) noexcept {
    message_ = std::move(other.message_);  // before what its arrays look into
    info_ = other.info_;
    frame_ = std::move(other.frame_);
    owner_ = std::move(other.owner_);
    return *this;
  }
  Received(const Received&) = delete;
  Received& operator=(const Received&) = delete;

  const T& operator*() const noexcept { return message_; }
  const T* operator->() const noexcept { return &message_; }
  const Info& info() const noexcept { return info_; }

 private:
  template <class>
  friend class Subscription;
  Received() = default;

  zmq::message_t frame_;
  std::shared_ptr<const void> owner_;
  Info info_;
  T message_{};
};

namespace detail {

// A publisher that a subscription should be connected to.
struct Source {
  std::uint64_t source = 0;
  std::uint64_t fingerprint = 0;
  std::string schema;
  std::string address;
  bool local = false;
  std::int64_t clock_offset_ns = 0;
  std::string server_key;  // for CURVE; empty: plain
};

class SubscriptionCore {
 public:
  SubscriptionCore(records::SubscriberRecord known, std::string schema, bool stamped, const Policy& wanted,
                   std::shared_ptr<net::Complaints> complaints)
      : record(std::move(known)),
        policy(wanted),
        schema_(std::move(schema)),
        type_{record.fingerprint, stamped},
        complaints_(std::move(complaints)) {}
  ~SubscriptionCore() { close(); }

  const records::SubscriberRecord record;  // what others know of it
  const Policy policy;

  // Connects to what is there and takes leave of what is gone; for the node's thread.
  void match(zmq::context_t& context, const std::vector<Source>& sources, const Keys* keys) {
    const std::lock_guard<std::mutex> lock(mutex_);
    if (closed_) return;
    for (auto& link : links_) {
      const auto found = std::find_if(sources.begin(), sources.end(),
                                      [&](const Source& source) { return source.source == link->source(); });
      const bool there = found != sources.end();
      if (there) link->clock_offset_ns = found->clock_offset_ns;
      if (!there && link->leaving_ns == 0) link->leave();
      link->leaving_ns = there ? 0 : link->leaving_ns != 0 ? link->leaving_ns : monotonic_ns();
    }
    note_leaving();
    for (const auto& source : sources) {
      if (std::any_of(links_.begin(), links_.end(),
                      [&](const auto& link) { return link->source() == source.source; })) {
        continue;
      }
      if (source.fingerprint != type_.fingerprint) {
        complain(source);
        continue;
      }
      const auto secure = [&](zmq::socket_t& socket) {
        if (!source.server_key.empty()) keys->apply_client(socket, source.server_key);
      };
      links_.push_back(std::make_unique<Link>(context, source.address, source.source, type_, policy, source.local,
                                              secure, counters_, complaints_));
      links_.back()->clock_offset_ns = source.clock_offset_ns;
    }
    waker_.set();
  }

  // Reads the sockets of a subscription that nobody reads at the moment, so that the queue keeps the last messages
  // and not the first that filled the sockets; closes the links of publishers that left, whether others are busy or not.
  void tend(std::int64_t now_ns) {
    const bool is_read = now_ns - drained_ns_.load(std::memory_order_relaxed) < tend_ns;
    if (is_read && !is_leaving_.load(std::memory_order_relaxed)) return;
    const std::unique_lock<std::mutex> lock(mutex_, std::try_to_lock);
    if (!lock.owns_lock() || closed_) return;
    const bool waiting = !queue_.empty();
    if (!is_read) drain();
    const auto stays = [&](const auto& link) {
      return link->leaving_ns == 0 || (!link->has_ended() && now_ns - link->leaving_ns <= leaving_ns);
    };
    const auto gone = std::stable_partition(links_.begin(), links_.end(), stays);
    std::for_each(gone, links_.end(), [](const auto& link) { link->end(); });
    links_.erase(gone, links_.end());
    note_leaving();
    if (!waiting && !queue_.empty()) waker_.set();
  }

  // The next message, or nothing by the deadline or once closed. Throws TypeMismatch.
  std::optional<Item> take(std::int64_t deadline_ns) {
    while (true) {
      std::vector<pollfd> fds;
      {
        const std::lock_guard<std::mutex> lock(mutex_);
        if (closed_) return std::nullopt;
        if (!problems_.empty()) {
          const TypeMismatch problem = std::move(problems_.front());
          problems_.pop_front();
          throw problem;
        }
        if (queue_.empty() || (!policy.is_reliable && is_stale())) drain();
        if (!queue_.empty()) {
          std::optional<Item> item(std::move(queue_.front()));
          queue_.pop_front();
          ++counters_->received;
          return item;
        }
        if (!exhausted_) continue;
        fds.push_back({waker_.fd(), POLLIN, 0});
        for (const auto& link : links_) {
          fds.push_back({link->fd(), POLLIN, 0});
          if (link->wakeup_fd() >= 0) fds.push_back({link->wakeup_fd(), POLLIN, 0});
        }
      }
      const std::int64_t now_ns = monotonic_ns();
      if (now_ns >= deadline_ns) return std::nullopt;
      wait(fds, now_ns, deadline_ns);
      if ((fds[0].revents & POLLIN) != 0) waker_.clear();
    }
  }

  void count_rejected(std::uint64_t source, const std::string& reason) {
    const std::lock_guard<std::mutex> lock(mutex_);
    --counters_->received;
    for (const auto& link : links_) {
      if (link->source() == source) return link->reject(reason);
    }
    ++counters_->rejected;
  }

  SubscriberCounters counters() const {
    const std::lock_guard<std::mutex> lock(mutex_);
    return *counters_;
  }

  std::size_t publisher_count() {
    const std::lock_guard<std::mutex> lock(mutex_);
    if (queue_.size() < policy.depth) drain();  // their answers may wait among the messages
    return static_cast<std::size_t>(std::count_if(links_.begin(), links_.end(), [](const auto& link) {
      return link->attached() && link->leaving_ns == 0;
    }));
  }

  bool closed() const {
    const std::lock_guard<std::mutex> lock(mutex_);
    return closed_;
  }

  void close() {
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      closed_ = true;
      queue_.clear();
      links_.clear();
    }
    waker_.set();
  }

 private:
  static constexpr std::size_t drain_count = 64;        // frames that are read at a time
  static constexpr std::size_t drain_lossy_count = 4096;  // more than a socket holds of small ones
  static constexpr std::size_t fresh_depth = 64;         // shorter queues are topped up before every message
  static constexpr std::int64_t fresh_ns = 1'000'000;    // and longer ones if they were filled so long ago
  static constexpr std::int64_t spin_ns = 20'000;
  static constexpr std::int64_t gather_ns = 10'000;
  static constexpr std::int64_t tend_ns = 20'000'000;
  static constexpr std::int64_t leaving_ns = 2'000'000'000;  // for what is still in flight, after all that is there

  // Waits until something may have come. To sleep costs the publisher a wake-up, more than the message itself: where
  // the last one was there within `spin_ns`, this looks for the next one for so long. It looks every `gather_ns`, since
  // each look in vain has whoever writes to the ring wake us.
  void wait(std::vector<pollfd>& fds, std::int64_t begin_ns, std::int64_t deadline_ns) {
    if (in_rush_.load(std::memory_order_relaxed)) {
      const std::int64_t end_ns = std::min(begin_ns + spin_ns, deadline_ns);
      for (std::int64_t look_ns = begin_ns; look_ns < end_ns;) {
        look_ns = std::min(look_ns + gather_ns, end_ns);
        while (monotonic_ns() < look_ns) {
        }
        if (::poll(fds.data(), fds.size(), 0) > 0) return;
      }
    }
    // Another thread's call on a socket may swallow its event, hence the bound.
    const std::int64_t left_ns = std::max<std::int64_t>(deadline_ns - monotonic_ns(), 0);
    const auto wait_ms = static_cast<int>(std::min<std::int64_t>((left_ns + 999'999) / 1'000'000, 100));
    ::poll(fds.data(), fds.size(), wait_ms);
    in_rush_.store(monotonic_ns() - begin_ns < spin_ns, std::memory_order_relaxed);
  }

  // Whether newer messages than those in the queue are to be looked for.
  bool is_stale() const {
    return !exhausted_ || policy.depth < fresh_depth ||
           monotonic_ns() - drained_ns_.load(std::memory_order_relaxed) > fresh_ns;
  }

  // Reads what has arrived, of a different publisher first each time. Those of a reliable subscription share the room
  // in the queue, so that none starves another.
  void drain() {
    const std::int64_t now_ns = monotonic_ns();
    drained_ns_.store(now_ns, std::memory_order_relaxed);
    if (policy.is_reliable && queue_.size() >= policy.depth) {
      for (auto& link : links_) link->stay(now_ns);
      return;
    }
    exhausted_ = true;
    const std::size_t count = links_.size();
    if (count > 1) first_ = (first_ + 1) % count;
    for (std::size_t index = 0; index < count; ++index) {
      Link& link = *links_[(first_ + index) % count];
      const std::size_t room = policy.depth - std::min(policy.depth, queue_.size());
      const std::size_t share = (room + count - index - 1) / (count - index);
      if (policy.is_reliable ? link.drain(queue_, share) : drain_lossy(link)) continue;
      link.stay(now_ns);
      exhausted_ = false;
    }
  }

  // Reads all that has arrived, but not for ever, and keeps the last of it; whether nothing is left.
  bool drain_lossy(Link& link) {
    for (std::size_t read = 0; read < drain_lossy_count; read += drain_count) {
      const bool empty = link.drain(queue_, drain_count);
      while (queue_.size() > policy.depth) {
        queue_.pop_front();
        ++counters_->overtaken;
      }
      if (empty && !link.is_crowded()) return true;
      if (link.is_crowded()) make_room(link);
    }
    return false;
  }

  // The oldest message gives way to a large one, or that one, if the user keeps all the memory.
  void make_room(Link& link) {
    if (queue_.empty()) return link.pass_over();
    queue_.pop_front();
    ++counters_->overtaken;
  }

  void note_leaving() {
    is_leaving_ = std::any_of(links_.begin(), links_.end(), [](const auto& link) { return link->leaving_ns != 0; });
  }

  void complain(const Source& source) {
    if (std::find(mismatched_.begin(), mismatched_.end(), source.source) != mismatched_.end()) return;
    if (mismatched_.size() >= 256) mismatched_.pop_front();
    mismatched_.push_back(source.source);
    ++counters_->rejected;
    if (problems_.size() >= 16) problems_.pop_front();
    problems_.emplace_back("a publisher of " + record.topic + " sends another type than is subscribed\nexpected: " + schema_ +
                           "\nactual: " + source.schema);
  }

  const std::string schema_;
  const TypeId type_;
  std::shared_ptr<net::Complaints> complaints_;
  mutable std::mutex mutex_;
  net::Waker waker_;
  std::shared_ptr<SubscriberCounters> counters_ = std::make_shared<SubscriberCounters>();
  std::deque<Item> queue_;
  std::vector<std::unique_ptr<Link>> links_;
  std::deque<TypeMismatch> problems_;
  std::deque<std::uint64_t> mismatched_;
  std::size_t first_ = 0;  // the link that was read first the last time
  std::atomic<std::int64_t> drained_ns_{0};
  std::atomic<bool> is_leaving_{false};  // a publisher has left whose link is still there
  std::atomic<bool> in_rush_{false};  // messages follow one another within `spin_ns`
  bool exhausted_ = true;
  bool closed_ = false;
};

inline std::int64_t deadline(std::chrono::nanoseconds timeout) {
  const std::int64_t now_ns = monotonic_ns();
  const std::int64_t most = std::numeric_limits<std::int64_t>::max() - now_ns;
  return now_ns + std::min<std::int64_t>(std::max<std::int64_t>(timeout.count(), 0), most);
}

}  // namespace detail

// Receives the messages of a topic; made by `Node::subscribe`. Calls may come from any thread. It ends with its last
// copy; after the end of its node, or `close`, `receive` returns nothing at once.
template <class T>
class Subscription {
 public:
  // The next message, or nothing if none came in time. Throws TypeMismatch, once for each publisher of another type.
  std::optional<Received<T>> receive(std::chrono::nanoseconds timeout) {
    const std::int64_t deadline_ns = detail::deadline(timeout);
    while (auto item = core_->take(deadline_ns)) {
      std::optional<Received<T>> result(Received<T>{});
      try {
        decode_into(item->body, result->message_);
      } catch (const MalformedMessage& error) {
        core_->count_rejected(item->source, error.what());
        continue;
      }
      result->info_ = {item->source, item->sequence, std::nullopt, item->publish_ns, item->body.size()};
      if constexpr (Codec<T>::stamped) result->info_.stamp_ns = item->stamp_ns;
      result->frame_ = std::move(item->frame);
      result->owner_ = std::move(item->owner);
      return result;
    }
    return std::nullopt;
  }

  // Waits until a publisher has taken this subscription in.
  bool wait_for_publisher(std::chrono::nanoseconds timeout) {
    const std::int64_t deadline_ns = detail::deadline(timeout);
    while (core_->publisher_count() == 0) {
      if (core_->closed() || monotonic_ns() >= deadline_ns) return false;
      std::this_thread::sleep_for(std::chrono::microseconds(500));
    }
    return true;
  }

  std::size_t publisher_count() { return core_->publisher_count(); }
  SubscriberCounters counters() const { return core_->counters(); }
  const std::string& topic() const noexcept { return core_->record.topic; }
  bool closed() const { return core_->closed(); }
  void close() { core_->close(); }

 private:
  friend class Node;
  explicit Subscription(std::shared_ptr<detail::SubscriptionCore> core) : core_(std::move(core)) {}
  std::shared_ptr<detail::SubscriptionCore> core_;
};

}  // namespace cortex
