// Written by `cortex cpp`; do not edit. Types: cortex::messages::AttitudeCommand, cortex::messages::CameraInfo, cortex::messages::Clock, cortex::messages::Collision, cortex::messages::CommandRanges, cortex::messages::Delivery, cortex::messages::Events, cortex::messages::Image, cortex::messages::Imu, cortex::messages::MotorCommand, cortex::messages::Odometry, cortex::messages::Parameter, cortex::messages::Parameters, cortex::messages::Path, cortex::messages::PointCloud, cortex::messages::PoseCommand, cortex::messages::RateThrustCommand, cortex::messages::Reset, cortex::messages::RotorSpeeds, cortex::messages::SensorStatus, cortex::messages::Simulation, cortex::messages::SimulatorReply, cortex::messages::VehicleStatus, cortex::messages::SimulatorStatus, cortex::messages::Step, cortex::messages::Text, cortex::messages::Transform, cortex::messages::Trigger, cortex::messages::VelocityCommand.
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

#ifndef CORTEX_TYPE_cortex_messages_AttitudeCommand_07A48E1ED0F97E93
#define CORTEX_TYPE_cortex_messages_AttitudeCommand_07A48E1ED0F97E93
namespace cortex::messages {
struct AttitudeCommand {
  std::int64_t stamp_ns{};  // ns
  double thrust_n{};  // N, frame body
  std::array<double, 4> orientation{};  // [4]
  std::uint64_t sequence{};

  friend bool operator==(const AttitudeCommand& a, const AttitudeCommand& b) {
    return a.stamp_ns == b.stamp_ns &&
           a.thrust_n == b.thrust_n &&
           a.orientation == b.orientation &&
           a.sequence == b.sequence;
  }
  friend bool operator!=(const AttitudeCommand& a, const AttitudeCommand& b) { return !(a == b); }
};
}  // namespace cortex::messages
namespace cortex {
template <>
struct Codec<::cortex::messages::AttitudeCommand> {
  static constexpr std::string_view name = "cortex/AttitudeCommand";
  static constexpr std::uint64_t fingerprint = 0x07A48E1ED0F97E93u;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/AttitudeCommand\",\"fields\":[{\"name\":\"stamp_ns\",\"type\":\"int64\",\"unit\":\"ns\",\""
      "frame\":\"\"},{\"name\":\"thrust_n\",\"type\":\"float64\",\"unit\":\"N\",\"frame\":\"body\"},{\"name\":\"orienta"
      "tion\",\"type\":{\"array\":\"float64\",\"shape\":[4]},\"unit\":\"\",\"frame\":\"\"},{\"name\":\"sequence\",\"typ"
      "e\":\"uint64\",\"unit\":\"\",\"frame\":\"\"}]}";
  static constexpr std::size_t block = 56;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = true;
  static constexpr bool stamped = true;

  static std::int64_t stamp(const ::cortex::messages::AttitudeCommand& message) noexcept {
    return static_cast<std::int64_t>(message.stamp_ns);
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::messages::AttitudeCommand& out) {
    reader.scalar(at, out.stamp_ns);
    reader.scalar(at + 8, out.thrust_n);
    reader.fixed(at + 16, out.orientation);
    reader.scalar(at + 48, out.sequence);
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::messages::AttitudeCommand& message) {
    sink.scalar(at, message.stamp_ns);
    sink.scalar(at + 8, message.thrust_n);
    sink.fixed(at + 16, message.orientation);
    sink.scalar(at + 48, message.sequence);
  }

  static void draft([[maybe_unused]] Placer& placer, [[maybe_unused]] ::cortex::messages::AttitudeCommand& out) {
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_messages_AttitudeCommand_07A48E1ED0F97E93

#ifndef CORTEX_TYPE_cortex_messages_CameraInfo_A8CD798F9836EB17
#define CORTEX_TYPE_cortex_messages_CameraInfo_A8CD798F9836EB17
namespace cortex::messages {
struct CameraInfo {
  std::int64_t stamp_ns{};  // ns
  std::uint32_t width{};  // px
  std::uint32_t height{};  // px
  std::array<std::array<double, 3>, 3> matrix{};  // [3, 3], px
  std::string distortion_model{};
  cortex::Array<double, 1> distortion{};  // [k]
  std::string frame_id{};
  std::uint64_t sequence{};

  friend bool operator==(const CameraInfo& a, const CameraInfo& b) {
    return a.stamp_ns == b.stamp_ns &&
           a.width == b.width &&
           a.height == b.height &&
           a.matrix == b.matrix &&
           a.distortion_model == b.distortion_model &&
           a.distortion == b.distortion &&
           a.frame_id == b.frame_id &&
           a.sequence == b.sequence;
  }
  friend bool operator!=(const CameraInfo& a, const CameraInfo& b) { return !(a == b); }
};
}  // namespace cortex::messages
namespace cortex {
template <>
struct Codec<::cortex::messages::CameraInfo> {
  static constexpr std::string_view name = "cortex/CameraInfo";
  static constexpr std::uint64_t fingerprint = 0xA8CD798F9836EB17u;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/CameraInfo\",\"fields\":[{\"name\":\"stamp_ns\",\"type\":\"int64\",\"unit\":\"ns\",\"frame"
      "\":\"\"},{\"name\":\"width\",\"type\":\"uint32\",\"unit\":\"px\",\"frame\":\"\"},{\"name\":\"height\",\"type\":\"uin"
      "t32\",\"unit\":\"px\",\"frame\":\"\"},{\"name\":\"matrix\",\"type\":{\"array\":\"float64\",\"shape\":[3,3]},\"un"
      "it\":\"px\",\"frame\":\"\"},{\"name\":\"distortion_model\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\""
      ":\"distortion\",\"type\":{\"array\":\"float64\",\"shape\":[\"k\"]},\"unit\":\"\",\"frame\":\"\"},{\"name\":\"fram"
      "e_id\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"sequence\",\"type\":\"uint64\",\"unit\":\"\",\"fra"
      "me\":\"\"}]}";
  static constexpr std::size_t block = 128;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = false;
  static constexpr bool stamped = true;

  static std::int64_t stamp(const ::cortex::messages::CameraInfo& message) noexcept {
    return static_cast<std::int64_t>(message.stamp_ns);
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::messages::CameraInfo& out) {
    Dimension<MalformedMessage> dimension_k("k");
    reader.scalar(at, out.stamp_ns);
    reader.scalar(at + 8, out.width);
    reader.scalar(at + 12, out.height);
    reader.fixed(at + 16, out.matrix);
    reader.text(at + 88, out.distortion_model);
    reader.array(at + 96, out.distortion);
    dimension_k(out.distortion.shape()[0], "cortex/CameraInfo.distortion");
    reader.text(at + 108, out.frame_id);
    reader.scalar(at + 120, out.sequence);
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::messages::CameraInfo& message) {
    Dimension<std::invalid_argument> dimension_k("k");
    sink.scalar(at, message.stamp_ns);
    sink.scalar(at + 8, message.width);
    sink.scalar(at + 12, message.height);
    sink.fixed(at + 16, message.matrix);
    sink.text(at + 88, message.distortion_model);
    dimension_k(message.distortion.shape()[0], "cortex/CameraInfo.distortion");
    sink.array(at + 96, message.distortion);
    sink.text(at + 108, message.frame_id);
    sink.zero(at + 116, 4);
    sink.scalar(at + 120, message.sequence);
  }

  static void draft(Placer& placer, ::cortex::messages::CameraInfo& out) {
    placer.array(out.distortion, {Placer::Extent{"k", 0}});
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_messages_CameraInfo_A8CD798F9836EB17

#ifndef CORTEX_TYPE_cortex_messages_Clock_BCA0768E4C56154A
#define CORTEX_TYPE_cortex_messages_Clock_BCA0768E4C56154A
namespace cortex::messages {
struct Clock {
  std::int64_t stamp_ns{};  // ns
  std::int64_t wall_ns{};  // ns, frame CLOCK_REALTIME
  double real_time_factor{};
  std::uint64_t sequence{};

  friend bool operator==(const Clock& a, const Clock& b) {
    return a.stamp_ns == b.stamp_ns &&
           a.wall_ns == b.wall_ns &&
           a.real_time_factor == b.real_time_factor &&
           a.sequence == b.sequence;
  }
  friend bool operator!=(const Clock& a, const Clock& b) { return !(a == b); }
};
}  // namespace cortex::messages
namespace cortex {
template <>
struct Codec<::cortex::messages::Clock> {
  static constexpr std::string_view name = "cortex/Clock";
  static constexpr std::uint64_t fingerprint = 0xBCA0768E4C56154Au;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/Clock\",\"fields\":[{\"name\":\"stamp_ns\",\"type\":\"int64\",\"unit\":\"ns\",\"frame\":\"\"}"
      ",{\"name\":\"wall_ns\",\"type\":\"int64\",\"unit\":\"ns\",\"frame\":\"CLOCK_REALTIME\"},{\"name\":\"real_time"
      "_factor\",\"type\":\"float64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"sequence\",\"type\":\"uint64\",\"unit\":"
      "\"\",\"frame\":\"\"}]}";
  static constexpr std::size_t block = 32;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = true;
  static constexpr bool stamped = true;

  static std::int64_t stamp(const ::cortex::messages::Clock& message) noexcept {
    return static_cast<std::int64_t>(message.stamp_ns);
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::messages::Clock& out) {
    reader.scalar(at, out.stamp_ns);
    reader.scalar(at + 8, out.wall_ns);
    reader.scalar(at + 16, out.real_time_factor);
    reader.scalar(at + 24, out.sequence);
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::messages::Clock& message) {
    sink.scalar(at, message.stamp_ns);
    sink.scalar(at + 8, message.wall_ns);
    sink.scalar(at + 16, message.real_time_factor);
    sink.scalar(at + 24, message.sequence);
  }

  static void draft([[maybe_unused]] Placer& placer, [[maybe_unused]] ::cortex::messages::Clock& out) {
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_messages_Clock_BCA0768E4C56154A

#ifndef CORTEX_TYPE_cortex_messages_Collision_3BC3B9F2DE012E00
#define CORTEX_TYPE_cortex_messages_Collision_3BC3B9F2DE012E00
namespace cortex::messages {
struct Collision {
  std::int64_t stamp_ns{};  // ns
  std::array<double, 3> position{};  // [3], m, frame world
  double clearance_m{};  // m
  std::uint64_t sequence{};

  friend bool operator==(const Collision& a, const Collision& b) {
    return a.stamp_ns == b.stamp_ns &&
           a.position == b.position &&
           a.clearance_m == b.clearance_m &&
           a.sequence == b.sequence;
  }
  friend bool operator!=(const Collision& a, const Collision& b) { return !(a == b); }
};
}  // namespace cortex::messages
namespace cortex {
template <>
struct Codec<::cortex::messages::Collision> {
  static constexpr std::string_view name = "cortex/Collision";
  static constexpr std::uint64_t fingerprint = 0x3BC3B9F2DE012E00u;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/Collision\",\"fields\":[{\"name\":\"stamp_ns\",\"type\":\"int64\",\"unit\":\"ns\",\"frame\""
      ":\"\"},{\"name\":\"position\",\"type\":{\"array\":\"float64\",\"shape\":[3]},\"unit\":\"m\",\"frame\":\"world\"}"
      ",{\"name\":\"clearance_m\",\"type\":\"float64\",\"unit\":\"m\",\"frame\":\"\"},{\"name\":\"sequence\",\"type\":\""
      "uint64\",\"unit\":\"\",\"frame\":\"\"}]}";
  static constexpr std::size_t block = 48;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = true;
  static constexpr bool stamped = true;

  static std::int64_t stamp(const ::cortex::messages::Collision& message) noexcept {
    return static_cast<std::int64_t>(message.stamp_ns);
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::messages::Collision& out) {
    reader.scalar(at, out.stamp_ns);
    reader.fixed(at + 8, out.position);
    reader.scalar(at + 32, out.clearance_m);
    reader.scalar(at + 40, out.sequence);
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::messages::Collision& message) {
    sink.scalar(at, message.stamp_ns);
    sink.fixed(at + 8, message.position);
    sink.scalar(at + 32, message.clearance_m);
    sink.scalar(at + 40, message.sequence);
  }

  static void draft([[maybe_unused]] Placer& placer, [[maybe_unused]] ::cortex::messages::Collision& out) {
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_messages_Collision_3BC3B9F2DE012E00

#ifndef CORTEX_TYPE_cortex_messages_CommandRanges_729DCC2C178D66AB
#define CORTEX_TYPE_cortex_messages_CommandRanges_729DCC2C178D66AB
namespace cortex::messages {
struct CommandRanges {
  bool refuse{};
  double rotor_speed_max_rad_s{};  // rad/s
  double thrust_max_n{};  // N
  double speed_max_m_s{};  // m/s
  double body_rate_max_rad_s{};  // rad/s
  double position_max_m{};  // m

  friend bool operator==(const CommandRanges& a, const CommandRanges& b) {
    return a.refuse == b.refuse &&
           a.rotor_speed_max_rad_s == b.rotor_speed_max_rad_s &&
           a.thrust_max_n == b.thrust_max_n &&
           a.speed_max_m_s == b.speed_max_m_s &&
           a.body_rate_max_rad_s == b.body_rate_max_rad_s &&
           a.position_max_m == b.position_max_m;
  }
  friend bool operator!=(const CommandRanges& a, const CommandRanges& b) { return !(a == b); }
};
}  // namespace cortex::messages
namespace cortex {
template <>
struct Codec<::cortex::messages::CommandRanges> {
  static constexpr std::string_view name = "cortex/CommandRanges";
  static constexpr std::uint64_t fingerprint = 0x729DCC2C178D66ABu;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/CommandRanges\",\"fields\":[{\"name\":\"refuse\",\"type\":\"bool\",\"unit\":\"\",\"frame\":"
      "\"\"},{\"name\":\"rotor_speed_max_rad_s\",\"type\":\"float64\",\"unit\":\"rad/s\",\"frame\":\"\"},{\"name\":\"t"
      "hrust_max_n\",\"type\":\"float64\",\"unit\":\"N\",\"frame\":\"\"},{\"name\":\"speed_max_m_s\",\"type\":\"float"
      "64\",\"unit\":\"m/s\",\"frame\":\"\"},{\"name\":\"body_rate_max_rad_s\",\"type\":\"float64\",\"unit\":\"rad/s\""
      ",\"frame\":\"\"},{\"name\":\"position_max_m\",\"type\":\"float64\",\"unit\":\"m\",\"frame\":\"\"}]}";
  static constexpr std::size_t block = 48;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = true;
  static constexpr bool stamped = false;

  static std::int64_t stamp([[maybe_unused]] const ::cortex::messages::CommandRanges& message) noexcept {
    return 0;
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::messages::CommandRanges& out) {
    reader.scalar(at, out.refuse);
    reader.scalar(at + 8, out.rotor_speed_max_rad_s);
    reader.scalar(at + 16, out.thrust_max_n);
    reader.scalar(at + 24, out.speed_max_m_s);
    reader.scalar(at + 32, out.body_rate_max_rad_s);
    reader.scalar(at + 40, out.position_max_m);
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::messages::CommandRanges& message) {
    sink.scalar(at, message.refuse);
    sink.zero(at + 1, 7);
    sink.scalar(at + 8, message.rotor_speed_max_rad_s);
    sink.scalar(at + 16, message.thrust_max_n);
    sink.scalar(at + 24, message.speed_max_m_s);
    sink.scalar(at + 32, message.body_rate_max_rad_s);
    sink.scalar(at + 40, message.position_max_m);
  }

  static void draft([[maybe_unused]] Placer& placer, [[maybe_unused]] ::cortex::messages::CommandRanges& out) {
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_messages_CommandRanges_729DCC2C178D66AB

#ifndef CORTEX_TYPE_cortex_messages_Delivery_2D8117FB3B19969D
#define CORTEX_TYPE_cortex_messages_Delivery_2D8117FB3B19969D
namespace cortex::messages {
struct Delivery {
  std::int64_t stamp_ns{};  // ns
  std::int64_t delivered_ns{};  // ns
  std::uint64_t size_bytes{};
  std::uint64_t sequence{};

  friend bool operator==(const Delivery& a, const Delivery& b) {
    return a.stamp_ns == b.stamp_ns &&
           a.delivered_ns == b.delivered_ns &&
           a.size_bytes == b.size_bytes &&
           a.sequence == b.sequence;
  }
  friend bool operator!=(const Delivery& a, const Delivery& b) { return !(a == b); }
};
}  // namespace cortex::messages
namespace cortex {
template <>
struct Codec<::cortex::messages::Delivery> {
  static constexpr std::string_view name = "cortex/Delivery";
  static constexpr std::uint64_t fingerprint = 0x2D8117FB3B19969Du;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/Delivery\",\"fields\":[{\"name\":\"stamp_ns\",\"type\":\"int64\",\"unit\":\"ns\",\"frame\":"
      "\"\"},{\"name\":\"delivered_ns\",\"type\":\"int64\",\"unit\":\"ns\",\"frame\":\"\"},{\"name\":\"size_bytes\",\"ty"
      "pe\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"sequence\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\""
      "}]}";
  static constexpr std::size_t block = 32;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = true;
  static constexpr bool stamped = true;

  static std::int64_t stamp(const ::cortex::messages::Delivery& message) noexcept {
    return static_cast<std::int64_t>(message.stamp_ns);
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::messages::Delivery& out) {
    reader.scalar(at, out.stamp_ns);
    reader.scalar(at + 8, out.delivered_ns);
    reader.scalar(at + 16, out.size_bytes);
    reader.scalar(at + 24, out.sequence);
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::messages::Delivery& message) {
    sink.scalar(at, message.stamp_ns);
    sink.scalar(at + 8, message.delivered_ns);
    sink.scalar(at + 16, message.size_bytes);
    sink.scalar(at + 24, message.sequence);
  }

  static void draft([[maybe_unused]] Placer& placer, [[maybe_unused]] ::cortex::messages::Delivery& out) {
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_messages_Delivery_2D8117FB3B19969D

#ifndef CORTEX_TYPE_cortex_messages_Events_7A86515720EDCDE6
#define CORTEX_TYPE_cortex_messages_Events_7A86515720EDCDE6
namespace cortex::messages {
struct Events {
  std::int64_t stamp_ns{};  // ns
  cortex::Array<std::uint16_t, 1> x{};  // [n], px
  cortex::Array<std::uint16_t, 1> y{};  // [n], px
  cortex::Array<std::int64_t, 1> t{};  // [n], us
  cortex::Array<std::uint8_t, 1> polarity{};  // [n]
  std::uint32_t width{};  // px
  std::uint32_t height{};  // px
  std::int64_t start_ns{};  // ns
  std::uint64_t dropped_count{};
  std::string frame_id{};
  std::uint64_t sequence{};

  friend bool operator==(const Events& a, const Events& b) {
    return a.stamp_ns == b.stamp_ns &&
           a.x == b.x &&
           a.y == b.y &&
           a.t == b.t &&
           a.polarity == b.polarity &&
           a.width == b.width &&
           a.height == b.height &&
           a.start_ns == b.start_ns &&
           a.dropped_count == b.dropped_count &&
           a.frame_id == b.frame_id &&
           a.sequence == b.sequence;
  }
  friend bool operator!=(const Events& a, const Events& b) { return !(a == b); }
};
}  // namespace cortex::messages
namespace cortex {
template <>
struct Codec<::cortex::messages::Events> {
  static constexpr std::string_view name = "cortex/Events";
  static constexpr std::uint64_t fingerprint = 0x7A86515720EDCDE6u;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/Events\",\"fields\":[{\"name\":\"stamp_ns\",\"type\":\"int64\",\"unit\":\"ns\",\"frame\":\"\""
      "},{\"name\":\"x\",\"type\":{\"array\":\"uint16\",\"shape\":[\"n\"]},\"unit\":\"px\",\"frame\":\"\"},{\"name\":\"y\","
      "\"type\":{\"array\":\"uint16\",\"shape\":[\"n\"]},\"unit\":\"px\",\"frame\":\"\"},{\"name\":\"t\",\"type\":{\"array"
      "\":\"int64\",\"shape\":[\"n\"]},\"unit\":\"us\",\"frame\":\"\"},{\"name\":\"polarity\",\"type\":{\"array\":\"uint8"
      "\",\"shape\":[\"n\"]},\"unit\":\"\",\"frame\":\"\"},{\"name\":\"width\",\"type\":\"uint32\",\"unit\":\"px\",\"frame\""
      ":\"\"},{\"name\":\"height\",\"type\":\"uint32\",\"unit\":\"px\",\"frame\":\"\"},{\"name\":\"start_ns\",\"type\":\"i"
      "nt64\",\"unit\":\"ns\",\"frame\":\"\"},{\"name\":\"dropped_count\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\""
      "},{\"name\":\"frame_id\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"sequence\",\"type\":\"uint64\""
      ",\"unit\":\"\",\"frame\":\"\"}]}";
  static constexpr std::size_t block = 96;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = false;
  static constexpr bool stamped = true;

  static std::int64_t stamp(const ::cortex::messages::Events& message) noexcept {
    return static_cast<std::int64_t>(message.stamp_ns);
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::messages::Events& out) {
    Dimension<MalformedMessage> dimension_n("n");
    reader.scalar(at, out.stamp_ns);
    reader.array(at + 8, out.x);
    dimension_n(out.x.shape()[0], "cortex/Events.x");
    reader.array(at + 20, out.y);
    dimension_n(out.y.shape()[0], "cortex/Events.y");
    reader.array(at + 32, out.t);
    dimension_n(out.t.shape()[0], "cortex/Events.t");
    reader.array(at + 44, out.polarity);
    dimension_n(out.polarity.shape()[0], "cortex/Events.polarity");
    reader.scalar(at + 56, out.width);
    reader.scalar(at + 60, out.height);
    reader.scalar(at + 64, out.start_ns);
    reader.scalar(at + 72, out.dropped_count);
    reader.text(at + 80, out.frame_id);
    reader.scalar(at + 88, out.sequence);
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::messages::Events& message) {
    Dimension<std::invalid_argument> dimension_n("n");
    sink.scalar(at, message.stamp_ns);
    dimension_n(message.x.shape()[0], "cortex/Events.x");
    sink.array(at + 8, message.x);
    dimension_n(message.y.shape()[0], "cortex/Events.y");
    sink.array(at + 20, message.y);
    dimension_n(message.t.shape()[0], "cortex/Events.t");
    sink.array(at + 32, message.t);
    dimension_n(message.polarity.shape()[0], "cortex/Events.polarity");
    sink.array(at + 44, message.polarity);
    sink.scalar(at + 56, message.width);
    sink.scalar(at + 60, message.height);
    sink.scalar(at + 64, message.start_ns);
    sink.scalar(at + 72, message.dropped_count);
    sink.text(at + 80, message.frame_id);
    sink.scalar(at + 88, message.sequence);
  }

  static void draft(Placer& placer, ::cortex::messages::Events& out) {
    placer.array(out.x, {Placer::Extent{"n", 0}});
    placer.array(out.y, {Placer::Extent{"n", 0}});
    placer.array(out.t, {Placer::Extent{"n", 0}});
    placer.array(out.polarity, {Placer::Extent{"n", 0}});
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_messages_Events_7A86515720EDCDE6

#ifndef CORTEX_TYPE_cortex_messages_Image_CEB1861C7571D322
#define CORTEX_TYPE_cortex_messages_Image_CEB1861C7571D322
namespace cortex::messages {
struct Image {
  std::int64_t stamp_ns{};  // ns
  cortex::AnyArray<3> data{};  // [height, width, channels]
  std::string encoding{};
  std::string frame_id{};
  std::uint64_t sequence{};

  friend bool operator==(const Image& a, const Image& b) {
    return a.stamp_ns == b.stamp_ns &&
           a.data == b.data &&
           a.encoding == b.encoding &&
           a.frame_id == b.frame_id &&
           a.sequence == b.sequence;
  }
  friend bool operator!=(const Image& a, const Image& b) { return !(a == b); }
};
}  // namespace cortex::messages
namespace cortex {
template <>
struct Codec<::cortex::messages::Image> {
  static constexpr std::string_view name = "cortex/Image";
  static constexpr std::uint64_t fingerprint = 0xCEB1861C7571D322u;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/Image\",\"fields\":[{\"name\":\"stamp_ns\",\"type\":\"int64\",\"unit\":\"ns\",\"frame\":\"\"}"
      ",{\"name\":\"data\",\"type\":{\"array\":\"any\",\"shape\":[\"height\",\"width\",\"channels\"]},\"unit\":\"\",\"fr"
      "ame\":\"\"},{\"name\":\"encoding\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"frame_id\",\"type\":\""
      "str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"sequence\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"}]}";
  static constexpr std::size_t block = 56;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = false;
  static constexpr bool stamped = true;

  static std::int64_t stamp(const ::cortex::messages::Image& message) noexcept {
    return static_cast<std::int64_t>(message.stamp_ns);
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::messages::Image& out) {
    Dimension<MalformedMessage> dimension_height("height");
    Dimension<MalformedMessage> dimension_width("width");
    Dimension<MalformedMessage> dimension_channels("channels");
    reader.scalar(at, out.stamp_ns);
    reader.any(at + 8, out.data);
    dimension_height(out.data.shape()[0], "cortex/Image.data");
    dimension_width(out.data.shape()[1], "cortex/Image.data");
    dimension_channels(out.data.shape()[2], "cortex/Image.data");
    reader.text(at + 28, out.encoding);
    reader.text(at + 36, out.frame_id);
    reader.scalar(at + 48, out.sequence);
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::messages::Image& message) {
    Dimension<std::invalid_argument> dimension_height("height");
    Dimension<std::invalid_argument> dimension_width("width");
    Dimension<std::invalid_argument> dimension_channels("channels");
    sink.scalar(at, message.stamp_ns);
    dimension_height(message.data.shape()[0], "cortex/Image.data");
    dimension_width(message.data.shape()[1], "cortex/Image.data");
    dimension_channels(message.data.shape()[2], "cortex/Image.data");
    sink.any(at + 8, message.data);
    sink.text(at + 28, message.encoding);
    sink.text(at + 36, message.frame_id);
    sink.zero(at + 44, 4);
    sink.scalar(at + 48, message.sequence);
  }

  static void draft(Placer& placer, ::cortex::messages::Image& out) {
    placer.any("data", out.data, {Placer::Extent{"height", 0}, Placer::Extent{"width", 0}, Placer::Extent{"channels", 0}});
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_messages_Image_CEB1861C7571D322

#ifndef CORTEX_TYPE_cortex_messages_Imu_9347CC90CF905225
#define CORTEX_TYPE_cortex_messages_Imu_9347CC90CF905225
namespace cortex::messages {
struct Imu {
  std::int64_t stamp_ns{};  // ns
  std::array<double, 3> specific_force{};  // [3], m/s^2, frame sensor
  std::array<double, 3> angular_rate{};  // [3], rad/s, frame sensor
  std::uint64_t sequence{};

  friend bool operator==(const Imu& a, const Imu& b) {
    return a.stamp_ns == b.stamp_ns &&
           a.specific_force == b.specific_force &&
           a.angular_rate == b.angular_rate &&
           a.sequence == b.sequence;
  }
  friend bool operator!=(const Imu& a, const Imu& b) { return !(a == b); }
};
}  // namespace cortex::messages
namespace cortex {
template <>
struct Codec<::cortex::messages::Imu> {
  static constexpr std::string_view name = "cortex/Imu";
  static constexpr std::uint64_t fingerprint = 0x9347CC90CF905225u;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/Imu\",\"fields\":[{\"name\":\"stamp_ns\",\"type\":\"int64\",\"unit\":\"ns\",\"frame\":\"\"},{"
      "\"name\":\"specific_force\",\"type\":{\"array\":\"float64\",\"shape\":[3]},\"unit\":\"m/s^2\",\"frame\":\"sen"
      "sor\"},{\"name\":\"angular_rate\",\"type\":{\"array\":\"float64\",\"shape\":[3]},\"unit\":\"rad/s\",\"frame\""
      ":\"sensor\"},{\"name\":\"sequence\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"}]}";
  static constexpr std::size_t block = 64;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = true;
  static constexpr bool stamped = true;

  static std::int64_t stamp(const ::cortex::messages::Imu& message) noexcept {
    return static_cast<std::int64_t>(message.stamp_ns);
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::messages::Imu& out) {
    reader.scalar(at, out.stamp_ns);
    reader.fixed(at + 8, out.specific_force);
    reader.fixed(at + 32, out.angular_rate);
    reader.scalar(at + 56, out.sequence);
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::messages::Imu& message) {
    sink.scalar(at, message.stamp_ns);
    sink.fixed(at + 8, message.specific_force);
    sink.fixed(at + 32, message.angular_rate);
    sink.scalar(at + 56, message.sequence);
  }

  static void draft([[maybe_unused]] Placer& placer, [[maybe_unused]] ::cortex::messages::Imu& out) {
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_messages_Imu_9347CC90CF905225

#ifndef CORTEX_TYPE_cortex_messages_MotorCommand_37D81F72E9E7D77C
#define CORTEX_TYPE_cortex_messages_MotorCommand_37D81F72E9E7D77C
namespace cortex::messages {
struct MotorCommand {
  std::int64_t stamp_ns{};  // ns
  cortex::Array<double, 1> speed{};  // [rotors], rad/s
  std::uint64_t sequence{};

  friend bool operator==(const MotorCommand& a, const MotorCommand& b) {
    return a.stamp_ns == b.stamp_ns &&
           a.speed == b.speed &&
           a.sequence == b.sequence;
  }
  friend bool operator!=(const MotorCommand& a, const MotorCommand& b) { return !(a == b); }
};
}  // namespace cortex::messages
namespace cortex {
template <>
struct Codec<::cortex::messages::MotorCommand> {
  static constexpr std::string_view name = "cortex/MotorCommand";
  static constexpr std::uint64_t fingerprint = 0x37D81F72E9E7D77Cu;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/MotorCommand\",\"fields\":[{\"name\":\"stamp_ns\",\"type\":\"int64\",\"unit\":\"ns\",\"fra"
      "me\":\"\"},{\"name\":\"speed\",\"type\":{\"array\":\"float64\",\"shape\":[\"rotors\"]},\"unit\":\"rad/s\",\"fram"
      "e\":\"\"},{\"name\":\"sequence\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"}]}";
  static constexpr std::size_t block = 32;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = false;
  static constexpr bool stamped = true;

  static std::int64_t stamp(const ::cortex::messages::MotorCommand& message) noexcept {
    return static_cast<std::int64_t>(message.stamp_ns);
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::messages::MotorCommand& out) {
    Dimension<MalformedMessage> dimension_rotors("rotors");
    reader.scalar(at, out.stamp_ns);
    reader.array(at + 8, out.speed);
    dimension_rotors(out.speed.shape()[0], "cortex/MotorCommand.speed");
    reader.scalar(at + 24, out.sequence);
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::messages::MotorCommand& message) {
    Dimension<std::invalid_argument> dimension_rotors("rotors");
    sink.scalar(at, message.stamp_ns);
    dimension_rotors(message.speed.shape()[0], "cortex/MotorCommand.speed");
    sink.array(at + 8, message.speed);
    sink.zero(at + 20, 4);
    sink.scalar(at + 24, message.sequence);
  }

  static void draft(Placer& placer, ::cortex::messages::MotorCommand& out) {
    placer.array(out.speed, {Placer::Extent{"rotors", 0}});
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_messages_MotorCommand_37D81F72E9E7D77C

#ifndef CORTEX_TYPE_cortex_messages_Odometry_F4089D8D806F600E
#define CORTEX_TYPE_cortex_messages_Odometry_F4089D8D806F600E
namespace cortex::messages {
struct Odometry {
  std::int64_t stamp_ns{};  // ns
  std::array<double, 3> position{};  // [3], m, frame world
  std::array<double, 4> orientation{};  // [4]
  std::array<double, 3> velocity{};  // [3], m/s, frame world
  std::array<double, 3> body_rate{};  // [3], rad/s, frame body
  std::uint64_t sequence{};

  friend bool operator==(const Odometry& a, const Odometry& b) {
    return a.stamp_ns == b.stamp_ns &&
           a.position == b.position &&
           a.orientation == b.orientation &&
           a.velocity == b.velocity &&
           a.body_rate == b.body_rate &&
           a.sequence == b.sequence;
  }
  friend bool operator!=(const Odometry& a, const Odometry& b) { return !(a == b); }
};
}  // namespace cortex::messages
namespace cortex {
template <>
struct Codec<::cortex::messages::Odometry> {
  static constexpr std::string_view name = "cortex/Odometry";
  static constexpr std::uint64_t fingerprint = 0xF4089D8D806F600Eu;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/Odometry\",\"fields\":[{\"name\":\"stamp_ns\",\"type\":\"int64\",\"unit\":\"ns\",\"frame\":"
      "\"\"},{\"name\":\"position\",\"type\":{\"array\":\"float64\",\"shape\":[3]},\"unit\":\"m\",\"frame\":\"world\"},"
      "{\"name\":\"orientation\",\"type\":{\"array\":\"float64\",\"shape\":[4]},\"unit\":\"\",\"frame\":\"\"},{\"name\""
      ":\"velocity\",\"type\":{\"array\":\"float64\",\"shape\":[3]},\"unit\":\"m/s\",\"frame\":\"world\"},{\"name\":\""
      "body_rate\",\"type\":{\"array\":\"float64\",\"shape\":[3]},\"unit\":\"rad/s\",\"frame\":\"body\"},{\"name\":\""
      "sequence\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"}]}";
  static constexpr std::size_t block = 120;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = true;
  static constexpr bool stamped = true;

  static std::int64_t stamp(const ::cortex::messages::Odometry& message) noexcept {
    return static_cast<std::int64_t>(message.stamp_ns);
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::messages::Odometry& out) {
    reader.scalar(at, out.stamp_ns);
    reader.fixed(at + 8, out.position);
    reader.fixed(at + 32, out.orientation);
    reader.fixed(at + 64, out.velocity);
    reader.fixed(at + 88, out.body_rate);
    reader.scalar(at + 112, out.sequence);
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::messages::Odometry& message) {
    sink.scalar(at, message.stamp_ns);
    sink.fixed(at + 8, message.position);
    sink.fixed(at + 32, message.orientation);
    sink.fixed(at + 64, message.velocity);
    sink.fixed(at + 88, message.body_rate);
    sink.scalar(at + 112, message.sequence);
  }

  static void draft([[maybe_unused]] Placer& placer, [[maybe_unused]] ::cortex::messages::Odometry& out) {
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_messages_Odometry_F4089D8D806F600E

#ifndef CORTEX_TYPE_cortex_messages_Parameter_196C4C1B4C829163
#define CORTEX_TYPE_cortex_messages_Parameter_196C4C1B4C829163
namespace cortex::messages {
struct Parameter {
  std::string name{};
  std::optional<bool> flag{};
  std::optional<std::int64_t> integer{};
  std::optional<double> number{};
  std::optional<std::string> text{};

  friend bool operator==(const Parameter& a, const Parameter& b) {
    return a.name == b.name &&
           a.flag == b.flag &&
           a.integer == b.integer &&
           a.number == b.number &&
           a.text == b.text;
  }
  friend bool operator!=(const Parameter& a, const Parameter& b) { return !(a == b); }
};
}  // namespace cortex::messages
namespace cortex {
template <>
struct Codec<::cortex::messages::Parameter> {
  static constexpr std::string_view name = "cortex/Parameter";
  static constexpr std::uint64_t fingerprint = 0x196C4C1B4C829163u;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/Parameter\",\"fields\":[{\"name\":\"name\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"n"
      "ame\":\"flag\",\"type\":{\"optional\":\"bool\"},\"unit\":\"\",\"frame\":\"\"},{\"name\":\"integer\",\"type\":{\"op"
      "tional\":\"int64\"},\"unit\":\"\",\"frame\":\"\"},{\"name\":\"number\",\"type\":{\"optional\":\"float64\"},\"uni"
      "t\":\"\",\"frame\":\"\"},{\"name\":\"text\",\"type\":{\"optional\":\"str\"},\"unit\":\"\",\"frame\":\"\"}]}";
  static constexpr std::size_t block = 64;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = false;
  static constexpr bool stamped = false;

  static std::int64_t stamp([[maybe_unused]] const ::cortex::messages::Parameter& message) noexcept {
    return 0;
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::messages::Parameter& out) {
    reader.text(at, out.name);
    if (reader.present(at + 8)) {
      auto& item2 = out.flag.emplace();
      reader.scalar(at + 8 + 1, item2);
    } else {
      out.flag.reset();
    }
    if (reader.present(at + 16)) {
      auto& item2 = out.integer.emplace();
      reader.scalar(at + 16 + 8, item2);
    } else {
      out.integer.reset();
    }
    if (reader.present(at + 32)) {
      auto& item2 = out.number.emplace();
      reader.scalar(at + 32 + 8, item2);
    } else {
      out.number.reset();
    }
    if (reader.present(at + 48)) {
      auto& item2 = out.text.emplace();
      reader.text(at + 48 + 4, item2);
    } else {
      out.text.reset();
    }
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::messages::Parameter& message) {
    sink.text(at, message.name);
    if (message.flag.has_value()) {
      sink.scalar(at + 8, std::uint8_t{1});
      sink.scalar(at + 8 + 1, (*message.flag));
    } else {
      sink.zero(at + 8, 2);
    }
    sink.zero(at + 10, 6);
    if (message.integer.has_value()) {
      sink.scalar(at + 16, std::uint8_t{1});
      sink.zero(at + 16 + 1, 7);
      sink.scalar(at + 16 + 8, (*message.integer));
    } else {
      sink.zero(at + 16, 16);
    }
    if (message.number.has_value()) {
      sink.scalar(at + 32, std::uint8_t{1});
      sink.zero(at + 32 + 1, 7);
      sink.scalar(at + 32 + 8, (*message.number));
    } else {
      sink.zero(at + 32, 16);
    }
    if (message.text.has_value()) {
      sink.scalar(at + 48, std::uint8_t{1});
      sink.zero(at + 48 + 1, 3);
      sink.text(at + 48 + 4, (*message.text));
    } else {
      sink.zero(at + 48, 12);
    }
    sink.zero(at + 60, 4);
  }

  static void draft([[maybe_unused]] Placer& placer, [[maybe_unused]] ::cortex::messages::Parameter& out) {
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_messages_Parameter_196C4C1B4C829163

#ifndef CORTEX_TYPE_cortex_messages_Parameters_5F1FE3F15D54C917
#define CORTEX_TYPE_cortex_messages_Parameters_5F1FE3F15D54C917
namespace cortex::messages {
struct Parameters {
  std::vector<::cortex::messages::Parameter> parameters{};
  std::int64_t stamp_ns{};  // ns
  std::uint64_t sequence{};

  friend bool operator==(const Parameters& a, const Parameters& b) {
    return a.parameters == b.parameters &&
           a.stamp_ns == b.stamp_ns &&
           a.sequence == b.sequence;
  }
  friend bool operator!=(const Parameters& a, const Parameters& b) { return !(a == b); }
};
}  // namespace cortex::messages
namespace cortex {
template <>
struct Codec<::cortex::messages::Parameters> {
  static constexpr std::string_view name = "cortex/Parameters";
  static constexpr std::uint64_t fingerprint = 0x5F1FE3F15D54C917u;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/Parameters\",\"fields\":[{\"name\":\"parameters\",\"type\":{\"list\":{\"message\":{\"nam"
      "e\":\"cortex/Parameter\",\"fields\":[{\"name\":\"name\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":"
      "\"flag\",\"type\":{\"optional\":\"bool\"},\"unit\":\"\",\"frame\":\"\"},{\"name\":\"integer\",\"type\":{\"optiona"
      "l\":\"int64\"},\"unit\":\"\",\"frame\":\"\"},{\"name\":\"number\",\"type\":{\"optional\":\"float64\"},\"unit\":\"\""
      ",\"frame\":\"\"},{\"name\":\"text\",\"type\":{\"optional\":\"str\"},\"unit\":\"\",\"frame\":\"\"}]}}},\"unit\":\"\","
      "\"frame\":\"\"},{\"name\":\"stamp_ns\",\"type\":\"int64\",\"unit\":\"ns\",\"frame\":\"\"},{\"name\":\"sequence\",\""
      "type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"}]}";
  static constexpr std::size_t block = 24;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = false;
  static constexpr bool stamped = true;

  static std::int64_t stamp(const ::cortex::messages::Parameters& message) noexcept {
    return static_cast<std::int64_t>(message.stamp_ns);
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::messages::Parameters& out) {
    {
      const auto list2 = reader.list(at, 64);
      out.parameters.clear();
      out.parameters.reserve(list2.count);
      for (std::size_t k2 = 0; k2 < list2.count; ++k2) {
        ::cortex::messages::Parameter item2{};
        Codec<::cortex::messages::Parameter>::decode(reader, list2.at + k2 * 64, item2);
        out.parameters.push_back(std::move(item2));
      }
    }
    reader.scalar(at + 8, out.stamp_ns);
    reader.scalar(at + 16, out.sequence);
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::messages::Parameters& message) {
    {
      const std::size_t start2 =
          sink.list(at, message.parameters.size(), 64, 8);
      for (std::size_t k2 = 0; k2 < message.parameters.size(); ++k2) {
        const auto& item2 = message.parameters[k2];
        Codec<::cortex::messages::Parameter>::encode(sink, start2 + k2 * 64, item2);
      }
    }
    sink.scalar(at + 8, message.stamp_ns);
    sink.scalar(at + 16, message.sequence);
  }

  static void draft([[maybe_unused]] Placer& placer, [[maybe_unused]] ::cortex::messages::Parameters& out) {
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_messages_Parameters_5F1FE3F15D54C917

#ifndef CORTEX_TYPE_cortex_messages_Path_AEE06658D5893930
#define CORTEX_TYPE_cortex_messages_Path_AEE06658D5893930
namespace cortex::messages {
struct Path {
  std::int64_t stamp_ns{};  // ns
  cortex::Array<std::int64_t, 1> time_ns{};  // [n], ns
  cortex::Array<double, 2> position{};  // [n, 3], m, frame world
  std::string frame_id{};
  std::uint64_t sequence{};

  friend bool operator==(const Path& a, const Path& b) {
    return a.stamp_ns == b.stamp_ns &&
           a.time_ns == b.time_ns &&
           a.position == b.position &&
           a.frame_id == b.frame_id &&
           a.sequence == b.sequence;
  }
  friend bool operator!=(const Path& a, const Path& b) { return !(a == b); }
};
}  // namespace cortex::messages
namespace cortex {
template <>
struct Codec<::cortex::messages::Path> {
  static constexpr std::string_view name = "cortex/Path";
  static constexpr std::uint64_t fingerprint = 0xAEE06658D5893930u;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/Path\",\"fields\":[{\"name\":\"stamp_ns\",\"type\":\"int64\",\"unit\":\"ns\",\"frame\":\"\"},"
      "{\"name\":\"time_ns\",\"type\":{\"array\":\"int64\",\"shape\":[\"n\"]},\"unit\":\"ns\",\"frame\":\"\"},{\"name\":\""
      "position\",\"type\":{\"array\":\"float64\",\"shape\":[\"n\",3]},\"unit\":\"m\",\"frame\":\"world\"},{\"name\":\""
      "frame_id\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"sequence\",\"type\":\"uint64\",\"unit\":\"\","
      "\"frame\":\"\"}]}";
  static constexpr std::size_t block = 56;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = false;
  static constexpr bool stamped = true;

  static std::int64_t stamp(const ::cortex::messages::Path& message) noexcept {
    return static_cast<std::int64_t>(message.stamp_ns);
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::messages::Path& out) {
    Dimension<MalformedMessage> dimension_n("n");
    reader.scalar(at, out.stamp_ns);
    reader.array(at + 8, out.time_ns);
    dimension_n(out.time_ns.shape()[0], "cortex/Path.time_ns");
    reader.array(at + 20, out.position);
    dimension_n(out.position.shape()[0], "cortex/Path.position");
    check_extent<MalformedMessage>(out.position.shape()[1], 3u, "cortex/Path.position");
    reader.text(at + 36, out.frame_id);
    reader.scalar(at + 48, out.sequence);
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::messages::Path& message) {
    Dimension<std::invalid_argument> dimension_n("n");
    sink.scalar(at, message.stamp_ns);
    dimension_n(message.time_ns.shape()[0], "cortex/Path.time_ns");
    sink.array(at + 8, message.time_ns);
    dimension_n(message.position.shape()[0], "cortex/Path.position");
    check_extent<std::invalid_argument>(message.position.shape()[1], 3u, "cortex/Path.position");
    sink.array(at + 20, message.position);
    sink.text(at + 36, message.frame_id);
    sink.zero(at + 44, 4);
    sink.scalar(at + 48, message.sequence);
  }

  static void draft(Placer& placer, ::cortex::messages::Path& out) {
    placer.array(out.time_ns, {Placer::Extent{"n", 0}});
    placer.array(out.position, {Placer::Extent{"n", 0}, Placer::Extent{nullptr, 3u}});
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_messages_Path_AEE06658D5893930

#ifndef CORTEX_TYPE_cortex_messages_PointCloud_903F979B91D15184
#define CORTEX_TYPE_cortex_messages_PointCloud_903F979B91D15184
namespace cortex::messages {
struct PointCloud {
  std::int64_t stamp_ns{};  // ns
  cortex::Array<float, 2> points{};  // [n, 3], m, frame sensor
  std::optional<cortex::Array<float, 1>> intensity{};
  std::optional<cortex::Array<std::uint16_t, 1>> ring{};
  std::optional<cortex::Array<std::uint32_t, 1>> t{};  // ns
  std::int64_t start_ns{};  // ns
  bool deskewed{};
  std::string frame_id{};
  std::uint64_t sequence{};

  friend bool operator==(const PointCloud& a, const PointCloud& b) {
    return a.stamp_ns == b.stamp_ns &&
           a.points == b.points &&
           a.intensity == b.intensity &&
           a.ring == b.ring &&
           a.t == b.t &&
           a.start_ns == b.start_ns &&
           a.deskewed == b.deskewed &&
           a.frame_id == b.frame_id &&
           a.sequence == b.sequence;
  }
  friend bool operator!=(const PointCloud& a, const PointCloud& b) { return !(a == b); }
};
}  // namespace cortex::messages
namespace cortex {
template <>
struct Codec<::cortex::messages::PointCloud> {
  static constexpr std::string_view name = "cortex/PointCloud";
  static constexpr std::uint64_t fingerprint = 0x903F979B91D15184u;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/PointCloud\",\"fields\":[{\"name\":\"stamp_ns\",\"type\":\"int64\",\"unit\":\"ns\",\"frame"
      "\":\"\"},{\"name\":\"points\",\"type\":{\"array\":\"float32\",\"shape\":[\"n\",3]},\"unit\":\"m\",\"frame\":\"sens"
      "or\"},{\"name\":\"intensity\",\"type\":{\"optional\":{\"array\":\"float32\",\"shape\":[\"n\"]}},\"unit\":\"\",\""
      "frame\":\"\"},{\"name\":\"ring\",\"type\":{\"optional\":{\"array\":\"uint16\",\"shape\":[\"n\"]}},\"unit\":\"\",\""
      "frame\":\"\"},{\"name\":\"t\",\"type\":{\"optional\":{\"array\":\"uint32\",\"shape\":[\"n\"]}},\"unit\":\"ns\",\"f"
      "rame\":\"\"},{\"name\":\"start_ns\",\"type\":\"int64\",\"unit\":\"ns\",\"frame\":\"\"},{\"name\":\"deskewed\",\"ty"
      "pe\":\"bool\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"frame_id\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"n"
      "ame\":\"sequence\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"}]}";
  static constexpr std::size_t block = 104;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = false;
  static constexpr bool stamped = true;

  static std::int64_t stamp(const ::cortex::messages::PointCloud& message) noexcept {
    return static_cast<std::int64_t>(message.stamp_ns);
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::messages::PointCloud& out) {
    Dimension<MalformedMessage> dimension_n("n");
    reader.scalar(at, out.stamp_ns);
    reader.array(at + 8, out.points);
    dimension_n(out.points.shape()[0], "cortex/PointCloud.points");
    check_extent<MalformedMessage>(out.points.shape()[1], 3u, "cortex/PointCloud.points");
    if (reader.present(at + 24)) {
      auto& item2 = out.intensity.emplace();
      reader.array(at + 24 + 4, item2);
      dimension_n(item2.shape()[0], "cortex/PointCloud.intensity");
    } else {
      out.intensity.reset();
    }
    if (reader.present(at + 40)) {
      auto& item2 = out.ring.emplace();
      reader.array(at + 40 + 4, item2);
      dimension_n(item2.shape()[0], "cortex/PointCloud.ring");
    } else {
      out.ring.reset();
    }
    if (reader.present(at + 56)) {
      auto& item2 = out.t.emplace();
      reader.array(at + 56 + 4, item2);
      dimension_n(item2.shape()[0], "cortex/PointCloud.t");
    } else {
      out.t.reset();
    }
    reader.scalar(at + 72, out.start_ns);
    reader.scalar(at + 80, out.deskewed);
    reader.text(at + 84, out.frame_id);
    reader.scalar(at + 96, out.sequence);
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::messages::PointCloud& message) {
    Dimension<std::invalid_argument> dimension_n("n");
    sink.scalar(at, message.stamp_ns);
    dimension_n(message.points.shape()[0], "cortex/PointCloud.points");
    check_extent<std::invalid_argument>(message.points.shape()[1], 3u, "cortex/PointCloud.points");
    sink.array(at + 8, message.points);
    if (message.intensity.has_value()) {
      sink.scalar(at + 24, std::uint8_t{1});
      sink.zero(at + 24 + 1, 3);
      dimension_n((*message.intensity).shape()[0], "cortex/PointCloud.intensity");
      sink.array(at + 24 + 4, (*message.intensity));
    } else {
      sink.zero(at + 24, 16);
    }
    if (message.ring.has_value()) {
      sink.scalar(at + 40, std::uint8_t{1});
      sink.zero(at + 40 + 1, 3);
      dimension_n((*message.ring).shape()[0], "cortex/PointCloud.ring");
      sink.array(at + 40 + 4, (*message.ring));
    } else {
      sink.zero(at + 40, 16);
    }
    if (message.t.has_value()) {
      sink.scalar(at + 56, std::uint8_t{1});
      sink.zero(at + 56 + 1, 3);
      dimension_n((*message.t).shape()[0], "cortex/PointCloud.t");
      sink.array(at + 56 + 4, (*message.t));
    } else {
      sink.zero(at + 56, 16);
    }
    sink.scalar(at + 72, message.start_ns);
    sink.scalar(at + 80, message.deskewed);
    sink.zero(at + 81, 3);
    sink.text(at + 84, message.frame_id);
    sink.zero(at + 92, 4);
    sink.scalar(at + 96, message.sequence);
  }

  static void draft(Placer& placer, ::cortex::messages::PointCloud& out) {
    placer.array(out.points, {Placer::Extent{"n", 0}, Placer::Extent{nullptr, 3u}});
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_messages_PointCloud_903F979B91D15184

#ifndef CORTEX_TYPE_cortex_messages_PoseCommand_005BB484B28E2421
#define CORTEX_TYPE_cortex_messages_PoseCommand_005BB484B28E2421
namespace cortex::messages {
struct PoseCommand {
  std::int64_t stamp_ns{};  // ns
  std::array<double, 3> position{};  // [3], m, frame world
  double yaw_rad{};  // rad, frame world
  std::uint64_t sequence{};

  friend bool operator==(const PoseCommand& a, const PoseCommand& b) {
    return a.stamp_ns == b.stamp_ns &&
           a.position == b.position &&
           a.yaw_rad == b.yaw_rad &&
           a.sequence == b.sequence;
  }
  friend bool operator!=(const PoseCommand& a, const PoseCommand& b) { return !(a == b); }
};
}  // namespace cortex::messages
namespace cortex {
template <>
struct Codec<::cortex::messages::PoseCommand> {
  static constexpr std::string_view name = "cortex/PoseCommand";
  static constexpr std::uint64_t fingerprint = 0x005BB484B28E2421u;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/PoseCommand\",\"fields\":[{\"name\":\"stamp_ns\",\"type\":\"int64\",\"unit\":\"ns\",\"fram"
      "e\":\"\"},{\"name\":\"position\",\"type\":{\"array\":\"float64\",\"shape\":[3]},\"unit\":\"m\",\"frame\":\"world"
      "\"},{\"name\":\"yaw_rad\",\"type\":\"float64\",\"unit\":\"rad\",\"frame\":\"world\"},{\"name\":\"sequence\",\"ty"
      "pe\":\"uint64\",\"unit\":\"\",\"frame\":\"\"}]}";
  static constexpr std::size_t block = 48;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = true;
  static constexpr bool stamped = true;

  static std::int64_t stamp(const ::cortex::messages::PoseCommand& message) noexcept {
    return static_cast<std::int64_t>(message.stamp_ns);
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::messages::PoseCommand& out) {
    reader.scalar(at, out.stamp_ns);
    reader.fixed(at + 8, out.position);
    reader.scalar(at + 32, out.yaw_rad);
    reader.scalar(at + 40, out.sequence);
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::messages::PoseCommand& message) {
    sink.scalar(at, message.stamp_ns);
    sink.fixed(at + 8, message.position);
    sink.scalar(at + 32, message.yaw_rad);
    sink.scalar(at + 40, message.sequence);
  }

  static void draft([[maybe_unused]] Placer& placer, [[maybe_unused]] ::cortex::messages::PoseCommand& out) {
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_messages_PoseCommand_005BB484B28E2421

#ifndef CORTEX_TYPE_cortex_messages_RateThrustCommand_91674913A79C2973
#define CORTEX_TYPE_cortex_messages_RateThrustCommand_91674913A79C2973
namespace cortex::messages {
struct RateThrustCommand {
  std::int64_t stamp_ns{};  // ns
  double thrust_n{};  // N, frame body
  std::array<double, 3> body_rate{};  // [3], rad/s, frame body
  std::uint64_t sequence{};

  friend bool operator==(const RateThrustCommand& a, const RateThrustCommand& b) {
    return a.stamp_ns == b.stamp_ns &&
           a.thrust_n == b.thrust_n &&
           a.body_rate == b.body_rate &&
           a.sequence == b.sequence;
  }
  friend bool operator!=(const RateThrustCommand& a, const RateThrustCommand& b) { return !(a == b); }
};
}  // namespace cortex::messages
namespace cortex {
template <>
struct Codec<::cortex::messages::RateThrustCommand> {
  static constexpr std::string_view name = "cortex/RateThrustCommand";
  static constexpr std::uint64_t fingerprint = 0x91674913A79C2973u;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/RateThrustCommand\",\"fields\":[{\"name\":\"stamp_ns\",\"type\":\"int64\",\"unit\":\"ns\""
      ",\"frame\":\"\"},{\"name\":\"thrust_n\",\"type\":\"float64\",\"unit\":\"N\",\"frame\":\"body\"},{\"name\":\"body_"
      "rate\",\"type\":{\"array\":\"float64\",\"shape\":[3]},\"unit\":\"rad/s\",\"frame\":\"body\"},{\"name\":\"seque"
      "nce\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"}]}";
  static constexpr std::size_t block = 48;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = true;
  static constexpr bool stamped = true;

  static std::int64_t stamp(const ::cortex::messages::RateThrustCommand& message) noexcept {
    return static_cast<std::int64_t>(message.stamp_ns);
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::messages::RateThrustCommand& out) {
    reader.scalar(at, out.stamp_ns);
    reader.scalar(at + 8, out.thrust_n);
    reader.fixed(at + 16, out.body_rate);
    reader.scalar(at + 40, out.sequence);
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::messages::RateThrustCommand& message) {
    sink.scalar(at, message.stamp_ns);
    sink.scalar(at + 8, message.thrust_n);
    sink.fixed(at + 16, message.body_rate);
    sink.scalar(at + 40, message.sequence);
  }

  static void draft([[maybe_unused]] Placer& placer, [[maybe_unused]] ::cortex::messages::RateThrustCommand& out) {
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_messages_RateThrustCommand_91674913A79C2973

#ifndef CORTEX_TYPE_cortex_messages_Reset_F2C3755C865D0572
#define CORTEX_TYPE_cortex_messages_Reset_F2C3755C865D0572
namespace cortex::messages {
struct Reset {
  std::optional<std::int64_t> seed{};
  std::string vehicle{};
  std::optional<std::array<double, 3>> position{};  // m, frame world
  std::optional<std::array<double, 4>> orientation{};
  std::optional<std::array<double, 3>> velocity{};  // m/s, frame world
  std::optional<std::array<double, 3>> body_rate{};  // rad/s, frame body

  friend bool operator==(const Reset& a, const Reset& b) {
    return a.seed == b.seed &&
           a.vehicle == b.vehicle &&
           a.position == b.position &&
           a.orientation == b.orientation &&
           a.velocity == b.velocity &&
           a.body_rate == b.body_rate;
  }
  friend bool operator!=(const Reset& a, const Reset& b) { return !(a == b); }
};
}  // namespace cortex::messages
namespace cortex {
template <>
struct Codec<::cortex::messages::Reset> {
  static constexpr std::string_view name = "cortex/Reset";
  static constexpr std::uint64_t fingerprint = 0xF2C3755C865D0572u;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/Reset\",\"fields\":[{\"name\":\"seed\",\"type\":{\"optional\":\"int64\"},\"unit\":\"\",\"fra"
      "me\":\"\"},{\"name\":\"vehicle\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"position\",\"type\":{\"o"
      "ptional\":{\"array\":\"float64\",\"shape\":[3]}},\"unit\":\"m\",\"frame\":\"world\"},{\"name\":\"orientation"
      "\",\"type\":{\"optional\":{\"array\":\"float64\",\"shape\":[4]}},\"unit\":\"\",\"frame\":\"\"},{\"name\":\"veloc"
      "ity\",\"type\":{\"optional\":{\"array\":\"float64\",\"shape\":[3]}},\"unit\":\"m/s\",\"frame\":\"world\"},{\"n"
      "ame\":\"body_rate\",\"type\":{\"optional\":{\"array\":\"float64\",\"shape\":[3]}},\"unit\":\"rad/s\",\"frame"
      "\":\"body\"}]}";
  static constexpr std::size_t block = 160;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = false;
  static constexpr bool stamped = false;

  static std::int64_t stamp([[maybe_unused]] const ::cortex::messages::Reset& message) noexcept {
    return 0;
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::messages::Reset& out) {
    if (reader.present(at)) {
      auto& item2 = out.seed.emplace();
      reader.scalar(at + 8, item2);
    } else {
      out.seed.reset();
    }
    reader.text(at + 16, out.vehicle);
    if (reader.present(at + 24)) {
      auto& item2 = out.position.emplace();
      reader.fixed(at + 24 + 8, item2);
    } else {
      out.position.reset();
    }
    if (reader.present(at + 56)) {
      auto& item2 = out.orientation.emplace();
      reader.fixed(at + 56 + 8, item2);
    } else {
      out.orientation.reset();
    }
    if (reader.present(at + 96)) {
      auto& item2 = out.velocity.emplace();
      reader.fixed(at + 96 + 8, item2);
    } else {
      out.velocity.reset();
    }
    if (reader.present(at + 128)) {
      auto& item2 = out.body_rate.emplace();
      reader.fixed(at + 128 + 8, item2);
    } else {
      out.body_rate.reset();
    }
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::messages::Reset& message) {
    if (message.seed.has_value()) {
      sink.scalar(at, std::uint8_t{1});
      sink.zero(at + 1, 7);
      sink.scalar(at + 8, (*message.seed));
    } else {
      sink.zero(at, 16);
    }
    sink.text(at + 16, message.vehicle);
    if (message.position.has_value()) {
      sink.scalar(at + 24, std::uint8_t{1});
      sink.zero(at + 24 + 1, 7);
      sink.fixed(at + 24 + 8, (*message.position));
    } else {
      sink.zero(at + 24, 32);
    }
    if (message.orientation.has_value()) {
      sink.scalar(at + 56, std::uint8_t{1});
      sink.zero(at + 56 + 1, 7);
      sink.fixed(at + 56 + 8, (*message.orientation));
    } else {
      sink.zero(at + 56, 40);
    }
    if (message.velocity.has_value()) {
      sink.scalar(at + 96, std::uint8_t{1});
      sink.zero(at + 96 + 1, 7);
      sink.fixed(at + 96 + 8, (*message.velocity));
    } else {
      sink.zero(at + 96, 32);
    }
    if (message.body_rate.has_value()) {
      sink.scalar(at + 128, std::uint8_t{1});
      sink.zero(at + 128 + 1, 7);
      sink.fixed(at + 128 + 8, (*message.body_rate));
    } else {
      sink.zero(at + 128, 32);
    }
  }

  static void draft([[maybe_unused]] Placer& placer, [[maybe_unused]] ::cortex::messages::Reset& out) {
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_messages_Reset_F2C3755C865D0572

#ifndef CORTEX_TYPE_cortex_messages_RotorSpeeds_4479009E8F5E5281
#define CORTEX_TYPE_cortex_messages_RotorSpeeds_4479009E8F5E5281
namespace cortex::messages {
struct RotorSpeeds {
  std::int64_t stamp_ns{};  // ns
  cortex::Array<double, 1> speed{};  // [rotors], rad/s
  std::uint64_t sequence{};

  friend bool operator==(const RotorSpeeds& a, const RotorSpeeds& b) {
    return a.stamp_ns == b.stamp_ns &&
           a.speed == b.speed &&
           a.sequence == b.sequence;
  }
  friend bool operator!=(const RotorSpeeds& a, const RotorSpeeds& b) { return !(a == b); }
};
}  // namespace cortex::messages
namespace cortex {
template <>
struct Codec<::cortex::messages::RotorSpeeds> {
  static constexpr std::string_view name = "cortex/RotorSpeeds";
  static constexpr std::uint64_t fingerprint = 0x4479009E8F5E5281u;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/RotorSpeeds\",\"fields\":[{\"name\":\"stamp_ns\",\"type\":\"int64\",\"unit\":\"ns\",\"fram"
      "e\":\"\"},{\"name\":\"speed\",\"type\":{\"array\":\"float64\",\"shape\":[\"rotors\"]},\"unit\":\"rad/s\",\"frame"
      "\":\"\"},{\"name\":\"sequence\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"}]}";
  static constexpr std::size_t block = 32;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = false;
  static constexpr bool stamped = true;

  static std::int64_t stamp(const ::cortex::messages::RotorSpeeds& message) noexcept {
    return static_cast<std::int64_t>(message.stamp_ns);
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::messages::RotorSpeeds& out) {
    Dimension<MalformedMessage> dimension_rotors("rotors");
    reader.scalar(at, out.stamp_ns);
    reader.array(at + 8, out.speed);
    dimension_rotors(out.speed.shape()[0], "cortex/RotorSpeeds.speed");
    reader.scalar(at + 24, out.sequence);
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::messages::RotorSpeeds& message) {
    Dimension<std::invalid_argument> dimension_rotors("rotors");
    sink.scalar(at, message.stamp_ns);
    dimension_rotors(message.speed.shape()[0], "cortex/RotorSpeeds.speed");
    sink.array(at + 8, message.speed);
    sink.zero(at + 20, 4);
    sink.scalar(at + 24, message.sequence);
  }

  static void draft(Placer& placer, ::cortex::messages::RotorSpeeds& out) {
    placer.array(out.speed, {Placer::Extent{"rotors", 0}});
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_messages_RotorSpeeds_4479009E8F5E5281

#ifndef CORTEX_TYPE_cortex_messages_SensorStatus_D4AD0AAC0CCF4967
#define CORTEX_TYPE_cortex_messages_SensorStatus_D4AD0AAC0CCF4967
namespace cortex::messages {
struct SensorStatus {
  std::string vehicle{};
  std::string name{};
  bool active{};
  std::uint32_t subscriber_count{};
  std::uint64_t published_count{};
  std::uint64_t dropped_count{};
  std::uint64_t injected_lost_count{};
  std::uint64_t undelivered_count{};
  std::int64_t late_p99_ns{};  // ns

  friend bool operator==(const SensorStatus& a, const SensorStatus& b) {
    return a.vehicle == b.vehicle &&
           a.name == b.name &&
           a.active == b.active &&
           a.subscriber_count == b.subscriber_count &&
           a.published_count == b.published_count &&
           a.dropped_count == b.dropped_count &&
           a.injected_lost_count == b.injected_lost_count &&
           a.undelivered_count == b.undelivered_count &&
           a.late_p99_ns == b.late_p99_ns;
  }
  friend bool operator!=(const SensorStatus& a, const SensorStatus& b) { return !(a == b); }
};
}  // namespace cortex::messages
namespace cortex {
template <>
struct Codec<::cortex::messages::SensorStatus> {
  static constexpr std::string_view name = "cortex/SensorStatus";
  static constexpr std::uint64_t fingerprint = 0xD4AD0AAC0CCF4967u;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/SensorStatus\",\"fields\":[{\"name\":\"vehicle\",\"type\":\"str\",\"unit\":\"\",\"frame\":\""
      "\"},{\"name\":\"name\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"active\",\"type\":\"bool\",\"unit\""
      ":\"\",\"frame\":\"\"},{\"name\":\"subscriber_count\",\"type\":\"uint32\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\""
      "published_count\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"dropped_count\",\"type\":\"uin"
      "t64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"injected_lost_count\",\"type\":\"uint64\",\"unit\":\"\",\"frame\""
      ":\"\"},{\"name\":\"undelivered_count\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"late_p99_n"
      "s\",\"type\":\"int64\",\"unit\":\"ns\",\"frame\":\"\"}]}";
  static constexpr std::size_t block = 64;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = false;
  static constexpr bool stamped = false;

  static std::int64_t stamp([[maybe_unused]] const ::cortex::messages::SensorStatus& message) noexcept {
    return 0;
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::messages::SensorStatus& out) {
    reader.text(at, out.vehicle);
    reader.text(at + 8, out.name);
    reader.scalar(at + 16, out.active);
    reader.scalar(at + 20, out.subscriber_count);
    reader.scalar(at + 24, out.published_count);
    reader.scalar(at + 32, out.dropped_count);
    reader.scalar(at + 40, out.injected_lost_count);
    reader.scalar(at + 48, out.undelivered_count);
    reader.scalar(at + 56, out.late_p99_ns);
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::messages::SensorStatus& message) {
    sink.text(at, message.vehicle);
    sink.text(at + 8, message.name);
    sink.scalar(at + 16, message.active);
    sink.zero(at + 17, 3);
    sink.scalar(at + 20, message.subscriber_count);
    sink.scalar(at + 24, message.published_count);
    sink.scalar(at + 32, message.dropped_count);
    sink.scalar(at + 40, message.injected_lost_count);
    sink.scalar(at + 48, message.undelivered_count);
    sink.scalar(at + 56, message.late_p99_ns);
  }

  static void draft([[maybe_unused]] Placer& placer, [[maybe_unused]] ::cortex::messages::SensorStatus& out) {
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_messages_SensorStatus_D4AD0AAC0CCF4967

#ifndef CORTEX_TYPE_cortex_messages_Simulation_6E54A4EFCCEB44C8
#define CORTEX_TYPE_cortex_messages_Simulation_6E54A4EFCCEB44C8
namespace cortex::messages {
struct Simulation {
  std::string config{};
  std::string version{};
  std::vector<std::string> vehicles{};
  std::string mode{};
  double control_rate_hz{};  // Hz
  std::vector<double> thrust_max_n{};  // N
  std::vector<::cortex::messages::CommandRanges> command_ranges{};

  friend bool operator==(const Simulation& a, const Simulation& b) {
    return a.config == b.config &&
           a.version == b.version &&
           a.vehicles == b.vehicles &&
           a.mode == b.mode &&
           a.control_rate_hz == b.control_rate_hz &&
           a.thrust_max_n == b.thrust_max_n &&
           a.command_ranges == b.command_ranges;
  }
  friend bool operator!=(const Simulation& a, const Simulation& b) { return !(a == b); }
};
}  // namespace cortex::messages
namespace cortex {
template <>
struct Codec<::cortex::messages::Simulation> {
  static constexpr std::string_view name = "cortex/Simulation";
  static constexpr std::uint64_t fingerprint = 0x6E54A4EFCCEB44C8u;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/Simulation\",\"fields\":[{\"name\":\"config\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},"
      "{\"name\":\"version\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"vehicles\",\"type\":{\"list\":\"st"
      "r\"},\"unit\":\"\",\"frame\":\"\"},{\"name\":\"mode\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"contr"
      "ol_rate_hz\",\"type\":\"float64\",\"unit\":\"Hz\",\"frame\":\"\"},{\"name\":\"thrust_max_n\",\"type\":{\"list\""
      ":\"float64\"},\"unit\":\"N\",\"frame\":\"\"},{\"name\":\"command_ranges\",\"type\":{\"list\":{\"message\":{\"na"
      "me\":\"cortex/CommandRanges\",\"fields\":[{\"name\":\"refuse\",\"type\":\"bool\",\"unit\":\"\",\"frame\":\"\"},"
      "{\"name\":\"rotor_speed_max_rad_s\",\"type\":\"float64\",\"unit\":\"rad/s\",\"frame\":\"\"},{\"name\":\"thrus"
      "t_max_n\",\"type\":\"float64\",\"unit\":\"N\",\"frame\":\"\"},{\"name\":\"speed_max_m_s\",\"type\":\"float64\","
      "\"unit\":\"m/s\",\"frame\":\"\"},{\"name\":\"body_rate_max_rad_s\",\"type\":\"float64\",\"unit\":\"rad/s\",\"fr"
      "ame\":\"\"},{\"name\":\"position_max_m\",\"type\":\"float64\",\"unit\":\"m\",\"frame\":\"\"}]}}},\"unit\":\"\",\"f"
      "rame\":\"\"}]}";
  static constexpr std::size_t block = 56;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = false;
  static constexpr bool stamped = false;

  static std::int64_t stamp([[maybe_unused]] const ::cortex::messages::Simulation& message) noexcept {
    return 0;
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::messages::Simulation& out) {
    reader.text(at, out.config);
    reader.text(at + 8, out.version);
    {
      const auto list2 = reader.list(at + 16, 8);
      out.vehicles.clear();
      out.vehicles.reserve(list2.count);
      for (std::size_t k2 = 0; k2 < list2.count; ++k2) {
        std::string item2{};
        reader.text(list2.at + k2 * 8, item2);
        out.vehicles.push_back(std::move(item2));
      }
    }
    reader.text(at + 24, out.mode);
    reader.scalar(at + 32, out.control_rate_hz);
    {
      const auto list2 = reader.list(at + 40, 8);
      out.thrust_max_n.clear();
      out.thrust_max_n.reserve(list2.count);
      for (std::size_t k2 = 0; k2 < list2.count; ++k2) {
        double item2{};
        reader.scalar(list2.at + k2 * 8, item2);
        out.thrust_max_n.push_back(std::move(item2));
      }
    }
    {
      const auto list2 = reader.list(at + 48, 48);
      out.command_ranges.clear();
      out.command_ranges.reserve(list2.count);
      for (std::size_t k2 = 0; k2 < list2.count; ++k2) {
        ::cortex::messages::CommandRanges item2{};
        Codec<::cortex::messages::CommandRanges>::decode(reader, list2.at + k2 * 48, item2);
        out.command_ranges.push_back(std::move(item2));
      }
    }
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::messages::Simulation& message) {
    sink.text(at, message.config);
    sink.text(at + 8, message.version);
    {
      const std::size_t start2 =
          sink.list(at + 16, message.vehicles.size(), 8, 8);
      for (std::size_t k2 = 0; k2 < message.vehicles.size(); ++k2) {
        const auto& item2 = message.vehicles[k2];
        sink.text(start2 + k2 * 8, item2);
      }
    }
    sink.text(at + 24, message.mode);
    sink.scalar(at + 32, message.control_rate_hz);
    {
      const std::size_t start2 =
          sink.list(at + 40, message.thrust_max_n.size(), 8, 8);
      for (std::size_t k2 = 0; k2 < message.thrust_max_n.size(); ++k2) {
        const auto& item2 = message.thrust_max_n[k2];
        sink.scalar(start2 + k2 * 8, item2);
      }
    }
    {
      const std::size_t start2 =
          sink.list(at + 48, message.command_ranges.size(), 48, 8);
      for (std::size_t k2 = 0; k2 < message.command_ranges.size(); ++k2) {
        const auto& item2 = message.command_ranges[k2];
        Codec<::cortex::messages::CommandRanges>::encode(sink, start2 + k2 * 48, item2);
      }
    }
  }

  static void draft([[maybe_unused]] Placer& placer, [[maybe_unused]] ::cortex::messages::Simulation& out) {
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_messages_Simulation_6E54A4EFCCEB44C8

#ifndef CORTEX_TYPE_cortex_messages_SimulatorReply_5DCD028328196B99
#define CORTEX_TYPE_cortex_messages_SimulatorReply_5DCD028328196B99
namespace cortex::messages {
struct SimulatorReply {
  bool accepted{};
  std::string reason{};
  std::int64_t stamp_ns{};  // ns
  std::string phase{};

  friend bool operator==(const SimulatorReply& a, const SimulatorReply& b) {
    return a.accepted == b.accepted &&
           a.reason == b.reason &&
           a.stamp_ns == b.stamp_ns &&
           a.phase == b.phase;
  }
  friend bool operator!=(const SimulatorReply& a, const SimulatorReply& b) { return !(a == b); }
};
}  // namespace cortex::messages
namespace cortex {
template <>
struct Codec<::cortex::messages::SimulatorReply> {
  static constexpr std::string_view name = "cortex/SimulatorReply";
  static constexpr std::uint64_t fingerprint = 0x5DCD028328196B99u;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/SimulatorReply\",\"fields\":[{\"name\":\"accepted\",\"type\":\"bool\",\"unit\":\"\",\"fram"
      "e\":\"\"},{\"name\":\"reason\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"stamp_ns\",\"type\":\"int6"
      "4\",\"unit\":\"ns\",\"frame\":\"\"},{\"name\":\"phase\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"}]}";
  static constexpr std::size_t block = 32;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = false;
  static constexpr bool stamped = true;

  static std::int64_t stamp(const ::cortex::messages::SimulatorReply& message) noexcept {
    return static_cast<std::int64_t>(message.stamp_ns);
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::messages::SimulatorReply& out) {
    reader.scalar(at, out.accepted);
    reader.text(at + 4, out.reason);
    reader.scalar(at + 16, out.stamp_ns);
    reader.text(at + 24, out.phase);
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::messages::SimulatorReply& message) {
    sink.scalar(at, message.accepted);
    sink.zero(at + 1, 3);
    sink.text(at + 4, message.reason);
    sink.zero(at + 12, 4);
    sink.scalar(at + 16, message.stamp_ns);
    sink.text(at + 24, message.phase);
  }

  static void draft([[maybe_unused]] Placer& placer, [[maybe_unused]] ::cortex::messages::SimulatorReply& out) {
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_messages_SimulatorReply_5DCD028328196B99

#ifndef CORTEX_TYPE_cortex_messages_VehicleStatus_80FB9B86E76C25D5
#define CORTEX_TYPE_cortex_messages_VehicleStatus_80FB9B86E76C25D5
namespace cortex::messages {
struct VehicleStatus {
  std::string name{};
  std::string command_mode{};
  std::uint64_t command_count{};
  std::uint64_t refused_count{};
  std::uint64_t superseded_count{};
  std::uint64_t lost_count{};
  std::int64_t command_age_ns{};  // ns
  bool fail_safe{};
  std::uint64_t fail_safe_count{};
  std::uint64_t collision_count{};
  std::uint64_t undelivered_count{};
  std::string refused_reason{};
  std::uint64_t clamped_count{};
  std::string clamped_reason{};

  friend bool operator==(const VehicleStatus& a, const VehicleStatus& b) {
    return a.name == b.name &&
           a.command_mode == b.command_mode &&
           a.command_count == b.command_count &&
           a.refused_count == b.refused_count &&
           a.superseded_count == b.superseded_count &&
           a.lost_count == b.lost_count &&
           a.command_age_ns == b.command_age_ns &&
           a.fail_safe == b.fail_safe &&
           a.fail_safe_count == b.fail_safe_count &&
           a.collision_count == b.collision_count &&
           a.undelivered_count == b.undelivered_count &&
           a.refused_reason == b.refused_reason &&
           a.clamped_count == b.clamped_count &&
           a.clamped_reason == b.clamped_reason;
  }
  friend bool operator!=(const VehicleStatus& a, const VehicleStatus& b) { return !(a == b); }
};
}  // namespace cortex::messages
namespace cortex {
template <>
struct Codec<::cortex::messages::VehicleStatus> {
  static constexpr std::string_view name = "cortex/VehicleStatus";
  static constexpr std::uint64_t fingerprint = 0x80FB9B86E76C25D5u;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/VehicleStatus\",\"fields\":[{\"name\":\"name\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"}"
      ",{\"name\":\"command_mode\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"command_count\",\"type\":"
      "\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"refused_count\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\""
      "\"},{\"name\":\"superseded_count\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"lost_count\",\""
      "type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"command_age_ns\",\"type\":\"int64\",\"unit\":\"ns\",\""
      "frame\":\"\"},{\"name\":\"fail_safe\",\"type\":\"bool\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"fail_safe_coun"
      "t\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"collision_count\",\"type\":\"uint64\",\"unit\":"
      "\"\",\"frame\":\"\"},{\"name\":\"undelivered_count\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\""
      "refused_reason\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"clamped_count\",\"type\":\"uint64\""
      ",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"clamped_reason\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"}]}";
  static constexpr std::size_t block = 112;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = false;
  static constexpr bool stamped = false;

  static std::int64_t stamp([[maybe_unused]] const ::cortex::messages::VehicleStatus& message) noexcept {
    return 0;
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::messages::VehicleStatus& out) {
    reader.text(at, out.name);
    reader.text(at + 8, out.command_mode);
    reader.scalar(at + 16, out.command_count);
    reader.scalar(at + 24, out.refused_count);
    reader.scalar(at + 32, out.superseded_count);
    reader.scalar(at + 40, out.lost_count);
    reader.scalar(at + 48, out.command_age_ns);
    reader.scalar(at + 56, out.fail_safe);
    reader.scalar(at + 64, out.fail_safe_count);
    reader.scalar(at + 72, out.collision_count);
    reader.scalar(at + 80, out.undelivered_count);
    reader.text(at + 88, out.refused_reason);
    reader.scalar(at + 96, out.clamped_count);
    reader.text(at + 104, out.clamped_reason);
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::messages::VehicleStatus& message) {
    sink.text(at, message.name);
    sink.text(at + 8, message.command_mode);
    sink.scalar(at + 16, message.command_count);
    sink.scalar(at + 24, message.refused_count);
    sink.scalar(at + 32, message.superseded_count);
    sink.scalar(at + 40, message.lost_count);
    sink.scalar(at + 48, message.command_age_ns);
    sink.scalar(at + 56, message.fail_safe);
    sink.zero(at + 57, 7);
    sink.scalar(at + 64, message.fail_safe_count);
    sink.scalar(at + 72, message.collision_count);
    sink.scalar(at + 80, message.undelivered_count);
    sink.text(at + 88, message.refused_reason);
    sink.scalar(at + 96, message.clamped_count);
    sink.text(at + 104, message.clamped_reason);
  }

  static void draft([[maybe_unused]] Placer& placer, [[maybe_unused]] ::cortex::messages::VehicleStatus& out) {
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_messages_VehicleStatus_80FB9B86E76C25D5

#ifndef CORTEX_TYPE_cortex_messages_SimulatorStatus_3BDFB9CD2C469ACD
#define CORTEX_TYPE_cortex_messages_SimulatorStatus_3BDFB9CD2C469ACD
namespace cortex::messages {
struct SimulatorStatus {
  std::int64_t stamp_ns{};  // ns
  std::int64_t wall_ns{};  // ns, frame CLOCK_REALTIME
  std::string phase{};
  std::string reason{};
  std::string mode{};
  double real_time_factor_wanted{};
  double real_time_factor{};
  std::uint64_t step_count{};
  std::int64_t step_median_ns{};  // ns
  std::int64_t step_p99_ns{};  // ns
  std::int64_t late_median_ns{};  // ns
  std::int64_t late_p99_ns{};  // ns
  std::uint64_t overrun_count{};
  std::int64_t slipped_ns{};  // ns
  std::vector<::cortex::messages::SensorStatus> sensors{};
  std::vector<::cortex::messages::VehicleStatus> vehicles{};
  std::uint64_t sequence{};

  friend bool operator==(const SimulatorStatus& a, const SimulatorStatus& b) {
    return a.stamp_ns == b.stamp_ns &&
           a.wall_ns == b.wall_ns &&
           a.phase == b.phase &&
           a.reason == b.reason &&
           a.mode == b.mode &&
           a.real_time_factor_wanted == b.real_time_factor_wanted &&
           a.real_time_factor == b.real_time_factor &&
           a.step_count == b.step_count &&
           a.step_median_ns == b.step_median_ns &&
           a.step_p99_ns == b.step_p99_ns &&
           a.late_median_ns == b.late_median_ns &&
           a.late_p99_ns == b.late_p99_ns &&
           a.overrun_count == b.overrun_count &&
           a.slipped_ns == b.slipped_ns &&
           a.sensors == b.sensors &&
           a.vehicles == b.vehicles &&
           a.sequence == b.sequence;
  }
  friend bool operator!=(const SimulatorStatus& a, const SimulatorStatus& b) { return !(a == b); }
};
}  // namespace cortex::messages
namespace cortex {
template <>
struct Codec<::cortex::messages::SimulatorStatus> {
  static constexpr std::string_view name = "cortex/SimulatorStatus";
  static constexpr std::uint64_t fingerprint = 0x3BDFB9CD2C469ACDu;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/SimulatorStatus\",\"fields\":[{\"name\":\"stamp_ns\",\"type\":\"int64\",\"unit\":\"ns\",\""
      "frame\":\"\"},{\"name\":\"wall_ns\",\"type\":\"int64\",\"unit\":\"ns\",\"frame\":\"CLOCK_REALTIME\"},{\"name\":"
      "\"phase\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"reason\",\"type\":\"str\",\"unit\":\"\",\"frame\""
      ":\"\"},{\"name\":\"mode\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"real_time_factor_wanted\",\""
      "type\":\"float64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"real_time_factor\",\"type\":\"float64\",\"unit\":\""
      "\",\"frame\":\"\"},{\"name\":\"step_count\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"step_med"
      "ian_ns\",\"type\":\"int64\",\"unit\":\"ns\",\"frame\":\"\"},{\"name\":\"step_p99_ns\",\"type\":\"int64\",\"unit\""
      ":\"ns\",\"frame\":\"\"},{\"name\":\"late_median_ns\",\"type\":\"int64\",\"unit\":\"ns\",\"frame\":\"\"},{\"name\":"
      "\"late_p99_ns\",\"type\":\"int64\",\"unit\":\"ns\",\"frame\":\"\"},{\"name\":\"overrun_count\",\"type\":\"uint6"
      "4\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"slipped_ns\",\"type\":\"int64\",\"unit\":\"ns\",\"frame\":\"\"},{\"nam"
      "e\":\"sensors\",\"type\":{\"list\":{\"message\":{\"name\":\"cortex/SensorStatus\",\"fields\":[{\"name\":\"ve"
      "hicle\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"name\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\""
      "},{\"name\":\"active\",\"type\":\"bool\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"subscriber_count\",\"type\":\""
      "uint32\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"published_count\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":"
      "\"\"},{\"name\":\"dropped_count\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"injected_lost_c"
      "ount\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"undelivered_count\",\"type\":\"uint64\",\"u"
      "nit\":\"\",\"frame\":\"\"},{\"name\":\"late_p99_ns\",\"type\":\"int64\",\"unit\":\"ns\",\"frame\":\"\"}]}}},\"unit"
      "\":\"\",\"frame\":\"\"},{\"name\":\"vehicles\",\"type\":{\"list\":{\"message\":{\"name\":\"cortex/VehicleStatu"
      "s\",\"fields\":[{\"name\":\"name\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"command_mode\",\"typ"
      "e\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"command_count\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\""
      "\"},{\"name\":\"refused_count\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"superseded_count"
      "\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"lost_count\",\"type\":\"uint64\",\"unit\":\"\",\"fr"
      "ame\":\"\"},{\"name\":\"command_age_ns\",\"type\":\"int64\",\"unit\":\"ns\",\"frame\":\"\"},{\"name\":\"fail_saf"
      "e\",\"type\":\"bool\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"fail_safe_count\",\"type\":\"uint64\",\"unit\":\"\""
      ",\"frame\":\"\"},{\"name\":\"collision_count\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"unde"
      "livered_count\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"refused_reason\",\"type\":\"str\""
      ",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"clamped_count\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\"nam"
      "e\":\"clamped_reason\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"}]}}},\"unit\":\"\",\"frame\":\"\"},{\"name\":\""
      "sequence\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"}]}";
  static constexpr std::size_t block = 136;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = false;
  static constexpr bool stamped = true;

  static std::int64_t stamp(const ::cortex::messages::SimulatorStatus& message) noexcept {
    return static_cast<std::int64_t>(message.stamp_ns);
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::messages::SimulatorStatus& out) {
    reader.scalar(at, out.stamp_ns);
    reader.scalar(at + 8, out.wall_ns);
    reader.text(at + 16, out.phase);
    reader.text(at + 24, out.reason);
    reader.text(at + 32, out.mode);
    reader.scalar(at + 40, out.real_time_factor_wanted);
    reader.scalar(at + 48, out.real_time_factor);
    reader.scalar(at + 56, out.step_count);
    reader.scalar(at + 64, out.step_median_ns);
    reader.scalar(at + 72, out.step_p99_ns);
    reader.scalar(at + 80, out.late_median_ns);
    reader.scalar(at + 88, out.late_p99_ns);
    reader.scalar(at + 96, out.overrun_count);
    reader.scalar(at + 104, out.slipped_ns);
    {
      const auto list2 = reader.list(at + 112, 64);
      out.sensors.clear();
      out.sensors.reserve(list2.count);
      for (std::size_t k2 = 0; k2 < list2.count; ++k2) {
        ::cortex::messages::SensorStatus item2{};
        Codec<::cortex::messages::SensorStatus>::decode(reader, list2.at + k2 * 64, item2);
        out.sensors.push_back(std::move(item2));
      }
    }
    {
      const auto list2 = reader.list(at + 120, 112);
      out.vehicles.clear();
      out.vehicles.reserve(list2.count);
      for (std::size_t k2 = 0; k2 < list2.count; ++k2) {
        ::cortex::messages::VehicleStatus item2{};
        Codec<::cortex::messages::VehicleStatus>::decode(reader, list2.at + k2 * 112, item2);
        out.vehicles.push_back(std::move(item2));
      }
    }
    reader.scalar(at + 128, out.sequence);
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::messages::SimulatorStatus& message) {
    sink.scalar(at, message.stamp_ns);
    sink.scalar(at + 8, message.wall_ns);
    sink.text(at + 16, message.phase);
    sink.text(at + 24, message.reason);
    sink.text(at + 32, message.mode);
    sink.scalar(at + 40, message.real_time_factor_wanted);
    sink.scalar(at + 48, message.real_time_factor);
    sink.scalar(at + 56, message.step_count);
    sink.scalar(at + 64, message.step_median_ns);
    sink.scalar(at + 72, message.step_p99_ns);
    sink.scalar(at + 80, message.late_median_ns);
    sink.scalar(at + 88, message.late_p99_ns);
    sink.scalar(at + 96, message.overrun_count);
    sink.scalar(at + 104, message.slipped_ns);
    {
      const std::size_t start2 =
          sink.list(at + 112, message.sensors.size(), 64, 8);
      for (std::size_t k2 = 0; k2 < message.sensors.size(); ++k2) {
        const auto& item2 = message.sensors[k2];
        Codec<::cortex::messages::SensorStatus>::encode(sink, start2 + k2 * 64, item2);
      }
    }
    {
      const std::size_t start2 =
          sink.list(at + 120, message.vehicles.size(), 112, 8);
      for (std::size_t k2 = 0; k2 < message.vehicles.size(); ++k2) {
        const auto& item2 = message.vehicles[k2];
        Codec<::cortex::messages::VehicleStatus>::encode(sink, start2 + k2 * 112, item2);
      }
    }
    sink.scalar(at + 128, message.sequence);
  }

  static void draft([[maybe_unused]] Placer& placer, [[maybe_unused]] ::cortex::messages::SimulatorStatus& out) {
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_messages_SimulatorStatus_3BDFB9CD2C469ACD

#ifndef CORTEX_TYPE_cortex_messages_Step_F36F31368FC43311
#define CORTEX_TYPE_cortex_messages_Step_F36F31368FC43311
namespace cortex::messages {
struct Step {
  std::uint32_t count{};
  double timeout_s{};  // s

  friend bool operator==(const Step& a, const Step& b) {
    return a.count == b.count &&
           a.timeout_s == b.timeout_s;
  }
  friend bool operator!=(const Step& a, const Step& b) { return !(a == b); }
};
}  // namespace cortex::messages
namespace cortex {
template <>
struct Codec<::cortex::messages::Step> {
  static constexpr std::string_view name = "cortex/Step";
  static constexpr std::uint64_t fingerprint = 0xF36F31368FC43311u;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/Step\",\"fields\":[{\"name\":\"count\",\"type\":\"uint32\",\"unit\":\"\",\"frame\":\"\"},{\"na"
      "me\":\"timeout_s\",\"type\":\"float64\",\"unit\":\"s\",\"frame\":\"\"}]}";
  static constexpr std::size_t block = 16;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = true;
  static constexpr bool stamped = false;

  static std::int64_t stamp([[maybe_unused]] const ::cortex::messages::Step& message) noexcept {
    return 0;
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::messages::Step& out) {
    reader.scalar(at, out.count);
    reader.scalar(at + 8, out.timeout_s);
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::messages::Step& message) {
    sink.scalar(at, message.count);
    sink.zero(at + 4, 4);
    sink.scalar(at + 8, message.timeout_s);
  }

  static void draft([[maybe_unused]] Placer& placer, [[maybe_unused]] ::cortex::messages::Step& out) {
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_messages_Step_F36F31368FC43311

#ifndef CORTEX_TYPE_cortex_messages_Text_62AB79C7A7989E5E
#define CORTEX_TYPE_cortex_messages_Text_62AB79C7A7989E5E
namespace cortex::messages {
struct Text {
  std::string text{};
  std::int64_t stamp_ns{};  // ns
  std::uint64_t sequence{};

  friend bool operator==(const Text& a, const Text& b) {
    return a.text == b.text &&
           a.stamp_ns == b.stamp_ns &&
           a.sequence == b.sequence;
  }
  friend bool operator!=(const Text& a, const Text& b) { return !(a == b); }
};
}  // namespace cortex::messages
namespace cortex {
template <>
struct Codec<::cortex::messages::Text> {
  static constexpr std::string_view name = "cortex/Text";
  static constexpr std::uint64_t fingerprint = 0x62AB79C7A7989E5Eu;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/Text\",\"fields\":[{\"name\":\"text\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":"
      "\"stamp_ns\",\"type\":\"int64\",\"unit\":\"ns\",\"frame\":\"\"},{\"name\":\"sequence\",\"type\":\"uint64\",\"unit"
      "\":\"\",\"frame\":\"\"}]}";
  static constexpr std::size_t block = 24;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = false;
  static constexpr bool stamped = true;

  static std::int64_t stamp(const ::cortex::messages::Text& message) noexcept {
    return static_cast<std::int64_t>(message.stamp_ns);
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::messages::Text& out) {
    reader.text(at, out.text);
    reader.scalar(at + 8, out.stamp_ns);
    reader.scalar(at + 16, out.sequence);
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::messages::Text& message) {
    sink.text(at, message.text);
    sink.scalar(at + 8, message.stamp_ns);
    sink.scalar(at + 16, message.sequence);
  }

  static void draft([[maybe_unused]] Placer& placer, [[maybe_unused]] ::cortex::messages::Text& out) {
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_messages_Text_62AB79C7A7989E5E

#ifndef CORTEX_TYPE_cortex_messages_Transform_63F69E56AA6773F9
#define CORTEX_TYPE_cortex_messages_Transform_63F69E56AA6773F9
namespace cortex::messages {
struct Transform {
  std::int64_t stamp_ns{};  // ns
  std::string parent{};
  std::string child{};
  std::array<double, 3> translation{};  // [3], m, frame parent
  std::array<double, 4> rotation{};  // [4]
  std::uint64_t sequence{};

  friend bool operator==(const Transform& a, const Transform& b) {
    return a.stamp_ns == b.stamp_ns &&
           a.parent == b.parent &&
           a.child == b.child &&
           a.translation == b.translation &&
           a.rotation == b.rotation &&
           a.sequence == b.sequence;
  }
  friend bool operator!=(const Transform& a, const Transform& b) { return !(a == b); }
};
}  // namespace cortex::messages
namespace cortex {
template <>
struct Codec<::cortex::messages::Transform> {
  static constexpr std::string_view name = "cortex/Transform";
  static constexpr std::uint64_t fingerprint = 0x63F69E56AA6773F9u;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/Transform\",\"fields\":[{\"name\":\"stamp_ns\",\"type\":\"int64\",\"unit\":\"ns\",\"frame\""
      ":\"\"},{\"name\":\"parent\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"child\",\"type\":\"str\",\"uni"
      "t\":\"\",\"frame\":\"\"},{\"name\":\"translation\",\"type\":{\"array\":\"float64\",\"shape\":[3]},\"unit\":\"m\","
      "\"frame\":\"parent\"},{\"name\":\"rotation\",\"type\":{\"array\":\"float64\",\"shape\":[4]},\"unit\":\"\",\"fra"
      "me\":\"\"},{\"name\":\"sequence\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"}]}";
  static constexpr std::size_t block = 88;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = false;
  static constexpr bool stamped = true;

  static std::int64_t stamp(const ::cortex::messages::Transform& message) noexcept {
    return static_cast<std::int64_t>(message.stamp_ns);
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::messages::Transform& out) {
    reader.scalar(at, out.stamp_ns);
    reader.text(at + 8, out.parent);
    reader.text(at + 16, out.child);
    reader.fixed(at + 24, out.translation);
    reader.fixed(at + 48, out.rotation);
    reader.scalar(at + 80, out.sequence);
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::messages::Transform& message) {
    sink.scalar(at, message.stamp_ns);
    sink.text(at + 8, message.parent);
    sink.text(at + 16, message.child);
    sink.fixed(at + 24, message.translation);
    sink.fixed(at + 48, message.rotation);
    sink.scalar(at + 80, message.sequence);
  }

  static void draft([[maybe_unused]] Placer& placer, [[maybe_unused]] ::cortex::messages::Transform& out) {
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_messages_Transform_63F69E56AA6773F9

#ifndef CORTEX_TYPE_cortex_messages_Trigger_32A0F962AED85713
#define CORTEX_TYPE_cortex_messages_Trigger_32A0F962AED85713
namespace cortex::messages {
struct Trigger {
  std::uint64_t sequence{};

  friend bool operator==(const Trigger& a, const Trigger& b) {
    return a.sequence == b.sequence;
  }
  friend bool operator!=(const Trigger& a, const Trigger& b) { return !(a == b); }
};
}  // namespace cortex::messages
namespace cortex {
template <>
struct Codec<::cortex::messages::Trigger> {
  static constexpr std::string_view name = "cortex/Trigger";
  static constexpr std::uint64_t fingerprint = 0x32A0F962AED85713u;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/Trigger\",\"fields\":[{\"name\":\"sequence\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\""
      "}]}";
  static constexpr std::size_t block = 8;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = true;
  static constexpr bool stamped = false;

  static std::int64_t stamp([[maybe_unused]] const ::cortex::messages::Trigger& message) noexcept {
    return 0;
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::messages::Trigger& out) {
    reader.scalar(at, out.sequence);
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::messages::Trigger& message) {
    sink.scalar(at, message.sequence);
  }

  static void draft([[maybe_unused]] Placer& placer, [[maybe_unused]] ::cortex::messages::Trigger& out) {
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_messages_Trigger_32A0F962AED85713

#ifndef CORTEX_TYPE_cortex_messages_VelocityCommand_9298B48D6BE20756
#define CORTEX_TYPE_cortex_messages_VelocityCommand_9298B48D6BE20756
namespace cortex::messages {
struct VelocityCommand {
  std::int64_t stamp_ns{};  // ns
  std::array<double, 3> velocity{};  // [3], m/s, frame world
  double yaw_rate_rad_s{};  // rad/s, frame world
  std::uint64_t sequence{};

  friend bool operator==(const VelocityCommand& a, const VelocityCommand& b) {
    return a.stamp_ns == b.stamp_ns &&
           a.velocity == b.velocity &&
           a.yaw_rate_rad_s == b.yaw_rate_rad_s &&
           a.sequence == b.sequence;
  }
  friend bool operator!=(const VelocityCommand& a, const VelocityCommand& b) { return !(a == b); }
};
}  // namespace cortex::messages
namespace cortex {
template <>
struct Codec<::cortex::messages::VelocityCommand> {
  static constexpr std::string_view name = "cortex/VelocityCommand";
  static constexpr std::uint64_t fingerprint = 0x9298B48D6BE20756u;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/VelocityCommand\",\"fields\":[{\"name\":\"stamp_ns\",\"type\":\"int64\",\"unit\":\"ns\",\""
      "frame\":\"\"},{\"name\":\"velocity\",\"type\":{\"array\":\"float64\",\"shape\":[3]},\"unit\":\"m/s\",\"frame\":"
      "\"world\"},{\"name\":\"yaw_rate_rad_s\",\"type\":\"float64\",\"unit\":\"rad/s\",\"frame\":\"world\"},{\"name\""
      ":\"sequence\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"}]}";
  static constexpr std::size_t block = 48;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = true;
  static constexpr bool stamped = true;

  static std::int64_t stamp(const ::cortex::messages::VelocityCommand& message) noexcept {
    return static_cast<std::int64_t>(message.stamp_ns);
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::messages::VelocityCommand& out) {
    reader.scalar(at, out.stamp_ns);
    reader.fixed(at + 8, out.velocity);
    reader.scalar(at + 32, out.yaw_rate_rad_s);
    reader.scalar(at + 40, out.sequence);
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::messages::VelocityCommand& message) {
    sink.scalar(at, message.stamp_ns);
    sink.fixed(at + 8, message.velocity);
    sink.scalar(at + 32, message.yaw_rate_rad_s);
    sink.scalar(at + 40, message.sequence);
  }

  static void draft([[maybe_unused]] Placer& placer, [[maybe_unused]] ::cortex::messages::VelocityCommand& out) {
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_messages_VelocityCommand_9298B48D6BE20756
