// Written by `cortex cpp`; do not edit. Types: cortex::records::PublisherRecord, cortex::records::SubscriberRecord, cortex::records::ServiceRecord, cortex::records::Endpoint, cortex::records::NodeRecord, cortex::records::Hello, cortex::records::Heartbeat, cortex::records::Alive, cortex::records::Welcome, cortex::records::Changed, cortex::records::Gone, cortex::records::Refused, cortex::records::Leave, cortex::records::Describe, cortex::records::PublisherStats, cortex::records::SubscriberStats, cortex::records::StatsRequest, cortex::records::StatsReply, cortex::records::ServiceError.
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

#ifndef CORTEX_TYPE_cortex_records_PublisherRecord_B683333975EEDD6B
#define CORTEX_TYPE_cortex_records_PublisherRecord_B683333975EEDD6B
namespace cortex::records {
struct PublisherRecord {
  std::string topic{};
  std::uint64_t source{};
  std::string type_name{};
  std::uint64_t fingerprint{};
  std::string schema{};
  bool latch{};

  friend bool operator==(const PublisherRecord& a, const PublisherRecord& b) {
    return a.topic == b.topic &&
           a.source == b.source &&
           a.type_name == b.type_name &&
           a.fingerprint == b.fingerprint &&
           a.schema == b.schema &&
           a.latch == b.latch;
  }
  friend bool operator!=(const PublisherRecord& a, const PublisherRecord& b) { return !(a == b); }
};
}  // namespace cortex::records
namespace cortex {
template <>
struct Codec<::cortex::records::PublisherRecord> {
  static constexpr std::string_view name = "cortex/PublisherRecord";
  static constexpr std::uint64_t fingerprint = 0xB683333975EEDD6Bu;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/PublisherRecord\",\"fields\":[{\"name\":\"topic\",\"type\":\"str\",\"unit\":\"\",\"frame\":"
      "\"\"},{\"name\":\"source\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"type_name\",\"type\":\"str"
      "\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"fingerprint\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\"name"
      "\":\"schema\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"latch\",\"type\":\"bool\",\"unit\":\"\",\"fra"
      "me\":\"\"}]}";
  static constexpr std::size_t block = 48;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = false;
  static constexpr bool stamped = false;

  static std::int64_t stamp([[maybe_unused]] const ::cortex::records::PublisherRecord& message) noexcept {
    return 0;
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::records::PublisherRecord& out) {
    reader.text(at, out.topic);
    reader.scalar(at + 8, out.source);
    reader.text(at + 16, out.type_name);
    reader.scalar(at + 24, out.fingerprint);
    reader.text(at + 32, out.schema);
    reader.scalar(at + 40, out.latch);
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::records::PublisherRecord& message) {
    sink.text(at, message.topic);
    sink.scalar(at + 8, message.source);
    sink.text(at + 16, message.type_name);
    sink.scalar(at + 24, message.fingerprint);
    sink.text(at + 32, message.schema);
    sink.scalar(at + 40, message.latch);
    sink.zero(at + 41, 7);
  }

  static void draft([[maybe_unused]] Placer& placer, [[maybe_unused]] ::cortex::records::PublisherRecord& out) {
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_records_PublisherRecord_B683333975EEDD6B

#ifndef CORTEX_TYPE_cortex_records_SubscriberRecord_043EBF42C2F8DEA8
#define CORTEX_TYPE_cortex_records_SubscriberRecord_043EBF42C2F8DEA8
namespace cortex::records {
struct SubscriberRecord {
  std::string topic{};
  std::string type_name{};
  std::uint64_t fingerprint{};
  std::string policy{};

  friend bool operator==(const SubscriberRecord& a, const SubscriberRecord& b) {
    return a.topic == b.topic &&
           a.type_name == b.type_name &&
           a.fingerprint == b.fingerprint &&
           a.policy == b.policy;
  }
  friend bool operator!=(const SubscriberRecord& a, const SubscriberRecord& b) { return !(a == b); }
};
}  // namespace cortex::records
namespace cortex {
template <>
struct Codec<::cortex::records::SubscriberRecord> {
  static constexpr std::string_view name = "cortex/SubscriberRecord";
  static constexpr std::uint64_t fingerprint = 0x043EBF42C2F8DEA8u;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/SubscriberRecord\",\"fields\":[{\"name\":\"topic\",\"type\":\"str\",\"unit\":\"\",\"frame\""
      ":\"\"},{\"name\":\"type_name\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"fingerprint\",\"type\":\""
      "uint64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"policy\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"}]}";
  static constexpr std::size_t block = 32;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = false;
  static constexpr bool stamped = false;

  static std::int64_t stamp([[maybe_unused]] const ::cortex::records::SubscriberRecord& message) noexcept {
    return 0;
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::records::SubscriberRecord& out) {
    reader.text(at, out.topic);
    reader.text(at + 8, out.type_name);
    reader.scalar(at + 16, out.fingerprint);
    reader.text(at + 24, out.policy);
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::records::SubscriberRecord& message) {
    sink.text(at, message.topic);
    sink.text(at + 8, message.type_name);
    sink.scalar(at + 16, message.fingerprint);
    sink.text(at + 24, message.policy);
  }

  static void draft([[maybe_unused]] Placer& placer, [[maybe_unused]] ::cortex::records::SubscriberRecord& out) {
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_records_SubscriberRecord_043EBF42C2F8DEA8

#ifndef CORTEX_TYPE_cortex_records_ServiceRecord_18BD366EB5E510C7
#define CORTEX_TYPE_cortex_records_ServiceRecord_18BD366EB5E510C7
namespace cortex::records {
struct ServiceRecord {
  std::string name{};
  std::uint64_t service{};
  std::string request_schema{};
  std::string reply_schema{};

  friend bool operator==(const ServiceRecord& a, const ServiceRecord& b) {
    return a.name == b.name &&
           a.service == b.service &&
           a.request_schema == b.request_schema &&
           a.reply_schema == b.reply_schema;
  }
  friend bool operator!=(const ServiceRecord& a, const ServiceRecord& b) { return !(a == b); }
};
}  // namespace cortex::records
namespace cortex {
template <>
struct Codec<::cortex::records::ServiceRecord> {
  static constexpr std::string_view name = "cortex/ServiceRecord";
  static constexpr std::uint64_t fingerprint = 0x18BD366EB5E510C7u;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/ServiceRecord\",\"fields\":[{\"name\":\"name\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"}"
      ",{\"name\":\"service\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"request_schema\",\"type\":\""
      "str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"reply_schema\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"}]}";
  static constexpr std::size_t block = 32;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = false;
  static constexpr bool stamped = false;

  static std::int64_t stamp([[maybe_unused]] const ::cortex::records::ServiceRecord& message) noexcept {
    return 0;
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::records::ServiceRecord& out) {
    reader.text(at, out.name);
    reader.scalar(at + 8, out.service);
    reader.text(at + 16, out.request_schema);
    reader.text(at + 24, out.reply_schema);
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::records::ServiceRecord& message) {
    sink.text(at, message.name);
    sink.scalar(at + 8, message.service);
    sink.text(at + 16, message.request_schema);
    sink.text(at + 24, message.reply_schema);
  }

  static void draft([[maybe_unused]] Placer& placer, [[maybe_unused]] ::cortex::records::ServiceRecord& out) {
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_records_ServiceRecord_18BD366EB5E510C7

#ifndef CORTEX_TYPE_cortex_records_Endpoint_8267DDE36E38C23A
#define CORTEX_TYPE_cortex_records_Endpoint_8267DDE36E38C23A
namespace cortex::records {
struct Endpoint {
  std::string transport{};
  std::string lossy{};
  std::string strict{};
  std::string control{};
  std::string server_key{};

  friend bool operator==(const Endpoint& a, const Endpoint& b) {
    return a.transport == b.transport &&
           a.lossy == b.lossy &&
           a.strict == b.strict &&
           a.control == b.control &&
           a.server_key == b.server_key;
  }
  friend bool operator!=(const Endpoint& a, const Endpoint& b) { return !(a == b); }
};
}  // namespace cortex::records
namespace cortex {
template <>
struct Codec<::cortex::records::Endpoint> {
  static constexpr std::string_view name = "cortex/Endpoint";
  static constexpr std::uint64_t fingerprint = 0x8267DDE36E38C23Au;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/Endpoint\",\"fields\":[{\"name\":\"transport\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"}"
      ",{\"name\":\"lossy\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"strict\",\"type\":\"str\",\"unit\":\""
      "\",\"frame\":\"\"},{\"name\":\"control\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"server_key\",\"t"
      "ype\":\"str\",\"unit\":\"\",\"frame\":\"\"}]}";
  static constexpr std::size_t block = 40;
  static constexpr std::size_t alignment = 4;
  static constexpr bool fixed = false;
  static constexpr bool stamped = false;

  static std::int64_t stamp([[maybe_unused]] const ::cortex::records::Endpoint& message) noexcept {
    return 0;
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::records::Endpoint& out) {
    reader.text(at, out.transport);
    reader.text(at + 8, out.lossy);
    reader.text(at + 16, out.strict);
    reader.text(at + 24, out.control);
    reader.text(at + 32, out.server_key);
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::records::Endpoint& message) {
    sink.text(at, message.transport);
    sink.text(at + 8, message.lossy);
    sink.text(at + 16, message.strict);
    sink.text(at + 24, message.control);
    sink.text(at + 32, message.server_key);
  }

  static void draft([[maybe_unused]] Placer& placer, [[maybe_unused]] ::cortex::records::Endpoint& out) {
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_records_Endpoint_8267DDE36E38C23A

#ifndef CORTEX_TYPE_cortex_records_NodeRecord_160F2AA65676B96F
#define CORTEX_TYPE_cortex_records_NodeRecord_160F2AA65676B96F
namespace cortex::records {
struct NodeRecord {
  std::uint64_t node{};
  std::string name{};
  std::string host{};
  std::uint32_t pid{};
  std::uint64_t revision{};
  std::int64_t clock_offset_ns{};
  std::vector<::cortex::records::Endpoint> endpoints{};
  std::vector<::cortex::records::PublisherRecord> publishers{};
  std::vector<::cortex::records::SubscriberRecord> subscribers{};
  std::vector<::cortex::records::ServiceRecord> services{};

  friend bool operator==(const NodeRecord& a, const NodeRecord& b) {
    return a.node == b.node &&
           a.name == b.name &&
           a.host == b.host &&
           a.pid == b.pid &&
           a.revision == b.revision &&
           a.clock_offset_ns == b.clock_offset_ns &&
           a.endpoints == b.endpoints &&
           a.publishers == b.publishers &&
           a.subscribers == b.subscribers &&
           a.services == b.services;
  }
  friend bool operator!=(const NodeRecord& a, const NodeRecord& b) { return !(a == b); }
};
}  // namespace cortex::records
namespace cortex {
template <>
struct Codec<::cortex::records::NodeRecord> {
  static constexpr std::string_view name = "cortex/NodeRecord";
  static constexpr std::uint64_t fingerprint = 0x160F2AA65676B96Fu;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/NodeRecord\",\"fields\":[{\"name\":\"node\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"}"
      ",{\"name\":\"name\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"host\",\"type\":\"str\",\"unit\":\"\",\""
      "frame\":\"\"},{\"name\":\"pid\",\"type\":\"uint32\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"revision\",\"type\":\""
      "uint64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"clock_offset_ns\",\"type\":\"int64\",\"unit\":\"\",\"frame\":\""
      "\"},{\"name\":\"endpoints\",\"type\":{\"list\":{\"message\":{\"name\":\"cortex/Endpoint\",\"fields\":[{\"nam"
      "e\":\"transport\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"lossy\",\"type\":\"str\",\"unit\":\"\",\""
      "frame\":\"\"},{\"name\":\"strict\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"control\",\"type\":\"s"
      "tr\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"server_key\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"}]}}},\"uni"
      "t\":\"\",\"frame\":\"\"},{\"name\":\"publishers\",\"type\":{\"list\":{\"message\":{\"name\":\"cortex/Publisher"
      "Record\",\"fields\":[{\"name\":\"topic\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"source\",\"typ"
      "e\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"type_name\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{"
      "\"name\":\"fingerprint\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"schema\",\"type\":\"str\",\""
      "unit\":\"\",\"frame\":\"\"},{\"name\":\"latch\",\"type\":\"bool\",\"unit\":\"\",\"frame\":\"\"}]}}},\"unit\":\"\",\"fr"
      "ame\":\"\"},{\"name\":\"subscribers\",\"type\":{\"list\":{\"message\":{\"name\":\"cortex/SubscriberRecord\""
      ",\"fields\":[{\"name\":\"topic\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"type_name\",\"type\":\""
      "str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"fingerprint\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\"n"
      "ame\":\"policy\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"}]}}},\"unit\":\"\",\"frame\":\"\"},{\"name\":\"servic"
      "es\",\"type\":{\"list\":{\"message\":{\"name\":\"cortex/ServiceRecord\",\"fields\":[{\"name\":\"name\",\"typ"
      "e\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"service\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\"n"
      "ame\":\"request_schema\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"reply_schema\",\"type\":\"st"
      "r\",\"unit\":\"\",\"frame\":\"\"}]}}},\"unit\":\"\",\"frame\":\"\"}]}";
  static constexpr std::size_t block = 80;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = false;
  static constexpr bool stamped = false;

  static std::int64_t stamp([[maybe_unused]] const ::cortex::records::NodeRecord& message) noexcept {
    return 0;
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::records::NodeRecord& out) {
    reader.scalar(at, out.node);
    reader.text(at + 8, out.name);
    reader.text(at + 16, out.host);
    reader.scalar(at + 24, out.pid);
    reader.scalar(at + 32, out.revision);
    reader.scalar(at + 40, out.clock_offset_ns);
    {
      const auto list2 = reader.list(at + 48, 40);
      out.endpoints.clear();
      out.endpoints.reserve(list2.count);
      for (std::size_t k2 = 0; k2 < list2.count; ++k2) {
        ::cortex::records::Endpoint item2{};
        Codec<::cortex::records::Endpoint>::decode(reader, list2.at + k2 * 40, item2);
        out.endpoints.push_back(std::move(item2));
      }
    }
    {
      const auto list2 = reader.list(at + 56, 48);
      out.publishers.clear();
      out.publishers.reserve(list2.count);
      for (std::size_t k2 = 0; k2 < list2.count; ++k2) {
        ::cortex::records::PublisherRecord item2{};
        Codec<::cortex::records::PublisherRecord>::decode(reader, list2.at + k2 * 48, item2);
        out.publishers.push_back(std::move(item2));
      }
    }
    {
      const auto list2 = reader.list(at + 64, 32);
      out.subscribers.clear();
      out.subscribers.reserve(list2.count);
      for (std::size_t k2 = 0; k2 < list2.count; ++k2) {
        ::cortex::records::SubscriberRecord item2{};
        Codec<::cortex::records::SubscriberRecord>::decode(reader, list2.at + k2 * 32, item2);
        out.subscribers.push_back(std::move(item2));
      }
    }
    {
      const auto list2 = reader.list(at + 72, 32);
      out.services.clear();
      out.services.reserve(list2.count);
      for (std::size_t k2 = 0; k2 < list2.count; ++k2) {
        ::cortex::records::ServiceRecord item2{};
        Codec<::cortex::records::ServiceRecord>::decode(reader, list2.at + k2 * 32, item2);
        out.services.push_back(std::move(item2));
      }
    }
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::records::NodeRecord& message) {
    sink.scalar(at, message.node);
    sink.text(at + 8, message.name);
    sink.text(at + 16, message.host);
    sink.scalar(at + 24, message.pid);
    sink.zero(at + 28, 4);
    sink.scalar(at + 32, message.revision);
    sink.scalar(at + 40, message.clock_offset_ns);
    {
      const std::size_t start2 =
          sink.list(at + 48, message.endpoints.size(), 40, 8);
      for (std::size_t k2 = 0; k2 < message.endpoints.size(); ++k2) {
        const auto& item2 = message.endpoints[k2];
        Codec<::cortex::records::Endpoint>::encode(sink, start2 + k2 * 40, item2);
      }
    }
    {
      const std::size_t start2 =
          sink.list(at + 56, message.publishers.size(), 48, 8);
      for (std::size_t k2 = 0; k2 < message.publishers.size(); ++k2) {
        const auto& item2 = message.publishers[k2];
        Codec<::cortex::records::PublisherRecord>::encode(sink, start2 + k2 * 48, item2);
      }
    }
    {
      const std::size_t start2 =
          sink.list(at + 64, message.subscribers.size(), 32, 8);
      for (std::size_t k2 = 0; k2 < message.subscribers.size(); ++k2) {
        const auto& item2 = message.subscribers[k2];
        Codec<::cortex::records::SubscriberRecord>::encode(sink, start2 + k2 * 32, item2);
      }
    }
    {
      const std::size_t start2 =
          sink.list(at + 72, message.services.size(), 32, 8);
      for (std::size_t k2 = 0; k2 < message.services.size(); ++k2) {
        const auto& item2 = message.services[k2];
        Codec<::cortex::records::ServiceRecord>::encode(sink, start2 + k2 * 32, item2);
      }
    }
  }

  static void draft([[maybe_unused]] Placer& placer, [[maybe_unused]] ::cortex::records::NodeRecord& out) {
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_records_NodeRecord_160F2AA65676B96F

#ifndef CORTEX_TYPE_cortex_records_Hello_CD49403F4FE8A800
#define CORTEX_TYPE_cortex_records_Hello_CD49403F4FE8A800
namespace cortex::records {
struct Hello {
  bool snapshot{};
  ::cortex::records::NodeRecord record{};

  friend bool operator==(const Hello& a, const Hello& b) {
    return a.snapshot == b.snapshot &&
           a.record == b.record;
  }
  friend bool operator!=(const Hello& a, const Hello& b) { return !(a == b); }
};
}  // namespace cortex::records
namespace cortex {
template <>
struct Codec<::cortex::records::Hello> {
  static constexpr std::string_view name = "cortex/Hello";
  static constexpr std::uint64_t fingerprint = 0xCD49403F4FE8A800u;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/Hello\",\"fields\":[{\"name\":\"snapshot\",\"type\":\"bool\",\"unit\":\"\",\"frame\":\"\"},{\""
      "name\":\"record\",\"type\":{\"message\":{\"name\":\"cortex/NodeRecord\",\"fields\":[{\"name\":\"node\",\"typ"
      "e\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"name\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name"
      "\":\"host\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"pid\",\"type\":\"uint32\",\"unit\":\"\",\"frame"
      "\":\"\"},{\"name\":\"revision\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"clock_offset_ns\",\""
      "type\":\"int64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"endpoints\",\"type\":{\"list\":{\"message\":{\"name\":"
      "\"cortex/Endpoint\",\"fields\":[{\"name\":\"transport\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\""
      ":\"lossy\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"strict\",\"type\":\"str\",\"unit\":\"\",\"frame"
      "\":\"\"},{\"name\":\"control\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"server_key\",\"type\":\"st"
      "r\",\"unit\":\"\",\"frame\":\"\"}]}}},\"unit\":\"\",\"frame\":\"\"},{\"name\":\"publishers\",\"type\":{\"list\":{\"m"
      "essage\":{\"name\":\"cortex/PublisherRecord\",\"fields\":[{\"name\":\"topic\",\"type\":\"str\",\"unit\":\"\","
      "\"frame\":\"\"},{\"name\":\"source\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"type_name\",\"ty"
      "pe\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"fingerprint\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\""
      "},{\"name\":\"schema\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"latch\",\"type\":\"bool\",\"unit\""
      ":\"\",\"frame\":\"\"}]}}},\"unit\":\"\",\"frame\":\"\"},{\"name\":\"subscribers\",\"type\":{\"list\":{\"message\":"
      "{\"name\":\"cortex/SubscriberRecord\",\"fields\":[{\"name\":\"topic\",\"type\":\"str\",\"unit\":\"\",\"frame\""
      ":\"\"},{\"name\":\"type_name\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"fingerprint\",\"type\":\""
      "uint64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"policy\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"}]}}},\"uni"
      "t\":\"\",\"frame\":\"\"},{\"name\":\"services\",\"type\":{\"list\":{\"message\":{\"name\":\"cortex/ServiceReco"
      "rd\",\"fields\":[{\"name\":\"name\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"service\",\"type\":\""
      "uint64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"request_schema\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},"
      "{\"name\":\"reply_schema\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"}]}}},\"unit\":\"\",\"frame\":\"\"}]}},\"un"
      "it\":\"\",\"frame\":\"\"}]}";
  static constexpr std::size_t block = 88;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = false;
  static constexpr bool stamped = false;

  static std::int64_t stamp([[maybe_unused]] const ::cortex::records::Hello& message) noexcept {
    return 0;
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::records::Hello& out) {
    reader.scalar(at, out.snapshot);
    Codec<::cortex::records::NodeRecord>::decode(reader, at + 8, out.record);
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::records::Hello& message) {
    sink.scalar(at, message.snapshot);
    sink.zero(at + 1, 7);
    Codec<::cortex::records::NodeRecord>::encode(sink, at + 8, message.record);
  }

  static void draft([[maybe_unused]] Placer& placer, [[maybe_unused]] ::cortex::records::Hello& out) {
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_records_Hello_CD49403F4FE8A800

#ifndef CORTEX_TYPE_cortex_records_Heartbeat_6E77B88C97FF3F69
#define CORTEX_TYPE_cortex_records_Heartbeat_6E77B88C97FF3F69
namespace cortex::records {
struct Heartbeat {
  std::uint64_t node{};
  std::uint64_t revision{};
  std::uint64_t held{};

  friend bool operator==(const Heartbeat& a, const Heartbeat& b) {
    return a.node == b.node &&
           a.revision == b.revision &&
           a.held == b.held;
  }
  friend bool operator!=(const Heartbeat& a, const Heartbeat& b) { return !(a == b); }
};
}  // namespace cortex::records
namespace cortex {
template <>
struct Codec<::cortex::records::Heartbeat> {
  static constexpr std::string_view name = "cortex/Heartbeat";
  static constexpr std::uint64_t fingerprint = 0x6E77B88C97FF3F69u;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/Heartbeat\",\"fields\":[{\"name\":\"node\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},"
      "{\"name\":\"revision\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"held\",\"type\":\"uint64\",\"u"
      "nit\":\"\",\"frame\":\"\"}]}";
  static constexpr std::size_t block = 24;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = true;
  static constexpr bool stamped = false;

  static std::int64_t stamp([[maybe_unused]] const ::cortex::records::Heartbeat& message) noexcept {
    return 0;
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::records::Heartbeat& out) {
    reader.scalar(at, out.node);
    reader.scalar(at + 8, out.revision);
    reader.scalar(at + 16, out.held);
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::records::Heartbeat& message) {
    sink.scalar(at, message.node);
    sink.scalar(at + 8, message.revision);
    sink.scalar(at + 16, message.held);
  }

  static void draft([[maybe_unused]] Placer& placer, [[maybe_unused]] ::cortex::records::Heartbeat& out) {
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_records_Heartbeat_6E77B88C97FF3F69

#ifndef CORTEX_TYPE_cortex_records_Alive_E12CAE238D03B0A9
#define CORTEX_TYPE_cortex_records_Alive_E12CAE238D03B0A9
namespace cortex::records {
struct Alive {
  std::uint64_t epoch{};
  std::uint64_t version{};
  std::uint64_t held{};

  friend bool operator==(const Alive& a, const Alive& b) {
    return a.epoch == b.epoch &&
           a.version == b.version &&
           a.held == b.held;
  }
  friend bool operator!=(const Alive& a, const Alive& b) { return !(a == b); }
};
}  // namespace cortex::records
namespace cortex {
template <>
struct Codec<::cortex::records::Alive> {
  static constexpr std::string_view name = "cortex/Alive";
  static constexpr std::uint64_t fingerprint = 0xE12CAE238D03B0A9u;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/Alive\",\"fields\":[{\"name\":\"epoch\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\"n"
      "ame\":\"version\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"held\",\"type\":\"uint64\",\"unit\""
      ":\"\",\"frame\":\"\"}]}";
  static constexpr std::size_t block = 24;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = true;
  static constexpr bool stamped = false;

  static std::int64_t stamp([[maybe_unused]] const ::cortex::records::Alive& message) noexcept {
    return 0;
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::records::Alive& out) {
    reader.scalar(at, out.epoch);
    reader.scalar(at + 8, out.version);
    reader.scalar(at + 16, out.held);
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::records::Alive& message) {
    sink.scalar(at, message.epoch);
    sink.scalar(at + 8, message.version);
    sink.scalar(at + 16, message.held);
  }

  static void draft([[maybe_unused]] Placer& placer, [[maybe_unused]] ::cortex::records::Alive& out) {
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_records_Alive_E12CAE238D03B0A9

#ifndef CORTEX_TYPE_cortex_records_Welcome_AE5A87059E9FB282
#define CORTEX_TYPE_cortex_records_Welcome_AE5A87059E9FB282
namespace cortex::records {
struct Welcome {
  std::uint64_t epoch{};
  std::uint64_t version{};
  std::vector<std::uint64_t> nodes{};
  std::vector<std::uint64_t> revisions{};

  friend bool operator==(const Welcome& a, const Welcome& b) {
    return a.epoch == b.epoch &&
           a.version == b.version &&
           a.nodes == b.nodes &&
           a.revisions == b.revisions;
  }
  friend bool operator!=(const Welcome& a, const Welcome& b) { return !(a == b); }
};
}  // namespace cortex::records
namespace cortex {
template <>
struct Codec<::cortex::records::Welcome> {
  static constexpr std::string_view name = "cortex/Welcome";
  static constexpr std::uint64_t fingerprint = 0xAE5A87059E9FB282u;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/Welcome\",\"fields\":[{\"name\":\"epoch\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{"
      "\"name\":\"version\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"nodes\",\"type\":{\"list\":\"uin"
      "t64\"},\"unit\":\"\",\"frame\":\"\"},{\"name\":\"revisions\",\"type\":{\"list\":\"uint64\"},\"unit\":\"\",\"frame\""
      ":\"\"}]}";
  static constexpr std::size_t block = 32;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = false;
  static constexpr bool stamped = false;

  static std::int64_t stamp([[maybe_unused]] const ::cortex::records::Welcome& message) noexcept {
    return 0;
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::records::Welcome& out) {
    reader.scalar(at, out.epoch);
    reader.scalar(at + 8, out.version);
    {
      const auto list2 = reader.list(at + 16, 8);
      out.nodes.clear();
      out.nodes.reserve(list2.count);
      for (std::size_t k2 = 0; k2 < list2.count; ++k2) {
        std::uint64_t item2{};
        reader.scalar(list2.at + k2 * 8, item2);
        out.nodes.push_back(std::move(item2));
      }
    }
    {
      const auto list2 = reader.list(at + 24, 8);
      out.revisions.clear();
      out.revisions.reserve(list2.count);
      for (std::size_t k2 = 0; k2 < list2.count; ++k2) {
        std::uint64_t item2{};
        reader.scalar(list2.at + k2 * 8, item2);
        out.revisions.push_back(std::move(item2));
      }
    }
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::records::Welcome& message) {
    sink.scalar(at, message.epoch);
    sink.scalar(at + 8, message.version);
    {
      const std::size_t start2 =
          sink.list(at + 16, message.nodes.size(), 8, 8);
      for (std::size_t k2 = 0; k2 < message.nodes.size(); ++k2) {
        const auto& item2 = message.nodes[k2];
        sink.scalar(start2 + k2 * 8, item2);
      }
    }
    {
      const std::size_t start2 =
          sink.list(at + 24, message.revisions.size(), 8, 8);
      for (std::size_t k2 = 0; k2 < message.revisions.size(); ++k2) {
        const auto& item2 = message.revisions[k2];
        sink.scalar(start2 + k2 * 8, item2);
      }
    }
  }

  static void draft([[maybe_unused]] Placer& placer, [[maybe_unused]] ::cortex::records::Welcome& out) {
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_records_Welcome_AE5A87059E9FB282

#ifndef CORTEX_TYPE_cortex_records_Changed_012D73AA488329E9
#define CORTEX_TYPE_cortex_records_Changed_012D73AA488329E9
namespace cortex::records {
struct Changed {
  std::uint64_t version{};
  ::cortex::records::NodeRecord record{};

  friend bool operator==(const Changed& a, const Changed& b) {
    return a.version == b.version &&
           a.record == b.record;
  }
  friend bool operator!=(const Changed& a, const Changed& b) { return !(a == b); }
};
}  // namespace cortex::records
namespace cortex {
template <>
struct Codec<::cortex::records::Changed> {
  static constexpr std::string_view name = "cortex/Changed";
  static constexpr std::uint64_t fingerprint = 0x012D73AA488329E9u;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/Changed\",\"fields\":[{\"name\":\"version\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"}"
      ",{\"name\":\"record\",\"type\":{\"message\":{\"name\":\"cortex/NodeRecord\",\"fields\":[{\"name\":\"node\",\""
      "type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"name\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"n"
      "ame\":\"host\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"pid\",\"type\":\"uint32\",\"unit\":\"\",\"fr"
      "ame\":\"\"},{\"name\":\"revision\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"clock_offset_ns"
      "\",\"type\":\"int64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"endpoints\",\"type\":{\"list\":{\"message\":{\"nam"
      "e\":\"cortex/Endpoint\",\"fields\":[{\"name\":\"transport\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"na"
      "me\":\"lossy\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"strict\",\"type\":\"str\",\"unit\":\"\",\"fr"
      "ame\":\"\"},{\"name\":\"control\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"server_key\",\"type\":"
      "\"str\",\"unit\":\"\",\"frame\":\"\"}]}}},\"unit\":\"\",\"frame\":\"\"},{\"name\":\"publishers\",\"type\":{\"list\":"
      "{\"message\":{\"name\":\"cortex/PublisherRecord\",\"fields\":[{\"name\":\"topic\",\"type\":\"str\",\"unit\":"
      "\"\",\"frame\":\"\"},{\"name\":\"source\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"type_name\","
      "\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"fingerprint\",\"type\":\"uint64\",\"unit\":\"\",\"frame\""
      ":\"\"},{\"name\":\"schema\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"latch\",\"type\":\"bool\",\"un"
      "it\":\"\",\"frame\":\"\"}]}}},\"unit\":\"\",\"frame\":\"\"},{\"name\":\"subscribers\",\"type\":{\"list\":{\"messag"
      "e\":{\"name\":\"cortex/SubscriberRecord\",\"fields\":[{\"name\":\"topic\",\"type\":\"str\",\"unit\":\"\",\"fra"
      "me\":\"\"},{\"name\":\"type_name\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"fingerprint\",\"type"
      "\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"policy\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"}]}}},\""
      "unit\":\"\",\"frame\":\"\"},{\"name\":\"services\",\"type\":{\"list\":{\"message\":{\"name\":\"cortex/ServiceR"
      "ecord\",\"fields\":[{\"name\":\"name\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"service\",\"type"
      "\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"request_schema\",\"type\":\"str\",\"unit\":\"\",\"frame\":\""
      "\"},{\"name\":\"reply_schema\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"}]}}},\"unit\":\"\",\"frame\":\"\"}]}},"
      "\"unit\":\"\",\"frame\":\"\"}]}";
  static constexpr std::size_t block = 88;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = false;
  static constexpr bool stamped = false;

  static std::int64_t stamp([[maybe_unused]] const ::cortex::records::Changed& message) noexcept {
    return 0;
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::records::Changed& out) {
    reader.scalar(at, out.version);
    Codec<::cortex::records::NodeRecord>::decode(reader, at + 8, out.record);
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::records::Changed& message) {
    sink.scalar(at, message.version);
    Codec<::cortex::records::NodeRecord>::encode(sink, at + 8, message.record);
  }

  static void draft([[maybe_unused]] Placer& placer, [[maybe_unused]] ::cortex::records::Changed& out) {
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_records_Changed_012D73AA488329E9

#ifndef CORTEX_TYPE_cortex_records_Gone_074E402C07731173
#define CORTEX_TYPE_cortex_records_Gone_074E402C07731173
namespace cortex::records {
struct Gone {
  std::uint64_t version{};
  std::uint64_t node{};
  std::string reason{};

  friend bool operator==(const Gone& a, const Gone& b) {
    return a.version == b.version &&
           a.node == b.node &&
           a.reason == b.reason;
  }
  friend bool operator!=(const Gone& a, const Gone& b) { return !(a == b); }
};
}  // namespace cortex::records
namespace cortex {
template <>
struct Codec<::cortex::records::Gone> {
  static constexpr std::string_view name = "cortex/Gone";
  static constexpr std::uint64_t fingerprint = 0x074E402C07731173u;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/Gone\",\"fields\":[{\"name\":\"version\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\""
      "name\":\"node\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"reason\",\"type\":\"str\",\"unit\":\"\""
      ",\"frame\":\"\"}]}";
  static constexpr std::size_t block = 24;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = false;
  static constexpr bool stamped = false;

  static std::int64_t stamp([[maybe_unused]] const ::cortex::records::Gone& message) noexcept {
    return 0;
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::records::Gone& out) {
    reader.scalar(at, out.version);
    reader.scalar(at + 8, out.node);
    reader.text(at + 16, out.reason);
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::records::Gone& message) {
    sink.scalar(at, message.version);
    sink.scalar(at + 8, message.node);
    sink.text(at + 16, message.reason);
  }

  static void draft([[maybe_unused]] Placer& placer, [[maybe_unused]] ::cortex::records::Gone& out) {
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_records_Gone_074E402C07731173

#ifndef CORTEX_TYPE_cortex_records_Refused_2EBC61F34974CAB1
#define CORTEX_TYPE_cortex_records_Refused_2EBC61F34974CAB1
namespace cortex::records {
struct Refused {
  std::uint64_t node{};
  std::string reason{};

  friend bool operator==(const Refused& a, const Refused& b) {
    return a.node == b.node &&
           a.reason == b.reason;
  }
  friend bool operator!=(const Refused& a, const Refused& b) { return !(a == b); }
};
}  // namespace cortex::records
namespace cortex {
template <>
struct Codec<::cortex::records::Refused> {
  static constexpr std::string_view name = "cortex/Refused";
  static constexpr std::uint64_t fingerprint = 0x2EBC61F34974CAB1u;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/Refused\",\"fields\":[{\"name\":\"node\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\""
      "name\":\"reason\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"}]}";
  static constexpr std::size_t block = 16;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = false;
  static constexpr bool stamped = false;

  static std::int64_t stamp([[maybe_unused]] const ::cortex::records::Refused& message) noexcept {
    return 0;
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::records::Refused& out) {
    reader.scalar(at, out.node);
    reader.text(at + 8, out.reason);
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::records::Refused& message) {
    sink.scalar(at, message.node);
    sink.text(at + 8, message.reason);
  }

  static void draft([[maybe_unused]] Placer& placer, [[maybe_unused]] ::cortex::records::Refused& out) {
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_records_Refused_2EBC61F34974CAB1

#ifndef CORTEX_TYPE_cortex_records_Leave_247A62B82028F735
#define CORTEX_TYPE_cortex_records_Leave_247A62B82028F735
namespace cortex::records {
struct Leave {
  std::uint64_t node{};

  friend bool operator==(const Leave& a, const Leave& b) {
    return a.node == b.node;
  }
  friend bool operator!=(const Leave& a, const Leave& b) { return !(a == b); }
};
}  // namespace cortex::records
namespace cortex {
template <>
struct Codec<::cortex::records::Leave> {
  static constexpr std::string_view name = "cortex/Leave";
  static constexpr std::uint64_t fingerprint = 0x247A62B82028F735u;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/Leave\",\"fields\":[{\"name\":\"node\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"}]}";
  static constexpr std::size_t block = 8;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = true;
  static constexpr bool stamped = false;

  static std::int64_t stamp([[maybe_unused]] const ::cortex::records::Leave& message) noexcept {
    return 0;
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::records::Leave& out) {
    reader.scalar(at, out.node);
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::records::Leave& message) {
    sink.scalar(at, message.node);
  }

  static void draft([[maybe_unused]] Placer& placer, [[maybe_unused]] ::cortex::records::Leave& out) {
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_records_Leave_247A62B82028F735

#ifndef CORTEX_TYPE_cortex_records_Describe_537860DF9555C7D3
#define CORTEX_TYPE_cortex_records_Describe_537860DF9555C7D3
namespace cortex::records {
struct Describe {
  std::uint64_t node{};

  friend bool operator==(const Describe& a, const Describe& b) {
    return a.node == b.node;
  }
  friend bool operator!=(const Describe& a, const Describe& b) { return !(a == b); }
};
}  // namespace cortex::records
namespace cortex {
template <>
struct Codec<::cortex::records::Describe> {
  static constexpr std::string_view name = "cortex/Describe";
  static constexpr std::uint64_t fingerprint = 0x537860DF9555C7D3u;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/Describe\",\"fields\":[{\"name\":\"node\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"}]}";
  static constexpr std::size_t block = 8;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = true;
  static constexpr bool stamped = false;

  static std::int64_t stamp([[maybe_unused]] const ::cortex::records::Describe& message) noexcept {
    return 0;
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::records::Describe& out) {
    reader.scalar(at, out.node);
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::records::Describe& message) {
    sink.scalar(at, message.node);
  }

  static void draft([[maybe_unused]] Placer& placer, [[maybe_unused]] ::cortex::records::Describe& out) {
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_records_Describe_537860DF9555C7D3

#ifndef CORTEX_TYPE_cortex_records_PublisherStats_0899BB0BD9F71E2F
#define CORTEX_TYPE_cortex_records_PublisherStats_0899BB0BD9F71E2F
namespace cortex::records {
struct PublisherStats {
  std::string topic{};
  std::uint64_t source{};
  std::uint32_t subscribers{};
  std::uint64_t published{};
  std::uint64_t bytes{};
  std::uint64_t timeouts{};
  std::uint64_t skipped{};

  friend bool operator==(const PublisherStats& a, const PublisherStats& b) {
    return a.topic == b.topic &&
           a.source == b.source &&
           a.subscribers == b.subscribers &&
           a.published == b.published &&
           a.bytes == b.bytes &&
           a.timeouts == b.timeouts &&
           a.skipped == b.skipped;
  }
  friend bool operator!=(const PublisherStats& a, const PublisherStats& b) { return !(a == b); }
};
}  // namespace cortex::records
namespace cortex {
template <>
struct Codec<::cortex::records::PublisherStats> {
  static constexpr std::string_view name = "cortex/PublisherStats";
  static constexpr std::uint64_t fingerprint = 0x0899BB0BD9F71E2Fu;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/PublisherStats\",\"fields\":[{\"name\":\"topic\",\"type\":\"str\",\"unit\":\"\",\"frame\":\""
      "\"},{\"name\":\"source\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"subscribers\",\"type\":\"ui"
      "nt32\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"published\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\"na"
      "me\":\"bytes\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"timeouts\",\"type\":\"uint64\",\"unit"
      "\":\"\",\"frame\":\"\"},{\"name\":\"skipped\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"}]}";
  static constexpr std::size_t block = 56;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = false;
  static constexpr bool stamped = false;

  static std::int64_t stamp([[maybe_unused]] const ::cortex::records::PublisherStats& message) noexcept {
    return 0;
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::records::PublisherStats& out) {
    reader.text(at, out.topic);
    reader.scalar(at + 8, out.source);
    reader.scalar(at + 16, out.subscribers);
    reader.scalar(at + 24, out.published);
    reader.scalar(at + 32, out.bytes);
    reader.scalar(at + 40, out.timeouts);
    reader.scalar(at + 48, out.skipped);
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::records::PublisherStats& message) {
    sink.text(at, message.topic);
    sink.scalar(at + 8, message.source);
    sink.scalar(at + 16, message.subscribers);
    sink.zero(at + 20, 4);
    sink.scalar(at + 24, message.published);
    sink.scalar(at + 32, message.bytes);
    sink.scalar(at + 40, message.timeouts);
    sink.scalar(at + 48, message.skipped);
  }

  static void draft([[maybe_unused]] Placer& placer, [[maybe_unused]] ::cortex::records::PublisherStats& out) {
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_records_PublisherStats_0899BB0BD9F71E2F

#ifndef CORTEX_TYPE_cortex_records_SubscriberStats_A8519EF575ADAF58
#define CORTEX_TYPE_cortex_records_SubscriberStats_A8519EF575ADAF58
namespace cortex::records {
struct SubscriberStats {
  std::string topic{};
  std::string policy{};
  std::uint64_t received{};
  std::uint64_t lost{};
  std::uint64_t rejected{};
  std::uint64_t overtaken{};
  std::array<std::uint64_t, 40> latency_counts{};  // [40]

  friend bool operator==(const SubscriberStats& a, const SubscriberStats& b) {
    return a.topic == b.topic &&
           a.policy == b.policy &&
           a.received == b.received &&
           a.lost == b.lost &&
           a.rejected == b.rejected &&
           a.overtaken == b.overtaken &&
           a.latency_counts == b.latency_counts;
  }
  friend bool operator!=(const SubscriberStats& a, const SubscriberStats& b) { return !(a == b); }
};
}  // namespace cortex::records
namespace cortex {
template <>
struct Codec<::cortex::records::SubscriberStats> {
  static constexpr std::string_view name = "cortex/SubscriberStats";
  static constexpr std::uint64_t fingerprint = 0xA8519EF575ADAF58u;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/SubscriberStats\",\"fields\":[{\"name\":\"topic\",\"type\":\"str\",\"unit\":\"\",\"frame\":"
      "\"\"},{\"name\":\"policy\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"received\",\"type\":\"uint64\""
      ",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"lost\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"rejec"
      "ted\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"overtaken\",\"type\":\"uint64\",\"unit\":\"\",\""
      "frame\":\"\"},{\"name\":\"latency_counts\",\"type\":{\"array\":\"uint64\",\"shape\":[40]},\"unit\":\"\",\"fram"
      "e\":\"\"}]}";
  static constexpr std::size_t block = 368;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = false;
  static constexpr bool stamped = false;

  static std::int64_t stamp([[maybe_unused]] const ::cortex::records::SubscriberStats& message) noexcept {
    return 0;
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::records::SubscriberStats& out) {
    reader.text(at, out.topic);
    reader.text(at + 8, out.policy);
    reader.scalar(at + 16, out.received);
    reader.scalar(at + 24, out.lost);
    reader.scalar(at + 32, out.rejected);
    reader.scalar(at + 40, out.overtaken);
    reader.fixed(at + 48, out.latency_counts);
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::records::SubscriberStats& message) {
    sink.text(at, message.topic);
    sink.text(at + 8, message.policy);
    sink.scalar(at + 16, message.received);
    sink.scalar(at + 24, message.lost);
    sink.scalar(at + 32, message.rejected);
    sink.scalar(at + 40, message.overtaken);
    sink.fixed(at + 48, message.latency_counts);
  }

  static void draft([[maybe_unused]] Placer& placer, [[maybe_unused]] ::cortex::records::SubscriberStats& out) {
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_records_SubscriberStats_A8519EF575ADAF58

#ifndef CORTEX_TYPE_cortex_records_StatsRequest_B1663887C9E13501
#define CORTEX_TYPE_cortex_records_StatsRequest_B1663887C9E13501
namespace cortex::records {
struct StatsRequest {
  std::uint64_t node{};

  friend bool operator==(const StatsRequest& a, const StatsRequest& b) {
    return a.node == b.node;
  }
  friend bool operator!=(const StatsRequest& a, const StatsRequest& b) { return !(a == b); }
};
}  // namespace cortex::records
namespace cortex {
template <>
struct Codec<::cortex::records::StatsRequest> {
  static constexpr std::string_view name = "cortex/StatsRequest";
  static constexpr std::uint64_t fingerprint = 0xB1663887C9E13501u;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/StatsRequest\",\"fields\":[{\"name\":\"node\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\""
      "\"}]}";
  static constexpr std::size_t block = 8;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = true;
  static constexpr bool stamped = false;

  static std::int64_t stamp([[maybe_unused]] const ::cortex::records::StatsRequest& message) noexcept {
    return 0;
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::records::StatsRequest& out) {
    reader.scalar(at, out.node);
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::records::StatsRequest& message) {
    sink.scalar(at, message.node);
  }

  static void draft([[maybe_unused]] Placer& placer, [[maybe_unused]] ::cortex::records::StatsRequest& out) {
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_records_StatsRequest_B1663887C9E13501

#ifndef CORTEX_TYPE_cortex_records_StatsReply_F9AA9BF018F14876
#define CORTEX_TYPE_cortex_records_StatsReply_F9AA9BF018F14876
namespace cortex::records {
struct StatsReply {
  std::uint64_t node{};
  std::vector<::cortex::records::PublisherStats> publishers{};
  std::vector<::cortex::records::SubscriberStats> subscribers{};
  std::uint64_t rejected{};

  friend bool operator==(const StatsReply& a, const StatsReply& b) {
    return a.node == b.node &&
           a.publishers == b.publishers &&
           a.subscribers == b.subscribers &&
           a.rejected == b.rejected;
  }
  friend bool operator!=(const StatsReply& a, const StatsReply& b) { return !(a == b); }
};
}  // namespace cortex::records
namespace cortex {
template <>
struct Codec<::cortex::records::StatsReply> {
  static constexpr std::string_view name = "cortex/StatsReply";
  static constexpr std::uint64_t fingerprint = 0xF9AA9BF018F14876u;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/StatsReply\",\"fields\":[{\"name\":\"node\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"}"
      ",{\"name\":\"publishers\",\"type\":{\"list\":{\"message\":{\"name\":\"cortex/PublisherStats\",\"fields\":["
      "{\"name\":\"topic\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"source\",\"type\":\"uint64\",\"unit\""
      ":\"\",\"frame\":\"\"},{\"name\":\"subscribers\",\"type\":\"uint32\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"publi"
      "shed\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"bytes\",\"type\":\"uint64\",\"unit\":\"\",\"fra"
      "me\":\"\"},{\"name\":\"timeouts\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"skipped\",\"type\":"
      "\"uint64\",\"unit\":\"\",\"frame\":\"\"}]}}},\"unit\":\"\",\"frame\":\"\"},{\"name\":\"subscribers\",\"type\":{\"li"
      "st\":{\"message\":{\"name\":\"cortex/SubscriberStats\",\"fields\":[{\"name\":\"topic\",\"type\":\"str\",\"un"
      "it\":\"\",\"frame\":\"\"},{\"name\":\"policy\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"received\","
      "\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"lost\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"}"
      ",{\"name\":\"rejected\",\"type\":\"uint64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"overtaken\",\"type\":\"uint"
      "64\",\"unit\":\"\",\"frame\":\"\"},{\"name\":\"latency_counts\",\"type\":{\"array\":\"uint64\",\"shape\":[40]},"
      "\"unit\":\"\",\"frame\":\"\"}]}}},\"unit\":\"\",\"frame\":\"\"},{\"name\":\"rejected\",\"type\":\"uint64\",\"unit\":"
      "\"\",\"frame\":\"\"}]}";
  static constexpr std::size_t block = 32;
  static constexpr std::size_t alignment = 8;
  static constexpr bool fixed = false;
  static constexpr bool stamped = false;

  static std::int64_t stamp([[maybe_unused]] const ::cortex::records::StatsReply& message) noexcept {
    return 0;
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::records::StatsReply& out) {
    reader.scalar(at, out.node);
    {
      const auto list2 = reader.list(at + 8, 56);
      out.publishers.clear();
      out.publishers.reserve(list2.count);
      for (std::size_t k2 = 0; k2 < list2.count; ++k2) {
        ::cortex::records::PublisherStats item2{};
        Codec<::cortex::records::PublisherStats>::decode(reader, list2.at + k2 * 56, item2);
        out.publishers.push_back(std::move(item2));
      }
    }
    {
      const auto list2 = reader.list(at + 16, 368);
      out.subscribers.clear();
      out.subscribers.reserve(list2.count);
      for (std::size_t k2 = 0; k2 < list2.count; ++k2) {
        ::cortex::records::SubscriberStats item2{};
        Codec<::cortex::records::SubscriberStats>::decode(reader, list2.at + k2 * 368, item2);
        out.subscribers.push_back(std::move(item2));
      }
    }
    reader.scalar(at + 24, out.rejected);
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::records::StatsReply& message) {
    sink.scalar(at, message.node);
    {
      const std::size_t start2 =
          sink.list(at + 8, message.publishers.size(), 56, 8);
      for (std::size_t k2 = 0; k2 < message.publishers.size(); ++k2) {
        const auto& item2 = message.publishers[k2];
        Codec<::cortex::records::PublisherStats>::encode(sink, start2 + k2 * 56, item2);
      }
    }
    {
      const std::size_t start2 =
          sink.list(at + 16, message.subscribers.size(), 368, 8);
      for (std::size_t k2 = 0; k2 < message.subscribers.size(); ++k2) {
        const auto& item2 = message.subscribers[k2];
        Codec<::cortex::records::SubscriberStats>::encode(sink, start2 + k2 * 368, item2);
      }
    }
    sink.scalar(at + 24, message.rejected);
  }

  static void draft([[maybe_unused]] Placer& placer, [[maybe_unused]] ::cortex::records::StatsReply& out) {
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_records_StatsReply_F9AA9BF018F14876

#ifndef CORTEX_TYPE_cortex_records_ServiceError_840B7D30A27B7EE1
#define CORTEX_TYPE_cortex_records_ServiceError_840B7D30A27B7EE1
namespace cortex::records {
struct ServiceError {
  std::string kind{};
  std::string text{};

  friend bool operator==(const ServiceError& a, const ServiceError& b) {
    return a.kind == b.kind &&
           a.text == b.text;
  }
  friend bool operator!=(const ServiceError& a, const ServiceError& b) { return !(a == b); }
};
}  // namespace cortex::records
namespace cortex {
template <>
struct Codec<::cortex::records::ServiceError> {
  static constexpr std::string_view name = "cortex/ServiceError";
  static constexpr std::uint64_t fingerprint = 0x840B7D30A27B7EE1u;
  static constexpr std::string_view schema =
      "{\"name\":\"cortex/ServiceError\",\"fields\":[{\"name\":\"kind\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"},"
      "{\"name\":\"text\",\"type\":\"str\",\"unit\":\"\",\"frame\":\"\"}]}";
  static constexpr std::size_t block = 16;
  static constexpr std::size_t alignment = 4;
  static constexpr bool fixed = false;
  static constexpr bool stamped = false;

  static std::int64_t stamp([[maybe_unused]] const ::cortex::records::ServiceError& message) noexcept {
    return 0;
  }

  static void decode(Reader& reader, std::size_t at, ::cortex::records::ServiceError& out) {
    reader.text(at, out.kind);
    reader.text(at + 8, out.text);
  }

  template <class Sink>
  static void encode(Sink& sink, std::size_t at, const ::cortex::records::ServiceError& message) {
    sink.text(at, message.kind);
    sink.text(at + 8, message.text);
  }

  static void draft([[maybe_unused]] Placer& placer, [[maybe_unused]] ::cortex::records::ServiceError& out) {
  }
};
}  // namespace cortex
#endif  // CORTEX_TYPE_cortex_records_ServiceError_840B7D30A27B7EE1
