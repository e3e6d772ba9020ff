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
#include <type_traits>
#include <utility>
#include <vector>

#include "cortex/array.hpp"
#include "cortex/broadcast.h"
#include "cortex/fields.hpp"
#include "cortex/wire.hpp"

namespace cortex {

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

// Reads a body that may hold anything. Every range is checked; all items together may not be larger than the body
// that brings them, so that lists that point at each other cannot multiply. What is in shared memory may change
// meanwhile: each number is read once.
class Decoder {
 public:
  Decoder(Span<const std::uint8_t> body, std::size_t block) : body_(body.data()), size_(body.size()) {
    if (size_ < block) {
      throw MalformedMessage("a body of " + std::to_string(size_) + " bytes is shorter than its block of " +
                             std::to_string(block));
    }
    if (size_ > std::numeric_limits<std::uint32_t>::max()) throw MalformedMessage("a body must be below 4 GiB");
    left_ = size_ - block;
  }

  // Positions are inside a block or a list's element, which were checked as a whole.
  template <class T>
  void operator()(std::size_t at, T& out) {
    if constexpr (std::is_same_v<T, bool>) {
      const std::uint8_t byte = body_[at];
      if (byte > 1) throw MalformedMessage("a bool is " + std::to_string(byte) + ", not 0 or 1");
      out = byte == 1;
    } else if constexpr (std::is_enum_v<T>) {
      const auto number = wire::load<std::int32_t>(body_ + at);
      if (!EnumCodec<T>::known(number)) {
        throw MalformedMessage(std::to_string(number) + " is no value of " + std::string(EnumCodec<T>::name));
      }
      out = static_cast<T>(number);
    } else if constexpr (std::is_same_v<T, std::string>) {
      const auto range = item(at, 1);
      out.assign(reinterpret_cast<const char*>(body_ + range.at), range.count);
      if (!is_utf8(reinterpret_cast<const std::uint8_t*>(out.data()), out.size())) {
        throw MalformedMessage("a str is not UTF-8");
      }
    } else if constexpr (is_plain<T>) {
      std::memcpy(static_cast<void*>(&out), body_ + at, sizeof out);
    } else {
      Codec<T>::fields(*this, at, out);
    }
  }

  template <class T, std::size_t Offset, class... Shape>
  void operator()(std::size_t at, std::optional<T>& out, Held<Offset>, const Shape&... shape) {
    bool present = false;
    (*this)(at, present);
    if (!present) return out.reset();
    (*this)(at + Offset, out.emplace(), shape...);
  }

  template <class T, std::size_t Stride, std::size_t Alignment, std::size_t Values, class... Shape>
  void operator()(std::size_t at, std::vector<T>& out, Elements<Stride, Alignment, Values>, const Shape&... shape) {
    const Items range = item(at, Stride);
    if (range.count > values_left_ / Values) throw MalformedMessage("lists hold more values than a body may");
    values_left_ -= range.count * Values;
    out.clear();
    out.reserve(range.count);
    for (std::size_t index = 0; index < range.count; ++index) {
      (begin_scope(shape), ...);
      T element{};
      (*this)(range.at + index * Stride, element, shape...);
      out.push_back(std::move(element));
    }
  }

  void operator()(std::size_t at, Array<std::uint8_t>& out, Bytes) {
    const auto range = item(at, 1);
    out = range.count == 0 ? Array<std::uint8_t>()
                           : Array<std::uint8_t>::view(body_ + range.at, {static_cast<std::uint32_t>(range.count)});
  }

  template <class T, std::size_t Rank>
  void operator()(std::size_t at, Array<T, Rank>& out, const Extents<Rank>& extents) {
    std::array<std::uint32_t, Rank> shape{};
    const auto range = array_range(at, shape, dtype_of<T>(), extents);
    place(range.at, range.count, shape, out);
  }

  template <std::size_t Rank>
  void operator()(std::size_t at, AnyArray<Rank>& out, const Extents<Rank>& extents) {
    std::array<std::uint32_t, Rank> shape{};
    const auto dtype = static_cast<Dtype>(body_[at + 4]);
    const std::size_t size = item_size(dtype);
    if (size == 0) throw MalformedMessage("dtype code " + std::to_string(static_cast<int>(dtype)) + " is unknown");
    const auto range = array_range(at, shape, dtype, extents);
    const auto bytes = static_cast<std::uint32_t>(range.count * size);
    Array<std::uint8_t> items;
    if (reinterpret_cast<std::uintptr_t>(body_ + range.at) % std::min<std::size_t>(size, 8) == 0) {
      if (bytes > 0) items = Array<std::uint8_t>::view(body_ + range.at, {bytes});
    } else {
      items = Array<std::uint8_t>({bytes}, {body_ + range.at, bytes});
    }
    out = AnyArray<Rank>(dtype, shape, std::move(items));
  }

  template <class T, std::size_t Rank, std::uint32_t... Sizes>
  void operator()(std::size_t at, Array<T, Rank>& out, Within<Sizes...>) {
    place(at, (std::size_t{1} * ... * Sizes), {Sizes...}, out);
  }

 private:
  struct Items {
    std::size_t at;
    std::size_t count;
  };

  // What an offset and a count in the block point at. Arithmetic is in 64 bits on numbers of 32: it cannot wrap.
  Items item(std::size_t at, std::size_t stride) {
    return range(wire::load<std::uint32_t>(body_ + at), wire::load<std::uint32_t>(body_ + at + 4), stride);
  }

  Items range(std::uint64_t offset, std::uint64_t count, std::uint64_t stride) {
    if (count > left_ / stride) {
      throw MalformedMessage("a body of " + std::to_string(size_) + " bytes cannot hold " + std::to_string(count) +
                             " items of " + std::to_string(stride));
    }
    if (offset > size_ || count * stride > size_ - offset) {
      throw MalformedMessage("an item at " + std::to_string(offset) + " of " + std::to_string(count * stride) +
                             " bytes leaves the body of " + std::to_string(size_));
    }
    left_ -= static_cast<std::size_t>(count * stride);
    return {static_cast<std::size_t>(offset), static_cast<std::size_t>(count)};
  }

  template <std::size_t Rank>
  Items array_range(std::size_t at, std::array<std::uint32_t, Rank>& shape, Dtype dtype, const Extents<Rank>& extents) {
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
    extents.template check<MalformedMessage>(shape);
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
  std::size_t left_ = 0;  // bytes that items may still take
  std::size_t values_left_ = values_max;
};

// Writes a body into memory of a known size; or, where it `writes` not, counts the bytes.
template <bool writes>
class Encoder {
 public:
  // `tail` is where the tail begins: after the block, or after the arrays that a loan placed.
  Encoder(Span<std::uint8_t> out, std::size_t tail)
      : out_(out.data()), capacity_(writes ? out.size() : wire::body_limit), cursor_(tail) {
    if (tail > capacity_) does_not_fit();
  }

  // Bytes of the body, once all fields are written; the block has so many.
  std::size_t finish(std::size_t block) {
    reach(block, 0);
    return cursor_;
  }

  template <class T>
  void operator()(std::size_t at, const T& value) {
    if constexpr (std::is_enum_v<T>) {
      const auto number = static_cast<std::int32_t>(value);
      if (writes && !EnumCodec<T>::known(number)) {
        throw std::invalid_argument(std::to_string(number) + " is no value of " + std::string(EnumCodec<T>::name));
      }
      store(at, number);
    } else if constexpr (std::is_same_v<T, std::string>) {
      if (writes && !is_utf8(reinterpret_cast<const std::uint8_t*>(value.data()), value.size())) {
        throw std::invalid_argument("a str must be UTF-8; use bytes for other data");
      }
      describe(at, put(value.data(), value.size(), 8), value.size());
    } else if constexpr (is_plain<T>) {
      store(at, value);
    } else {
      Codec<T>::fields(*this, at, value);
    }
  }

  template <class T, std::size_t Offset, class... Shape>
  void operator()(std::size_t at, const std::optional<T>& value, Held<Offset>, const Shape&... shape) {
    if (!value.has_value()) return;
    store(at, true);
    (*this)(at + Offset, *value, shape...);
  }

  template <class T, std::size_t Stride, std::size_t Alignment, std::size_t Values, class... Shape>
  void operator()(std::size_t at, const std::vector<T>& value, Elements<Stride, Alignment, Values>, const Shape&... shape) {
    if (value.size() > capacity_ / Stride) does_not_fit();
    if (value.size() > values_left_ / Values) throw std::invalid_argument("lists hold more values than a body may");
    values_left_ -= value.size() * Values;
    const std::size_t start = take(value.size() * Stride, Alignment);
    describe(at, start, value.size());
    const std::size_t filled = std::exchange(filled_, start);
    for (std::size_t index = 0; index < value.size(); ++index) {
      (begin_scope(shape), ...);
      (*this)(start + index * Stride, static_cast<const T&>(value[index]), shape...);
    }
    reach(start + value.size() * Stride, 0);
    filled_ = filled;
  }

  void operator()(std::size_t at, const Array<std::uint8_t>& value, Bytes) {
    describe(at, put(value.data(), value.size(), 8), value.size());
  }
  template <class T, std::size_t Rank>
  void operator()(std::size_t at, const Array<T, Rank>& value, const Extents<Rank>& extents) {
    items(at, dtype_of<T>(), value.shape(), value.data(), value.size() * sizeof(T), extents);
  }
  template <std::size_t Rank>
  void operator()(std::size_t at, const AnyArray<Rank>& value, const Extents<Rank>& extents) {
    items(at, value.dtype(), value.shape(), value.bytes().data(), value.bytes().size(), extents);
  }
  template <class T, std::size_t Rank, std::uint32_t... Sizes>
  void operator()(std::size_t at, const Array<T, Rank>& value, Within<Sizes...>) {
    if (value.shape() != typename Array<T, Rank>::Shape{Sizes...} || value.size() != (std::size_t{1} * ... * Sizes)) {
      throw std::invalid_argument("an array within a message has another shape than the type says");
    }
    const std::size_t bytes = value.size() * sizeof(T);
    reach(at, bytes);
    if (writes && static_cast<const void*>(value.data()) != out_ + at) std::memcpy(out_ + at, value.data(), bytes);
  }

 private:
  template <std::size_t Rank>
  void items(std::size_t at, Dtype dtype, const std::array<std::uint32_t, Rank>& shape, const void* from, std::size_t bytes,
             const Extents<Rank>& extents) {
    extents.template check<std::invalid_argument>(shape);
    std::uint64_t expected = item_size(dtype);
    for (const auto extent : shape) expected *= extent;
    if (expected != bytes) throw std::invalid_argument("an array without its items");
    const std::size_t start = put(from, bytes, bytes >= large_bytes ? 64 : 8);
    describe(at, start, static_cast<std::size_t>(dtype) | Rank << 8);
    for (std::size_t index = 0; index < Rank; ++index) store(at + 8 + 4 * index, shape[index]);
  }

  // An offset and a second number, as begin the descriptors of all that lies in the tail.
  void describe(std::size_t at, std::size_t start, std::size_t second) {
    store(at, static_cast<std::uint32_t>(start));
    store(at + 4, static_cast<std::uint32_t>(second));
  }

  template <class T>
  void store(std::size_t at, [[maybe_unused]] const T& value) {
    reach(at, sizeof value);
    if constexpr (writes) std::memcpy(out_ + at, static_cast<const void*>(&value), sizeof value);
  }

  // Fields come in order: what lies between them is zero.
  void reach([[maybe_unused]] std::size_t at, [[maybe_unused]] std::size_t bytes) {
    if constexpr (writes) {
      if (at > filled_) std::memset(out_ + filled_, 0, at - filled_);
      filled_ = at + bytes;
    }
  }

  // Offset of these bytes in the tail; they are copied, unless a loan has them here already.
  std::size_t put(const void* from, std::size_t bytes, std::size_t alignment) {
    const auto position = reinterpret_cast<std::uintptr_t>(from) - reinterpret_cast<std::uintptr_t>(out_);
    if (writes && bytes > 0 && position < capacity_) return position;
    const std::size_t start = take(bytes, alignment);
    if (writes && bytes > 0) cortex_copy(out_ + start, from, bytes);
    return start;
  }

  std::size_t take(std::size_t bytes, std::size_t alignment) {
    if (bytes == 0) return 0;
    const auto start = static_cast<std::size_t>(wire::round_up(cursor_, alignment));
    if (start > capacity_ || bytes > capacity_ - start) does_not_fit();
    if (writes) std::memset(out_ + cursor_, 0, start - cursor_);
    cursor_ = start + bytes;
    return start;
  }

  [[noreturn]] void does_not_fit() const {
    throw std::invalid_argument("a message does not fit into " + std::to_string(capacity_) + " bytes");
  }

  std::uint8_t* out_;
  std::size_t capacity_;
  std::size_t cursor_;
  std::size_t filled_ = 0;  // of the block, or of a list, all below this is written
  std::size_t values_left_ = values_max;
};

template <class T>
constexpr std::size_t block_of() noexcept {
  return static_cast<std::size_t>(wire::round_up(Codec<T>::block, 8));
}

// Bytes of the body of this message. Throws std::invalid_argument for a message that breaks its type.
template <class T>
std::size_t encoded_size(const T& message) {
  if constexpr (Codec<T>::fixed) return block_of<T>();
  Encoder<false> encoder({}, block_of<T>());
  Codec<T>::fields(encoder, 0, message);
  return encoder.finish(block_of<T>());
}

// Writes the body into memory of at least `encoded_size` bytes, returns its size.
template <class T>
std::size_t encode_into(const T& message, Span<std::uint8_t> out, std::size_t tail = block_of<T>()) {
  Encoder<true> encoder(out, tail);
  Codec<T>::fields(encoder, 0, message);
  return encoder.finish(block_of<T>());
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
  Decoder decoder(body, block_of<T>());
  Codec<T>::fields(decoder, 0, out);
}

template <class T>
T decode(Span<const std::uint8_t> body) {
  T message{};
  decode_into(body, message);
  return message;
}

}  // namespace cortex
