// SPDX-License-Identifier: Apache-2.0
// One subscriber's connection to one publisher: attaching, sequence numbers, leases of shared memory.
#pragma once

#include <cstdint>
#include <cstring>
#include <deque>
#include <map>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "cortex/policy.hpp"
#include "cortex/ring.hpp"
#include "cortex/runtime.hpp"
#include "cortex/socket.hpp"
#include "cortex/wire.hpp"

namespace cortex::detail {

// A message that has arrived: its body, and what keeps that alive.
struct Item {
  Span<const std::uint8_t> body;
  std::uint64_t source = 0;
  std::uint64_t sequence = 0;
  std::int64_t stamp_ns = 0;
  std::int64_t publish_ns = 0;  // by this host's clock
  zmq::message_t frame;
  std::shared_ptr<const void> owner;  // of a slot's lease, or of a frame that several messages share
  std::shared_ptr<RingView> unleased;  // where the body is to be copied from when it is wanted
  std::uint32_t slot = 0;
};

struct TypeId {
  std::uint64_t fingerprint = 0;
  bool stamped = false;
};

// Every call runs under its subscription's lock.
class Link {
 public:
  Link(zmq::context_t& context, std::string address, std::uint64_t source, TypeId type, const Policy& policy,
       bool local, std::int64_t clock_offset_ns, std::shared_ptr<SubscriberCounters> counters,
       std::shared_ptr<net::Complaints> complaints)
      : address_(std::move(address)),
        source_(source),
        type_(type),
        policy_(policy),
        clock_offset_ns_(clock_offset_ns),
        counters_(std::move(counters)),
        complaints_(std::move(complaints)),
        socket_(net::make_socket(context, zmq::socket_type::sub, net::is_tcp(address_),
                                 policy.is_reliable ? static_cast<int>(policy.depth) : net::queue_max, 0)) {
#if defined(__linux__)
    const bool shared_memory = local;
#else
    const bool shared_memory = false && local;
#endif
    fd_ = socket_.get(zmq::sockopt::fd);
    socket_.connect(address_);
    for (const char kind : {'M', 'B', 'L'}) socket_.set(zmq::sockopt::subscribe, prefix(kind));
    if (shared_memory) socket_.set(zmq::sockopt::subscribe, prefix('S'));
    attach(shared_memory);
  }

  ~Link() {
    // Leases are given back before the end of the socket tells the publisher to free the column.
    for (auto& ring : rings_) ring.second->close();
  }
  Link(const Link&) = delete;
  Link& operator=(const Link&) = delete;

  int fd() const noexcept { return fd_; }
  std::uint64_t source() const noexcept { return source_; }
  const std::string& address() const noexcept { return address_; }
  bool attached() const noexcept { return attached_; }
  std::int64_t leaving_ns = 0;  // when the publisher was seen to have left; 0: it is there

  // Reads at most `budget` frames into the queue; false if there may be more.
  bool drain(std::deque<Item>& queue, std::size_t budget) {
    for (; budget > 0; --budget) {
      zmq::message_t frame;
      if (!socket_.recv(frame, zmq::recv_flags::dontwait)) return true;
      const bool more = frame.more();
      try {
        accept(frame, queue);
        if (more && net::drop_parts(socket_) > 0) reject("parts after the end of a message");
      } catch (const std::exception& error) {  // MalformedMessage, or no memory for what it says
        reject(error.what());
        if (more) net::drop_parts(socket_);
      }
    }
    return false;
  }

  void reject(const std::string& reason) {
    ++counters_->rejected;
    complaints_->once(reason.substr(0, 24), "rejected a frame of " + address_ + ": " + reason);
  }

 private:
  std::string prefix(char kind) const {
    std::string bytes(wire::prefix_size, '\0');
    wire::write_prefix(reinterpret_cast<std::uint8_t*>(bytes.data()), kind, flags(), source_);
    return bytes;
  }
  std::uint8_t flags() const noexcept { return type_.stamped ? wire::flag_stamp : 0; }

  void attach(bool shared_memory) {
    wire::AttachKey key;
    key.source = source_;
    key.reader = reader_ = random_number();
    key.shared_memory = shared_memory;
    key.strict = policy_.is_reliable;
    key.quota = static_cast<std::uint8_t>(std::min<std::size_t>(policy_.depth + 2, 255));
    key.timeout_ms = static_cast<std::uint32_t>(policy_.timeout.count());
    key_ = wire::pack_key(key, flags());
    socket_.set(zmq::sockopt::subscribe, key_);
  }

  void accept(zmq::message_t& frame, std::deque<Item>& queue) {
    const auto bytes = net::bytes(frame);
    const wire::Header header = wire::read_header(bytes);
    if (header.source != source_ || header.flags != flags()) throw MalformedMessage("not a frame of this publisher");
    if (header.kind == 'A') return on_answer(bytes, queue);
    if (header.fingerprint != type_.fingerprint) throw MalformedMessage("a message of another type");
    if (header.body_size > wire::body_limit) throw MalformedMessage("a body over the limit of 1 GiB");
    switch (header.kind) {
      case 'M': {
        const auto body = wire::body_of(header, bytes, wire::body_limit);
        if (!advance(header.sequence, 1)) return;
        Item& item = append(queue, header.sequence, header.stamp_ns, header.publish_ns);
        item.body = body;  // a frame has 64 bytes or more, so ZeroMQ does not keep it within `frame` itself
        item.frame = std::move(frame);
        return;
      }
      case 'B':
        return on_batch(header, frame, queue);
      case 'L':
        return on_large(header, frame, queue);
      case 'S':
        return on_slot(header, bytes, queue);
      default:
        throw MalformedMessage(std::string("kind '") + header.kind + "' is unknown");
    }
  }

  // Accounts for the numbers up to these; false if they have been seen before.
  bool advance(std::uint64_t sequence, std::uint64_t count) {
    if (known_ && sequence < expected_) return false;
    if (known_ && sequence > expected_) {
      if (sequence - expected_ > wire::jump_max) throw MalformedMessage("a sequence number from nowhere");
      counters_->lost += sequence - expected_;
      for (auto& ring : rings_) ring.second->heal(sequence);
      if (policy_.is_reliable) {  // the publisher may have given us up
        const std::string key = wire::pack_resume(source_, reader_, sequence, flags());
        socket_.set(zmq::sockopt::subscribe, key);
        socket_.set(zmq::sockopt::unsubscribe, key);
      }
    }
    known_ = true;
    expected_ = sequence + count;
    return true;
  }

  Item& append(std::deque<Item>& queue, std::uint64_t sequence, std::int64_t stamp_ns, std::int64_t publish_ns) {
    Item& item = queue.emplace_back();
    item.source = source_;
    item.sequence = sequence;
    item.stamp_ns = stamp_ns;
    item.publish_ns = publish_ns + clock_offset_ns_;
    if (sample_++ % 8 == 0) count_latency(item.publish_ns);
    return item;
  }

  void count_latency(std::int64_t publish_ns) noexcept {
    std::uint64_t left = static_cast<std::uint64_t>(std::max<std::int64_t>(monotonic_ns() - publish_ns, 0));
    std::size_t bucket = 0;
    for (; left != 0 && bucket < 39; left >>= 1) ++bucket;
    ++counters_->latency[bucket];
  }

  void on_large(const wire::Header& header, zmq::message_t& frame, std::deque<Item>& queue) {
    if (frame.size() != wire::header_size || !frame.more()) {
      throw MalformedMessage("a large message without its body");
    }
    zmq::message_t body;
    if (!socket_.recv(body, zmq::recv_flags::dontwait)) throw MalformedMessage("a large message ends after its header");
    const auto bytes = net::bytes(body);
    if (bytes.size() != header.body_size) throw MalformedMessage("a large message with another size than it says");
    if (!advance(header.sequence, 1)) return;
    Item& item = append(queue, header.sequence, header.stamp_ns, header.publish_ns);
    if (bytes.size() >= wire::header_size) {
      item.body = bytes;
      item.frame = std::move(body);
    } else {  // ZeroMQ keeps small messages within `body`, which moves
      auto copy = std::make_shared<std::vector<std::uint8_t>>(bytes.begin(), bytes.end());
      item.body = {copy->data(), copy->size()};
      item.owner = std::move(copy);
    }
  }

  void on_batch(const wire::Header& header, zmq::message_t& frame, std::deque<Item>& queue) {
    wire::body_of(header, net::bytes(frame), wire::body_limit);
    if (header.aux == 0) {  // tells which number comes next, so that a loss at the end of a burst is known
      if (header.body_size != 0) throw MalformedMessage("a batch of bytes without records");
      advance(header.sequence, 0);
      return;
    }
    const auto shared = std::make_shared<zmq::message_t>(std::move(frame));
    const auto records = wire::batch_records(header, net::bytes(*shared));
    if (!advance(header.sequence, header.aux)) return;
    for (std::size_t index = 0; index < records.size(); ++index) {
      Item& item = append(queue, header.sequence + index, records[index].stamp_ns, records[index].publish_ns);
      item.body = records[index].body;
      item.owner = shared;
    }
  }

  void on_slot(const wire::Header& header, Span<const std::uint8_t> bytes, std::deque<Item>& queue) {
    if (bytes.size() != wire::header_size + 8 + wire::place_size) throw MalformedMessage("a descriptor of another size");
    const auto mask = wire::load<std::uint64_t>(bytes.data() + wire::header_size);
    auto ring = rings_.find(static_cast<std::uint32_t>(header.aux >> 32));
    if (ring == rings_.end() && column_ != wire::no_column) {
      const wire::RingPlace place = wire::load_place(bytes.data() + wire::header_size + 8);
      if (place.ring != header.aux >> 32) throw MalformedMessage("a descriptor that places another ring");
      try {
        ring = rings_.emplace(place.ring, std::make_shared<RingView>(source_, place, column_)).first;
      } catch (const ShmUnavailable& error) {
        go_without_memory(error.what());
        return;
      }
    }
    const auto slot = static_cast<std::uint32_t>(header.aux);
    const bool leased = column_ != wire::no_column && (mask >> column_ & 1) != 0;
    if (ring == rings_.end() || !leased) {
      // While `L` is subscribed the message comes that way. A reliable reader that was left out had its share of
      // slots: the gap is counted with the next message.
      if (large_subscribed_ || (known_ && header.sequence < expected_) || ring == rings_.end() || policy_.is_reliable) {
        return;
      }
      advance(header.sequence, 1);
      Item& item = append(queue, header.sequence, header.stamp_ns, header.publish_ns);
      item.body = {nullptr, static_cast<std::size_t>(header.body_size)};
      item.unleased = ring->second;
      item.slot = slot;
      return;
    }
    std::shared_ptr<const void> owner;
    const auto body = ring->second->take(slot, header.sequence, header.body_size, owner);
    if (!advance(header.sequence, 1)) return;  // it was latched, or came as `L`: `owner` gives the slot back
    Item& item = append(queue, header.sequence, header.stamp_ns, header.publish_ns);
    item.body = body;
    item.owner = std::move(owner);
  }

  void on_answer(Span<const std::uint8_t> bytes, std::deque<Item>& queue) {
    if (bytes.size() < wire::key_size || std::memcmp(bytes.data(), key_.data(), wire::key_size) != 0) {
      return;  // the answer to an earlier attempt
    }
    const wire::AttachAnswer answer = wire::read_answer(bytes);
    const bool first = !attached_;
    attached_ = true;
    column_ = answer.column;
    if (column_ != wire::no_column) {
      try {
        // The newest: a descriptor tells of an older one, and the publisher may have let go of that.
        if (!answer.rings.empty()) map_ring(answer.rings.back());
      } catch (const ShmUnavailable& error) {
        const std::string descriptors = "/proc/" + std::to_string(answer.rings.back().pid) + "/fd";
        if (::access(descriptors.c_str(), R_OK | X_OK) != 0) {
          go_without_memory(error.what());
          return;
        }  // it was replaced before we came: the next descriptor says by what
      }
      while (rings_.size() > wire::rings_alive) rings_.erase(rings_.begin());  // leases keep their ring alive
      if (large_subscribed_) {
        socket_.set(zmq::sockopt::unsubscribe, prefix('L'));
        large_subscribed_ = false;
      }
    } else if (!large_subscribed_) {  // the publisher cannot share memory any more
      socket_.set(zmq::sockopt::subscribe, prefix('L'));
      large_subscribed_ = true;
    }
    if (!first || known_) return;
    if (!answer.latched.empty()) latched(answer.latched, queue);
    known_ = true;
    expected_ = answer.sequence;
  }

  void map_ring(const wire::RingPlace& place) {
    if (rings_.count(place.ring) == 0) {
      rings_.emplace(place.ring, std::make_shared<RingView>(source_, place, column_));
    }
  }

  void latched(Span<const std::uint8_t> frame, std::deque<Item>& queue) {
    const wire::Header header = wire::read_header(frame);
    if ((header.kind != 'M' && header.kind != 'L') || header.source != source_ || header.flags != flags() ||
        header.fingerprint != type_.fingerprint) {
      throw MalformedMessage("a latched message of another publisher or type");
    }
    const auto body = wire::body_of(header, frame, wire::body_limit);
    auto copy = std::make_shared<std::vector<std::uint8_t>>(body.begin(), body.end());
    Item& item = append(queue, header.sequence, header.stamp_ns, header.publish_ns);
    item.body = {copy->data(), copy->size()};
    item.owner = std::move(copy);
  }

  void go_without_memory(const std::string& why) {
    complaints_->once("memory " + address_, "cannot share memory with " + address_ + ": " + why);
    if (!large_subscribed_) socket_.set(zmq::sockopt::subscribe, prefix('L'));
    large_subscribed_ = true;
    socket_.set(zmq::sockopt::unsubscribe, prefix('S'));
    socket_.set(zmq::sockopt::unsubscribe, key_);
    column_ = wire::no_column;
    attached_ = false;
    attach(false);
  }

  std::string address_;
  std::uint64_t source_;
  TypeId type_;
  Policy policy_;
  std::int64_t clock_offset_ns_;
  std::shared_ptr<SubscriberCounters> counters_;
  std::shared_ptr<net::Complaints> complaints_;
  zmq::socket_t socket_;  // closes after `~Link` has given the leases back
  int fd_ = -1;
  std::string key_;
  std::uint64_t reader_ = 0;
  bool attached_ = false;
  bool large_subscribed_ = true;
  bool known_ = false;  // whether `expected_` is
  std::uint64_t expected_ = 0;
  std::uint64_t sample_ = 0;
  std::uint32_t column_ = wire::no_column;
  std::map<std::uint32_t, std::shared_ptr<RingView>> rings_;
};

}  // namespace cortex::detail
