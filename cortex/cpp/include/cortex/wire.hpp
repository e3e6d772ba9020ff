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
constexpr std::size_t key_size = 32;     // of an attach key, or a resume key
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

// What a reader subscribes to, as it lies in a subscription: kind A with options to attach; kind R, which is given up at once, to say
// that all below a sequence is accounted for.
struct Key {
  static constexpr std::uint64_t shared_memory = 1, strict = 2;

  Key() = default;
  Key(char letter, std::uint8_t bits, std::uint64_t from, std::uint64_t number, std::uint64_t rest) noexcept
      : kind(letter), flags(bits), source(from), reader(number), last(rest) {}
  bool has(std::uint64_t option) const noexcept { return (last & option) != 0; }
  std::uint32_t timeout_ms() const noexcept { return static_cast<std::uint32_t>(last >> 32); }
  std::string bytes() const { return {reinterpret_cast<const char*>(this), key_size}; }

  char magic[3] = {'C', 'T', 'X'};
  char kind = 0;
  std::uint8_t version = wire::version;
  std::uint8_t flags = 0;
  std::uint16_t size = header_size;
  std::uint64_t source = 0;
  std::uint64_t reader = 0;
  std::uint64_t last = 0;  // options, or the sequence
};
static_assert(sizeof(Key) == key_size, "a key has 32 bytes");

// The key that was subscribed; of kind 0 if it was something else.
inline Key read_key(Span<const std::uint8_t> bytes) noexcept {
  Key key;
  if (bytes.size() == key_size && std::memcmp(bytes.data(), key.magic, sizeof key.magic) == 0) std::memcpy(&key, bytes.data(), key_size);
  return key;
}

struct AttachAnswer {
  std::uint64_t sequence = 0;
  Span<const std::uint8_t> latched;
};

inline std::string pack_answer(const std::string& key, const AttachAnswer& answer) {
  std::string frame(header_size, '\0');
  std::memcpy(frame.data(), key.data(), key_size);
  auto* out = reinterpret_cast<std::uint8_t*>(frame.data()) + key_size;
  store(out, answer.sequence);
  store(out + 8, std::uint64_t{1});
  store(out + 16, static_cast<std::uint64_t>(answer.latched.size()));
  frame.append(reinterpret_cast<const char*>(answer.latched.data()), answer.latched.size());
  return frame;
}

inline AttachAnswer read_answer(Span<const std::uint8_t> frame) {
  if (frame.size() < header_size) throw MalformedMessage("an attach answer is too short");
  const std::uint8_t* at = frame.data() + key_size;
  AttachAnswer answer;
  answer.sequence = load<std::uint64_t>(at);
  const auto latched = load<std::uint64_t>(at + 16);
  if (latched > body_limit + header_size || frame.size() != header_size + latched) {
    throw MalformedMessage("an attach answer cannot hold its latched message");
  }
  answer.latched = {at + 32, static_cast<std::size_t>(latched)};
  return answer;
}

}  // namespace wire
}  // namespace cortex
