// SPDX-License-Identifier: Apache-2.0
// A process with a node, for the tests with Python: `peer ROLE ...`. It ends when its standard input does.
#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdlib>
#include <deque>
#include <iostream>
#include <sstream>
#include <string>
#include <thread>
#include <vector>

#include <fcntl.h>

#include <cortex/node.hpp>

#include "peer_messages.hpp"

using namespace std::chrono_literals;

namespace {

constexpr auto soon = 60s;  // deadline of what takes milliseconds, on a machine that does a lot besides

std::atomic<bool> ended{false};

cortex::Policy policy_of(const std::string& text) {
  if (text == "reliable") return cortex::reliable(64, soon);
  if (text == "brief") return cortex::reliable(4, 1ms);
  if (text == "latest") return cortex::latest();
  return cortex::keep_last(static_cast<std::size_t>(std::stoi(text)));
}

// Sends every message back that comes.
void echo(cortex::Node& node) {
  auto out = node.advertise<Rich>("/from_cpp");
  auto in = node.subscribe<Rich>("/to_cpp", cortex::reliable(8, soon));
  std::cout << "ready" << std::endl;
  while (!ended) {
    if (auto message = in.receive(50ms)) out.publish(**message);
  }
}

// Publishes pictures by loan; pixel k of picture n is n + k.
void loan(cortex::Node& node, int count, std::uint32_t height) {
  auto pictures = node.advertise<test::Picture>("/picture");
  std::cout << "ready" << std::endl;
  if (!pictures.wait_for_subscribers(1, soon)) std::exit(2);
  for (int number = 0; number < count; ++number) {
    auto picture = pictures.loan({{"height", height}, {"width", 64}}, {{"depth", cortex::Dtype::float32}});
    picture->stamp_ns = number;
    picture->name = "picture " + std::to_string(number);
    auto pixels = picture->pixels.writable();
    for (std::size_t k = 0; k < pixels.size(); ++k) {
      pixels[k] = static_cast<std::uint8_t>(static_cast<std::size_t>(number) + k);
    }
    for (auto& depth : picture->depth.writable<float>()) depth = static_cast<float>(number);
    if (!picture.publish()) std::exit(3);
  }
  while (!ended) std::this_thread::sleep_for(5ms);
}

std::vector<std::uint32_t> numbers_of(const std::string& text) {
  std::vector<std::uint32_t> numbers;
  std::istringstream parts(text);
  for (std::string part; std::getline(parts, part, ',');) numbers.push_back(static_cast<std::uint32_t>(std::stoul(part)));
  return numbers;
}

// Publishes scans of these sizes by turns, as soon as there are so many readers; "latch": at once; "full": without a
// free file descriptor.
void publish(cortex::Node& node, const std::string& topic, int count, const std::vector<std::uint32_t>& sizes,
             const std::string& how, std::size_t readers) {
  cortex::PublisherOptions options;
  options.latch = how == "latch";
  auto scans = node.advertise<Scan>(topic, options);
  std::cout << "ready" << std::endl;
  if (!options.latch && !scans.wait_for_subscribers(readers, soon)) std::exit(2);
  while (how == "full" && ::open("/dev/null", O_RDONLY) >= 0) {
  }
  const auto send = [&](int number) {
    Scan scan;
    scan.stamp_ns = number;
    scan.ranges = cortex::Array<float>::zeros({sizes[static_cast<std::size_t>(number) % sizes.size()]});
    for (auto& range : scan.ranges.writable()) range = static_cast<float>(number);
    return scans.publish(scan);
  };
  int refused = 0;
  for (int number = 0; number != count && !ended; ++number) refused += send(number) ? 0 : 1;  // -1 never ends
  std::cout << "{\"published\": " << count << ", \"refused\": " << refused << ", \"timeouts\": " << scans.counters().timeouts << "}" << std::endl;
  while (!ended) std::this_thread::sleep_for(5ms);
}

// Publishes scans of this size, at most so many, until a reliable reader has no room; says how many were taken once the
// publisher is gone.
void fill(cortex::Node& node, const std::string& topic, int most, std::uint32_t size) {
  std::cout << "ready" << std::endl;
  int taken = 0;
  std::uint64_t published = 0;
  {
    auto scans = node.advertise<Scan>(topic);
    if (!scans.wait_for_subscribers(1, soon)) std::exit(2);
    Scan scan;
    scan.ranges = cortex::Array<float>::zeros({size});
    while (taken < most) {
      scan.stamp_ns = taken;
      for (auto& range : scan.ranges.writable()) range = static_cast<float>(taken);
      if (!scans.publish(scan)) break;
      ++taken;
    }
    published = scans.counters().published;
  }
  std::cout << "{\"taken\": " << taken << ", \"published\": " << published << "}" << std::endl;
  while (!ended) std::this_thread::sleep_for(5ms);
}

// Receives until a scan with stamp -1, or `until` if that is not 0, holding the last `hold` messages, and says what
// came; each publisher's scans count up.
void count(cortex::Node& node, const std::string& topic, const std::string& policy, int pause_us, std::size_t hold,
           int until) {
  auto scans = node.subscribe<Scan>(topic, policy_of(policy));
  std::cout << "ready" << std::endl;
  std::deque<cortex::Received<Scan>> held;
  std::int64_t last = -1;
  std::uint64_t sequence = 0;
  int received = 0;
  int wrong = 0;
  std::uint64_t source = 0;
  int sources = 0;
  while (!ended) {
    std::optional<cortex::Received<Scan>> scan;
    try {
      scan = scans.receive(50ms);
    } catch (const cortex::TypeMismatch& error) {
      std::cout << "mismatch " << error.what() << std::endl;
      continue;
    }
    if (!scan) continue;
    sequence = scan->info().sequence;
    if ((*scan)->stamp_ns == -1) break;
    ++received;
    if (scan->info().source != source) {
      source = scan->info().source;
      last = -1;
      ++sources;
    }
    if ((*scan)->stamp_ns <= last) ++wrong;
    last = (*scan)->stamp_ns;
    for (const float range : (*scan)->ranges) {
      if (range != static_cast<float>(last)) ++wrong;
    }
    if (until > 0 && last + 1 == until) break;
    if (hold > 0) {
      held.push_back(std::move(*scan));
      if (held.size() > hold) held.pop_front();
      for (const auto& old : held) {
        if (!old->ranges.empty() && old->ranges[0] != static_cast<float>(old->stamp_ns)) ++wrong;
      }
    }
    if (pause_us > 0) std::this_thread::sleep_for(std::chrono::microseconds(pause_us));
  }
  const auto counters = scans.counters();
  std::cout << "{\"received\": " << received << ", \"wrong\": " << wrong << ", \"lost\": " << counters.lost
            << ", \"rejected\": " << counters.rejected << ", \"overtaken\": " << counters.overtaken
            << ", \"cut_off\": " << counters.cut_off << ", \"sequence\": " << sequence << ", \"sources\": " << sources << ", \"last\": " << last << "}"
            << std::endl;
  scans.close();
  for (const auto& old : held) {  // still there, though the publisher may write to the slots again
    if (!old->ranges.empty() && old->ranges[0] != static_cast<float>(old->stamp_ns)) std::exit(4);
  }
  while (!ended) std::this_thread::sleep_for(5ms);
}

}  // namespace

int main(int argc, char** argv) {
  const auto argument = [&](int index) { return std::string(index < argc ? argv[index] : "0"); };
  cortex::Options options;
  if (const char* registry = std::getenv("CORTEX_TEST_REGISTRY")) options.registry = registry;
  if (const char* keys = std::getenv("CORTEX_TEST_KEYS")) options.keys = keys;
  if (const char* listen = std::getenv("CORTEX_TEST_LISTEN")) options.listen = listen;
  cortex::Node node{"cpp", options};
  std::thread input([] {
    std::string line;
    while (std::getline(std::cin, line)) {
    }
    ended = true;
  });
  if (!node.wait_for_registry(soon)) {
    std::cerr << "no registry answers\n";
    return 1;
  }
  const std::string role = argument(1);
  if (role == "echo") echo(node);
  if (role == "loan") loan(node, std::stoi(argument(2)), static_cast<std::uint32_t>(std::stoi(argument(3))));
  if (role == "publish") {
    publish(node, argument(2), std::stoi(argument(3)), numbers_of(argument(4)), argument(5),
            std::max<std::size_t>(1, static_cast<std::size_t>(std::stoi(argument(6)))));
  }
  if (role == "fill") fill(node, argument(2), std::stoi(argument(3)), static_cast<std::uint32_t>(std::stoi(argument(4))));
  if (role == "count") {
    count(node, argument(2), argument(3), std::stoi(argument(4)), static_cast<std::size_t>(std::stoi(argument(5))),
          std::stoi(argument(6)));
  }
  input.join();
  return 0;
}
