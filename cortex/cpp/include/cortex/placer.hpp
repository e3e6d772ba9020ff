// SPDX-License-Identifier: Apache-2.0
// Where the arrays of a loan lie in its slot.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "cortex/array.hpp"
#include "cortex/codec.hpp"
#include "cortex/wire.hpp"

namespace cortex {

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
}  // namespace cortex
