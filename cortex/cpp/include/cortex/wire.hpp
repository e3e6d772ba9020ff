// SPDX-License-Identifier: Apache-2.0
// The frames of WIRE.md: header, kinds, attaching. Everything is little-endian.
#pragma once

#include <cstddef>
#include <cstdint>
#include <cstring>
#include <stdexcept>
#include <string>
#include <vector>

#include "cortex/array.hpp"

#if defined(__BYTE_ORDER__) && __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "cortex reads and writes little-endian memory in place: big-endian machines are not supported"
#endif

namespace cortex {

// Bytes that are not what they claim to be. Receivers count it and go on.
class MalformedMessage : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

namespace wire {

constexpr std::uint8_t version = 1;
constexpr std::size_t header_size = 64;
constexpr std::size_t prefix_size = 16;  // of a header: what a ZeroMQ subscription matches
constexpr std::size_t key_size = 32;     // of an attach key
constexpr std::size_t resume_size = 32;  // of a resume key
constexpr std::uint64_t jump_max = std::uint64_t{1} << 32;  // no source loses more messages at once
constexpr std::uint8_t flag_stamp = 1;
constexpr std::uint64_t last = 1;  // `aux` of a frame of kind N: nothing follows, the stream ends here
constexpr std::uint64_t body_limit = std::uint64_t{1} << 30;
constexpr std::uint64_t control_limit = 16u << 20;

template <class T>
T load(const std::uint8_t* from) noexcept {
  T value;
  std::memcpy(&value, from, sizeof value);
  return value;
}

template <class T>
void store(std::uint8_t* to, T value) noexcept {
  std::memcpy(to, &value, sizeof value);
}

constexpr std::uint64_t round_up(std::uint64_t value, std::uint64_t alignment) noexcept {
  return (value + alignment - 1) / alignment * alignment;
}

// As it lies in a frame.
struct Header {
  Header() = default;
  Header(char letter, std::uint8_t bits, std::uint64_t from, std::uint64_t type, std::uint64_t number, std::int64_t stamp,
         std::int64_t published, std::uint64_t body, std::uint64_t other) noexcept
      : kind(letter), flags(bits), source(from), fingerprint(type), sequence(number), stamp_ns(stamp), publish_ns(published),
        body_size(body), aux(other) {}

  char magic[3] = {'C', 'T', 'X'};
  char kind = 'M';
  std::uint8_t version = wire::version;
  std::uint8_t flags = 0;
  std::uint16_t size = header_size;
  std::uint64_t source = 0;
  std::uint64_t fingerprint = 0;
  std::uint64_t sequence = 0;
  std::int64_t stamp_ns = 0;  // meaningful if flags has flag_stamp
  std::int64_t publish_ns = 0;
  std::uint64_t body_size = 0;
  std::uint64_t aux = 0;
};
static_assert(sizeof(Header) == header_size && offsetof(Header, source) == 8, "a header has 64 bytes");

inline void write_header(std::uint8_t* out, const Header& header) noexcept { std::memcpy(out, &header, header_size); }

inline void write_prefix(std::uint8_t* out, char kind, std::uint8_t flags, std::uint64_t source) noexcept {
  const Header header(kind, flags, source, 0, 0, 0, 0, 0, 0);
  std::memcpy(out, &header, prefix_size);
}

inline Header read_header(Span<const std::uint8_t> frame) {
  if (frame.size() < header_size) {
    throw MalformedMessage("a frame of " + std::to_string(frame.size()) + " bytes is shorter than a header of 64");
  }
  Header header;
  std::memcpy(&header, frame.data(), header_size);
  if (std::memcmp(header.magic, "CTX", 3) != 0 || header.version != version || (header.flags & ~flag_stamp) != 0 ||
      header.size != header_size) {
    throw MalformedMessage("not a frame of Cortex 1: wrong magic, version, flags or header length");
  }
  return header;
}

// A single frame holds exactly its header and its body, and no more than the limit.
inline Span<const std::uint8_t> body_of(const Header& header, Span<const std::uint8_t> frame, std::uint64_t limit) {
  if (header.body_size > limit || header.body_size != frame.size() - header_size) {
    throw MalformedMessage("a frame of " + std::to_string(frame.size()) + " bytes says that its body has " +
                           std::to_string(header.body_size) + " (limit " + std::to_string(limit) + ")");
  }
  return {frame.data() + header_size, static_cast<std::size_t>(header.body_size)};
}

// What a reader asks for when it attaches to a publisher.
struct AttachKey {
  std::uint64_t source = 0;
  std::uint64_t reader = 0;
  bool shared_memory = false;
  bool strict = false;
  std::uint8_t quota = 0;
  std::uint32_t timeout_ms = 0;
  bool confirms = false;  // it says how far it has read, when it is told how many messages there have been
  bool confirms_end = false;  // it says so of the answer, too, and of the end of the stream
};

inline std::string pack_key(const AttachKey& key, std::uint8_t flags) {
  std::string bytes(key_size, '\0');
  auto* out = reinterpret_cast<std::uint8_t*>(bytes.data());
  write_prefix(out, 'A', flags, key.source);
  store(out + 16, key.reader);
  store(out + 24, static_cast<std::uint64_t>(key.shared_memory ? 1 : 0) | (key.strict ? 2u : 0u) | (key.confirms ? 4u : 0u) |
                      (key.confirms_end ? 8u : 0u) | static_cast<std::uint64_t>(key.quota) << 8 | static_cast<std::uint64_t>(key.timeout_ms) << 32);
  return bytes;
}

// What a reliable reader subscribes to, and at once gives up: it has accounted for all below a sequence.
inline std::string pack_resume(std::uint64_t source, std::uint64_t reader, std::uint64_t sequence,
                               std::uint8_t flags) {
  std::string bytes(resume_size, '\0');
  auto* out = reinterpret_cast<std::uint8_t*>(bytes.data());
  write_prefix(out, 'R', flags, source);
  store(out + 16, reader);
  store(out + 24, sequence);
  return bytes;
}

// The source, reader and sequence of a resume key; a source of 0 if the subscription is something else.
inline std::uint64_t read_resume(Span<const std::uint8_t> bytes, std::uint64_t& reader,
                                 std::uint64_t& sequence) noexcept {
  if (bytes.size() != resume_size || std::memcmp(bytes.data(), "CTXR", 4) != 0) return 0;
  reader = load<std::uint64_t>(bytes.data() + 16);
  sequence = load<std::uint64_t>(bytes.data() + 24);
  return load<std::uint64_t>(bytes.data() + 8);
}

// True and the key, if the subscription is one.
inline bool read_key(Span<const std::uint8_t> bytes, AttachKey& key) noexcept {
  if (bytes.size() != key_size || std::memcmp(bytes.data(), "CTXA", 4) != 0) return false;
  const auto options = load<std::uint64_t>(bytes.data() + 24);
  key.source = load<std::uint64_t>(bytes.data() + 8);
  key.reader = load<std::uint64_t>(bytes.data() + 16);
  key.shared_memory = (options & 1) != 0;
  key.strict = (options & 2) != 0;
  key.confirms = (options & 4) != 0;
  key.confirms_end = (options & 8) != 0;
  key.quota = static_cast<std::uint8_t>(options >> 8);
  key.timeout_ms = static_cast<std::uint32_t>(options >> 32);
  return true;
}

struct AttachAnswer {
  std::uint64_t sequence = 0;
  Span<const std::uint8_t> latched;
  bool marks_end = true;  // it will say when the stream ends; older versions did not
};

inline std::string pack_answer(const std::string& key, const AttachAnswer& answer) {
  std::string frame(header_size, '\0');
  std::memcpy(frame.data(), key.data(), key_size);
  auto* out = reinterpret_cast<std::uint8_t*>(frame.data()) + key_size;
  store(out, answer.sequence);
  store(out + 8, static_cast<std::uint64_t>(answer.marks_end ? 1 : 0));
  store(out + 16, static_cast<std::uint64_t>(answer.latched.size()));
  frame.append(reinterpret_cast<const char*>(answer.latched.data()), answer.latched.size());
  return frame;
}

inline AttachAnswer read_answer(Span<const std::uint8_t> frame) {
  if (frame.size() < header_size) throw MalformedMessage("an attach answer is too short");
  const std::uint8_t* at = frame.data() + key_size;
  AttachAnswer answer;
  answer.sequence = load<std::uint64_t>(at);
  answer.marks_end = (load<std::uint64_t>(at + 8) & 1) != 0;
  const auto latched = load<std::uint64_t>(at + 16);
  if (latched > body_limit + header_size || frame.size() != header_size + latched) {
    throw MalformedMessage("an attach answer cannot hold its latched message");
  }
  answer.latched = {at + 32, static_cast<std::size_t>(latched)};
  return answer;
}

}  // namespace wire
}  // namespace cortex
