// SPDX-License-Identifier: Apache-2.0
// The ring's protocol between threads that share its memory, so that the thread sanitizer sees each access. Reliable
// readers only: a lossy one copies what may be written over, and looks afterwards.
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <thread>
#include <vector>

#include <poll.h>
#include <sys/eventfd.h>
#include <unistd.h>

#include "cortex/broadcast.h"

namespace {

constexpr std::uint64_t capacity = 1 << 12;
constexpr std::uint64_t count = 100'000;
constexpr std::size_t frame_bytes = 56;  // with what precedes it, 64: no entry is cut, as the memory is mapped once here
constexpr int readers = 2;
constexpr int patience_ms = 60'000;

void expect(bool holds, const char* what) {
  if (holds) return;
  std::fprintf(stderr, "broken: %s\n", what);
  std::exit(1);
}

void follow(CortexReader reader) {
  for (std::uint64_t number = 0; number < count;) {
    const std::uint8_t* data = nullptr;
    const std::int64_t size = cortex_reader_peek(&reader, &data);
    if (size == 0) {
      if (cortex_reader_arm(&reader) == 0) continue;
      pollfd look{reader.wakeup, POLLIN, 0};
      expect(::poll(&look, 1, patience_ms) == 1, "the wakeup is signalled for whoever sleeps");
      continue;
    }
    cortex_reader_disarm(&reader);
    expect(size == static_cast<std::int64_t>(frame_bytes), "a frame has the size that was sent");
    std::uint64_t words[frame_bytes / 8];
    std::memcpy(words, data, frame_bytes);
    for (const std::uint64_t word : words) expect(word == number, "frames are whole and in order");
    CortexBody none;
    expect(cortex_reader_finish(&reader, data, size, &none) == 1, "a reliable reader is never overrun");
    ++number;
  }
}

}  // namespace

int main() {
  std::vector<std::uint64_t> memory((CORTEX_HEAD_BYTES + capacity) / 8);
  std::vector<CortexPage> pages(readers);
  CortexMap map{};
  map.slot_count = 1;  // a ring with slots does not grow
  CortexWriter writer{};
  writer.map = &map;
  writer.ring = reinterpret_cast<CortexRing*>(memory.data());
  writer.data = reinterpret_cast<std::uint8_t*>(memory.data()) + CORTEX_HEAD_BYTES;
  writer.capacity = capacity;
  writer.count = readers;
  std::vector<std::thread> threads;
  for (int index = 0; index < readers; ++index) {
    CortexMember& member = writer.members[index];
    member.used = member.strict = 1;
    member.page = &pages[static_cast<std::size_t>(index)];
    member.wakeup = member.socket = ::eventfd(0, EFD_NONBLOCK | EFD_CLOEXEC);  // which never ends
    CortexReader reader{};
    reader.ring = writer.ring;
    reader.data = writer.data;
    reader.page = member.page;
    reader.capacity = capacity;
    reader.wakeup = member.wakeup;
    threads.emplace_back(follow, reader);
  }
  for (std::uint64_t number = 0; number < count; ++number) {
    std::uint64_t words[frame_bytes / 8];
    for (std::uint64_t& word : words) word = number;
    while (cortex_writer_put(&writer, words, sizeof words, 0) == CORTEX_FULL) std::this_thread::yield();
    if (number % 1000 == 0) ::usleep(200);  // so that readers fall asleep
  }
  for (std::thread& thread : threads) thread.join();
  for (const CortexMember& member : writer.members) {
    if (member.used) ::close(member.wakeup);
  }
  std::puts("ok");
}
