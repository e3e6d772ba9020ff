// SPDX-License-Identifier: Apache-2.0
// Reads bodies from standard input, one a line: type, "good" or "bad", hexadecimal, of a bad one perhaps the field that
// is. A good body must decode and encode to the same bytes, a bad one must be rejected. Then good bodies are damaged at random, argv[1] times each: whatever
// comes must be rejected or decode to a message that encodes, decodes and compares equal.
#include <cstdint>
#include <cstdlib>
#include <iostream>
#include <random>
#include <sstream>
#include <string>
#include <vector>

#include <cortex/codec.hpp>

#include "vectors.hpp"

namespace {

using Bytes = std::vector<std::uint8_t>;

Bytes from_hex(const std::string& text) {
  Bytes bytes;
  for (std::size_t at = 0; at + 1 < text.size(); at += 2) {
    bytes.push_back(static_cast<std::uint8_t>(std::stoi(text.substr(at, 2), nullptr, 16)));
  }
  return bytes;
}

volatile int looked_at = 0;
std::string rejected;  // why the last one was

// The body from memory of exactly its size, at an odd address: sanitizers see a byte read beyond it.
template <class T>
bool round_trip(const Bytes& body, std::size_t shift, Bytes& again) {
  Bytes moved(body.size() + shift);
  std::copy(body.begin(), body.end(), moved.begin() + static_cast<std::ptrdiff_t>(shift));
  try {
    const T message = cortex::decode<T>({moved.data() + shift, body.size()});
    const T copy = message;
    looked_at = looked_at + (message == copy ? 1 : 0);  // reads every item where it lies
    again = cortex::encode(copy);
    return true;
  } catch (const cortex::MalformedMessage& error) {
    rejected = error.what();
    return false;
  }
}

template <class T>
int check(bool good, const Bytes& body, const std::string& field) {
  int failures = 0;
  for (const std::size_t shift : {0, 1, 4}) {
    Bytes again;
    const bool read = round_trip<T>(body, shift, again);
    const std::string where = std::string(cortex::Codec<T>::name) + (field.empty() ? "" : "." + field + ": ");
    if (!read && rejected.rfind(where, 0) != 0) {
      std::cerr << rejected << ": should begin with " << where << "\n";
      ++failures;
    }
    if (read != good || (good && again != body)) {
      std::cerr << cortex::Codec<T>::name << ": " << (good ? "good" : "bad") << " body was "
                << (read ? "read, and encodes differently" : "rejected") << "\n";
      ++failures;
    }
  }
  return failures;
}

template <class T>
int fuzz(const Bytes& body, int count, std::mt19937& random, int& accepted) {
  static constexpr std::uint8_t special[] = {0, 1, 2, 7, 8, 0x7F, 0x80, 0xFE, 0xFF};
  int failures = 0;
  for (int round = 0; round < count; ++round) {
    Bytes changed = body;
    for (unsigned edits = 1 + random() % 4; edits > 0 && !changed.empty(); --edits) {
      const std::size_t at = random() % changed.size();
      switch (random() % 4) {
        case 0:
          changed[at] = static_cast<std::uint8_t>(random());
          break;
        case 1:
          changed[at] = special[random() % sizeof special];
          break;
        case 2:
          changed.resize(at);
          break;
        default:
          changed[at] = static_cast<std::uint8_t>(changed[at] + 1);
      }
    }
    Bytes first;
    if (!round_trip<T>(changed, random() % 8, first)) continue;
    ++accepted;
    Bytes second;
    if (!round_trip<T>(first, 0, second) || first != second) {
      std::cerr << cortex::Codec<T>::name << ": a damaged body decodes, but not to a message that travels\n";
      ++failures;
    }
  }
  return failures;
}

}  // namespace

int main(int argc, char** argv) {
  const int count = argc > 1 ? std::atoi(argv[1]) : 0;
  std::mt19937 random(12345);
  int lines = 0;
  int failures = cortex::Array<float, 3>::zeros({1u << 31, 1u << 20, 0}).empty() ? 0 : 1;  // and takes no memory
  int accepted = 0;
  std::string line;
  while (std::getline(std::cin, line)) {
    std::istringstream fields(line);
    std::string type, verdict, hex, field;
    fields >> type >> verdict >> hex >> field;
    const Bytes body = from_hex(hex);
    bool known = false;
#define CORTEX_CHECK(name)                                                       \
  if (type == #name) {                                                           \
    known = true;                                                                \
    failures += check<::vectors::name>(verdict == "good", body, field);          \
    if (verdict == "good") failures += fuzz<::vectors::name>(body, count, random, accepted); \
  }
    CORTEX_TYPES(CORTEX_CHECK)
#undef CORTEX_CHECK
    if (!known) {
      std::cerr << "type " << type << " is not among those that were generated\n";
      ++failures;
    }
    ++lines;
  }
  std::cout << lines << " bodies, " << accepted << " damaged ones accepted, " << failures << " failures\n";
  return failures == 0 ? 0 : 1;
}
