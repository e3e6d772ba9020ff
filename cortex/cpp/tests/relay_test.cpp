// SPDX-License-Identifier: Apache-2.0
// Many pipes written by one thread, for the thread sanitizer: every reader gets whole frames in their order, however
// slow the others are, and also across the moments in which the publisher takes a pipe back.
#include <algorithm>
#include <chrono>
#include <cstdint>
#include <cstdlib>
#include <iostream>
#include <memory>
#include <random>
#include <string>
#include <thread>
#include <vector>

#include <unistd.h>

#include <cortex/pipe.hpp>
#include <cortex/relay.hpp>

namespace {

using Bytes = std::vector<std::uint8_t>;
int failures = 0;

void expect(bool condition, const std::string& what) {
  if (!condition && ++failures < 10) std::cerr << "failed: " << what << "\n";
}

Bytes frame_of(std::uint64_t sequence, std::size_t size) {
  cortex::wire::Header header;
  header.kind = 'M';
  header.sequence = sequence;
  header.body_size = size;
  Bytes frame(cortex::wire::header_size + size, static_cast<std::uint8_t>(sequence));
  cortex::wire::write_header(frame.data(), header);
  return frame;
}

std::size_t random_size(std::mt19937& random) {
  return random() % 1000 == 0 ? random() % 500'000 : random() % 20 == 0 ? random() % 17'000 : random() % 200;
}

// Both ends of a pipe; the reading one is used by this test, the writing one by us or by a relay.
struct End {
  End(const std::string& directory, std::uint64_t number)
      : offer(directory, number), writer(cortex::pipe::Writer::open(directory, number)), reader(offer.fd()) {
    expect(!offer.taken(), "a pipe is empty at first");
  }

  bool write(cortex::pipe::Relay& relay, const Bytes& frame) {
    const cortex::Span<const std::uint8_t> bytes(frame.data(), frame.size());
    return member == nullptr ? writer->write(bytes) : relay.put(*member, bytes);
  }

  // Reads at most so many frames, which must be the next ones; whether there was one.
  bool read(std::uint64_t most) {
    const std::uint64_t before = next;
    for (; most > 0; --most) {
      const auto frame = reader.next();
      if (frame.empty()) break;
      bool whole = cortex::wire::read_header(frame).sequence == next;
      for (std::size_t at = cortex::wire::header_size; at < frame.size(); ++at) {
        whole = whole && frame[at] == static_cast<std::uint8_t>(next);
      }
      expect(whole, "frames come out as they went in");
      ++next;
    }
    return next > before;
  }

  cortex::pipe::Offer offer;
  std::unique_ptr<cortex::pipe::Writer> writer;
  cortex::pipe::Reader reader;
  std::shared_ptr<cortex::pipe::Relay::Member> member;
  std::uint64_t next = 0;  // to be read
};

std::vector<std::unique_ptr<End>> ends_of(const std::string& directory, std::uint64_t count) {
  std::vector<std::unique_ptr<End>> ends;
  for (std::uint64_t number = 1; number <= count; ++number) ends.push_back(std::make_unique<End>(directory, number));
  return ends;
}

constexpr std::uint64_t count = 2'000;

void rest() { std::this_thread::sleep_for(std::chrono::microseconds(100)); }

// Puts all frames into all pipes, which go to the relay and come back at any moment.
void publish(std::vector<std::unique_ptr<End>>& ends, cortex::pipe::Relay& relay) {
  std::mt19937 random(1);
  std::vector<std::uint64_t> put(ends.size(), 0);
  while (std::any_of(put.begin(), put.end(), [](std::uint64_t number) { return number < count; })) {
    bool written = false;
    for (std::size_t index = 0; index < ends.size(); ++index) {
      End& end = *ends[index];
      if (random() % 50 == 0) {
        if (end.member == nullptr) {
          end.member = relay.add(*end.writer);
        } else {
          relay.remove(end.member);
          end.member.reset();
        }
      }
      for (auto burst = random() % 20; burst > 0 && put[index] < count; --burst) {
        if (!end.write(relay, frame_of(put[index], random_size(random)))) break;
        ++put[index];
        written = true;
      }
      if (end.member == nullptr) end.writer->flush();
    }
    if (!written) rest();
  }
  for (const auto& end : ends) {
    if (end->member == nullptr) end->member = relay.add(*end->writer);
  }
}

void taken_and_given_back(const std::string& directory) {
  auto ends = ends_of(directory, 5);
  cortex::pipe::Relay relay;
  std::thread publisher([&ends, &relay] { publish(ends, relay); });
  std::mt19937 random(2);
  while (std::any_of(ends.begin(), ends.end(), [](const auto& end) { return end->next < count; })) {
    bool read = false;
    for (auto& end : ends) {
      if (end != ends[4] || random() % 20 == 0) read = end->read(random() % 300) || read;  // one is far slower
    }
    if (!read) rest();
  }
  publisher.join();
  for (auto& end : ends) {
    relay.remove(end->member);
    expect(end->writer->left() == 0 && !end->read(1), "nothing is left");
  }
}

// One reader never reads: it is refused at last, and the others get all.
void one_that_sleeps(const std::string& directory) {
  auto ends = ends_of(directory, 4);
  cortex::pipe::Relay relay;
  for (auto& end : ends) end->member = relay.add(*end->writer);
  End& asleep = *ends[0];
  std::uint64_t taken = 0;
  for (std::uint64_t number = 0; number < 10'000; ++number) {
    const Bytes frame = frame_of(number, 100);
    taken += asleep.write(relay, frame_of(taken, 100)) ? 1 : 0;
    for (std::size_t index = 1; index < ends.size(); ++index) {
      while (!ends[index]->write(relay, frame)) {
        if (!ends[index]->read(10'000)) rest();
      }
    }
  }
  for (std::size_t index = 1; index < ends.size(); ++index) {
    while (ends[index]->next < 10'000) {
      if (!ends[index]->read(10'000)) rest();
    }
  }
  expect(taken < 5'000, "what nobody reads is not kept");
  for (auto& end : ends) relay.remove(end->member);
  expect(asleep.writer->left() > 0 && asleep.writer->left() < 200'000, "some of it waits");
  while (!asleep.writer->flush()) asleep.read(10'000);
  asleep.read(10'000);
  expect(asleep.next == taken, "who slept gets what was taken, whole");
}

}  // namespace

int main() {
  char directory[] = "/tmp/cortex-relay-XXXXXX";
  if (::mkdtemp(directory) == nullptr) return 2;
  taken_and_given_back(directory);
  one_that_sleeps(directory);
  { const cortex::pipe::Relay idle; }
  expect(::rmdir(directory) == 0, "no name is left");
  std::cout << failures << " failures\n";
  return failures == 0 ? 0 : 1;
}
