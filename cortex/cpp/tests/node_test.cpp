// SPDX-License-Identifier: Apache-2.0
// Nodes in one process, used by many threads at once, for the thread sanitizer (ZeroMQ itself is not judged: it is
// built without). There has to be a registry.
#include <atomic>
#include <chrono>
#include <cstdlib>
#include <iostream>
#include <map>
#include <random>
#include <string>
#include <thread>
#include <vector>

#include <cortex/node.hpp>

#include "peer_messages.hpp"

using namespace std::chrono_literals;

namespace {

std::atomic<int> failures{0};

void expect(bool condition, const std::string& what) {
  if (!condition && ++failures < 10) std::cerr << "failed: " << what << "\n";
}

Scan scan_of(std::int64_t number, std::uint32_t size) {
  Scan scan;
  scan.stamp_ns = number;
  scan.ranges = cortex::Array<float>::zeros({size});
  for (auto& range : scan.ranges.writable()) range = static_cast<float>(number);
  return scan;
}

bool is_whole(const Scan& scan) {
  for (const float range : scan.ranges) {
    if (range != static_cast<float>(scan.stamp_ns)) return false;
  }
  return true;
}

// Two threads publish on one publisher, three subscriptions read: none of a reliable one's messages is missing.
void share(cortex::Node& talker, cortex::Node& hearer, const std::string& topic, std::uint32_t size, int count) {
  auto publisher = talker.advertise<Scan>(topic);
  auto every = hearer.subscribe<Scan>(topic, cortex::reliable(16, 20s));
  auto newest = hearer.subscribe<Scan>(topic, cortex::latest());
  expect(publisher.wait_for_subscribers(2, 60s), "two subscribers attach");
  expect(every.wait_for_publisher(60s), "and learn of it");  // its answer may still be in flight
  std::vector<std::thread> threads;
  for (int writer = 0; writer < 2; ++writer) {
    threads.emplace_back([&publisher, size, count, writer] {
      for (int number = 0; number < count; ++number) {
        expect(publisher.publish(scan_of(2 * number + writer, size)), "a reliable subscriber keeps up");
      }
    });
  }
  threads.emplace_back([&newest] {
    std::vector<cortex::Received<Scan>> held;
    while (auto scan = newest.receive(200ms)) {
      expect(is_whole(**scan), "a whole scan of the newest");
      held.push_back(std::move(*scan));
      if (held.size() > 2) held.erase(held.begin());
    }
    newest.close();
    for (const auto& scan : held) expect(is_whole(*scan), "a scan that outlives its subscription");
  });
  std::atomic<bool> done{false};
  std::thread watcher([&publisher, &every, &done] {
    std::uint64_t published = 0;
    while (!done) {
      const std::uint64_t now = publisher.counters().published;
      expect(now >= published && every.counters().lost == 0, "counters grow");
      expect(publisher.subscriber_count() <= 2 && every.publisher_count() == 1, "who is attached");
      published = now;
      std::this_thread::sleep_for(1ms);
    }
  });
  std::vector<int> seen(static_cast<std::size_t>(2 * count), 0);
  for (int left = 2 * count; left > 0; --left) {
    const auto scan = every.receive(20s);
    expect(scan.has_value(), "every scan arrives");
    if (!scan) break;
    expect(is_whole(**scan), "a whole scan");
    ++seen[static_cast<std::size_t>((*scan)->stamp_ns)];
  }
  for (const int times : seen) expect(times == 1, "each scan arrives once");
  done = true;
  watcher.join();
  for (auto& thread : threads) thread.join();
  expect(every.counters().lost == 0 && every.counters().rejected == 0, "nothing is lost");
}

// Reads scans that count up until this one.
void hear_all(cortex::Subscription<Scan> subscription, int until) {
  for (int number = 0; number < until; ++number) {
    const auto scan = subscription.receive(60s);
    expect(scan && (*scan)->stamp_ns == number && is_whole(**scan), "every scan arrives, in order");
    if (!scan) return;
  }
  expect(subscription.counters().lost == 0, "nothing is lost");
}

// More readers than a publisher writes to itself: those that may miss nothing get all, in order, while others leave,
// and also what has not been written when the publisher leaves.
void fan_out(cortex::Node& talker, cortex::Node& hearer) {
  constexpr int count = 2000;
  auto publisher = std::make_unique<cortex::Publisher<Scan>>(talker.advertise<Scan>("/fan"));
  std::vector<std::thread> threads;
  for (const int until : {count, count, count / 4, count / 2}) {
    threads.emplace_back(hear_all, hearer.subscribe<Scan>("/fan", cortex::reliable(16, 60s)), until);
  }
  std::atomic<bool> done{false};
  std::thread lossy([&done, subscription = hearer.subscribe<Scan>("/fan", cortex::keep_last(64))]() mutable {
    std::int64_t last = -1;
    while (!done || last < 0) {
      const auto scan = subscription.receive(10ms);
      if (!scan) continue;
      expect((*scan)->stamp_ns > last && is_whole(**scan), "scans arrive in order");
      last = (*scan)->stamp_ns;
    }
  });
  expect(publisher->wait_for_subscribers(5, 60s), "all attach");
  for (int number = 0; number < count; ++number) {
    expect(publisher->publish(scan_of(number, number % 100 == 0 ? 6000 : 10)), "reliable subscribers keep up");
  }
  publisher.reset();
  for (auto& thread : threads) thread.join();
  done = true;
  lossy.join();
}

// Publishes until a reliable subscriber has no room; how many messages were taken.
int fill(cortex::Publisher<Scan>& publisher) {
  int taken = 0;
  while (publisher.publish(scan_of(taken, 10))) ++taken;
  return taken;
}

// Two publishers whose rings are full: a reliable subscription, in whose queue there is room for few, reads both.
void share_the_room(cortex::Node& talker, cortex::Node& hearer) {
  auto subscription = hearer.subscribe<Scan>("/room", cortex::reliable(8, 1ms));
  std::vector<cortex::Publisher<Scan>> publishers;
  for (int number = 0; number < 2; ++number) {
    publishers.push_back(talker.advertise<Scan>("/room"));
    expect(publishers.back().wait_for_subscribers(1, 60s), "a publisher is found");
    expect(fill(publishers.back()) > 200, "a ring holds hundreds of messages");
  }
  std::map<std::uint64_t, int> received;
  for (int left = 200; left > 0; --left) {
    const auto scan = subscription.receive(60s);
    expect(scan.has_value(), "what is in the rings arrives");
    if (scan) ++received[scan->info().source];
  }
  expect(received.size() == 2, "both publishers are heard");
  for (const auto& entry : received) expect(std::abs(entry.second - 100) <= 16, "each as often as the other");
}

// A reliable subscription that is read long after its publisher has left gets all that this was told to be taken.
void read_late(cortex::Node& talker, cortex::Node& hearer) {
  auto subscription = hearer.subscribe<Scan>("/late", cortex::reliable(8, 1ms));
  int taken = 0;
  {
    auto publisher = talker.advertise<Scan>("/late");
    expect(publisher.wait_for_subscribers(1, 60s), "the subscriber attaches");
    taken = fill(publisher);
  }
  while (subscription.publisher_count() > 0) std::this_thread::sleep_for(1ms);
  std::this_thread::sleep_for(2500ms);  // more than what is in flight would need
  for (int number = 0; number < taken; ++number) {
    const auto scan = subscription.receive(60s);
    expect(scan && (*scan)->stamp_ns == number, "every scan arrives, in order");
    if (!scan) return;
  }
}

// A node that ends under its users: receivers return, publishers throw, received messages stay.
void end_early() {
  auto talker = std::make_unique<cortex::Node>("talker");
  auto hearer = std::make_unique<cortex::Node>("hearer");
  auto publisher = talker->advertise<Scan>("/end");
  auto subscription = hearer->subscribe<Scan>("/end", cortex::reliable(4, 100ms));
  expect(publisher.wait_for_subscribers(1, 60s), "the subscriber attaches");
  expect(publisher.publish(scan_of(7, 50'000)), "a large scan is published");
  auto kept = subscription.receive(60s);
  expect(kept.has_value(), "it arrives");
  std::thread waiting([&subscription] {
    while (auto scan = subscription.receive(30s)) expect(is_whole(**scan), "a whole scan");
  });
  std::atomic<bool> told{false};
  std::thread talking([&publisher, &told] {
    try {
      for (int number = 0;; ++number) publisher.publish(scan_of(number, 5000));
    } catch (const std::logic_error&) {
      told = true;
    }
  });
  std::this_thread::sleep_for(50ms);
  hearer.reset();
  waiting.join();
  talker.reset();
  talking.join();
  expect(told, "the publisher tells that its node has ended");
  expect(kept && is_whole(**kept), "a message outlives both nodes");
}

// A clock that is an hour ahead, over a link of 20 ms and 5 ms of jitter each way, and is set.
void estimate_a_clock() {
  cortex::detail::ClockEstimate clock;
  expect(clock.offset_ns() == 0, "nothing is known before an answer");
  std::mt19937 random(1);
  std::exponential_distribution<double> jitter(1.0 / 5e6);
  std::int64_t now_ns = 18'000'000'000'000, ahead_ns = 3'600'000'000'000;
  const auto answer = [&](int count) {
    for (; count > 0; --count, now_ns += 250'000'000) {
      const std::int64_t told_at_ns = now_ns + 20'000'000 + static_cast<std::int64_t>(jitter(random));
      clock.add(now_ns, told_at_ns + ahead_ns, told_at_ns + 20'000'000 + static_cast<std::int64_t>(jitter(random)));
    }
    return std::abs(clock.offset_ns() - ahead_ns);
  };
  expect(answer(1) < 30'000'000, "the first answer tells the offset to half a round trip");
  expect(answer(240) < 3'000'000, "after a minute it is known better than a usual answer tells it");
  ahead_ns -= 1'000'000'000;
  expect(answer(4) < 30'000'000, "a clock that is set is followed at once");
}

}  // namespace

int main() {
  estimate_a_clock();
  {
    cortex::Node talker{"talker"};
    cortex::Node hearer{"hearer"};
    std::thread large([&] { share(talker, hearer, "/large", 8000, 150); });
    share(talker, hearer, "/small", 10, 500);
    large.join();
    fan_out(talker, hearer);
    share_the_room(talker, hearer);
    read_late(talker, hearer);
    auto wrong = talker.advertise<Scan>("/wrong");
    bool refused = false;
    try {
      auto loan = wrong.loan({{"n", 100'000}});
      loan->ranges = cortex::Array<float>::zeros({200'000});
      loan.publish();
    } catch (const std::invalid_argument&) {
      refused = true;
    }
    expect(refused, "a loan does not take what does not fit");
    for (int round = 0; round < 100; ++round) wrong.loan({{"n", 100'000}});  // slots come back unpublished
    for (const char* topic : {"", "scan", "/", "/a//b", "/a/", "/a b"}) {
      refused = false;
      try {
        talker.advertise<Scan>(topic);
      } catch (const std::invalid_argument&) {
        refused = true;
      }
      expect(refused, std::string("the topic '") + topic + "' is refused");
    }
  }
  end_early();
  std::cout << failures << " failures\n";
  return failures == 0 ? 0 : 1;
}
