// SPDX-License-Identifier: Apache-2.0
// A node's view of the others: what it hears from the registry (cortex/registry.py describes
// the protocol). It belongs to the node's thread.
#pragma once

#include <algorithm>
#include <cstdint>
#include <functional>
#include <map>
#include <memory>
#include <optional>
#include <set>
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

class Directory {
 public:
  using Nodes = std::map<std::uint64_t, records::NodeRecord>;

  // Without a registry (an empty address) nobody else is known.
  Directory(zmq::context_t& context, std::function<records::NodeRecord()> record, const std::string& registry,
            std::shared_ptr<const Keys> keys, std::shared_ptr<net::Complaints> complaints)
      : record_(std::move(record)), keys_(std::move(keys)), complaints_(std::move(complaints)) {
    own_ = next_record();
    if (!registry.empty()) connect(context, registry);
  }

  // The socket to poll; null without a registry.
  zmq::socket_t* socket() noexcept { return link_ == nullptr ? nullptr : &link_->socket; }

  const Nodes& nodes() const noexcept { return nodes_; }
  std::uint64_t rejected() const noexcept { return rejected_; }
  bool connected() const noexcept { return link_ == nullptr || link_->welcomed; }
  // Whether `nodes` has changed since the last call.
  bool take_changed() noexcept { return std::exchange(changed_, false); }

  // This node's record has changed; the next `tick` says so.
  void announce() noexcept { dirty_ = true; }

  std::int64_t deadline_ns() const {
    const std::int64_t deadline = tick_ns_ + heartbeat_ns;
    return dirty_ ? tick_ns_ : link_ == nullptr ? deadline : std::min(deadline, link_->next_ns);
  }

  void tick() {
    const std::int64_t now_ns = monotonic_ns();
    const std::int64_t stood_ns = tick_ns_ == 0 ? 0 : now_ns - tick_ns_;
    tick_ns_ = now_ns;
    if (stood_ns > stall_ns && link_ != nullptr) forgive(*link_, stood_ns);
    if (link_ != nullptr) receive(*link_, now_ns);
    if (dirty_) {
      own_ = next_record();
      if (link_ != nullptr && link_->welcomed) say_hello(*link_, now_ns, false);
    }
    if (link_ == nullptr) return;
    if (now_ns >= link_->next_ns) beat(*link_, now_ns);
    expire(*link_, now_ns);
  }

  void leave() {
    if (link_ != nullptr && link_->welcomed) try_send(link_->socket, control_frame(records::Leave{own_.node}));
  }

 private:
  struct Link {
    std::string address;
    zmq::socket_t socket;
    std::int64_t next_ns = 0;   // when to send the next heartbeat or `Hello`
    std::int64_t heard_ns = 0;  // when the other side was last heard
    std::int64_t wait_ns = first_wait_ns;
    std::int64_t quiet_ns = 0;  // until when an `Alive` is no reason for a further `Hello`
    bool asked = false;
    bool welcomed = false;
    std::uint64_t epoch = 0;
    std::uint64_t version = 0;
    std::map<std::uint64_t, std::uint64_t> missing;  // revisions that `Welcome` named and that have not come yet
    std::map<std::uint64_t, std::int64_t> doubted;   // when to drop nodes that the registry did not name
  };

  static constexpr std::int64_t first_wait_ns = 2'000'000;
  static constexpr std::int64_t last_wait_ns = 50'000'000;

  static bool try_send(zmq::socket_t& socket, zmq::message_t frame) {
    return socket.send(std::move(frame), zmq::send_flags::dontwait).has_value();
  }

  void connect(zmq::context_t& context, const std::string& address) {
    if (address.rfind("tcp://", 0) != 0 && address.rfind("ipc://", 0) != 0) {
      throw std::invalid_argument("a registry must be a tcp:// or ipc:// address, got '" + address + "'");
    }
    auto link = std::make_unique<Link>();
    link->address = address;
    link->socket = net::make_socket(context, zmq::socket_type::dealer, net::is_tcp(address), 4096, 200);
    link->socket.set(zmq::sockopt::maxmsgsize, static_cast<std::int64_t>(wire::control_limit + wire::header_size));
    // Nothing may queue for a registry that is not there: a `send` that fails tells us so at once.
    link->socket.set(zmq::sockopt::immediate, true);
    if (keys_ != nullptr && net::is_tcp(address)) {
      const std::string server_key = keys_->of_host(net::host_of(address));
      if (!keys_->allows(server_key)) throw std::invalid_argument("the key of " + address + " is not authorised");
      keys_->apply_client(link->socket, server_key);
    }
    link->socket.connect(address);
    link->heard_ns = monotonic_ns();
    link_ = std::move(link);
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

  void beat(Link& link, std::int64_t now_ns) {
    if (!link.welcomed) return say_hello(link, now_ns, true);
    if (!try_send(link.socket, control_frame(records::Heartbeat{own_.node, own_.revision, 0}))) return lose(link, now_ns);
    link.next_ns = now_ns + heartbeat_ns;
    warn_of_silence(link, now_ns);
  }

  void say_hello(Link& link, std::int64_t now_ns, bool snapshot) {
    if (!try_send(link.socket, control_frame(records::Hello{snapshot, own_}))) return lose(link, now_ns);
    link.wait_ns = link.asked ? std::min(2 * link.wait_ns, lease_ns) : answer_ns;
    link.asked = true;
    link.quiet_ns = now_ns + answer_ns;
    link.next_ns = now_ns + (link.welcomed ? heartbeat_ns : link.wait_ns);
  }

  // The connection is gone. What was known through it stays, until its lease says otherwise.
  void lose(Link& link, std::int64_t now_ns) {
    if (link.welcomed || link.asked) link.wait_ns = first_wait_ns;
    link.welcomed = link.asked = false;
    link.next_ns = now_ns + link.wait_ns;
    link.wait_ns = std::min(2 * link.wait_ns, last_wait_ns);
    warn_of_silence(link, now_ns);
  }

  void warn_of_silence(const Link& link, std::int64_t now_ns) {
    if (now_ns - link.heard_ns > 3 * lease_ns) {
      complaints_->once("silent " + link.address, "no answer of the registry at " + link.address + "; is it running? Trying on.");
    }
  }

  // Receiving

  void receive(Link& link, std::int64_t now_ns) {
    zmq::message_t frame;
    for (int budget = 256; budget > 0 && link.socket.recv(frame, zmq::recv_flags::dontwait); --budget) {
      try {
        if (frame.more()) {
          net::drop_parts(link.socket);
          throw MalformedMessage("several frames where one was expected");
        }
        on_frame(link, parse_control(net::bytes(frame)), now_ns);
      } catch (const MalformedMessage& error) {
        ++rejected_;
        complaints_->once("control " + link.address, "rejected a frame of " + link.address + ": " + error.what());
      }
    }
  }

  void on_frame(Link& link, const ControlFrame& frame, std::int64_t now_ns) {
    link.heard_ns = now_ns;
    if (frame.is<records::Welcome>()) {
      on_welcome(link, frame.as<records::Welcome>(), now_ns);
    } else if (frame.is<records::Alive>()) {
      on_alive(link, frame.as<records::Alive>(), now_ns);
    } else if (frame.is<records::Changed>()) {
      on_changed(link, frame.as<records::Changed>());
    } else if (frame.is<records::Gone>()) {
      const auto gone = frame.as<records::Gone>();
      count(link, gone.version);
      link.missing.erase(gone.node);
      link.doubted.erase(gone.node);
      drop(gone.node);
    } else if (frame.is<records::Refused>()) {
      complaints_->once("refused " + link.address,
                        link.address + " refuses this node: " + frame.as<records::Refused>().reason);
      link.wait_ns = lease_ns;
      link.quiet_ns = now_ns + lease_ns;
      if (!link.welcomed) link.next_ns = link.quiet_ns;
    } else {
      throw MalformedMessage("an unexpected control message");
    }
  }

  void greet(Link& link, std::int64_t now_ns) {
    if (!link.welcomed) link.next_ns = now_ns + heartbeat_ns;
    link.welcomed = true;
    link.asked = false;
    link.quiet_ns = 0;
  }

  void on_welcome(Link& link, const records::Welcome& welcome, std::int64_t now_ns) {
    if (welcome.nodes.size() != welcome.revisions.size()) throw MalformedMessage("a welcome with lists of different lengths");
    greet(link, now_ns);
    link.epoch = welcome.epoch;
    link.version = welcome.version;
    link.missing.clear();
    std::set<std::uint64_t> named;
    for (std::size_t index = 0; index < welcome.nodes.size(); ++index) {
      const std::uint64_t node = welcome.nodes[index];
      if (node == own_.node) continue;
      named.insert(node);
      const auto known = nodes_.find(node);
      if (known == nodes_.end() || known->second.revision != welcome.revisions[index]) {
        link.missing[node] = welcome.revisions[index];
      }
    }
    // A registry that was just started does not know everybody yet: one lease of grace.
    std::map<std::uint64_t, std::int64_t> doubted;
    for (const auto& entry : nodes_) {
      const std::uint64_t node = entry.first;
      if (named.count(node) != 0) continue;
      const auto since = link.doubted.find(node);
      doubted[node] = since != link.doubted.end() ? since->second : now_ns + lease_ns;
    }
    link.doubted = std::move(doubted);
  }

  void on_alive(Link& link, const records::Alive& alive, std::int64_t now_ns) {
    if (!link.welcomed || now_ns < link.quiet_ns) return;  // the answer to our last `Hello` says more
    if (alive.epoch != link.epoch || alive.version != link.version || !link.missing.empty()) return say_hello(link, now_ns, true);
    if (alive.held != own_.revision) say_hello(link, now_ns, false);
  }

  void on_changed(Link& link, records::Changed changed) {
    check(changed.record);
    const std::uint64_t node = changed.record.node;
    count(link, changed.version);
    link.missing.erase(node);
    link.doubted.erase(node);
    if (node == own_.node) return;
    const auto known = nodes_.find(node);
    if (known != nodes_.end() && known->second.revision == changed.record.revision) return;
    nodes_[node] = std::move(changed.record);
    changed_ = true;
  }

  static void count(Link& link, std::uint64_t version) noexcept {
    if (link.welcomed && version == link.version + 1) link.version = version;
  }

  // What is known

  static void forgive(Link& link, std::int64_t stood_ns) {
    link.heard_ns += stood_ns;
    for (auto& doubt : link.doubted) doubt.second += stood_ns;
  }

  void expire(Link& link, std::int64_t now_ns) {
    if (!link.welcomed) return;  // without a registry nobody is removed
    for (auto doubt = link.doubted.begin(); doubt != link.doubted.end();) {
      if (now_ns > doubt->second) drop(doubt->first);
      doubt = now_ns > doubt->second ? link.doubted.erase(doubt) : std::next(doubt);
    }
  }

  void drop(std::uint64_t node) { changed_ = nodes_.erase(node) > 0 || changed_; }

  std::function<records::NodeRecord()> record_;
  std::shared_ptr<const Keys> keys_;
  std::shared_ptr<net::Complaints> complaints_;
  std::unique_ptr<Link> link_;
  records::NodeRecord own_;
  std::uint64_t revision_ = 0;
  bool dirty_ = false;
  bool changed_ = false;
  std::uint64_t rejected_ = 0;
  std::int64_t tick_ns_ = 0;
  Nodes nodes_;
};

}  // namespace cortex::detail
