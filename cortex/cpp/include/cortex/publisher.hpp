// SPDX-License-Identifier: Apache-2.0
// Publishing: one topic, one type, any number of subscribers, each with its own policy.
#pragma once

#include <algorithm>
#include <chrono>
#include <cstdint>
#include <cstring>
#include <memory>
#include <mutex>
#include <optional>
#include <stdexcept>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "cortex/codec.hpp"
#include "cortex/publisher_core.hpp"

namespace cortex {

struct PublisherOptions {
  bool latch = false;               // give the last message to subscribers that come later
  std::size_t inline_max = 16'384;  // larger bodies go through shared memory where that is possible
  std::chrono::milliseconds max_wait{1000};  // longest that reliable subscribers hold up a `publish`, whatever they ask
};

using Dimensions = std::vector<std::pair<std::string, std::uint32_t>>;  // by the name of the dimension
using Dtypes = std::vector<std::pair<std::string, Dtype>>;              // by the name of the field

namespace detail {

// What is known of a name; null if nothing is.
template <class Value>
const Value* find(const std::vector<std::pair<std::string, Value>>& known, const char* name) {
  const auto found = std::find_if(known.begin(), known.end(), [&](const auto& each) { return each.first == name; });
  return found == known.end() ? nullptr : &found->second;
}

// Whether dtype and dimensions of a field are all given; then `array` gets them.
inline bool is_given(const CortexItem* items, const CortexItem& field, const char* name, const Dimensions& dimensions,
                     const Dtypes& dtypes, CortexArray& array) {
  const Dtype* const dtype = field.dtypes > 1 ? find(dtypes, name) : nullptr;
  if (field.dtypes > 1 && dtype == nullptr) return false;
  const CortexItem* const axes = items + field.first;
  array.dtype = dtype == nullptr ? 0 : static_cast<std::int64_t>(*dtype);
  array.bytes = static_cast<std::uint64_t>(axes[field.count + array.dtype].size);
  for (std::int64_t axis = 0; axis < field.count; ++axis) {
    const auto* const dimension = static_cast<const char*>(axes[axis].object);
    const std::uint32_t* const size = dimension == nullptr ? nullptr : find(dimensions, dimension);
    if (dimension != nullptr && size == nullptr) return false;
    array.shape[axis] = size == nullptr ? axes[axis].size : *size;
    const auto factor = static_cast<std::uint64_t>(array.shape[axis]);
    if (factor != 0 && array.bytes > wire::body_limit / factor) throw std::invalid_argument("a loan is larger than 1 GiB");
    array.bytes *= factor;
  }
  return true;
}

// Gives those arrays of a loan their places in its slot whose dimensions are all given; where they end. Without memory (null) it
// only counts.
inline std::size_t place_arrays(const CortexItem* items, const char* const* names, char* message, std::uint8_t* body,
                                const Dimensions& dimensions, const Dtypes& dtypes) {
  auto end = static_cast<std::uint64_t>(items->size);
  for (std::int64_t number = 0; number < items->count; ++number) {
    const CortexItem& field = items[items->first + number];
    const bool is_array = field.kind == CORTEX_VARIABLE || field.kind == CORTEX_FIXED;
    CortexArray array;
    if (!is_array || !is_given(items, field, names[number], dimensions, dtypes, array)) continue;
    auto start = static_cast<std::uint64_t>(field.offset);
    if (field.kind == CORTEX_VARIABLE) {
      start = wire::round_up(end, array.bytes >= CORTEX_LARGE_BYTES ? 64 : 8);
      if (start + array.bytes > wire::body_limit) throw std::invalid_argument("a loan is larger than 1 GiB");
      if (body != nullptr) std::memset(body + end, 0, start - end);
      end = start + array.bytes;
    }
    if (body == nullptr) continue;
    array.data = body + start;
    type_of<ArrayType>(&field).put(message + field.place, array, true);
  }
  return end;
}

}  // namespace detail
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
