// Written by `cortex cpp`; do not edit. Types: example::Scan, example::Cmd.
#pragma once

#include <array>
#include <complex>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <optional>
#include <stdexcept>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include <cortex/codec.hpp>

#ifndef CORTEX_TYPE_example_Scan_7C6C9A4EA4BD11ED
#define CORTEX_TYPE_example_Scan_7C6C9A4EA4BD11ED
namespace example {
struct Scan {
  std::int64_t stamp_ns{};
  cortex::Array<float, 1> ranges{};  // [n], m

  friend bool operator==(const Scan& a, const Scan& b) {
    return a.stamp_ns == b.stamp_ns &&
           a.ranges == b.ranges;
  }
  friend bool operator!=(const Scan& a, const Scan& b) { return !(a == b); }
};
}  // namespace example
namespace cortex {
template <>
struct Codec<::example::Scan> {
  static constexpr std::string_view name = "example/Scan";
  static constexpr std::uint64_t fingerprint = 0x7C6C9A4EA4BD11EDu;
  static constexpr std::string_view schema =
      "{\"name\":\"example/Scan\",\"fields\":[{\"name\":\"stamp_ns\",\"type\":\"int64\",\"unit\":\"\",\"frame\":\"\"},{"
      "\"name\":\"ranges\",\"type\":{\"array\":\"float32\",\"shape\":[\"n\"]},\"unit\":\"m\",\"frame\":\"\"}]}";
  static constexpr std::size_t block = 24;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = false;
  static constexpr bool stamped = true;

  static std::int64_t stamp(const ::example::Scan& message) noexcept {
    return static_cast<std::int64_t>(message.stamp_ns);
  }

  static void decode(Reader& reader, std::size_t at, ::example::Scan& out) {
    Dimension<MalformedMessage> dimension_n("n");
    reader.scalar(at, out.stamp_ns);
    reader.array(at + 8, out.ranges);
    dimension_n(out.ranges.shape()[0], "example/Scan.ranges");
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::example::Scan& message) {
    Dimension<std::invalid_argument> dimension_n("n");
    sink.scalar(at, message.stamp_ns);
    dimension_n(message.ranges.shape()[0], "example/Scan.ranges");
    sink.array(at + 8, message.ranges);
    sink.zero(at + 20, 4);
  }

  static void draft(Placer& placer, ::example::Scan& out) {
    placer.array(out.ranges, {Placer::Extent{"n", 0}});
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_example_Scan_7C6C9A4EA4BD11ED

#ifndef CORTEX_TYPE_example_Cmd_97E1A8FE9993306D
#define CORTEX_TYPE_example_Cmd_97E1A8FE9993306D
namespace example {
struct Cmd {
  std::int64_t stamp_ns{};
  double speed{};  // m/s, frame body
  double turn{};  // rad/s, frame body

  friend bool operator==(const Cmd& a, const Cmd& b) {
    return a.stamp_ns == b.stamp_ns &&
           a.speed == b.speed &&
           a.turn == b.turn;
  }
  friend bool operator!=(const Cmd& a, const Cmd& b) { return !(a == b); }
};
}  // namespace example
namespace cortex {
template <>
struct Codec<::example::Cmd> {
  static constexpr std::string_view name = "example/Cmd";
  static constexpr std::uint64_t fingerprint = 0x97E1A8FE9993306Du;
  static constexpr std::string_view schema =
      "{\"name\":\"example/Cmd\",\"fields\":[{\"name\":\"stamp_ns\",\"type\":\"int64\",\"unit\":\"\",\"frame\":\"\"},{\""
      "name\":\"speed\",\"type\":\"float64\",\"unit\":\"m/s\",\"frame\":\"body\"},{\"name\":\"turn\",\"type\":\"float64"
      "\",\"unit\":\"rad/s\",\"frame\":\"body\"}]}";
  static constexpr std::size_t block = 24;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = true;
  static constexpr bool stamped = true;

  static std::int64_t stamp(const ::example::Cmd& message) noexcept {
    return static_cast<std::int64_t>(message.stamp_ns);
  }

  static void decode(Reader& reader, std::size_t at, ::example::Cmd& out) {
    reader.scalar(at, out.stamp_ns);
    reader.scalar(at + 8, out.speed);
    reader.scalar(at + 16, out.turn);
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::example::Cmd& message) {
    sink.scalar(at, message.stamp_ns);
    sink.scalar(at + 8, message.speed);
    sink.scalar(at + 16, message.turn);
  }

  static void draft([[maybe_unused]] Placer& placer, [[maybe_unused]] ::example::Cmd& out) {
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_example_Cmd_97E1A8FE9993306D
