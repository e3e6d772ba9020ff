// SPDX-License-Identifier: Apache-2.0
// A ring between one writer and several readers in threads, for the thread sanitizer: nothing is lost, torn or written
// while somebody looks at it; readers that leave keep what they hold.
#include <array>
#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <cstring>
#include <deque>
#include <iostream>
#include <memory>
#include <mutex>
#include <thread>
#include <vector>

#include <cortex/ring.hpp>
#include <cortex/ring_view.hpp>

namespace {

constexpr std::uint64_t source = 7;
constexpr std::uint32_t readers = 3;
constexpr std::uint64_t messages = 4000;

struct Descriptor {
  std::uint32_t slot = 0;
  std::uint64_t sequence = 0;
  std::uint64_t size = 0;
};

// Stands for ZeroMQ, which orders memory as it passes messages.
class Channel {
 public:
  void push(const Descriptor& descriptor) {
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      queue_.push_back(descriptor);
    }
    ready_.notify_one();
  }
  Descriptor pop() {
    std::unique_lock<std::mutex> lock(mutex_);
    ready_.wait(lock, [this] { return !queue_.empty(); });
    const Descriptor descriptor = queue_.front();
    queue_.pop_front();
    return descriptor;
  }

 private:
  std::mutex mutex_;
  std::condition_variable ready_;
  std::deque<Descriptor> queue_;
};

std::atomic<int> failures{0};

void expect(bool condition, const char* what) {
  if (!condition && ++failures < 10) std::cerr << "failed: " << what << "\n";
}

bool is_whole(cortex::Span<const std::uint8_t> body, std::uint64_t sequence) {
  for (const auto byte : body) {
    if (byte != static_cast<std::uint8_t>(sequence)) return false;
  }
  return true;
}

void consume(const cortex::wire::RingPlace& place, std::uint32_t column, Channel& channel) {
  auto view = std::make_shared<cortex::RingView>(source, place, column);
  struct Held {
    std::shared_ptr<const void> owner;
    cortex::Span<const std::uint8_t> body;
    std::uint64_t sequence;
  };
  std::deque<Held> held;
  std::thread releaser;
  for (std::uint64_t expected = 0; expected < messages; ++expected) {
    const Descriptor descriptor = channel.pop();
    Held message;
    message.body = view->take(descriptor.slot, descriptor.sequence, descriptor.size, message.owner);
    message.sequence = descriptor.sequence;
    expect(descriptor.sequence == expected, "order");
    expect(is_whole(message.body, message.sequence), "a whole message");
    held.push_back(std::move(message));
    for (const auto& old : held) expect(is_whole(old.body, old.sequence), "a held message stays");
    if (held.size() > column) {  // leases end in another thread
      if (releaser.joinable()) releaser.join();
      releaser = std::thread([owner = std::move(held.front().owner)]() mutable { owner.reset(); });
      held.pop_front();
    }
  }
  if (releaser.joinable()) releaser.join();
  view->close();
  for (const auto& old : held) expect(is_whole(old.body, old.sequence), "a message outlives its view");
}

}  // namespace

int main() {
  cortex::Ring ring(source, 1, 8, 4096);
  std::array<Channel, readers> channels;
  std::vector<std::thread> threads;
  for (std::uint32_t column = 0; column < readers; ++column) {
    threads.emplace_back(consume, ring.place(), column, std::ref(channels[column]));
  }
  for (std::uint64_t sequence = 0; sequence < messages; ++sequence) {
    int slot = ring.acquire();
    for (; slot < 0; slot = ring.acquire()) std::this_thread::yield();
    const std::uint64_t size = 1 + sequence % 512;
    std::memset(ring.buffer(slot).data(), static_cast<int>(sequence & 0xFF), size);
    ring.commit(slot, sequence, size, (std::uint64_t{1} << readers) - 1);
    for (auto& channel : channels) channel.push({static_cast<std::uint32_t>(slot), sequence, size});
  }
  for (auto& thread : threads) thread.join();
  expect(ring.idle(), "all slots come back");

  // A reader that is not granted a slot copies it; one that was left out heals nothing that it holds.
  auto view = std::make_shared<cortex::RingView>(source, ring.place(), 5);
  const int slot = ring.acquire();
  std::memset(ring.buffer(slot).data(), 9, 100);
  std::array<std::uint8_t, 100> copy{};
  expect(!view->copy(static_cast<std::uint32_t>(slot), messages, 100, copy.data()), "no copy while it is written");
  ring.commit(slot, messages, 100, 1u << 5);
  expect(view->copy(static_cast<std::uint32_t>(slot), messages, 100, copy.data()) && copy[99] == 9, "a copy");
  expect(!view->copy(static_cast<std::uint32_t>(slot), messages + 1, 100, copy.data()), "no copy of another message");
  expect(ring.outstanding(5, 1) == 1, "one lease");
  view->heal(messages);
  expect(ring.outstanding(5, 1) == 1, "the message may still come");
  view->heal(messages + 1);
  expect(ring.outstanding(5, 1) == 0, "it was dropped on the way: the slot comes back");
  const int next = ring.acquire();
  ring.commit(next, messages + 1, 100, 1u << 5);
  std::shared_ptr<const void> owner;
  view->take(static_cast<std::uint32_t>(next), messages + 1, 100, owner);
  view->heal(messages + 9);
  expect(ring.outstanding(5, 1) == 1, "what is delivered is not healed");
  for (const auto& [bad_slot, bad_size] : {std::pair<std::uint32_t, std::uint64_t>{8, 1}, {0, 4097}, {1u << 31, 1}}) {
    bool refused = false;
    try {
      std::shared_ptr<const void> nothing;
      view->take(bad_slot, 0, bad_size, nothing);
    } catch (const cortex::MalformedMessage&) {
      refused = true;
    }
    expect(refused, "a slot or size beyond the ring");
  }
  // A reader that leaves keeps what it looks at, though the publisher writes to its slot again.
  const auto held = std::make_shared<cortex::RingView>(source, ring.place(), 6);
  const int kept = ring.acquire();
  std::memset(ring.buffer(kept).data(), 21, 4096);
  ring.commit(kept, messages + 20, 4096, 1u << 6);
  std::shared_ptr<const void> keeper;
  const auto kept_body = held->take(static_cast<std::uint32_t>(kept), messages + 20, 4096, keeper);
  held->close();
  ring.free_column(6);
  for (int written = 0; written < 8; ++written) {
    const int again = ring.acquire();
    if (again >= 0) std::memset(ring.buffer(again).data(), 99, 4096);
    if (again >= 0) ring.commit(again, messages + 30, 4096, 0);
  }
  expect(ring.buffer(kept)[0] == 99 && kept_body[0] == 21 && kept_body[4095] == 21, "a private copy of a slot");
  keeper.reset();
  ring.pin(kept);
  for (int tries = 0; tries < 9; ++tries) {
    const int other = ring.acquire();
    expect(other != kept, "a pinned slot is not written");
    if (other >= 0) ring.commit(other, messages + 40, 1, 0);
  }
  ring.unpin(kept);
  ring.free_column(5);
  for (auto place : {ring.place(), ring.place(), ring.place()}) {
    static int kind = 0;
    ++kind;
    if (kind == 1) place.slots = 9;
    if (kind == 2) place.slot_bytes = 8192;
    if (kind == 3) place.fd = 0;
    bool refused = false;
    try {
      cortex::RingView other(source, place, 1);
    } catch (const cortex::ShmUnavailable&) {
      refused = true;
    }
    expect(refused, "a ring that is not what was announced");
  }
  std::cout << messages << " messages to " << readers << " readers, " << failures << " failures\n";
  return failures == 0 ? 0 : 1;
}
