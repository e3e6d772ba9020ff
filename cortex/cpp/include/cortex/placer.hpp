// SPDX-License-Identifier: Apache-2.0
// Where the arrays of a loan lie in its slot.
#pragma once

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <stdexcept>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "cortex/array.hpp"
#include "cortex/fields.hpp"
#include "cortex/wire.hpp"

namespace cortex {

using Dimensions = std::vector<std::pair<std::string, std::uint32_t>>;  // by the name of the dimension
using Dtypes = std::vector<std::pair<std::string, Dtype>>;              // by the name of the field

// Visits the fields of a loan, and gives those of its arrays their place in the slot whose dimensions are all known.
class Placer {
 public:
  // Without memory (data null) it only counts.
  Placer(Span<std::uint8_t> body, std::size_t block, const Dimensions& dimensions, const Dtypes& dtypes)
      : body_(body), cursor_(block), dimensions_(dimensions), dtypes_(dtypes) {}
  std::size_t size() const noexcept { return cursor_; }

  template <class T, class... Shape>
  void operator()(std::size_t, T&, const Shape&...) const noexcept {}

  template <class T, std::size_t Rank>
  void operator()(std::size_t, Array<T, Rank>& out, const Extents<Rank>& extents) {
    std::array<std::uint32_t, Rank> shape{};
    std::size_t bytes = sizeof(T);
    if (!known(extents, shape, bytes)) return;
    std::uint8_t* at = take(bytes);
    if (at != nullptr) out = Array<T, Rank>::loaned(reinterpret_cast<T*>(at), shape);
  }
  template <std::size_t Rank>
  void operator()(std::size_t, AnyArray<Rank>& out, const Extents<Rank>& extents) {
    const std::string_view field = std::string_view(extents.field).substr(std::string_view(extents.field).rfind('.') + 1);
    const auto found = std::find_if(dtypes_.begin(), dtypes_.end(), [&](const auto& each) { return each.first == field; });
    if (found == dtypes_.end()) return;
    std::array<std::uint32_t, Rank> shape{};
    std::size_t bytes = item_size(found->second);
    if (!known(extents, shape, bytes)) return;
    std::uint8_t* at = take(bytes);
    if (at == nullptr) return;
    out = AnyArray<Rank>(found->second, shape, Array<std::uint8_t>::loaned(at, {static_cast<std::uint32_t>(bytes)}));
  }
  template <class T, std::size_t Rank, std::uint32_t... Sizes>
  void operator()(std::size_t at, Array<T, Rank>& out, Within<Sizes...>) {
    if (body_.data() != nullptr) out = Array<T, Rank>::loaned(reinterpret_cast<T*>(body_.data() + at), {Sizes...});
  }

 private:
  // Whether all dimensions are given: then the shape, and `bytes` times its items.
  template <std::size_t Rank>
  bool known(const Extents<Rank>& extents, std::array<std::uint32_t, Rank>& shape, std::size_t& bytes) const {
    for (std::size_t index = 0; index < Rank; ++index) {
      const auto& extent = extents.each[index];
      shape[index] = extent.size;
      if (extent.named != nullptr) {
        const auto found = std::find_if(dimensions_.begin(), dimensions_.end(),
                                        [&](const auto& dimension) { return dimension.first == extent.named->name; });
        if (found == dimensions_.end()) return false;
        shape[index] = found->second;
      }
      if (shape[index] != 0 && bytes > wire::body_limit / shape[index]) too_large();
      bytes *= shape[index];
    }
    return true;
  }

  // The next place for so many bytes, null while only counting.
  std::uint8_t* take(std::size_t bytes) {
    const auto start = static_cast<std::size_t>(wire::round_up(cursor_, bytes >= large_bytes ? 64 : 8));
    if (start + bytes > wire::body_limit) too_large();
    if (body_.data() != nullptr && start > cursor_) std::memset(body_.data() + cursor_, 0, start - cursor_);
    cursor_ = start + bytes;
    return body_.data() == nullptr ? nullptr : body_.data() + start;
  }

  [[noreturn]] static void too_large() { throw std::invalid_argument("a loan is larger than 1 GiB"); }

  Span<std::uint8_t> body_;
  std::size_t cursor_;
  const Dimensions& dimensions_;
  const Dtypes& dtypes_;
};

}  // namespace cortex
