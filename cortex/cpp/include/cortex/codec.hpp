// SPDX-License-Identifier: Apache-2.0
// Bodies of messages: how generated structs hold their values, for the walk of `body_walk.h`.
#pragma once

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <optional>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "cortex/array.hpp"
#include "cortex/body_walk.h"
#include "cortex/broadcast.h"
#include "cortex/wire.hpp"

namespace cortex {

// Specialised by the headers that `cortex cpp` writes:
//   name, schema (canonical JSON), fingerprint; fixed (no tail), stamped; stamp(message); items (a table, see `body.h`), names (of
//   the fields). Of an optional, a list, or an array that may be a view, the table has its type, as below.
template <class T>
struct Codec;

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

namespace detail {

struct OptionalType {
  char* (*set)(void* optional, bool present);
  const char* (*get)(const void* optional);
};

template <class T>
constexpr OptionalType optional_type{
    [](void* place, bool present) {
      auto& optional = *static_cast<std::optional<T>*>(place);
      optional.reset();
      return present ? reinterpret_cast<char*>(&optional.emplace()) : nullptr;
    },
    [](const void* place) {
      const auto& optional = *static_cast<const std::optional<T>*>(place);
      return optional.has_value() ? reinterpret_cast<const char*>(&*optional) : nullptr;
    }};

struct ListType {
  char* (*resize)(void* list, std::size_t count);
  const char* (*get)(const void* list, std::uint64_t& count);
  std::size_t step;
};

template <class T>
constexpr ListType list_type{
    [](void* place, std::size_t count) {
      auto& list = *static_cast<std::vector<T>*>(place);
      list.clear();
      list.resize(count);
      return reinterpret_cast<char*>(list.data());
    },
    [](const void* place, std::uint64_t& count) {
      const auto& list = *static_cast<const std::vector<T>*>(place);
      count = list.size();
      return reinterpret_cast<const char*>(list.data());
    },
    sizeof(T)};

struct ArrayType {
  void (*put)(void* array, const CortexArray& found, bool loaned);  // items that lie elsewhere; aligned, or they are copied
  void (*get)(const void* array, CortexArray& found);
};

template <std::size_t Rank>
std::array<std::uint32_t, Rank> shape_of(const CortexArray& found) noexcept {
  std::array<std::uint32_t, Rank> shape{};
  for (std::size_t axis = 0; axis < Rank; ++axis) shape[axis] = static_cast<std::uint32_t>(found.shape[axis]);
  return shape;
}

inline bool is_aligned(const void* data, std::size_t alignment) noexcept { return reinterpret_cast<std::uintptr_t>(data) % alignment == 0; }

// A view where memory is aligned (always in a slot), a copy where ZeroMQ put the frame elsewhere; what is loaned may be written.
template <class T, std::size_t Rank>
void put(Array<T, Rank>& array, const CortexArray& found, bool loaned) {
  const auto shape = shape_of<Rank>(found);
  if (loaned) {
    array = Array<T, Rank>::loaned(static_cast<T*>(const_cast<void*>(found.data)), shape);
  } else if (found.bytes > 0 && is_aligned(found.data, alignof(T))) {
    array = Array<T, Rank>::view(static_cast<const T*>(found.data), shape);
  } else {
    array = Array<T, Rank>::uninitialized(shape);
    if (found.bytes > 0) std::memcpy(static_cast<void*>(array.writable().data()), found.data, found.bytes);
  }
}
template <std::size_t Rank>
void put(AnyArray<Rank>& array, const CortexArray& found, bool loaned) {
  const auto dtype = static_cast<Dtype>(found.dtype);
  const auto* const data = static_cast<const std::uint8_t*>(found.data);
  const bool aligned = found.bytes > 0 && is_aligned(data, std::min<std::size_t>(item_size(dtype), 8));
  const std::array<std::uint32_t, 1> count{static_cast<std::uint32_t>(found.bytes)};
  auto bytes = loaned    ? Array<std::uint8_t>::loaned(const_cast<std::uint8_t*>(data), count)
               : aligned ? Array<std::uint8_t>::view(data, count)
                         : Array<std::uint8_t>(count, {data, found.bytes});
  array = AnyArray<Rank>(dtype, shape_of<Rank>(found), std::move(bytes));
}

template <class T, std::size_t Rank>
void get(const Array<T, Rank>& array, CortexArray& found) noexcept {
  std::copy(array.shape().begin(), array.shape().end(), found.shape);
  found.dtype = 0;
  found.data = array.data();
  found.bytes = array.size() * sizeof(T);
}
template <std::size_t Rank>
void get(const AnyArray<Rank>& array, CortexArray& found) noexcept {
  std::copy(array.shape().begin(), array.shape().end(), found.shape);
  found.dtype = static_cast<std::int64_t>(array.dtype());
  found.data = array.bytes().data();
  found.bytes = array.bytes().size();
}

template <class A>
constexpr ArrayType array_type{[](void* array, const CortexArray& found, bool loaned) { put(*static_cast<A*>(array), found, loaned); },
                               [](const void* array, CortexArray& found) { get(*static_cast<const A*>(array), found); }};

// Copies a number, or a small array of a fixed shape, which lies in a struct as in a body.
inline void copy_number(void* to, const void* from, std::int64_t size) noexcept {
  switch (size) {
    case 8:
      std::memcpy(to, from, 8);
      break;
    case 4:
      std::memcpy(to, from, 4);
      break;
    case 2:
      std::memcpy(to, from, 2);
      break;
    case 1:
      std::memcpy(to, from, 1);
      break;
    default:
      std::memcpy(to, from, static_cast<std::size_t>(size));
  }
}

template <class Type>
const Type& type_of(const CortexItem* item) noexcept {
  return *static_cast<const Type*>(item->object);
}

}  // namespace detail
}  // namespace cortex

// What `body_walk.h` asks for.

inline int cortex_put_number(CortexRead*, const CortexItem* item, const std::uint8_t* in, char* place) {
  cortex::detail::copy_number(place, in, item->size);
  return 1;
}

inline int cortex_put_bool(CortexRead*, int truth, char* place) {
  *place = static_cast<char>(truth);
  return 1;
}

inline int cortex_put_member(CortexRead*, const CortexItem* member, char* place) {
  const auto number = static_cast<std::int32_t>(member->code);
  std::memcpy(place, &number, sizeof number);
  return 1;
}

inline int cortex_put_text(CortexRead* read, const CortexItem* item, const std::uint8_t* in, std::uint64_t size, char* place) {
  if (item->kind == CORTEX_BYTES) {
    auto& bytes = *reinterpret_cast<cortex::Array<std::uint8_t>*>(place);
    bytes = size == 0 ? cortex::Array<std::uint8_t>() : cortex::Array<std::uint8_t>::view(in, {static_cast<std::uint32_t>(size)});
    return 1;
  }
  auto& text = *reinterpret_cast<std::string*>(place);
  text.assign(reinterpret_cast<const char*>(in), size);  // first: what it was read from may change
  if (cortex::is_utf8(reinterpret_cast<const std::uint8_t*>(text.data()), text.size())) return 1;
  return cortex_reject(read, "a str is not UTF-8");
}

inline int cortex_put_array(CortexRead*, const CortexItem* item, const CortexArray* array, char* place) {
  cortex::detail::type_of<cortex::detail::ArrayType>(item).put(place, *array, false);
  return 1;
}

inline char* cortex_put_optional(CortexRead*, const CortexItem* item, int present, char* place) {
  return cortex::detail::type_of<cortex::detail::OptionalType>(item).set(place, present != 0);
}

inline int cortex_put_list(CortexRead*, const CortexItem* item, std::uint64_t count, char* place, char** elements, std::size_t* step) {
  const auto& type = cortex::detail::type_of<cortex::detail::ListType>(item);
  *elements = type.resize(place, count);
  *step = type.step;
  return 1;
}

inline char* cortex_put_message(CortexRead*, const CortexItem*, char* place) { return place; }

inline int cortex_get_scalar(CortexWrite* write, const CortexItem* item, const char* place, std::uint8_t* out) {
  cortex::detail::copy_number(out, place, item->size);
  if (item->kind == CORTEX_NUMBER) return 1;
  if (item->kind == CORTEX_BOOL) *out = *out != 0;
  if (item->kind != CORTEX_ENUM || cortex_member(write->items, item, cortex::wire::load<std::int32_t>(out)) != nullptr) return 1;
  return cortex_refuse(write, "a number is no value of its enum");
}

inline int cortex_get_text(CortexWrite* write, const CortexItem* item, const char* place, const void** data, std::uint64_t* size) {
  if (item->kind == CORTEX_BYTES) {
    const auto& bytes = *reinterpret_cast<const cortex::Array<std::uint8_t>*>(place);
    *data = bytes.data();
    *size = bytes.size();
    return 1;
  }
  const auto& text = *reinterpret_cast<const std::string*>(place);
  *data = text.data();
  *size = text.size();
  const bool is_good = write->out == nullptr || cortex::is_utf8(reinterpret_cast<const std::uint8_t*>(text.data()), text.size());
  return is_good ? 1 : cortex_refuse(write, "a str must be UTF-8; use bytes for other data");
}

inline int cortex_get_array(CortexWrite* write, const CortexItem* item, const char* place, CortexArray* array) {
  cortex::detail::type_of<cortex::detail::ArrayType>(item).get(place, *array);
  auto bytes = static_cast<std::uint64_t>(write->items[item->first + item->count + array->dtype].size);
  for (std::int64_t axis = 0; axis < item->count; ++axis) bytes *= static_cast<std::uint64_t>(array->shape[axis]);
  return bytes == array->bytes ? 1 : cortex_refuse(write, "an array without its items");
}

inline int cortex_copy_array(CortexWrite* write, const CortexArray* array, const char*, std::uint64_t start) {
  if (write->out != nullptr && array->data != write->out + start) cortex_copy(write->out + start, array->data, array->bytes);
  return 1;
}

inline const char* cortex_get_optional(CortexWrite*, const CortexItem* item, const char* place) {
  return cortex::detail::type_of<cortex::detail::OptionalType>(item).get(place);
}

inline int cortex_get_list(CortexWrite*, const CortexItem* item, const char* place, std::uint64_t* count, const char** elements,
                           std::size_t* step) {
  const auto& type = cortex::detail::type_of<cortex::detail::ListType>(item);
  *elements = type.get(place, *count);
  *step = type.step;
  return 1;
}

inline const char* cortex_get_message(CortexWrite*, const CortexItem*, const char* place) { return place; }

namespace cortex {

// Bytes of a body before its tail.
template <class T>
constexpr std::size_t block_of() noexcept {
  return static_cast<std::size_t>(Codec<T>::items[0].size);
}

namespace detail {

// Of what type, and in which of its fields, something is wrong.
template <class T>
std::string complaint(const char* wrong, const CortexItem* field) {
  std::string where(Codec<T>::name);
  if (field != nullptr) where.append(".").append(Codec<T>::names[field - &Codec<T>::items[Codec<T>::items[0].first]]);
  return where + ": " + wrong;
}

template <class T>
std::size_t write_body(const T& message, std::uint8_t* out, std::size_t placed, std::size_t limit) {
  CortexWrite write;
  if (cortex_write_body(&write, Codec<T>::items, out, placed, limit, reinterpret_cast<const char*>(&message)) != 0) return write.end;
  throw std::invalid_argument(complaint<T>(write.wrong, write.field));
}

}  // namespace detail

// Bytes of the body of this message. Throws std::invalid_argument for a message that breaks its type.
template <class T>
std::size_t encoded_size(const T& message) {
  if constexpr (Codec<T>::fixed) return block_of<T>();
  return detail::write_body(message, nullptr, 0, wire::body_limit);
}

// Writes the body into memory of at least `encoded_size` bytes, returns its size. Arrays that lie there before `tail` stay.
template <class T>
std::size_t encode_into(const T& message, Span<std::uint8_t> out, std::size_t tail = 0) {
  return detail::write_body(message, out.data(), tail, out.size());
}

template <class T>
std::vector<std::uint8_t> encode(const T& message) {
  std::vector<std::uint8_t> body(encoded_size(message));
  encode_into(message, {body.data(), body.size()});
  return body;
}

// Reads a body that may hold anything; arrays look into it. Throws MalformedMessage.
template <class T>
void decode_into(Span<const std::uint8_t> body, T& out) {
  CortexRead read;
  if (cortex_read_body(&read, Codec<T>::items, body.data(), body.size(), nullptr, reinterpret_cast<char*>(&out)) != 0) return;
  throw MalformedMessage(detail::complaint<T>(read.wrong, read.field));
}

template <class T>
T decode(Span<const std::uint8_t> body) {
  T message{};
  decode_into(body, message);
  return message;
}

}  // namespace cortex
