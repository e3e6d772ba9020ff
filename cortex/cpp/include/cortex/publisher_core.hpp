// SPDX-License-Identifier: Apache-2.0
// What one publisher does with its node's sockets: readers, inline frames, slots of shared memory.
#pragma once

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdint>
#include <cstring>
#include <memory>
#include <mutex>
#include <stdexcept>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "cortex/pub_socket.hpp"
#include "cortex/policy.hpp"
#include "cortex/readers.hpp"
#include "cortex/records.hpp"
#include "cortex/runtime.hpp"
#include "cortex/socket.hpp"
#include "cortex/wire.hpp"

namespace cortex::detail {

// What does not depend on the type of the messages. Bodies are written without the lock, by one thread at a time.
class PublisherCore {
 public:
  PublisherCore(std::shared_ptr<PubSockets> pub_sockets, records::PublisherRecord known, bool stamped, std::size_t inline_max,
                std::uint32_t max_wait_ms, bool exact, std::shared_ptr<net::Complaints> complaints)
      : record(std::move(known)),
        pub_sockets_(std::move(pub_sockets)),
        flags_(stamped ? wire::flag_stamp : 0),
        inline_max_(inline_max),
        max_wait_ms_(max_wait_ms),
        exact_(exact),
        complaints_(std::move(complaints)) {}

  // What users share: the publisher closes with the last of them, but lasts until readers of sockets have confirmed it.
  static std::shared_ptr<PublisherCore> enlist(std::shared_ptr<PublisherCore> core) {
    const Lock lock(core->pub_sockets_->mutex);
    core->pub_sockets_->publishers[core->record.source] = core;
    return {core.get(), [core](PublisherCore*) { core->close(); }};
  }
  PublisherCore(const PublisherCore&) = delete;
  PublisherCore& operator=(const PublisherCore&) = delete;

  const records::PublisherRecord record;  // what others know of it

  std::size_t inline_max() const noexcept { return inline_max_; }

  // One thread at a time encodes large messages: order, and one slot in hand, not many.
  std::mutex large_mutex;

  // Whether a message would reach anybody; otherwise it is counted as published and need not be encoded.
  bool wanted() {
    Lock lock(pub_sockets_->mutex);
    prepare(lock, false);
    if (!readers_.empty() || record.latch) return true;
    ++sequence_;
    ++counters_.published;
    return false;
  }

  // Sends a frame whose body is in place after room for the header; false if a reliable subscriber lost it.
  bool publish_inline(zmq::message_t frame, std::int64_t stamp_ns) {
    Lock lock(pub_sockets_->mutex);
    prepare(lock, false);
    waited_ns_ = 0;
    const std::size_t size = frame.size() - wire::header_size;
    write_header(static_cast<std::uint8_t*>(frame.data()), 'M', sequence_++, stamp_ns, size, 0);
    ++counters_.published;
    counters_.bytes += size;
    if (record.latch) latched_.assign(static_cast<const char*>(frame.data()), frame.size());
    if (has_sockets(pub_sockets_->lossy)) pub_sockets_->lossy.try_send(share(frame));
    bool on_time = !is_lagging_ && !readers_.is_moving(true);
    if (has_sockets(pub_sockets_->strict)) on_time &= send_strict(lock, frame, zmq::send_flags::none);
    on_time &= send_to_ring(lock, net::bytes(frame));
    if (!on_time) ++counters_.timeouts;
    return on_time;
  }

  // Memory for a message; for a loan without a buffer if every slot is out on loan.
  Slot acquire(std::size_t size, bool for_loan) {
    Lock lock(pub_sockets_->mutex);
    prepare(lock, true);
    waited_ns_ = 0;
    Slot slot;
    if (provide(lock, size)) {
      wait_for_readers(lock, 0, [&] {
        if (!readers_.has_members()) return true;
        slot = readers_.acquire();
        return slot.index >= 0;
      });
      if (slot.index < 0 && for_loan) {
        ++sequence_;
        ++counters_.published;
        ++counters_.skipped;
        return {};
      }
    }
    if (slot.index < 0) slot = private_slot(size);
    slot.waited_ns = waited_ns_;
    return slot;
  }

  void abandon(const Slot& slot) noexcept {
    if (slot.index < 0) return;
    const Lock lock(pub_sockets_->mutex);
    readers_.abandon(slot);
  }

  // Sends what was written into a slot; false if a reliable subscriber lost it.
  bool publish_slot(const Slot& slot, std::size_t size, std::int64_t stamp_ns) {
    Lock lock(pub_sockets_->mutex);
    prepare(lock, true);
    waited_ns_ = slot.waited_ns;
    const std::uint64_t sequence = sequence_++;
    ++counters_.published;
    counters_.bytes += size;
    std::string head(wire::header_size, '\0');
    auto* header = reinterpret_cast<std::uint8_t*>(head.data());
    write_header(header, 'L', sequence, stamp_ns, size, 0);
    if (record.latch) {
      latched_ = head;
      latched_.append(reinterpret_cast<const char*>(slot.buffer.data()), size);
    }
    bool on_time = !is_lagging_ && !readers_.is_moving(true);
    bool passed_over = false;
    for (PubSocket* pub_socket : {&pub_sockets_->lossy, &pub_sockets_->strict}) {
      if (!pub_sockets_->closed && has_sockets(*pub_socket)) on_time &= send_large(lock, *pub_socket, slot, head, size, passed_over);
    }
    on_time &= send_large_to_ring(lock, slot, sequence, stamp_ns, size);
    if (passed_over) ++counters_.skipped;
    if (!on_time) ++counters_.timeouts;
    return on_time;
  }

  // After a burst: tells readers which number comes next, so that they know of a loss at its end.
  void tend(std::int64_t now_ns) {
    const Lock lock(pub_sockets_->mutex, std::try_to_lock);
    if (!lock.owns_lock() || closed_ || pub_sockets_->closed) return;
    if (blocked_ || told_ == sequence_ || now_ns - refresh_at_ns_ < silence_ns) return;
    zmq::message_t frame = last_frame();
    bool sent = !is_lagging_ && readers_.put(net::bytes(frame)) == CORTEX_WRITTEN;
    if (has_sockets(pub_sockets_->lossy)) pub_sockets_->lossy.try_send(share(frame));
    if (has_sockets(pub_sockets_->strict)) sent &= pub_sockets_->strict.try_send(std::move(frame));
    if (sent) told_ = sequence_;
  }

  // A reader has come; called under the lock.
  void attach(PubSocket& pub_socket, const std::string& key, const wire::Key& request) {
    if (closed_ || readers_.size() >= 1024) return;
    const auto& reader = readers_.add(pub_socket, key, request, max_wait_ms_, sequence_, pub_sockets_->listener);
    if (pub_sockets_->listener.heard_other_version) {
      complaints_->once("version", "a subscriber with another version of Cortex cannot share memory, and gets messages through its socket");
    }
    answer(*reader, latched_);
  }

  // A reader has left or died; called under the lock.
  void detach(const std::string& key) {
    const auto reader = readers_.remove(key);
    if (reader == nullptr) return;
    if (reader->pub_socket->strict && reader->member < 0) is_lagging_ = false;
    if (closed_) settle();
  }

  // A reliable reader has accounted for all below a sequence; called under the lock.
  void resume(std::uint64_t number, std::uint64_t sequence) noexcept {
    bool is_new = false;
    for (const auto& reader : readers_.all()) {
      if (reader->request.reader != number) continue;
      reader->confirmed = std::max(reader->confirmed, sequence);
      is_new = !std::exchange(reader->has_answer, true);
    }
    if (!is_new && sequence >= lagging_until_) is_lagging_ = false;  // else it was too late once more since, or another was
    if (closed_) settle();
  }

  // Tells those that have not confirmed the end of it again: libzmq drops it where a queue is full; false if it has
  // not ended. Called under the lock.
  bool repeat_end() {
    if (!closed_) return false;
    zmq::message_t frame = last_frame();
    for (PubSocket* pub_socket : {&pub_sockets_->lossy, &pub_sockets_->strict}) {
      if (has_sockets(*pub_socket)) pub_socket->try_send(share(frame));
    }
    return true;
  }

  std::size_t reader_count() {
    const Lock lock(pub_sockets_->mutex);
    if (!pub_sockets_->closed) pub_sockets_->refresh();
    return readers_.attached_count();
  }

  PublisherCounters counters() const {
    const Lock lock(pub_sockets_->mutex);
    return counters_;
  }

  // Whether it waits for readers to confirm its end; called under the lock.
  bool is_ending() const noexcept { return closed_; }

  bool closed() const {
    const Lock lock(pub_sockets_->mutex);
    return closed_ || pub_sockets_->closed;
  }

  // Leaves the topic. What readers have not got yet is delivered by the node.
  void close() noexcept {
    const Lock lock(pub_sockets_->mutex);
    if (closed_) return;
    closed_ = true;
    pub_sockets_->changed = true;
    latched_.clear();
    try {
      readers_.end(net::bytes(last_frame()));  // what is in the ring stays the readers'
      if (!pub_sockets_->closed) repeat_end();
    } catch (...) {  // no memory to say so: the node does it again
    }
    settle();
  }

 private:
  static constexpr std::int64_t refresh_ns = 1'000'000;
  static constexpr std::int64_t silence_ns = 100'000'000;
  static constexpr std::uint32_t move_ms = 100;

  void write_header(std::uint8_t* out, char kind, std::uint64_t sequence, std::int64_t stamp_ns, std::uint64_t size,
                    std::uint64_t aux) const noexcept {
    wire::write_header(out, {kind, flags_, record.source, record.fingerprint, sequence, stamp_ns, monotonic_ns(), size, aux});
  }

  // Waits for our turn if another thread is held up by a reader, and sees who has come and gone.
  void prepare(Lock& lock, bool now) {
    while (blocked_) {
      lock.unlock();
      std::this_thread::sleep_for(std::chrono::microseconds(100));
      lock.lock();
    }
    if (closed_ || pub_sockets_->closed) throw std::logic_error("the publisher of " + record.topic + " is closed");
    const std::int64_t time_ns = monotonic_ns();
    if (!now && time_ns < refresh_at_ns_) return;
    refresh_at_ns_ = time_ns + refresh_ns;
    pub_sockets_->refresh();
  }

  // Says how many messages there were, and at the end that there are no more.
  zmq::message_t last_frame() const {
    zmq::message_t frame(wire::header_size);
    write_header(static_cast<std::uint8_t*>(frame.data()), 'N', sequence_, 0, 0, closed_ ? wire::last : 0);
    return frame;
  }

  // Lets go of readers that know all there was, or need not say so; the last ends it.
  void settle() noexcept {
    readers_.settle(sequence_);
    if (readers_.empty()) pub_sockets_->publishers.erase(record.source);
  }

  void answer(const Reader& reader, const std::string& latched) {
    wire::AttachAnswer answer;
    answer.sequence = sequence_;
    answer.latched = {reinterpret_cast<const std::uint8_t*>(latched.data()), latched.size()};
    zmq::message_t frame = message_of(wire::pack_answer(reader.key, answer));
    if (!reader.pub_socket->try_send(share(frame)) && reader.pub_socket->strict) reader.pub_socket->send_anyway(std::move(frame));
  }

  // Whether the socket itself serves some reader.
  bool has_sockets(const PubSocket& pub_socket) const noexcept { return readers_.socket_count(pub_socket) > 0; }

  // Tries to send until it works or the message was held up for its time; the lock is let go while sleeping.
  template <class Attempt>
  bool await_room(Lock& lock, std::uint32_t timeout_ms, Attempt attempt) {
    const std::int64_t begin_ns = monotonic_ns() - waited_ns_;
    Backoff backoff(std::int64_t{timeout_ms} * 1'000'000 - waited_ns_);
    bool sent = false;
    bool in_time = true;
    blocked_ = true;
    while (!sent && in_time) {
      lock.unlock();
      in_time = backoff.wait();
      lock.lock();
      waited_ns_ = monotonic_ns() - begin_ns;
      if (closed_ || pub_sockets_->closed) break;
      pub_sockets_->refresh();
      sent = attempt();
    }
    blocked_ = false;
    if (!in_time && !sent) report_lagging();
    return sent;
  }

  void report_lagging() {
    complaints_->once("slow " + record.topic, record.topic + ": a reliable subscriber did not keep up and lost a message");
  }

  // Sends over the strict socket, waiting for the slowest reader.
  bool send_strict(Lock& lock, zmq::message_t& frame, zmq::send_flags flags) {
    PubSocket& pub_socket = pub_sockets_->strict;
    const auto attempt = [&] { return pub_socket.try_send(share(frame), flags); };
    if (attempt() || await_room(lock, readers_.timeout_ms(pub_socket), attempt)) return true;
    if (closed_ || pub_sockets_->closed) return false;
    give_up();  // ZeroMQ sends that reader nothing until it has caught up
    pub_socket.send_anyway(share(frame), flags);
    return false;
  }

  // Waits for the readers of the strict socket no more, until they have found what they lost.
  void give_up() noexcept {
    lagging_until_ = sequence_;
    is_lagging_ = true;
  }

  // Writes into the ring, waiting for reliable readers; false if one of those lost the frame.
  bool send_to_ring(Lock& lock, Span<const std::uint8_t> frame) {
    return send_to_ring(lock, frame.size(), [&] { return readers_.put(frame); });
  }

  template <class Put>
  bool send_to_ring(Lock& lock, std::size_t frame_size, Put put) {
    int found = CORTEX_FULL;
    const bool sent = wait_for_readers(lock, frame_size, [&] {
      found = put();
      return found != CORTEX_FULL;
    });
    return sent && found == CORTEX_WRITTEN;
  }

  // Attempts something until it works, or nobody is in its way; false if it did not. Gives up readers whose time is over.
  template <class Attempt>
  bool wait_for_readers(Lock& lock, std::size_t frame_size, Attempt attempt) {
    while (!attempt()) {
      const std::int64_t patience_ms = readers_.patience_ms(frame_size);
      if (patience_ms < 0) return attempt();
      if (await_room(lock, static_cast<std::uint32_t>(patience_ms), attempt)) break;
      if (closed_ || pub_sockets_->closed) return false;
      readers_.give_up(frame_size, waited_ns_ / 1'000'000);
    }
    return true;
  }

  // A body that found no slot travels through the ring as a message.
  bool send_large_to_ring(Lock& lock, const Slot& slot, std::uint64_t sequence, std::int64_t stamp_ns, std::size_t size) {
    if (!readers_.has_members()) return true;
    if (readers_.has(slot)) {
      std::uint8_t header[wire::header_size];
      write_header(header, 'S', sequence, stamp_ns, size, static_cast<std::uint64_t>(slot.index));
      return send_to_ring(lock, sizeof header, [&] {
        if (!readers_.has_members()) return static_cast<int>(CORTEX_WRITTEN);
        return readers_.commit(slot, sequence, {header, sizeof header});
      });
    }
    std::vector<std::uint8_t> frame(wire::header_size + size);
    write_header(frame.data(), 'M', sequence, stamp_ns, size, 0);
    std::memcpy(frame.data() + wire::header_size, slot.buffer.data(), size);
    return send_to_ring(lock, {frame.data(), frame.size()});
  }

  // Header and body, the body from where it lies.
  bool send_large(Lock& lock, PubSocket& pub_socket, const Slot& slot, const std::string& head, std::size_t size,
                  bool& passed_over) {
    const auto& waiting = pub_socket.strict ? strict_waiting_ : lossy_waiting_;
    const std::size_t most = pub_socket.strict ? std::max(strict_bytes, 2 * size) : std::max<std::size_t>(CORTEX_PRIVATE_BYTES, 4 * size);
    const auto fits = [&] { return *waiting + size <= most; };
    const bool may_wait = pub_socket.strict && !is_lagging_;
    if (!fits() && !(may_wait && await_room(lock, readers_.timeout_ms(pub_socket), fits))) {
      if (may_wait) give_up();
      passed_over = true;
      return !pub_socket.strict;
    }
    zmq::message_t header = message_of(head);
    bool on_time = true;
    if (pub_socket.strict) {
      on_time = send_strict(lock, header, zmq::send_flags::sndmore);
    } else {
      pub_socket.try_send(std::move(header), zmq::send_flags::sndmore);
    }
    // The second part goes where the first went: it must not be refused.
    pub_socket.send_anyway(private_message(slot, size, waiting));
    return on_time;
  }

  // Whether there are slots for bodies of a size, made if need be. Where there is no memory for them readers are sent to
  // their sockets, and waited for a little.
  bool provide(Lock& lock, std::size_t size) {
    if (!readers_.has_members()) return false;
    if (readers_.provide(size, exact_)) return true;
    complaints_->once("memory " + record.topic, record.topic + ": no shared memory for slots of large messages");
    readers_.dissolve();
    const std::uint32_t timeout_ms = std::max({move_ms, readers_.timeout_ms(pub_sockets_->lossy), readers_.timeout_ms(pub_sockets_->strict)});
    await_room(lock, timeout_ms, [&] { return !readers_.is_moving(false); });
    return false;
  }

  std::shared_ptr<PubSockets> pub_sockets_;
  const std::uint8_t flags_;
  const std::size_t inline_max_;
  const std::uint32_t max_wait_ms_;
  const bool exact_;
  std::shared_ptr<net::Complaints> complaints_;
  Readers readers_;
  std::shared_ptr<std::atomic<std::size_t>> lossy_waiting_ = std::make_shared<std::atomic<std::size_t>>(0);
  std::shared_ptr<std::atomic<std::size_t>> strict_waiting_ = std::make_shared<std::atomic<std::size_t>>(0);
  std::uint64_t sequence_ = 0;
  std::uint64_t told_ = 0;  // what readers know that `sequence_` was
  std::string latched_;
  PublisherCounters counters_;
  std::int64_t refresh_at_ns_ = 0;
  bool blocked_ = false;
  std::int64_t waited_ns_ = 0;  // for how long the message that is sent now was held up so far
  bool is_lagging_ = false;
  std::uint64_t lagging_until_ = 0;
  bool closed_ = false;
};

inline void PubSockets::refresh() {
  for (PubSocket* pub_socket : {&lossy, &strict}) {
    zmq::message_t event;
    const std::int64_t until_ns = monotonic_ns() + look_max_ns;  // others may send more than we can read
    while (monotonic_ns() < until_ns && pub_socket->socket.recv(event, zmq::recv_flags::dontwait)) {
      const auto bytes = net::bytes(event);
      if (bytes.empty()) continue;
      const wire::Key request = wire::read_key({bytes.data() + 1, bytes.size() - 1});
      const auto publisher = publishers.find(request.source);
      if (request.kind == 'R' && bytes[0] == 1 && publisher != publishers.end()) {
        std::shared_ptr(publisher->second)->resume(request.reader, request.last);
      }
      if (request.kind != 'A') continue;
      const std::string key(reinterpret_cast<const char*>(bytes.data()) + 1, bytes.size() - 1);
      if (publisher == publishers.end()) {
        attached.erase(key);
      } else if (bytes[0] == 1) {
        attached[key] = pub_socket;
        publisher->second->attach(*pub_socket, key, request);
      } else if (attached.erase(key) > 0) {
        std::shared_ptr(publisher->second)->detach(key);
      }
    }
  }
}

inline bool PubSockets::repeat_ends(std::int64_t now_ns) {
  const bool is_due = now_ns - told_ns_ >= 20'000'000;
  if (is_due) told_ns_ = now_ns;
  bool some = false;
  for (const auto& publisher : publishers) some |= is_due ? publisher.second->repeat_end() : publisher.second->is_ending();
  return some;
}

}  // namespace cortex::detail
