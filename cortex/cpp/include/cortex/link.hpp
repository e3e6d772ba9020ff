// SPDX-License-Identifier: Apache-2.0
// One subscriber's connection to one publisher: attaching, sequence numbers, leases of shared memory.
#pragma once

#include <cstdint>
#include <cstring>
#include <deque>
#include <functional>
#include <map>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "cortex/broadcast.hpp"
#include "cortex/policy.hpp"
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
};

struct TypeId {
  std::uint64_t fingerprint = 0;
  bool stamped = false;
};

// Every call runs under its subscription's lock.
class Link {
 public:
  Link(zmq::context_t& context, std::string address, std::uint64_t source, TypeId type, const Policy& policy,
       bool local, const std::function<void(zmq::socket_t&)>& secure,
       std::shared_ptr<SubscriberCounters> counters, std::shared_ptr<net::Complaints> complaints)
      : address_(std::move(address)),
        source_(source),
        type_(type),
        policy_(policy),
        counters_(std::move(counters)),
        complaints_(std::move(complaints)),
        socket_(net::make_socket(context, zmq::socket_type::sub, net::is_tcp(address_),
                                 policy.is_reliable ? static_cast<int>(policy.depth) : net::queue_max, 0)) {
    fd_ = socket_.get(zmq::sockopt::fd);
    secure(socket_);
    socket_.connect(address_);
    for (const char kind : {'M', 'N', 'L'}) socket_.set(zmq::sockopt::subscribe, prefix(kind));
    attach(local);
  }

  Link(const Link&) = delete;
  Link& operator=(const Link&) = delete;

  // Becomes readable, as the ring's wakeup does, when something may have come.
  int fd() const noexcept { return fd_; }
  // The wakeup of the ring, -1 if there is none.
  int wakeup_fd() const noexcept { return end_ == nullptr ? -1 : end_->fd(); }
  std::uint64_t source() const noexcept { return source_; }
  const std::string& address() const noexcept { return address_; }
  bool attached() const noexcept { return attached_; }
  std::int64_t clock_offset_ns = 0;  // what to add to the publisher's clock to read it on ours
  std::int64_t leaving_ns = 0;  // when the publisher had left and there was still something to read; 0: it is there

  // There may be more to read, if the publisher has left or not.
  void stay(std::int64_t now_ns) noexcept {
    if (leaving_ns != 0) leaving_ns = now_ns;
  }

  // The publisher has left: what it wrote into its ring counts, also if its answer never came.
  void leave() {
    if (!attached_ && end_ != nullptr && end_->welcomed() > 0) enter_ring();
  }

  // Whether the publisher has said that nothing follows what has come.
  bool has_ended() const noexcept { return known_ && expected_ + 1 == ended_; }

  // The publisher has left, and all that came of it has been read: what it has published besides is lost.
  void end() {
    try {
      if (known_ && expected_ < reached_) advance(reached_, 0);
      if (!policy_.is_reliable || !known_ || expected_ < ended_) return;
      ++counters_->cut_off;
      complaints_->once("cut off " + address_, "a publisher at " + address_ + " ended without saying how much it had sent");
    } catch (const MalformedMessage& error) {
      reject(error.what());
    }
  }

  // Reads at most `budget` frames into the queue, those of the ring first; false if there may be more.
  bool drain(std::deque<Item>& queue, std::size_t budget) {
    for (; budget > 0; --budget) {
      if (in_ring_) {
        const auto bytes = end_->next();
        if (end_->is_crowded()) return true;
        if (!bytes.empty()) {
          take_in({bytes, nullptr}, queue);
          continue;
        }
        if (end_->state() == CORTEX_BROKEN) reject("something in the ring is no frame");
        if (end_->state() != CORTEX_SOUND) go_without_memory("nothing more comes through its ring");
      }
      zmq::message_t message;
      if (!socket_.recv(message, zmq::recv_flags::dontwait)) return true;
      const bool more = message.more();
      const bool taken = take_in({net::bytes(message), &message}, queue);
      if (more && net::drop_parts(socket_) > 0 && taken) reject("parts after the end of a message");
    }
    return false;
  }

  // Whether the next message waits, because too many large ones are kept; it may be left out.
  bool is_crowded() const noexcept { return in_ring_ && end_->is_crowded(); }
  void pass_over() noexcept { end_->pass_over(); }

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

  // A frame where it lies: in a message of ZeroMQ, or in the buffer of our end of the ring (null) until the next is read.
  struct Arrival {
    Span<const std::uint8_t> bytes;
    zmq::message_t* message;
    // Has 64 bytes or more, so that ZeroMQ does not keep it within the object, which moves.
    zmq::message_t keep() const {
      return message == nullptr ? zmq::message_t(bytes.data(), bytes.size()) : std::move(*message);
    }
  };

  void attach(bool shared_memory) {
    using wire::Key;
    const auto quota = std::min<std::uint64_t>(policy_.depth + 2, 255), timeout_ms = static_cast<std::uint64_t>(policy_.timeout.count());
    reader_ = random_number();
    if (shared_memory && net::is_ipc(address_)) {
      end_ = RingReader::open(address_.substr(6, address_.rfind('.') - 6) + ".ring", source_, reader_);
    }
    const std::uint64_t options = (end_ != nullptr ? Key::shared_memory : 0) | (policy_.is_reliable ? Key::strict : 0);
    key_ = Key('A', flags(), source_, reader_, options | quota << 8 | timeout_ms << 32).bytes();
    socket_.set(zmq::sockopt::subscribe, key_);
  }

  // False if it was rejected.
  bool take_in(const Arrival& arrival, std::deque<Item>& queue) {
    wire::Header header;
    try {
      header = wire::read_header(arrival.bytes);
      accept(header, arrival, queue);
      return true;
    } catch (const std::exception& error) {  // MalformedMessage, or no memory for what it says
      reject(error.what());
      // A message that was rejected is accounted for, if it is the one that was to come.
      const bool large = (header.kind == 'L' || header.kind == 'S') && header.source == source_;
      if (large && known_ && header.sequence == expected_) ++expected_;
      return false;
    }
  }

  void accept(const wire::Header& header, const Arrival& arrival, std::deque<Item>& queue) {
    if (header.source != source_ || header.flags != flags()) throw MalformedMessage("not a frame of this publisher");
    if (arrival.message == nullptr && std::strchr("MNS", header.kind) == nullptr) {
      throw MalformedMessage("a frame in the ring that belongs into the socket");
    }
    if (header.kind == 'A') return on_answer(arrival.bytes, queue);
    if (in_ring_ && arrival.message != nullptr) return;  // it came through the ring
    if (header.fingerprint != type_.fingerprint) throw MalformedMessage("a message of another type");
    if (header.body_size > wire::body_limit) throw MalformedMessage("a body over the limit of 1 GiB");
    switch (header.kind) {
      case 'M': {
        wire::body_of(header, arrival.bytes, wire::body_limit);
        if (!advance(header.sequence, 1)) return;
        Item& item = append(queue, header.sequence, header.stamp_ns, header.publish_ns);
        item.frame = arrival.keep();
        item.body = {net::bytes(item.frame).data() + wire::header_size, static_cast<std::size_t>(header.body_size)};
        return;
      }
      case 'N':
        return on_next(header, arrival);
      case 'L':
        return on_large(header, *arrival.message, queue);  // none comes through a ring
      case 'S':
        return on_slot(header, arrival, queue);
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
      if (policy_.is_reliable) confirm(sequence);  // the publisher may have given us up
    }
    known_ = true;
    expected_ = sequence + count;
    return true;
  }

  // Tells the publisher that all below a sequence is accounted for.
  void confirm(std::uint64_t sequence) {
    const std::string key = wire::Key('R', flags(), source_, reader_, sequence).bytes();
    socket_.set(zmq::sockopt::subscribe, key);
    socket_.set(zmq::sockopt::unsubscribe, key);
  }

  Item& append(std::deque<Item>& queue, std::uint64_t sequence, std::int64_t stamp_ns, std::int64_t publish_ns) {
    Item& item = queue.emplace_back();
    item.source = source_;
    item.sequence = sequence;
    item.stamp_ns = stamp_ns;
    item.publish_ns = publish_ns + clock_offset_ns;
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
      keep_copy(item, bytes);
    }
  }

  static void keep_copy(Item& item, Span<const std::uint8_t> body) {
    auto copy = std::make_shared<std::vector<std::uint8_t>>(body.begin(), body.end());
    item.body = {copy->data(), copy->size()};
    item.owner = std::move(copy);
  }

  // Tells which number comes next, so that a loss at the end of a burst is known, or that none does.
  void on_next(const wire::Header& header, const Arrival& arrival) {
    if (header.body_size != 0 || arrival.bytes.size() != wire::header_size) throw MalformedMessage("a body where there is none");
    if (!advance(header.sequence, 0)) return;
    const std::uint64_t last = header.aux & wire::last;
    if (last != 0) ended_ = header.sequence + 1;
    if (!in_ring_) confirm(header.sequence + last);
  }

  void on_slot(const wire::Header& header, const Arrival& arrival, std::deque<Item>& queue) {
    Span<const std::uint8_t> body;
    auto owner = arrival.message == nullptr ? end_->take_body(body) : nullptr;
    if (owner == nullptr) throw MalformedMessage("a slot that does not hold its message");
    if (!advance(header.sequence, 1)) return;  // it was latched: `owner` gives the slot back
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
    reached_ = std::max(reached_, answer.sequence);
    const bool is_new = !known_ || std::exchange(begins_again_, false);
    if (!std::exchange(known_, true)) expected_ = answer.sequence;  // what is lost counts, also in a ring that we cannot read
    if (first && !use_ring()) {
      attached_ = false;
      begins_again_ = is_new;
      return;  // it is asked again
    }
    if (policy_.is_reliable && !in_ring_) confirm(expected_);
    if (is_new && !answer.latched.empty()) latched(answer.latched, queue);
  }

  // If the publisher has taken us in, it sends all that follows through its ring; false if we cannot read it.
  bool use_ring() {
    const int welcomed = end_ == nullptr ? 0 : end_->welcomed();
    if (welcomed < 0) go_without_memory("its ring cannot be mapped");
    if (welcomed > 0) enter_ring();
    return welcomed >= 0;
  }

  void enter_ring() {
    in_ring_ = attached_ = true;
    if (!std::exchange(known_, true)) expected_ = end_->first();  // what is lost counts from there on
    for (const char kind : {'M', 'N', 'L'}) socket_.set(zmq::sockopt::unsubscribe, prefix(kind));
  }

  void latched(Span<const std::uint8_t> frame, std::deque<Item>& queue) {
    const wire::Header header = wire::read_header(frame);
    if ((header.kind != 'M' && header.kind != 'L') || header.source != source_ || header.flags != flags() ||
        header.fingerprint != type_.fingerprint) {
      throw MalformedMessage("a latched message of another publisher or type");
    }
    const auto body = wire::body_of(header, frame, wire::body_limit);
    if (header.sequence >= expected_) advance(header.sequence, 1);
    keep_copy(append(queue, header.sequence, header.stamp_ns, header.publish_ns), body);
  }

  // Attaches anew, as another reader: what follows comes through the socket.
  void go_without_memory(const std::string& why) {
    complaints_->once("memory " + address_, "cannot share memory with " + address_ + ": " + why);
    if (in_ring_) {
      for (const char kind : {'M', 'N', 'L'}) socket_.set(zmq::sockopt::subscribe, prefix(kind));
    }
    in_ring_ = false;
    end_.reset();
    const std::string key = key_;
    attached_ = false;
    attach(false);
    socket_.set(zmq::sockopt::unsubscribe, key);  // after that, so that the publisher counts us all the time
  }

  std::string address_;
  std::uint64_t source_;
  TypeId type_;
  Policy policy_;
  std::shared_ptr<SubscriberCounters> counters_;
  std::shared_ptr<net::Complaints> complaints_;
  zmq::socket_t socket_;
  int fd_ = -1;
  std::string key_;
  std::uint64_t reader_ = 0;
  bool attached_ = false;
  bool known_ = false;  // whether `expected_` is
  bool begins_again_ = false;  // the first answer told of a ring that we cannot read: the next brings the latched message
  std::uint64_t ended_ = 0;  // one more than the number at which the publisher said that the stream ends
  std::uint64_t expected_ = 0;
  std::uint64_t reached_ = 0;  // the highest number below which all has been given away
  std::uint64_t sample_ = 0;
  std::unique_ptr<RingReader> end_;  // of the ring, if we have asked for it
  bool in_ring_ = false;             // else everything comes through the socket
};

}  // namespace cortex::detail
