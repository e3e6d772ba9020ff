// SPDX-License-Identifier: Apache-2.0
// What the processes of one host share: clock, random numbers, runtime directory, the lock file of a node.
#pragma once

#include <array>
#include <cerrno>
#include <chrono>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <random>
#include <stdexcept>
#include <string>
#include <system_error>
#include <thread>
#include <utility>

#include <fcntl.h>
#include <sys/file.h>
#include <sys/stat.h>
#include <time.h>
#include <unistd.h>

#include "cortex/wire.hpp"

namespace cortex {

inline std::int64_t clock_ns(clockid_t clock) noexcept {
  timespec now{};
  ::clock_gettime(clock, &now);
  return static_cast<std::int64_t>(now.tv_sec) * 1'000'000'000 + now.tv_nsec;
}

// CLOCK_MONOTONIC: the clock of every time on the wire.
inline std::int64_t monotonic_ns() noexcept { return clock_ns(CLOCK_MONOTONIC); }

// A number for a node, a publisher or a reader; never 0.
inline std::uint64_t random_number() {
  std::random_device device;
  std::uint64_t number = 0;
  while (number == 0) number = static_cast<std::uint64_t>(device()) << 32 | device();
  return number;
}

// BLAKE2b (RFC 7693) with a digest of 8 bytes: fingerprints, and the name of this host.
inline std::array<std::uint8_t, 8> blake2b_8(const std::string& data) {
  static constexpr std::uint64_t start[8] = {0x6A09E667F3BCC908u, 0xBB67AE8584CAA73Bu, 0x3C6EF372FE94F82Bu,
                                             0xA54FF53A5F1D36F1u, 0x510E527FADE682D1u, 0x9B05688C2B3E6C1Fu,
                                             0x1F83D9ABFB41BD6Bu, 0x5BE0CD19137E2179u};
  static constexpr std::uint8_t sigma[10][16] = {
      {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15}, {14, 10, 4, 8, 9, 15, 13, 6, 1, 12, 0, 2, 11, 7, 5, 3},
      {11, 8, 12, 0, 5, 2, 15, 13, 10, 14, 3, 6, 7, 1, 9, 4}, {7, 9, 3, 1, 13, 12, 11, 14, 2, 6, 5, 10, 4, 0, 15, 8},
      {9, 0, 5, 7, 2, 4, 10, 15, 14, 1, 11, 12, 6, 8, 3, 13}, {2, 12, 6, 10, 0, 11, 8, 3, 4, 13, 7, 5, 15, 14, 1, 9},
      {12, 5, 1, 15, 14, 13, 4, 10, 0, 7, 6, 3, 9, 2, 8, 11}, {13, 11, 7, 14, 12, 1, 3, 9, 5, 0, 15, 4, 8, 6, 2, 10},
      {6, 15, 14, 9, 11, 3, 0, 8, 12, 2, 13, 7, 1, 4, 10, 5}, {10, 2, 8, 4, 7, 6, 1, 5, 15, 11, 9, 14, 3, 12, 13, 0}};
  const auto rotate = [](std::uint64_t value, int by) { return value >> by | value << (64 - by); };
  std::array<std::uint64_t, 8> h{};
  std::copy(std::begin(start), std::end(start), h.begin());
  h[0] ^= 0x01010000u ^ 8u;
  std::size_t done = 0;
  do {
    std::uint64_t m[16] = {};
    const std::size_t size = std::min<std::size_t>(128, data.size() - done);
    std::memcpy(m, data.data() + done, size);
    done += size;
    std::uint64_t v[16];
    std::copy(h.begin(), h.end(), v);
    std::copy(std::begin(start), std::end(start), v + 8);
    v[12] ^= done;
    if (done == data.size()) v[14] = ~v[14];
    const auto mix = [&](int a, int b, int c, int d, std::uint64_t x, std::uint64_t y) {
      v[a] += v[b] + x;
      v[d] = rotate(v[d] ^ v[a], 32);
      v[c] += v[d];
      v[b] = rotate(v[b] ^ v[c], 24);
      v[a] += v[b] + y;
      v[d] = rotate(v[d] ^ v[a], 16);
      v[c] += v[d];
      v[b] = rotate(v[b] ^ v[c], 63);
    };
    for (int round = 0; round < 12; ++round) {
      const std::uint8_t* s = sigma[round % 10];
      for (int k = 0; k < 4; ++k) mix(k, 4 + k, 8 + k, 12 + k, m[s[2 * k]], m[s[2 * k + 1]]);
      for (int k = 0; k < 4; ++k) {
        mix(k, 4 + (k + 1) % 4, 8 + (k + 2) % 4, 12 + (k + 3) % 4, m[s[8 + 2 * k]], m[s[9 + 2 * k]]);
      }
    }
    for (std::size_t k = 0; k < 8; ++k) h[k] ^= v[k] ^ v[k + 8];
  } while (done < data.size());
  std::array<std::uint8_t, 8> digest{};
  std::memcpy(digest.data(), &h[0], 8);
  return digest;
}

namespace runtime {

inline std::string hexadecimal(std::uint64_t number) {
  char text[17];
  std::snprintf(text, sizeof text, "%016llx", static_cast<unsigned long long>(number));
  return text;
}

inline std::string environment(const char* name, const char* otherwise = "") {
  const char* value = std::getenv(name);
  return value == nullptr || *value == '\0' ? otherwise : value;
}

// The domain given, else that of CORTEX_DOMAIN, else 0; -1 stands for "not given".
inline int domain_id(int domain) {
  if (domain == -1) {
    const std::string text = environment("CORTEX_DOMAIN");
    if (text.empty()) return 0;
    if (text.size() > 3 || text.find_first_not_of("0123456789") != std::string::npos) {
      throw std::invalid_argument("CORTEX_DOMAIN must be 0 to 232, got '" + text + "'");
    }
    domain = std::stoi(text);
  }
  if (domain < 0 || domain > 232) {
    throw std::invalid_argument("the domain must be 0 to 232, got " + std::to_string(domain));
  }
  return domain;
}

inline std::string base_directory() {
  const std::string chosen = environment("CORTEX_RUNTIME_DIR");
  if (!chosen.empty()) return std::filesystem::absolute(chosen).string();
  const std::string session = environment("XDG_RUNTIME_DIR");
  struct stat status {};
  if (!session.empty() && ::stat(session.c_str(), &status) == 0 && status.st_uid == ::getuid()) {
    return session + "/cortex";
  }
  return "/tmp/cortex-" + std::to_string(::getuid());
}

inline void make_private(const std::string& directory) {
  if (::mkdir(directory.c_str(), 0700) != 0 && errno != EEXIST) {
    throw std::system_error(errno, std::generic_category(), directory);
  }
  struct stat status {};
  if (::lstat(directory.c_str(), &status) != 0 || !S_ISDIR(status.st_mode) || status.st_uid != ::getuid() ||
      (status.st_mode & 077) != 0) {
    throw std::runtime_error(directory + " must be a directory of this user with mode 0700");
  }
}

// The directory of a domain, made if it does not exist; others than this user cannot enter it.
inline std::string directory(int domain) {
  const std::string base = base_directory();
  const std::string path = base + "/" + std::to_string(domain);
  if (path.size() + 30 > 107) {
    throw std::invalid_argument("the runtime directory '" + path +
                                "' is too long for unix sockets; set CORTEX_RUNTIME_DIR to a shorter one");
  }
  make_private(base);
  make_private(path);
  return path;
}

// Equal for two processes if they can share memory and unix sockets; as `host_id` of cortex/host.py.
inline std::string host_id() {
  std::string boot;
  std::ifstream("/proc/sys/kernel/random/boot_id") >> boot;
  char link[128] = {};
  const ssize_t length = ::readlink("/proc/self/ns/pid", link, sizeof link - 1);
  const std::string base = base_directory();
  struct stat status {};
  const std::string place = ::stat(base.c_str(), &status) == 0
                                ? std::to_string(status.st_dev) + ":" + std::to_string(status.st_ino)
                                : base;
  const auto digest = blake2b_8(boot + "\n" + std::string(link, length > 0 ? static_cast<std::size_t>(length) : 0) +
                                "\n" + std::to_string(::getuid()) + "\n" + place);
  std::uint64_t number = 0;
  for (const auto byte : digest) number = number << 8 | byte;
  return hexadecimal(number);
}

// The files of one node: a lock that says it lives, and the paths of its sockets. Any process may remove the files
// of a node whose lock is not held.
class NodeFiles {
 public:
  NodeFiles(const std::string& directory, std::uint64_t node) {
    stem_ = directory + "/" + hexadecimal(node);
    const std::int64_t deadline_ns = monotonic_ns() + 1'000'000'000;
    while (!lock()) {
      // A sweep may hold the new file for a moment, before it sees that there is nothing to remove.
      if (monotonic_ns() > deadline_ns) throw std::runtime_error(stem_ + ".lock is held by another process");
      std::this_thread::sleep_for(std::chrono::milliseconds(1));
    }
  }
  NodeFiles(const NodeFiles&) = delete;
  NodeFiles& operator=(const NodeFiles&) = delete;
  ~NodeFiles() {
    for (const char* role : {"lossy", "strict", "control", "ring", "lock"}) ::unlink((stem_ + "." + role).c_str());
    ::close(fd_);
  }
  std::string path(const char* role) const { return stem_ + "." + role; }
  std::string endpoint(const char* role) const { return "ipc://" + path(role); }

 private:
  bool lock() {
    const std::string path = stem_ + ".lock";
    const int fd = ::open(path.c_str(), O_RDWR | O_CREAT | O_CLOEXEC | O_NOFOLLOW, 0600);
    if (fd < 0) throw std::system_error(errno, std::generic_category(), path);
    struct stat here {};
    struct stat there {};
    if (::flock(fd, LOCK_EX | LOCK_NB) == 0 && ::fstat(fd, &here) == 0 && ::stat(path.c_str(), &there) == 0 &&
        here.st_dev == there.st_dev && here.st_ino == there.st_ino) {
      fd_ = fd;
      return true;
    }
    ::close(fd);
    return false;
  }

  std::string stem_;
  int fd_ = -1;
};

}  // namespace runtime
}  // namespace cortex
