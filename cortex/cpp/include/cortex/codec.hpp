// SPDX-License-Identifier: Apache-2.0
// Bodies of messages: what generated structs are read and written with (WIRE.md, section 5).
#pragma once

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <limits>
#include <optional>
#include <stdexcept>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "cortex/array.hpp"
#include "cortex/broadcast.h"
#include "cortex/placer.hpp"
#include "cortex/wire.hpp"

namespace cortex {

// Specialised by the headers that `cortex cpp` writes:
//   name, schema (canonical JSON), fingerprint; block and alignment (bytes); fixed (no tail), stamped;
//   decode(Reader&, at, T&), encode(Sink&, at, const T&), draft(Placer&, T&), stamp(const T&).
template <class T>
struct Codec;

// Specialised for generated enums: `known(number)` tells whether the schema lists it.
template <class E>
struct EnumCodec;

// Whether bytes are UTF-8 as Python reads it: no overlong forms, no surrogates, at most U+10FFFF.
inline bool is_utf8(const std::uint8_t* at, std::size_t size) noexcept {
  const std::uint8_t* const end = at + size;
  while (at != end) {
    if (end - at >= 8 && (wire::load<std::uint64_t>(at) & 0x8080808080808080u) == 0) {
      at += 8;
      continue;
    }
    const std::uint8_t first = *at++;
    if (first < 0x80) continue;
    const int more = first >= 0xF0 ? 3 : first >= 0xE0 ? 2 : 1;
    if (first < 0xC2 || first > 0xF4 || end - at < more) return false;
    if ((first == 0xE0 && at[0] < 0xA0) || (first == 0xED && at[0] > 0x9F) || (first == 0xF0 && at[0] < 0x90) ||
        (first == 0xF4 && at[0] > 0x8F)) {
      return false;
    }
    for (int index = 0; index < more; ++index) {
      if ((*at++ & 0xC0) != 0x80) return false;
    }
  }
  return true;
}

// A named dimension: one size within one message.
template <class Error>
class Dimension {
 public:
  explicit Dimension(const char* name) noexcept : name_(name) {}
  void operator()(std::uint32_t extent, const char* field) {
    if (size_ < 0) {
      size_ = extent;
    } else if (size_ != static_cast<std::int64_t>(extent)) {
      throw Error(std::string(field) + ": dimension " + name_ + " is " + std::to_string(extent) + " here and " +
                  std::to_string(size_) + " elsewhere");
    }
  }

 private:
  const char* name_;
  std::int64_t size_ = -1;
};

// A dimension of which the type says the size.
template <class Error>
void check_extent(std::uint32_t extent, std::uint32_t expected, const char* field) {
  if (extent != expected) {
    throw Error(std::string(field) + ": a dimension is " + std::to_string(extent) + ", the type says " +
                std::to_string(expected));
  }
}

// Reads a body that may hold anything. Every range is checked; all items together may not be larger than the body
// that brings them, so that lists that point at each other cannot multiply.
class Reader {
 public:
  struct Items {
    std::size_t at;
    std::size_t count;
  };

  Reader(Span<const std::uint8_t> body, std::size_t block) : body_(body.data()), size_(body.size()) {
    if (size_ < block) {
      throw MalformedMessage("a body of " + std::to_string(size_) + " bytes is shorter than its block of " +
                             std::to_string(block));
    }
    if (size_ > std::numeric_limits<std::uint32_t>::max()) throw MalformedMessage("a body must be below 4 GiB");
    budget_ = size_ - block;
  }

  // Positions are inside a block or a list's item, which were checked as a whole.
  template <class T>
  void scalar(std::size_t at, T& out) const noexcept {
    std::memcpy(&out, body_ + at, sizeof out);
  }
  void scalar(std::size_t at, bool& out) const { out = present(at); }

  bool present(std::size_t at) const {
    if (body_[at] > 1) throw MalformedMessage("a bool is " + std::to_string(body_[at]) + ", not 0 or 1");
    return body_[at] == 1;
  }

  template <class E>
  void enumeration(std::size_t at, E& out) const {
    const auto number = wire::load<std::int32_t>(body_ + at);
    if (!EnumCodec<E>::known(number)) {
      throw MalformedMessage(std::to_string(number) + " is no value of " + std::string(EnumCodec<E>::name));
    }
    out = static_cast<E>(number);
  }

  void text(std::size_t at, std::string& out) {
    const auto range = item(at, 1);
    if (!is_utf8(body_ + range.at, range.count)) throw MalformedMessage("a str is not UTF-8");
    out.assign(reinterpret_cast<const char*>(body_ + range.at), range.count);
  }

  void bytes(std::size_t at, Array<std::uint8_t>& out) {
    const auto range = item(at, 1);
    out = range.count == 0 ? Array<std::uint8_t>()
                           : Array<std::uint8_t>::view(body_ + range.at, {static_cast<std::uint32_t>(range.count)});
  }

  Items list(std::size_t at, std::size_t stride) { return item(at, stride); }

  template <class T, std::size_t Rank>
  void array(std::size_t at, Array<T, Rank>& out) {
    std::array<std::uint32_t, Rank> shape{};
    const auto range = array_range<Rank>(at, shape, dtype_of<T>());
    place(range.at, range.count, shape, out);
  }

  template <std::size_t Rank>
  void any(std::size_t at, AnyArray<Rank>& out) {
    std::array<std::uint32_t, Rank> shape{};
    const auto dtype = static_cast<Dtype>(body_[at + 4]);
    if (item_size(dtype) == 0) throw MalformedMessage("dtype code " + std::to_string(body_[at + 4]) + " is unknown");
    const auto range = array_range<Rank>(at, shape, dtype);
    const auto bytes = static_cast<std::uint32_t>(range.count * item_size(dtype));
    Array<std::uint8_t> items;
    if (reinterpret_cast<std::uintptr_t>(body_ + range.at) % std::min<std::size_t>(item_size(dtype), 8) == 0) {
      if (bytes > 0) items = Array<std::uint8_t>::view(body_ + range.at, {bytes});
    } else {
      items = Array<std::uint8_t>({bytes}, {body_ + range.at, bytes});
    }
    out = AnyArray<Rank>(dtype, shape, std::move(items));
  }

  // An array within the block.
  template <class T, std::size_t Rank>
  void fixed(std::size_t at, Array<T, Rank>& out, const std::array<std::uint32_t, Rank>& shape) {
    std::size_t items = 1;
    for (const auto extent : shape) items *= extent;
    place(at, items, shape, out);
  }
  template <class T, std::size_t N>
  void fixed(std::size_t at, std::array<T, N>& out) const noexcept {
    if constexpr (N > 0) std::memcpy(static_cast<void*>(&out), body_ + at, sizeof out);
  }

 private:
  // What an offset and a count in the block point at. Arithmetic is in 64 bits on numbers of 32: it cannot wrap.
  Items item(std::size_t at, std::size_t stride) {
    return range(wire::load<std::uint32_t>(body_ + at), wire::load<std::uint32_t>(body_ + at + 4), stride);
  }

  Items range(std::uint64_t offset, std::uint64_t count, std::uint64_t stride) {
    if (count > budget_ / stride) {
      throw MalformedMessage("a body of " + std::to_string(size_) + " bytes cannot hold " + std::to_string(count) +
                             " items of " + std::to_string(stride));
    }
    if (offset > size_ || count * stride > size_ - offset) {
      throw MalformedMessage("an item at " + std::to_string(offset) + " of " + std::to_string(count * stride) +
                             " bytes leaves the body of " + std::to_string(size_));
    }
    budget_ -= static_cast<std::size_t>(count * stride);
    return {static_cast<std::size_t>(offset), static_cast<std::size_t>(count)};
  }

  template <std::size_t Rank>
  Items array_range(std::size_t at, std::array<std::uint32_t, Rank>& shape, Dtype dtype) {
    const std::uint8_t* head = body_ + at;
    if (head[4] != static_cast<std::uint8_t>(dtype) || head[5] != Rank || head[6] != 0 || head[7] != 0) {
      throw MalformedMessage("an array has dtype code " + std::to_string(head[4]) + " and " +
                             std::to_string(head[5]) + " dimensions, the type says " +
                             std::to_string(static_cast<int>(dtype)) + " and " + std::to_string(Rank));
    }
    bool empty = false;
    for (std::size_t index = 0; index < Rank; ++index) {
      shape[index] = wire::load<std::uint32_t>(head + 8 + 4 * index);
      empty = empty || shape[index] == 0;
    }
    // A shape is bounded by the body that holds its items, and without items by what an index can count.
    const std::uint64_t most = empty ? (std::uint64_t{1} << 63) - 1 : size_;
    std::uint64_t bytes = item_size(dtype);
    for (const auto extent : shape) {
      if (extent != 0 && bytes > most / extent) throw MalformedMessage("an array's shape is larger than its body");
      if (extent != 0) bytes *= extent;
    }
    const std::uint64_t items = empty ? 0 : bytes / item_size(dtype);
    return range(wire::load<std::uint32_t>(head), items, item_size(dtype));
  }

  // A view where memory is aligned (always in a slot), a copy where ZeroMQ put the frame elsewhere.
  template <class T, std::size_t Rank>
  void place(std::size_t at, std::size_t items, const std::array<std::uint32_t, Rank>& shape, Array<T, Rank>& out) {
    const std::uint8_t* const from = body_ + at;
    if (items > 0 && reinterpret_cast<std::uintptr_t>(from) % alignof(T) == 0) {
      out = Array<T, Rank>::view(reinterpret_cast<const T*>(from), shape);
    } else {
      out = Array<T, Rank>::uninitialized(shape);
      if (items > 0) std::memcpy(static_cast<void*>(out.writable().data()), from, items * sizeof(T));
    }
  }

  const std::uint8_t* body_;
  std::size_t size_;
  std::size_t budget_ = 0;
};

// Counts the tail of a body; the same calls as `Writer`.
class Measure {
 public:
  explicit Measure(std::size_t cursor) noexcept : cursor_(cursor) {}
  std::size_t size() const noexcept { return cursor_; }

  template <class T>
  void scalar(std::size_t, const T&) const noexcept {}
  template <class E>
  void enumeration(std::size_t, E) const noexcept {}
  void zero(std::size_t, std::size_t) const noexcept {}
  template <class T, std::size_t Rank>
  void fixed(std::size_t, const Array<T, Rank>&) const noexcept {}
  template <class T, std::size_t N>
  void fixed(std::size_t, const std::array<T, N>&) const noexcept {}
  void text(std::size_t, const std::string& value) { take(value.size(), 8); }
  void bytes(std::size_t, const Array<std::uint8_t>& value) { take(value.size(), 8); }
  std::size_t list(std::size_t, std::size_t count, std::size_t stride, std::size_t alignment) {
    if (count > wire::body_limit / stride) throw std::invalid_argument("a list is larger than 1 GiB");
    return take(count * stride, alignment);
  }
  template <class T, std::size_t Rank>
  void array(std::size_t, const Array<T, Rank>& value) {
    const std::size_t bytes = value.size() * sizeof(T);
    take(bytes, bytes >= 1024 ? 64 : 8);
  }
  template <std::size_t Rank>
  void any(std::size_t, const AnyArray<Rank>& value) {
    const std::size_t bytes = value.bytes().size();
    take(bytes, bytes >= 1024 ? 64 : 8);
  }

 private:
  std::size_t take(std::size_t bytes, std::size_t alignment) {
    if (bytes == 0) return 0;
    const auto start = static_cast<std::size_t>(wire::round_up(cursor_, alignment));
    cursor_ = start + bytes;
    if (cursor_ > wire::body_limit) throw std::invalid_argument("a message is larger than 1 GiB");
    return start;
  }

  std::size_t cursor_;
};

// Writes a body into memory of a known size.
class Writer {
 public:
  // `tail` is where the tail begins: after the block, or after the arrays that a loan placed.
  Writer(Span<std::uint8_t> out, std::size_t tail) : out_(out.data()), capacity_(out.size()), cursor_(tail) {
    if (tail > capacity_) throw std::invalid_argument("a message does not fit its buffer");
  }
  std::size_t size() const noexcept { return cursor_; }

  template <class T>
  void scalar(std::size_t at, const T& value) const noexcept {
    std::memcpy(out_ + at, &value, sizeof value);
  }
  void scalar(std::size_t at, bool value) const noexcept { out_[at] = value ? 1 : 0; }
  template <class E>
  void enumeration(std::size_t at, E value) const {
    const auto number = static_cast<std::int32_t>(value);
    if (!EnumCodec<E>::known(number)) {
      throw std::invalid_argument(std::to_string(number) + " is no value of " + std::string(EnumCodec<E>::name));
    }
    scalar(at, number);
  }
  void zero(std::size_t at, std::size_t bytes) const noexcept {
    if (bytes > 0) std::memset(out_ + at, 0, bytes);
  }

  template <class T, std::size_t Rank>
  void fixed(std::size_t at, const Array<T, Rank>& value) const noexcept {
    const auto* from = reinterpret_cast<const std::uint8_t*>(value.data());
    if (value.size() > 0 && from != out_ + at) std::memcpy(out_ + at, from, value.size() * sizeof(T));
  }
  template <class T, std::size_t N>
  void fixed(std::size_t at, const std::array<T, N>& value) const noexcept {
    if constexpr (N > 0) std::memcpy(out_ + at, static_cast<const void*>(&value), sizeof value);
  }

  void text(std::size_t at, const std::string& value) {
    if (!is_utf8(reinterpret_cast<const std::uint8_t*>(value.data()), value.size())) {
      throw std::invalid_argument("a str must be UTF-8; use bytes for other data");
    }
    range(at, put(value.data(), value.size(), 8), value.size());
  }
  void bytes(std::size_t at, const Array<std::uint8_t>& value) {
    range(at, put(value.data(), value.size(), 8), value.size());
  }
  std::size_t list(std::size_t at, std::size_t count, std::size_t stride, std::size_t alignment) {
    const std::size_t start = take(count * stride, alignment);
    range(at, start, count);
    return start;
  }
  template <class T, std::size_t Rank>
  void array(std::size_t at, const Array<T, Rank>& value) {
    items(at, dtype_of<T>(), value.shape(), value.data(), value.size() * sizeof(T));
  }
  template <std::size_t Rank>
  void any(std::size_t at, const AnyArray<Rank>& value) {
    items(at, value.dtype(), value.shape(), value.bytes().data(), value.bytes().size());
  }

 private:
  template <std::size_t Rank>
  void items(std::size_t at, Dtype dtype, const std::array<std::uint32_t, Rank>& shape, const void* from,
             std::size_t bytes) {
    std::uint64_t expected = item_size(dtype);
    for (const auto extent : shape) expected *= extent;
    if (expected != bytes) throw std::invalid_argument("an array without its items");
    wire::store(out_ + at, static_cast<std::uint32_t>(put(from, bytes, bytes >= 1024 ? 64 : 8)));
    out_[at + 4] = static_cast<std::uint8_t>(dtype);
    out_[at + 5] = static_cast<std::uint8_t>(Rank);
    out_[at + 6] = out_[at + 7] = 0;
    for (std::size_t index = 0; index < Rank; ++index) wire::store(out_ + at + 8 + 4 * index, shape[index]);
  }

  void range(std::size_t at, std::size_t offset, std::size_t count) const noexcept {
    wire::store(out_ + at, static_cast<std::uint32_t>(offset));
    wire::store(out_ + at + 4, static_cast<std::uint32_t>(count));
  }

  // Offset of these bytes in the body; they are copied, unless a loan has them here already.
  std::size_t put(const void* from, std::size_t bytes, std::size_t alignment) {
    const auto position = reinterpret_cast<std::uintptr_t>(from) - reinterpret_cast<std::uintptr_t>(out_);
    if (bytes > 0 && position < capacity_) return position;
    const std::size_t start = take(bytes, alignment);
    if (bytes > 0) cortex_copy(out_ + start, from, bytes);
    return start;
  }

  std::size_t take(std::size_t bytes, std::size_t alignment) {
    if (bytes == 0) return 0;
    const auto start = static_cast<std::size_t>(wire::round_up(cursor_, alignment));
    if (start > capacity_ || bytes > capacity_ - start) {
      throw std::invalid_argument("a message does not fit its buffer of " + std::to_string(capacity_) + " bytes");
    }
    zero(cursor_, start - cursor_);
    cursor_ = start + bytes;
    return start;
  }

  std::uint8_t* out_;
  std::size_t capacity_;
  std::size_t cursor_;
};

template <class T>
constexpr std::size_t block_of() noexcept {
  return static_cast<std::size_t>(wire::round_up(Codec<T>::block, 8));
}

// Bytes of the body of this message. Throws std::invalid_argument for a message that breaks its type.
template <class T>
std::size_t encoded_size(const T& message) {
  if constexpr (Codec<T>::fixed) {
    return block_of<T>();
  } else {
    Measure measure(block_of<T>());
    Codec<T>::encode(measure, 0, message);
    return measure.size();
  }
}

// Writes the body into memory of at least `encoded_size` bytes, returns its size.
template <class T>
std::size_t encode_into(const T& message, Span<std::uint8_t> out, std::size_t tail = block_of<T>()) {
  Writer writer(out, tail);
  writer.zero(Codec<T>::block, block_of<T>() - Codec<T>::block);
  Codec<T>::encode(writer, 0, message);
  return writer.size();
}

template <class T>
std::vector<std::uint8_t> encode(const T& message) {
  std::vector<std::uint8_t> body(encoded_size(message));
  encode_into(message, {body.data(), body.size()});
  return body;
}

// Reads a body; arrays look into it. Throws MalformedMessage.
template <class T>
void decode_into(Span<const std::uint8_t> body, T& out) {
  if (Codec<T>::fixed && body.size() != block_of<T>()) {
    throw MalformedMessage("a body of " + std::to_string(body.size()) + " bytes, the type has " +
                           std::to_string(block_of<T>()));
  }
  Reader reader(body, block_of<T>());
  Codec<T>::decode(reader, 0, out);
}

template <class T>
T decode(Span<const std::uint8_t> body) {
  T message{};
  decode_into(body, message);
  return message;
}

}  // namespace cortex
