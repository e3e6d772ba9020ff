// SPDX-License-Identifier: Apache-2.0
// Publishing: one topic, one type, any number of subscribers, each with its own policy.
#pragma once

#include <chrono>
#include <cstdint>
#include <memory>
#include <mutex>
#include <optional>
#include <stdexcept>
#include <string>
#include <thread>
#include <utility>

#include "cortex/codec.hpp"
#include "cortex/placer.hpp"
#include "cortex/publisher_core.hpp"

namespace cortex {

struct PublisherOptions {
  bool latch = false;               // give the last message to subscribers that come later
  std::size_t inline_max = 16'384;  // larger bodies go through shared memory where that is possible
  std::chrono::milliseconds max_wait{1000};  // longest that reliable subscribers hold up a `publish`, whatever they ask
};

// A message that is written where its readers will find it. Arrays whose dimensions were given are views to be
// filled through `writable()`, the other fields are set as usual. Without `publish` it is dropped.
template <class T>
class Loan {
 public:
  Loan(Loan&& other) noexcept
      : core_(std::move(other.core_)), slot_(std::move(other.slot_)), tail_(other.tail_), message_(std::move(other.message_)) {
    other.core_.reset();
  }
  Loan& operator=(Loan&&) = delete;
  ~Loan() {
    if (core_ != nullptr) core_->abandon(slot_);
  }

  T& operator*() noexcept { return message_; }
  T* operator->() noexcept { return &message_; }

  // As `Publisher::publish`. What does not lie in the slot already must fit 4 KiB.
  bool publish() {
    if (core_ == nullptr) throw std::logic_error("this loan was published before");
    const std::size_t size = encode_into(message_, slot_.buffer, tail_);
    const auto core = std::move(core_);
    core_.reset();
    if (size <= core->inline_max()) {
      zmq::message_t frame(wire::header_size + size);
      std::memcpy(static_cast<std::uint8_t*>(frame.data()) + wire::header_size, slot_.buffer.data(), size);
      core->abandon(slot_);
      return core->publish_inline(std::move(frame), Codec<T>::stamp(message_));
    }
    const std::lock_guard<std::mutex> lock(core->large_mutex);
    return core->publish_slot(slot_, size, Codec<T>::stamp(message_));
  }

 private:
  template <class>
  friend class Publisher;
  static constexpr std::size_t reserve = 4096;

  Loan(std::shared_ptr<detail::PublisherCore> core, const Dimensions& dimensions, const Dtypes& dtypes)
      : core_(std::move(core)) {
    const auto place = [&](std::uint8_t* body) {
      return detail::place_arrays(Codec<T>::items, Codec<T>::names, reinterpret_cast<char*>(&message_), body, dimensions, dtypes);
    };
    tail_ = place(nullptr);
    const std::size_t size = tail_ + reserve;
    slot_ = size <= core_->inline_max() ? detail::private_slot(size) : core_->acquire(size, true);
    if (slot_.buffer.data() == nullptr) {
      core_.reset();
      throw std::runtime_error("every slot is out on loan; publish or drop one first");
    }
    place(slot_.buffer.data());
  }

  std::shared_ptr<detail::PublisherCore> core_;
  detail::Slot slot_;
  std::size_t tail_ = 0;
  T message_{};
};

// Sends messages of one type; made by `Node::advertise`. Calls may come from any thread. It ends with its last copy.
template <class T>
class Publisher {
 public:
  // Sends a message, which may be changed or freed afterwards. False if a reliable subscriber lost it, because it
  // held up the publisher for longer than its timeout. Throws std::invalid_argument for a message that breaks its
  // type, std::logic_error after the end of the node.
  bool publish(const T& message) {
    if (!core_->wanted()) return true;
    const std::size_t size = encoded_size(message);
    if (size <= core_->inline_max()) {
      zmq::message_t frame(wire::header_size + size);
      encode_into(message, {static_cast<std::uint8_t*>(frame.data()) + wire::header_size, size});
      return core_->publish_inline(std::move(frame), Codec<T>::stamp(message));
    }
    const std::lock_guard<std::mutex> lock(core_->large_mutex);
    const detail::Slot slot = core_->acquire(size, false);
    try {
      encode_into(message, slot.buffer);
    } catch (...) {
      core_->abandon(slot);
      throw;
    }
    return core_->publish_slot(slot, size, Codec<T>::stamp(message));
  }

  // Borrows memory for a message of these dimensions, such as {{"height", 480}, {"width", 640}}; an array that may
  // have any type of items is placed if its field is given one, such as {{"data", cortex::Dtype::uint8}}.
  Loan<T> loan(const Dimensions& dimensions = {}, const Dtypes& dtypes = {}) {
    const std::lock_guard<std::mutex> lock(core_->large_mutex);
    return Loan<T>(core_, dimensions, dtypes);
  }

  bool wait_for_subscribers(std::size_t count, std::chrono::nanoseconds timeout) {
    const std::int64_t deadline_ns = monotonic_ns() + timeout.count();
    while (core_->reader_count() < count) {
      if (core_->closed() || monotonic_ns() >= deadline_ns) return false;
      std::this_thread::sleep_for(std::chrono::microseconds(500));
    }
    return true;
  }

  std::size_t subscriber_count() { return core_->reader_count(); }
  PublisherCounters counters() const { return core_->counters(); }
  const std::string& topic() const noexcept { return core_->record.topic; }

 private:
  friend class Node;
  explicit Publisher(std::shared_ptr<detail::PublisherCore> core) : core_(std::move(core)) {}
  std::shared_ptr<detail::PublisherCore> core_;
};

}  // namespace cortex
