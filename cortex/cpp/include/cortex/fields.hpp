// SPDX-License-Identifier: Apache-2.0
// What is told of a field besides its C++ type (WIRE.md, section 5.1).
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <string>
#include <type_traits>
#include <vector>

#include "cortex/array.hpp"
#include "cortex/wire.hpp"

namespace cortex {

// Specialised by the headers that `cortex cpp` writes:
//   name, schema (canonical JSON), fingerprint; block (bytes), fixed (no tail), stamped; stamp(message);
//   fields(visitor, at, message), which calls visitor(at, field, shape...) for each field in order. The shapes are what its
//   C++ type leaves open, from the outside in: `Held` for an optional, `Elements` for a list, one of the others for arrays.
template <class T>
struct Codec;

// Specialised for generated enums: `known(number)` tells whether the schema lists it.
template <class E>
struct EnumCodec;

constexpr std::size_t large_bytes = 1024;    // an array of so many is aligned to 64
constexpr std::size_t values_max = 1 << 20;  // that the elements of all lists of a body may become

// Whether a value lies in the block as it does in memory.
template <class T>
constexpr bool is_plain = std::is_arithmetic_v<T>;
template <class T, std::size_t Size>
constexpr bool is_plain<std::array<T, Size>> = true;

// What an optional holds lies so far behind the byte that says whether it is there.
template <std::size_t Offset>
struct Held {};

// Elements of a list: their distance, how the first is aligned, and how many values each becomes.
template <std::size_t Stride, std::size_t Alignment, std::size_t Values>
struct Elements {};

// A large array in the block.
template <std::uint32_t... Sizes>
struct Within {};

// Bytes, and no array of them.
struct Bytes {};

// A named dimension: one size within one message, or within one element of a list.
struct Dimension {
  const char* name;
  std::int64_t size = -1;
};

// An array in the tail.
template <std::size_t Rank>
struct Extents {
  struct Extent {
    Extent(Dimension& dimension) : named(&dimension) {}  // NOLINT: generated code lists both
    Extent(std::uint32_t expected) : size(expected) {}   // NOLINT
    Dimension* named = nullptr;
    std::uint32_t size = 0;
  };

  const char* field;
  std::array<Extent, Rank> each;

  template <class Error>
  void check(const std::array<std::uint32_t, Rank>& shape) const {
    for (std::size_t index = 0; index < Rank; ++index) {
      Dimension* const named = each[index].named;
      if (named != nullptr && named->size < 0) named->size = shape[index];
      const std::int64_t expected = named != nullptr ? named->size : each[index].size;
      if (expected != shape[index]) refuse<Error>(index, shape[index], expected);
    }
  }

  template <class Error>
  [[noreturn]] void refuse(std::size_t index, std::uint32_t size, std::int64_t expected) const {
    const Dimension* const named = each[index].named;
    throw Error(std::string(field) + ": dimension " + (named != nullptr ? named->name : std::to_string(index)) + " is " +
                std::to_string(size) + " here and " + std::to_string(expected) +
                (named != nullptr ? " elsewhere" : " by the type"));
  }
};

// An element of a list begins: the dimensions of its arrays are its own.
template <class Shape>
void begin_scope(const Shape&) noexcept {}
template <std::size_t Rank>
void begin_scope(const Extents<Rank>& extents) noexcept {
  for (const auto& extent : extents.each) {
    if (extent.named != nullptr) extent.named->size = -1;
  }
}

}  // namespace cortex
