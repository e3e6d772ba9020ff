// SPDX-License-Identifier: Apache-2.0
// A participant: its publishers and subscriptions, and the thread that keeps them connected.
#pragma once

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdint>
#include <functional>
#include <iostream>
#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <stdexcept>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "cortex/directory.hpp"
#include "cortex/pub_socket.hpp"
#include "cortex/policy.hpp"
#include "cortex/publisher.hpp"
#include "cortex/publisher_core.hpp"
#include "cortex/records.hpp"
#include "cortex/runtime.hpp"
#include "cortex/security.hpp"
#include "cortex/subscriber.hpp"

namespace cortex {

struct Options {
  int domain = -1;                 // 0 to 232; -1 takes CORTEX_DOMAIN, else 0
  // "auto": the one of this host; "off"; or "tcp://host:port"
  std::string registry = runtime::environment("CORTEX_REGISTRY", "auto");
  // Address of an interface to be reached at over tcp; empty: this host only.
  std::string listen = runtime::environment("CORTEX_LISTEN");
  // Directory of CURVE keys for tcp (`cortex keys new`); empty: none.
  std::string keys = runtime::environment("CORTEX_KEYS");
  bool insecure = false;           // without keys, allow plain tcp beyond this host
  Log log = [](const std::string& text) { std::clog << "cortex: " + text + "\n"; };
};

// Registers itself like a Python node. It starts no registry: as long as none answers it knows nobody, says so once
// through the log, and goes on trying.
class Node {
 public:
  explicit Node(std::string name, Options options = {}) : name_(std::move(name)), options_(std::move(options)) {
    if (name_.empty() || name_.size() > 100) {
      throw std::invalid_argument("a node's name has 1 to 100 characters, got '" + name_ + "'");
    }
    if (!options_.keys.empty()) keys_ = std::make_shared<const Keys>(options_.keys);
    check_addresses();
    const std::string directory = runtime::directory(runtime::domain_id(options_.domain));
    host_ = runtime::host_id();
    context_.set(zmq::ctxopt::max_sockets, 8192);
    files_ = std::make_unique<runtime::NodeFiles>(directory, id_);
    open_sockets();
    const std::string registry = options_.registry == "auto"  ? "ipc://" + directory + "/registry"
                                 : options_.registry == "off" ? ""
                                                              : options_.registry;
    directory_ = std::make_unique<detail::Directory>(
        context_, [this] { return record(); }, registry, keys_, complaints_);
    connected_ = directory_->connected();
    thread_ = std::thread([this] { run(); });
  }

  ~Node() { close(); }
  Node(const Node&) = delete;
  Node& operator=(const Node&) = delete;

  const std::string& name() const noexcept { return name_; }
  std::uint64_t id() const noexcept { return id_; }

  template <class T>
  Publisher<T> advertise(const std::string& topic, const PublisherOptions& options = {}) {
    check_open(topic);
    const auto max_wait_ms = static_cast<std::uint32_t>(std::clamp<std::int64_t>(options.max_wait.count(), 0, 86'400'000));
    auto core = detail::PublisherCore::enlist(std::make_shared<detail::PublisherCore>(
        pub_sockets_,
        records::PublisherRecord{topic, random_number(), std::string(Codec<T>::name), Codec<T>::fingerprint,
                                 std::string(Codec<T>::schema), options.latch},
        Codec<T>::stamped, options.inline_max, max_wait_ms, Codec<T>::fixed, complaints_));
    change();
    return Publisher<T>(std::move(core));
  }

  template <class T>
  Subscription<T> subscribe(const std::string& topic, const Policy& policy = keep_last()) {
    check_open(topic);
    auto core = std::make_shared<detail::SubscriptionCore>(
        records::SubscriberRecord{topic, std::string(Codec<T>::name), Codec<T>::fingerprint, policy.text()},
        std::string(Codec<T>::schema), Codec<T>::stamped, policy, complaints_);
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      subscriptions_.push_back(core);
    }
    change();
    return Subscription<T>(std::move(core));
  }

  // Waits until the registry has answered.
  bool wait_for_registry(std::chrono::nanoseconds timeout) const {
    const std::int64_t deadline_ns = detail::deadline(timeout);
    while (!connected_.load()) {
      if (monotonic_ns() >= deadline_ns) return false;
      std::this_thread::sleep_for(std::chrono::milliseconds(1));
    }
    return true;
  }

  // Leaves: subscriptions receive nothing any more, publishers throw, received messages stay valid.
  void close() {
    if (!thread_.joinable()) return;
    stop_ = true;
    waker_.set();
    thread_.join();
    directory_->leave();
    for (const auto& subscription : subscriptions()) subscription->close();
    for (const auto& publisher : publishers()) publisher->close();
    linger();
    {
      const std::lock_guard<std::mutex> lock(pub_sockets_->mutex);
      pub_sockets_->closed = true;
      pub_sockets_->publishers.clear();
      pub_sockets_->lossy.socket.close();
      pub_sockets_->strict.socket.close();
    }
    directory_.reset();
    router_.close();
    authenticator_.reset();
    context_.close();
    files_.reset();
  }

 private:
  static constexpr std::int64_t tick_ns = 20'000'000;
  static constexpr std::int64_t short_tick_ns = 2'000'000;  // for a while after a change, so that peers meet soon
  static constexpr std::int64_t busy_ns = 300'000'000;
  static constexpr std::int64_t clock_step_ns = 500'000;  // others are told when our clock has moved by more
  static constexpr std::int64_t linger_ns = 1'000'000'000;

  void check_addresses() const {
    if (options_.insecure || keys_ != nullptr) return;
    std::vector<std::string> hosts;
    if (!options_.listen.empty()) hosts.push_back(options_.listen);
    if (net::is_tcp(options_.registry)) hosts.push_back(net::host_of(options_.registry));
    for (const auto& host : hosts) {
      if (!net::is_loopback(host)) {
        throw std::invalid_argument("plain tcp to " + host + " is open to the network: set keys (`cortex keys new`), " +
                                    "or insecure = true if the network is trusted");
      }
    }
  }

  void open_sockets() {
    const bool tcp = !options_.listen.empty();
    pub_sockets_ = std::make_shared<detail::PubSockets>(context_, tcp, files_->path("ring"));
    lossy_fd_ = pub_sockets_->lossy.socket.get(zmq::sockopt::fd);
    strict_fd_ = pub_sockets_->strict.socket.get(zmq::sockopt::fd);
    router_ = net::make_socket(context_, zmq::socket_type::router, tcp, 4096, 200);
    router_.set(zmq::sockopt::router_mandatory, true);
    router_.set(zmq::sockopt::maxmsgsize, static_cast<std::int64_t>(wire::control_limit + wire::header_size));
    records::Endpoint local{"ipc", files_->endpoint("lossy"), files_->endpoint("strict"), files_->endpoint("control"),
                            ""};
    pub_sockets_->lossy.socket.bind(local.lossy);
    pub_sockets_->strict.socket.bind(local.strict);
    router_.bind(local.control);
    endpoints_.push_back(local);
    if (!tcp) return;
    if (options_.listen == "0.0.0.0" || options_.listen == "::" || options_.listen == "*") {
      throw std::invalid_argument("listen must be the address of an interface, which others are told, got '" +
                                  options_.listen + "'");
    }
    if (keys_ != nullptr) authenticator_ = std::make_unique<Authenticator>(context_, keys_, complaints_);
    const auto bind = [&](zmq::socket_t& socket) {
      if (keys_ != nullptr) keys_->apply_server(socket);
      const bool sixth = options_.listen.find(':') != std::string::npos, bare = sixth && options_.listen.front() != '[';
      socket.set(zmq::sockopt::ipv6, sixth);  // else others would be told ::ffff:127.0.0.1
      socket.bind("tcp://" + (bare ? "[" + options_.listen + "]" : options_.listen) + ":*");
      return socket.get(zmq::sockopt::last_endpoint);
    };
    const std::string lossy = bind(pub_sockets_->lossy.socket);
    const std::string strict = bind(pub_sockets_->strict.socket);
    endpoints_.push_back({"tcp", lossy, strict, bind(router_), keys_ == nullptr ? "" : keys_->public_key()});
  }

  void check_open(const std::string& topic) const {
    if (!detail::is_topic(topic)) {
      throw std::invalid_argument("a topic is 1 to 200 characters of /name parts of A-Z a-z 0-9 _, got '" + topic + "'");
    }
    if (stop_) throw std::logic_error("node '" + name_ + "' is closed");
  }

  // The set of publishers or subscriptions has changed.
  void change() {
    changed_ = true;
    waker_.set();
  }

  std::vector<std::shared_ptr<detail::SubscriptionCore>> subscriptions() {
    std::vector<std::shared_ptr<detail::SubscriptionCore>> result;
    const std::lock_guard<std::mutex> lock(mutex_);
    for (const auto& weak : subscriptions_) {
      if (auto core = weak.lock()) result.push_back(std::move(core));
    }
    return result;
  }

  std::vector<std::shared_ptr<detail::PublisherCore>> publishers() {
    std::vector<std::shared_ptr<detail::PublisherCore>> result;
    const detail::Lock lock(pub_sockets_->mutex);
    for (const auto& entry : pub_sockets_->publishers) {
      if (!entry.second->is_ending()) result.push_back(entry.second);
    }
    return result;
  }

  // Forgets subscriptions that have ended; true if there were any.
  bool prune() {
    const std::lock_guard<std::mutex> lock(mutex_);
    const std::size_t before = subscriptions_.size();
    subscriptions_.erase(std::remove_if(subscriptions_.begin(), subscriptions_.end(),
                                        [](const auto& weak) {
                                          const auto core = weak.lock();
                                          return core == nullptr || core->closed();
                                        }),
                         subscriptions_.end());
    return subscriptions_.size() != before;
  }

  records::NodeRecord record() {
    records::NodeRecord record;
    record.node = id_;
    record.name = name_;
    record.host = host_;
    record.pid = static_cast<std::uint32_t>(::getpid());
    record.clock_offset_ns = clock_offset_ns_;
    record.endpoints = endpoints_;
    for (const auto& core : publishers()) record.publishers.push_back(core->record);
    for (const auto& core : subscriptions()) record.subscribers.push_back(core->record);
    return record;
  }

  // Waits a little until readers have confirmed all that closed publishers had sent.
  void linger() {
    detail::Backoff backoff(linger_ns);
    bool in_time = true;
    while (in_time) {
      {
        const detail::Lock lock(pub_sockets_->mutex);
        pub_sockets_->refresh();
        if (!pub_sockets_->repeat_ends(monotonic_ns())) return;
      }
      in_time = backoff.wait();
    }
  }

  // The node's thread

  void run() {
    std::int64_t busy_until_ns = monotonic_ns() + busy_ns;
    while (!stop_) {
      wait(monotonic_ns() < busy_until_ns ? short_tick_ns : tick_ns);
      try {
        if (turn()) busy_until_ns = monotonic_ns() + busy_ns;
      } catch (const std::exception& error) {  // no memory or no file descriptors: the next turn may do better
        complaints_->once("turn", std::string("the node's thread had an error and goes on: ") + error.what());
      }
    }
  }

  void wait(std::int64_t most_ns) {
    std::vector<pollfd> fds;
    const auto add = [&](int fd) { fds.push_back({fd, POLLIN, 0}); };
    add(waker_.fd());
    add(router_.get(zmq::sockopt::fd));
    if (directory_->socket() != nullptr) add(directory_->socket()->get(zmq::sockopt::fd));
    add(lossy_fd_);
    add(strict_fd_);
    if (authenticator_ != nullptr) add(authenticator_->fd());
    const std::int64_t left_ns = std::clamp<std::int64_t>(directory_->deadline_ns() - monotonic_ns(), 0, most_ns);
    ::poll(fds.data(), fds.size(), static_cast<int>((left_ns + 999'999) / 1'000'000));
    if ((fds[0].revents & POLLIN) != 0) waker_.clear();
  }

  // Whether the next turn should come soon.
  bool turn() {
    const bool pruned = prune(), closed = pub_sockets_->changed.exchange(false);
    bool changed = changed_.exchange(false) || pruned || closed;
    if (changed) directory_->announce();
    if (authenticator_ != nullptr) authenticator_->serve();
    serve();
    directory_->tick();
    connected_ = directory_->connected();
    {
      const detail::Lock lock(pub_sockets_->mutex, std::try_to_lock);
      if (lock.owns_lock()) {
        pub_sockets_->refresh();
        pub_sockets_->repeat_ends(monotonic_ns());
      }
    }
    changed = directory_->take_changed() || changed;
    const std::int64_t offset_ns = directory_->clock_offset_ns();
    if (offset_ns != 0 && std::abs(offset_ns - clock_offset_ns_) > clock_step_ns) {
      clock_offset_ns_ = offset_ns;
      directory_->announce();
      changed = true;
    }
    const auto subscriptions = this->subscriptions();
    if (changed) match(subscriptions);
    const std::int64_t now_ns = monotonic_ns();
    for (const auto& subscription : subscriptions) subscription->tend(now_ns);
    for (const auto& publisher : publishers()) publisher->tend(now_ns);
    return changed;
  }

  void match(const std::vector<std::shared_ptr<detail::SubscriptionCore>>& subscriptions) {
    if (subscriptions.empty()) return;
    const records::NodeRecord own = record();
    std::vector<const records::NodeRecord*> nodes{&own};
    for (const auto& entry : directory_->nodes()) nodes.push_back(&entry.second);
    for (const auto& subscription : subscriptions) {
      std::vector<detail::Source> sources;
      for (const auto* node : nodes) {
        for (const auto& publisher : node->publishers) {
          if (publisher.topic != subscription->record.topic) continue;
          const bool same_host = node->host == host_;
          const records::Endpoint* endpoint = reach(*node, same_host);
          if (endpoint == nullptr) continue;
          sources.push_back({publisher.source, publisher.fingerprint, publisher.schema,
                             subscription->policy.is_reliable ? endpoint->strict : endpoint->lossy,
                             endpoint->transport == "ipc", same_host ? 0 : node->clock_offset_ns - clock_offset_ns_,
                             endpoint->server_key});
        }
      }
      subscription->match(context_, sources, keys_.get());
    }
  }

  const records::Endpoint* reach(const records::NodeRecord& node, bool same_host) {
    for (const auto& endpoint : node.endpoints) {
      if (endpoint.transport == "ipc" && same_host) return &endpoint;
    }
    std::string why = "it does not listen beyond its host";
    for (const auto& endpoint : node.endpoints) {
      if (endpoint.transport != "tcp") continue;
      if (may_reach(endpoint)) return &endpoint;
      why = endpoint.server_key.empty() ? "it speaks plain tcp"
            : keys_ == nullptr          ? "it wants CURVE, and this node has no keys"
                                        : "its key " + endpoint.server_key + " is not authorised";
    }
    complaints_->once("reach " + std::to_string(node.node), "node '" + node.name + "' cannot be reached: " + why);
    return nullptr;
  }

  // With keys nothing beyond this host is spoken to in plain.
  bool may_reach(const records::Endpoint& endpoint) const {
    if (!endpoint.server_key.empty()) return keys_ != nullptr && keys_->allows(endpoint.server_key);
    const auto local = [](const std::string& address) { return net::is_loopback(net::host_of(address)); };
    return (options_.insecure && keys_ == nullptr) ||
           (local(endpoint.lossy) && local(endpoint.strict) && local(endpoint.control));
  }

  void serve() {
    zmq::message_t identity;
    for (int budget = 256; budget > 0 && router_.recv(identity, zmq::recv_flags::dontwait); --budget) {
      zmq::message_t frame;
      try {
        if (!identity.more() || !router_.recv(frame, zmq::recv_flags::dontwait) || frame.more()) {
          net::drop_parts(router_);
          throw MalformedMessage("not one frame");
        }
        const auto control = detail::parse_control(net::bytes(frame));
        if (!control.is<records::StatsRequest>()) throw MalformedMessage("an unexpected control message");
        router_.send(identity, zmq::send_flags::sndmore | zmq::send_flags::dontwait);
        router_.send(detail::control_frame(stats(), control.header.sequence), zmq::send_flags::dontwait);
      } catch (const MalformedMessage& error) {
        ++rejected_;
        complaints_->once("router", std::string("rejected a control frame: ") + error.what());
      } catch (const zmq::error_t&) {
        // The asker has gone: ROUTER says so, and nobody else waits for the answer.
      }
    }
  }

  records::StatsReply stats() {
    records::StatsReply reply;
    reply.node = id_;
    reply.rejected = rejected_ + directory_->rejected();
    for (const auto& core : publishers()) {
      const auto counters = core->counters();
      reply.publishers.push_back({core->record.topic, core->record.source, static_cast<std::uint32_t>(core->reader_count()),
                                  counters.published, counters.bytes, counters.timeouts, counters.skipped});
    }
    for (const auto& core : subscriptions()) {
      const auto counters = core->counters();
      reply.subscribers.push_back({core->record.topic, core->record.policy, counters.received, counters.lost,
                                   counters.rejected, counters.overtaken, counters.cut_off, counters.latency});
    }
    return reply;
  }

  const std::string name_;
  const Options options_;
  const std::uint64_t id_ = random_number();
  std::string host_;
  std::int64_t clock_offset_ns_ = clock_ns(CLOCK_REALTIME) - monotonic_ns();  // see `NodeRecord`
  std::shared_ptr<net::Complaints> complaints_ = std::make_shared<net::Complaints>(options_.log);
  std::unique_ptr<runtime::NodeFiles> files_;
  std::shared_ptr<const Keys> keys_;
  zmq::context_t context_;
  std::unique_ptr<Authenticator> authenticator_;
  std::shared_ptr<detail::PubSockets> pub_sockets_;
  zmq::socket_t router_;
  int lossy_fd_ = -1;
  int strict_fd_ = -1;
  std::vector<records::Endpoint> endpoints_;
  std::unique_ptr<detail::Directory> directory_;
  std::mutex mutex_;
  std::vector<std::weak_ptr<detail::SubscriptionCore>> subscriptions_;
  net::Waker waker_;
  std::atomic<bool> changed_{true};
  std::atomic<bool> connected_{false};
  std::atomic<bool> stop_{false};
  std::uint64_t rejected_ = 0;
  std::thread thread_;
};

}  // namespace cortex
