// SPDX-License-Identifier: Apache-2.0
// Arrays of messages: values that either own their items or look into a received frame or a slot of shared memory.
#pragma once

#include <array>
#include <complex>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <initializer_list>
#include <memory>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

namespace cortex {

// A view of consecutive items; C++17 has no std::span.
template <class T>
class Span {
 public:
  constexpr Span() noexcept = default;
  constexpr Span(T* data, std::size_t size) noexcept : data_(data), size_(size) {}

  constexpr T* data() const noexcept { return data_; }
  constexpr std::size_t size() const noexcept { return size_; }
  constexpr bool empty() const noexcept { return size_ == 0; }
  constexpr T* begin() const noexcept { return data_; }
  constexpr T* end() const noexcept { return data_ + size_; }
  constexpr T& operator[](std::size_t index) const noexcept { return data_[index]; }

 private:
  T* data_ = nullptr;
  std::size_t size_ = 0;
};

// An item of a boolean array: one byte, so that any byte that arrives is a value and not undefined behaviour.
struct Bool {
  std::uint8_t value = 0;
  constexpr Bool() noexcept = default;
  constexpr Bool(bool truth) noexcept : value(truth ? 1 : 0) {}  // NOLINT: a bool is what it stands for
  constexpr operator bool() const noexcept { return value != 0; }
};

// The 16 bits of an IEEE half; C++17 has no arithmetic for them.
struct Half {
  std::uint16_t bits = 0;
  friend constexpr bool operator==(Half a, Half b) noexcept { return a.bits == b.bits; }
};

enum class Dtype : std::uint8_t {
  boolean = 0,
  int8 = 1,
  int16 = 2,
  int32 = 3,
  int64 = 4,
  uint8 = 5,
  uint16 = 6,
  uint32 = 7,
  uint64 = 8,
  float16 = 9,
  float32 = 10,
  float64 = 11,
  complex64 = 12,
  complex128 = 13,
};

// Bytes of one item, 0 for a code that does not exist.
constexpr std::size_t item_size(Dtype dtype) noexcept {
  constexpr std::uint8_t sizes[] = {1, 1, 2, 4, 8, 1, 2, 4, 8, 2, 4, 8, 8, 16};
  const auto code = static_cast<std::uint8_t>(dtype);
  return code < sizeof(sizes) ? sizes[code] : 0;
}

template <class T>
constexpr Dtype dtype_of() noexcept {
  if constexpr (std::is_same_v<T, Bool>) return Dtype::boolean;
  else if constexpr (std::is_same_v<T, std::int8_t>) return Dtype::int8;
  else if constexpr (std::is_same_v<T, std::int16_t>) return Dtype::int16;
  else if constexpr (std::is_same_v<T, std::int32_t>) return Dtype::int32;
  else if constexpr (std::is_same_v<T, std::int64_t>) return Dtype::int64;
  else if constexpr (std::is_same_v<T, std::uint8_t>) return Dtype::uint8;
  else if constexpr (std::is_same_v<T, std::uint16_t>) return Dtype::uint16;
  else if constexpr (std::is_same_v<T, std::uint32_t>) return Dtype::uint32;
  else if constexpr (std::is_same_v<T, std::uint64_t>) return Dtype::uint64;
  else if constexpr (std::is_same_v<T, Half>) return Dtype::float16;
  else if constexpr (std::is_same_v<T, float>) return Dtype::float32;
  else if constexpr (std::is_same_v<T, double>) return Dtype::float64;
  else if constexpr (std::is_same_v<T, std::complex<float>>) return Dtype::complex64;
  else {
    static_assert(std::is_same_v<T, std::complex<double>>, "not an item type of an array");
    return Dtype::complex128;
  }
}

// Items in a shape, row-major.
//
// A copy owns its items. What a subscription hands out looks into the frame or the slot, which lives as long as the
// received message; reading never copies, `writable()` copies first if the items are not this array's own.
template <class T, std::size_t Rank = 1>
class Array {
 public:
  using value_type = T;
  using Shape = std::array<std::uint32_t, Rank>;
  static constexpr std::size_t rank = Rank;

  Array() noexcept { shape_.fill(0); }

  Array(const Shape& shape, Span<const T> items) : shape_(shape) {
    if (count() != items.size()) {
      throw std::invalid_argument("an array of " + std::to_string(count()) + " items was given " +
                                  std::to_string(items.size()));
    }
    allocate(false);
    copy_from(items.data());
  }

  template <std::size_t R = Rank, class = std::enable_if_t<R == 1>>
  Array(std::initializer_list<T> items) : Array(one_dimension(items.size()), {items.begin(), items.size()}) {}

  template <std::size_t R = Rank, class = std::enable_if_t<R == 1>>
  Array(const std::vector<T>& items) : Array(one_dimension(items.size()), {items.data(), items.size()}) {}  // NOLINT

  Array(const Array& other) : shape_(other.shape_) {
    allocate(false);
    copy_from(other.data_);
  }
  Array(Array&& other) noexcept
      : shape_(other.shape_), data_(other.data_), mutable_(other.mutable_), owned_(std::move(other.owned_)) {
    other.forget();
  }
  Array& operator=(const Array& other) { return *this = Array(other); }
  Array& operator=(Array&& other) noexcept {
    if (this != &other) {
      shape_ = other.shape_;
      data_ = other.data_;
      mutable_ = other.mutable_;
      owned_ = std::move(other.owned_);
      other.forget();
    }
    return *this;
  }
  ~Array() = default;

  static Array zeros(const Shape& shape) {
    Array array;
    array.shape_ = shape;
    array.allocate(true);
    return array;
  }
  // Looks at items that someone else keeps alive.
  static Array view(const T* data, const Shape& shape) noexcept {
    Array array;
    array.shape_ = shape;
    array.data_ = data;
    return array;
  }
  // As `view`, and `writable()` writes there: a loan's arrays in their slot.
  static Array loaned(T* data, const Shape& shape) noexcept {
    Array array = view(data, shape);
    array.mutable_ = data;
    return array;
  }
  // Items left as they come, to be written at once.
  static Array uninitialized(const Shape& shape) {
    Array array;
    array.shape_ = shape;
    array.allocate(false);
    return array;
  }

  const Shape& shape() const noexcept { return shape_; }
  std::size_t size() const noexcept { return data_ == nullptr ? 0 : count(); }
  bool empty() const noexcept { return size() == 0; }
  const T* data() const noexcept { return data_; }
  const T* begin() const noexcept { return data_; }
  const T* end() const noexcept { return data_ + size(); }
  const T& operator[](std::size_t index) const noexcept { return data_[index]; }
  Span<const T> span() const noexcept { return {data_, size()}; }

  // The item at these indices, one for each dimension (not checked).
  template <class... Index>
  const T& operator()(Index... indices) const noexcept {
    static_assert(sizeof...(Index) == Rank, "one index for each dimension");
    const std::array<std::size_t, Rank> index{static_cast<std::size_t>(indices)...};
    std::size_t flat = 0;
    for (std::size_t dimension = 0; dimension < Rank; ++dimension) flat = flat * shape_[dimension] + index[dimension];
    return data_[flat];
  }

  // The items, to be changed.
  Span<T> writable() {
    if (mutable_ == nullptr && size() > 0) *this = Array(*this);
    return {mutable_, size()};
  }

  friend bool operator==(const Array& a, const Array& b) noexcept {
    if (a.shape_ != b.shape_ || a.size() != b.size()) return false;
    for (std::size_t index = 0; index < a.size(); ++index) {
      if (!(a.data_[index] == b.data_[index])) return false;
    }
    return true;
  }
  friend bool operator!=(const Array& a, const Array& b) noexcept { return !(a == b); }

 private:
  static Shape one_dimension(std::size_t size) {
    if (size > 0xFFFFFFFFu) throw std::invalid_argument("an array dimension must be below 2^32");
    Shape shape{};
    shape[0] = static_cast<std::uint32_t>(size);
    return shape;
  }
  std::size_t count() const noexcept {
    std::size_t items = 1;
    for (const auto extent : shape_) items *= extent;
    return items;
  }
  void allocate(bool zero) {
    for (const auto extent : shape_) {
      if (extent == 0) return;  // whatever the others are
    }
    std::size_t items = 1;
    for (const auto extent : shape_) {
      if (items > (std::size_t{1} << 40) / extent) throw std::invalid_argument("an array is too large");
      items *= extent;
    }
    owned_.reset(zero ? new T[items]() : new T[items]);
    data_ = mutable_ = owned_.get();
  }
  void copy_from(const T* items) noexcept {
    if (data_ == nullptr) return;
    if (items != nullptr) {
      std::memcpy(static_cast<void*>(mutable_), items, count() * sizeof(T));
    } else {
      std::memset(static_cast<void*>(mutable_), 0, count() * sizeof(T));
    }
  }
  void forget() noexcept {
    shape_.fill(0);
    data_ = mutable_ = nullptr;
  }

  Shape shape_{};
  const T* data_ = nullptr;
  T* mutable_ = nullptr;
  std::unique_ptr<T[]> owned_;
};

// An array whose item type is only known at run time (dtype "any" in a schema).
template <std::size_t Rank>
class AnyArray {
 public:
  using Shape = std::array<std::uint32_t, Rank>;

  AnyArray() noexcept { shape_.fill(0); }

  template <class T>
  AnyArray(const Array<T, Rank>& array)  // NOLINT: an array with its type is what this stands for
      : AnyArray(dtype_of<T>(), array.shape(),
                 Array<std::uint8_t>({static_cast<std::uint32_t>(array.size() * sizeof(T))},
                                     {reinterpret_cast<const std::uint8_t*>(array.data()), array.size() * sizeof(T)})) {}

  AnyArray(Dtype dtype, const Shape& shape, Array<std::uint8_t> bytes)
      : dtype_(dtype), shape_(shape), bytes_(std::move(bytes)) {
    std::size_t expected = item_size(dtype);
    for (const auto extent : shape) expected *= extent;
    if (item_size(dtype) == 0 || expected != bytes_.size()) {
      throw std::invalid_argument("an array of " + std::to_string(expected) + " bytes was given " +
                                  std::to_string(bytes_.size()));
    }
  }

  Dtype dtype() const noexcept { return dtype_; }
  const Shape& shape() const noexcept { return shape_; }
  const Array<std::uint8_t>& bytes() const noexcept { return bytes_; }
  template <class T>
  bool holds() const noexcept {
    return dtype_ == dtype_of<T>();
  }
  // The items; throws if they are of another type.
  template <class T>
  Span<const T> as() const {
    if (!holds<T>()) {
      throw std::invalid_argument("an array of dtype code " + std::to_string(static_cast<int>(dtype_)) +
                                  " was asked for items of code " + std::to_string(static_cast<int>(dtype_of<T>())));
    }
    return {reinterpret_cast<const T*>(bytes_.data()), bytes_.size() / sizeof(T)};
  }

  // The items, to be changed; as `Array::writable`.
  template <class T>
  Span<T> writable() {
    as<T>();
    return {reinterpret_cast<T*>(bytes_.writable().data()), bytes_.size() / sizeof(T)};
  }

  friend bool operator==(const AnyArray& a, const AnyArray& b) noexcept {
    return a.dtype_ == b.dtype_ && a.shape_ == b.shape_ && a.bytes_ == b.bytes_;
  }
  friend bool operator!=(const AnyArray& a, const AnyArray& b) noexcept { return !(a == b); }

 private:
  Dtype dtype_ = Dtype::uint8;
  Shape shape_{};
  Array<std::uint8_t> bytes_;
};

}  // namespace cortex
