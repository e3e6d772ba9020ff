// SPDX-License-Identifier: Apache-2.0
// A node's view of the others: what it hears from the registry (cortex/registry.py describes
// the protocol). It belongs to the node's thread.
#pragma once

#include <algorithm>
#include <cstdint>
#include <cstdlib>
#include <deque>
#include <functional>
#include <iterator>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "cortex/codec.hpp"
#include "cortex/records.hpp"
#include "cortex/runtime.hpp"
#include "cortex/security.hpp"
#include "cortex/socket.hpp"
#include "cortex/wire.hpp"

namespace cortex::detail {

constexpr std::int64_t heartbeat_ns = 250'000'000;
constexpr std::int64_t lease_ns = 1'000'000'000;
constexpr std::int64_t answer_ns = 300'000'000;  // a `Hello` that was not answered for so long is sent again
constexpr std::int64_t stall_ns = 300'000'000;   // a loop that stood still for so long must not judge who was silent

template <class T>
zmq::message_t control_frame(const T& message, std::uint64_t sequence = 0) {
  const std::size_t size = encoded_size(message);
  zmq::message_t frame(wire::header_size + size);
  auto* out = static_cast<std::uint8_t*>(frame.data());
  wire::write_header(out, {'C', 0, 0, Codec<T>::fingerprint, sequence, 0, 0, size, 0});
  encode_into(message, {out + wire::header_size, size});
  return frame;
}

struct ControlFrame {
  wire::Header header;
  Span<const std::uint8_t> body;

  template <class T>
  bool is() const noexcept {
    return header.fingerprint == Codec<T>::fingerprint;
  }
  template <class T>
  T as() const {
    return decode<T>(body);
  }
};

inline ControlFrame parse_control(Span<const std::uint8_t> frame) {
  ControlFrame result;
  result.header = wire::read_header(frame);
  if (result.header.kind != 'C') throw MalformedMessage("not a control frame");
  result.body = wire::body_of(result.header, frame, wire::control_limit);
  return result;
}

inline bool is_topic(const std::string& topic, bool or_pattern = false) noexcept {
  if (topic.empty() || topic.size() > 200 || topic.front() != '/' || topic.back() == '/') return false;
  char before = ' ';
  for (const char c : topic) {
    const bool word = (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z') || (c >= '0' && c <= '9') || c == '_' ||
                      (or_pattern && c == '*');
    if (!word && (c != '/' || before == '/')) return false;
    before = c;
  }
  return true;
}

// The time of the registry's host, estimated from the answers to heartbeats. The answer that tells most counts: one that was quick, or came just now.
class ClockEstimate {
 public:
  // CLOCK_REALTIME of the registry's host less CLOCK_MONOTONIC of this one; 0 before the first answer.
  std::int64_t offset_ns() const noexcept { return offset_ns_; }

  // Takes an answer into account: when it was asked for and when it came by CLOCK_MONOTONIC of this host, and what it
  // said by CLOCK_REALTIME of the registry's.
  void add(std::int64_t asked_ns, std::int64_t told_ns, std::int64_t answered_ns) {
    const std::int64_t trip_ns = answered_ns - asked_ns, at_ns = asked_ns + trip_ns / 2;
    const auto error_ns = [&](const Sample& each) { return each.trip_ns / 2 + (at_ns - each.at_ns) / apart; };
    const Sample sample{at_ns, told_ns - at_ns, trip_ns};
    if (!samples_.empty()) {
      const Sample& last = samples_.back();
      const std::int64_t step_ns = std::abs(sample.offset_ns - last.offset_ns);
      if (step_ns > trip_ns / 2 + last.trip_ns / 2 + (at_ns - last.at_ns) / apart_most) samples_.clear();  // a clock was set
    }
    samples_.push_back(sample);
    if (samples_.size() > sample_count) samples_.pop_front();
    offset_ns_ = std::min_element(samples_.begin(), samples_.end(), [&](const Sample& a, const Sample& b) {
                   return error_ns(a) < error_ns(b);
                 })->offset_ns;
  }

  // Another registry answers from now on: begins anew, from where we are.
  void forget() noexcept { samples_.clear(); }

 private:
  static constexpr std::size_t sample_count = 64;
  static constexpr std::int64_t apart = 10'000;      // clocks that nobody sets run apart by 1 ns in so many,
  static constexpr std::int64_t apart_most = 2'000;  // and none of two computers by more than this

  struct Sample {
    std::int64_t at_ns;
    std::int64_t offset_ns;
    std::int64_t trip_ns;
  };

  std::deque<Sample> samples_;
  std::int64_t offset_ns_ = 0;
};

class Directory {
 public:
  using Nodes = std::map<std::uint64_t, records::NodeRecord>;

  // Without a registry (an empty address) nobody else is known.
  Directory(zmq::context_t& context, std::function<records::NodeRecord()> record, const std::string& registry,
            std::shared_ptr<const Keys> keys, std::shared_ptr<net::Complaints> complaints)
      : record_(std::move(record)), keys_(std::move(keys)), complaints_(std::move(complaints)), address_(registry) {
    own_ = next_record();
    if (has_registry()) connect(context);
  }

  // The socket to poll; null without a registry.
  zmq::socket_t* socket() noexcept { return has_registry() ? &socket_ : nullptr; }

  const Nodes& nodes() const noexcept { return nodes_; }
  std::uint64_t rejected() const noexcept { return rejected_; }
  bool connected() const noexcept { return !has_registry() || welcomed_; }
  // Whether `nodes` has changed since the last call.
  bool take_changed() noexcept { return std::exchange(changed_, false); }

  // CLOCK_REALTIME of the registry's host less CLOCK_MONOTONIC of this one; 0: not known.
  std::int64_t clock_offset_ns() const noexcept { return clock_.offset_ns(); }

  // This node's record has changed; the next `tick` says so.
  void announce() noexcept { dirty_ = true; }

  std::int64_t deadline_ns() const {
    const std::int64_t deadline = tick_ns_ + heartbeat_ns;
    return dirty_ ? tick_ns_ : has_registry() ? std::min(deadline, next_ns_) : deadline;
  }

  void tick() {
    const std::int64_t now_ns = monotonic_ns();
    const std::int64_t stood_ns = tick_ns_ == 0 ? 0 : now_ns - tick_ns_;
    tick_ns_ = now_ns;
    if (stood_ns > stall_ns) forgive(stood_ns);
    if (has_registry()) receive(now_ns);
    if (dirty_) {
      own_ = next_record();
      if (welcomed_) say_hello(now_ns, false);
    }
    if (!has_registry()) return;
    if (now_ns >= next_ns_) beat(now_ns);
    expire(now_ns);
  }

  void leave() {
    if (welcomed_) try_send(control_frame(records::Leave{own_.node}));
  }

 private:
  static constexpr std::int64_t first_wait_ns = 2'000'000;
  static constexpr std::int64_t last_wait_ns = 50'000'000;
  static constexpr std::int64_t clock_max_ns = std::int64_t{1} << 62;

  bool has_registry() const noexcept { return !address_.empty(); }

  bool try_send(zmq::message_t frame) { return socket_.send(std::move(frame), zmq::send_flags::dontwait).has_value(); }

  void connect(zmq::context_t& context) {
    if (address_.rfind("tcp://", 0) != 0 && address_.rfind("ipc://", 0) != 0) {
      throw std::invalid_argument("a registry must be a tcp:// or ipc:// address, got '" + address_ + "'");
    }
    socket_ = net::make_socket(context, zmq::socket_type::dealer, net::is_tcp(address_), 4096, 200);
    socket_.set(zmq::sockopt::maxmsgsize, static_cast<std::int64_t>(wire::control_limit + wire::header_size));
    // Nothing may queue for a registry that is not there: a `send` that fails tells us so at once.
    socket_.set(zmq::sockopt::immediate, true);
    if (keys_ != nullptr && net::is_tcp(address_)) {
      const std::string server_key = keys_->of_host(net::host_of(address_));
      if (!keys_->allows(server_key)) throw std::invalid_argument("the key of " + address_ + " is not authorised");
      keys_->apply_client(socket_, server_key);
    }
    socket_.connect(address_);
    heard_ns_ = monotonic_ns();
  }

  records::NodeRecord next_record() {
    dirty_ = false;
    records::NodeRecord record = record_();
    record.revision = ++revision_;
    return record;
  }

  static void check(const records::NodeRecord& record) {
    bool good = record.node != 0 && record.revision != 0;
    for (const auto& publisher : record.publishers) good = good && publisher.source != 0 && is_topic(publisher.topic);
    for (const auto& subscriber : record.subscribers) good = good && is_topic(subscriber.topic, true);
    for (const auto& service : record.services) good = good && is_topic(service.name);
    for (const auto& endpoint : record.endpoints) {
      for (const auto* address : {&endpoint.lossy, &endpoint.strict, &endpoint.control}) {
        good = good && (address->empty() || address->rfind(endpoint.transport + "://", 0) == 0);
      }
    }
    if (!good) throw MalformedMessage("a record that no node would send");
  }

  // Sending

  void beat(std::int64_t now_ns) {
    if (!welcomed_) return say_hello(now_ns, true);
    const auto asked_ns = static_cast<std::uint64_t>(monotonic_ns());  // the answer returns it
    if (!try_send(control_frame(records::Heartbeat{own_.node, own_.revision, 0}, asked_ns))) return lose(now_ns);
    next_ns_ = now_ns + heartbeat_ns;
    warn_of_silence(now_ns);
  }

  void say_hello(std::int64_t now_ns, bool snapshot) {
    if (!try_send(control_frame(records::Hello{snapshot, own_}))) return lose(now_ns);
    wait_ns_ = asked_ ? std::min(2 * wait_ns_, lease_ns) : answer_ns;
    asked_ = true;
    quiet_ns_ = now_ns + answer_ns;
    next_ns_ = now_ns + (welcomed_ ? heartbeat_ns : wait_ns_);
  }

  // The connection is gone. What was known through it stays, until its lease says otherwise.
  void lose(std::int64_t now_ns) {
    if (welcomed_ || asked_) wait_ns_ = first_wait_ns;
    welcomed_ = asked_ = false;
    next_ns_ = now_ns + wait_ns_;
    wait_ns_ = std::min(2 * wait_ns_, last_wait_ns);
    warn_of_silence(now_ns);
  }

  void warn_of_silence(std::int64_t now_ns) {
    if (now_ns - heard_ns_ > 3 * lease_ns) {
      complaints_->once("silent " + address_, "no answer of the registry at " + address_ + "; is it running? Trying on.");
    }
  }

  // Receiving

  void receive(std::int64_t now_ns) {
    zmq::message_t frame;
    for (int budget = 256; budget > 0 && socket_.recv(frame, zmq::recv_flags::dontwait); --budget) {
      try {
        if (frame.more()) {
          net::drop_parts(socket_);
          throw MalformedMessage("several frames where one was expected");
        }
        on_frame(parse_control(net::bytes(frame)), now_ns);
      } catch (const MalformedMessage& error) {
        ++rejected_;
        complaints_->once("control " + address_, "rejected a frame of " + address_ + ": " + error.what());
      }
    }
  }

  void on_frame(const ControlFrame& frame, std::int64_t now_ns) {
    heard_ns_ = now_ns;
    if (frame.is<records::Welcome>()) {
      on_welcome(frame.as<records::Welcome>(), now_ns);
    } else if (frame.is<records::Alive>()) {
      read_clock(frame.header, monotonic_ns());
      on_alive(frame.as<records::Alive>(), now_ns);
    } else if (frame.is<records::Changed>()) {
      on_changed(frame.as<records::Changed>());
    } else if (frame.is<records::Gone>()) {
      const auto gone = frame.as<records::Gone>();
      count(gone.version);
      named_.erase(gone.node);
      drop(gone.node);
    } else if (frame.is<records::Refused>()) {
      complaints_->once("refused " + address_,
                        address_ + " refuses this node: " + frame.as<records::Refused>().reason);
      wait_ns_ = lease_ns;
      quiet_ns_ = now_ns + lease_ns;
      if (!welcomed_) next_ns_ = quiet_ns_;
    } else {
      throw MalformedMessage("an unexpected control message");
    }
  }

  void greet(std::int64_t now_ns) {
    if (!welcomed_) next_ns_ = now_ns + heartbeat_ns;
    welcomed_ = true;
    asked_ = false;
    quiet_ns_ = 0;
  }

  void on_welcome(const records::Welcome& welcome, std::int64_t now_ns) {
    if (welcome.nodes.size() != welcome.revisions.size()) throw MalformedMessage("a welcome with lists of different lengths");
    greet(now_ns);
    if (welcome.epoch != epoch_) clock_.forget();
    epoch_ = welcome.epoch;
    version_ = welcome.version;
    named_.clear();
    for (std::size_t index = 0; index < welcome.nodes.size(); ++index) named_[welcome.nodes[index]] = welcome.revisions[index];
    named_.erase(own_.node);
    doubt_until_ns_ = now_ns + lease_ns;  // a registry that was just started does not know everybody yet
  }

  // Whether all records that were named have come.
  bool is_complete() const {
    return std::all_of(named_.begin(), named_.end(), [&](const auto& named) {
      const auto known = nodes_.find(named.first);
      return known != nodes_.end() && known->second.revision == named.second;
    });
  }

  void on_alive(const records::Alive& alive, std::int64_t now_ns) {
    if (!welcomed_ || now_ns < quiet_ns_) return;  // the answer to our last `Hello` says more
    if (alive.epoch != epoch_ || alive.version != version_ || !is_complete()) return say_hello(now_ns, true);
    if (alive.held != own_.revision) say_hello(now_ns, false);
  }

  void read_clock(const wire::Header& header, std::int64_t now_ns) {
    const auto asked_ns = static_cast<std::int64_t>(header.sequence);
    const bool is_told = asked_ns > 0 && asked_ns < now_ns && header.publish_ns > 0 && header.publish_ns < clock_max_ns;
    if (is_told && net::is_tcp(address_)) clock_.add(asked_ns, header.publish_ns, now_ns);
  }

  void on_changed(records::Changed changed) {
    check(changed.record);
    const std::uint64_t node = changed.record.node;
    count(changed.version);
    if (node == own_.node) return;
    named_[node] = changed.record.revision;
    const auto known = nodes_.find(node);
    if (known != nodes_.end() && known->second.revision == changed.record.revision) return;
    nodes_[node] = std::move(changed.record);
    changed_ = true;
  }

  void count(std::uint64_t version) noexcept {
    if (welcomed_ && version == version_ + 1) version_ = version;
  }

  // What is known

  void forgive(std::int64_t stood_ns) {
    heard_ns_ += stood_ns;
    doubt_until_ns_ += stood_ns;
  }

  void expire(std::int64_t now_ns) {
    if (!welcomed_ || now_ns <= doubt_until_ns_) return;  // without a registry nobody is removed
    for (auto node = nodes_.begin(); node != nodes_.end();) {
      const bool is_named = named_.count(node->first) != 0;
      changed_ = changed_ || !is_named;
      node = is_named ? std::next(node) : nodes_.erase(node);
    }
  }

  void drop(std::uint64_t node) { changed_ = nodes_.erase(node) > 0 || changed_; }

  std::function<records::NodeRecord()> record_;
  std::shared_ptr<const Keys> keys_;
  std::shared_ptr<net::Complaints> complaints_;
  records::NodeRecord own_;
  std::uint64_t revision_ = 0;
  bool dirty_ = false;
  bool changed_ = false;
  std::uint64_t rejected_ = 0;
  std::int64_t tick_ns_ = 0;
  Nodes nodes_;
  ClockEstimate clock_;
  const std::string address_;  // of the registry; empty: there is none
  zmq::socket_t socket_;
  std::int64_t next_ns_ = 0;   // when to send the next heartbeat or `Hello`
  std::int64_t heard_ns_ = 0;  // when the registry was last heard
  std::int64_t wait_ns_ = first_wait_ns;
  std::int64_t quiet_ns_ = 0;  // until when an `Alive` is no reason for a further `Hello`
  bool asked_ = false;
  bool welcomed_ = false;
  std::uint64_t epoch_ = 0;
  std::uint64_t version_ = 0;
  std::map<std::uint64_t, std::uint64_t> named_;  // revisions of all nodes that the registry has told of
  std::int64_t doubt_until_ns_ = 0;               // when to drop the others
};

}  // namespace cortex::detail
