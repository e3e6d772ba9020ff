// SPDX-License-Identifier: Apache-2.0
// `hostile_test DIRECTORY WRITES SEED`: a peer that writes at random into all that it may write, half of the time as a
// publisher and half as readers, while the other side works. For the address and the undefined-behaviour sanitizer.
#include <atomic>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <deque>
#include <iostream>
#include <memory>
#include <mutex>
#include <random>
#include <string>
#include <thread>
#include <vector>

#include <cortex/codec.hpp>
#include <cortex/link.hpp>

#include "peer_messages.hpp"

namespace {

using Random = std::mt19937_64;

constexpr std::uint64_t source = 77;
constexpr int batch = 8;  // writes, before the other side has done something more

// Counts what one side has done, so that the other does not run away from it.
class Steps {
 public:
  void count() noexcept { ++done_; }
  // Waits for one more since the last call, not for ever.
  void wait() noexcept {
    for (int looks = 0; looks < 1000 && done_ == seen_; ++looks) std::this_thread::yield();
    seen_ = done_;
  }

 private:
  std::atomic<std::uint64_t> done_{0};
  std::uint64_t seen_ = 0;
};

void expect(bool holds, const char* what) {
  if (holds) return;
  std::cerr << "broken: " << what << std::endl;
  std::abort();
}

// Does something, which must not take this thread a second, whatever else the machine does.
template <class Action>
auto in_time(Action action) {
  const std::int64_t begin_ns = cortex::clock_ns(CLOCK_THREAD_CPUTIME_ID);
  auto result = action();
  expect(cortex::clock_ns(CLOCK_THREAD_CPUTIME_ID) - begin_ns < 1'000'000'000, "nothing takes a second");
  return result;
}

// A number that may hurt where another one was expected.
std::uint64_t nasty(Random& random, std::uint64_t expected) {
  switch (random() % 8) {
    case 0:
      return random();
    case 1:
      return random() % 256;
    case 2:
      return random() % (1 << 20);
    case 3:
      return std::uint64_t{1} << random() % 64;
    case 4:
      return 0 - random() % 16;
    case 5:
      return expected + random() % 4096 - 2048;
    default:
      return expected + (random() % 64 - 32) * 8;
  }
}

// Writes one to eight bytes of a number.
void write_at(std::uint8_t* place, std::uint64_t value, Random& random) {
  constexpr std::size_t sizes[] = {1, 4, 8};
  std::memcpy(place, &value, sizes[random() % 3]);
}

Rich rich_of(std::uint64_t number) {
  Rich rich{};
  rich.stamp_ns = static_cast<std::int64_t>(number);
  rich.text = std::string(number % 300, 'x');
  rich.words = {"one", "two", std::string(number % 40, 'y')};
  rich.numbers.assign(number % 100, static_cast<std::int16_t>(number));
  rich.points.resize(number % 5);
  rich.plane = cortex::Array<float, 2>::zeros({16, 32});
  rich.image = cortex::Array<std::uint8_t, 3>::zeros({2, 5, 3});
  rich.depth = decltype(rich.depth)::zeros({2, 5});
  rich.waves = cortex::Array<std::complex<double>>::zeros({static_cast<std::uint32_t>(number % 50)});
  return rich;
}

// A publisher that goes through the motions, and writes into its ring whatever comes to its mind.
class HostilePublisher {
 public:
  HostilePublisher(zmq::context_t& context, const std::string& directory, std::uint64_t seed)
      : random_(seed), socket_(context, zmq::socket_type::xpub), listener_(cortex_listen((directory + "/1.ring").c_str())) {
    expect(listener_ >= 0, "it listens");
    socket_.set(zmq::sockopt::linger, 0);
    socket_.bind("ipc://" + directory + "/1.strict");
    for (std::uint64_t number = 0; number < 16; ++number) bodies_.push_back(cortex::encode(rich_of(37 * number)));
  }
  HostilePublisher(const HostilePublisher&) = delete;
  HostilePublisher& operator=(const HostilePublisher&) = delete;
  ~HostilePublisher() {
    if (open_) cortex_writer_close(&writer_);
    ::close(listener_);
  }

  // Goes on until it has written so often.
  void run(std::uint64_t writes) {
    while (writes_ < writes) {
      is_silent = is_expected.load();
      take_in();
      if (!open_) continue;
      steps.wait();
      switch (random_() % 16) {
        case 0:
        case 1:
          publish_small();
          break;
        case 2:
        case 3:
          publish_large();
          break;
        case 4:
          if (!is_silent && random_() % 16 == 0) send_damaged();
          break;
        case 5:
          if (random_() % 64 == 0) welcome();
          break;
        default:
          for (int count = 0; count < batch; ++count) write_anywhere();
      }
    }
    done = true;
  }

  std::atomic<bool> done{false};
  std::atomic<std::uint64_t> sessions{0};
  // Until who comes next has its answer nothing goes through the socket: it would not know what was before it.
  std::atomic<bool> is_expected{true}, is_silent{false};
  Steps steps;  // of who reads

 private:
  void take_in() {
    zmq::message_t event;
    while (socket_.recv(event, zmq::recv_flags::dontwait)) {
      const auto bytes = cortex::net::bytes(event);
      if (bytes.empty() || bytes[0] != 1) continue;
      const cortex::wire::Key key = cortex::wire::read_key({bytes.data() + 1, bytes.size() - 1});
      if (key.kind != 'A') continue;
      CortexHello hello{};
      if (key.has(cortex::wire::Key::shared_memory)) {
        int fd = -1;
        while ((fd = cortex_accept(listener_)) >= 0) {
          if (cortex_hear(fd, &hello) == 0 && hello.reader == key.reader) break;
        }
        if (fd < 0) continue;
        if (open_) cortex_writer_close(&writer_);
        open_ = cortex_writer_open(&writer_, source, 1 << 16) == 0 && cortex_writer_grow(&writer_, 1 << 16, 8, 1 << 14) == 0;
        expect(open_ && cortex_writer_add(&writer_, &hello, 1, 0, 0) == 0, "a reader is taken in");
        sequence_ = 0;
        is_expected = is_silent = false;
        ++sessions;
      }
      const std::string name(reinterpret_cast<const char*>(bytes.data()) + 1, bytes.size() - 1);
      const std::string answer = cortex::wire::pack_answer(name, {sequence_, {}});
      socket_.send(zmq::buffer(answer), zmq::send_flags::dontwait);
    }
  }

  std::string header(char kind, std::uint64_t size, std::uint64_t aux) {
    std::string bytes(cortex::wire::header_size, '\0');
    cortex::wire::write_header(reinterpret_cast<std::uint8_t*>(bytes.data()),
                               {kind, cortex::wire::flag_stamp, source, cortex::Codec<Rich>::fingerprint, sequence_, 0, 0, size, aux});
    return bytes;
  }

  const std::vector<std::uint8_t>& body() { return bodies_[random_() % bodies_.size()]; }
  std::string message(char kind) {
    const auto& said = body();
    return header(kind, said.size(), 0).append(reinterpret_cast<const char*>(said.data()), said.size());
  }
  void put(const std::string& frame) { sequence_ += cortex_writer_put(&writer_, frame.data(), frame.size(), 0) != CORTEX_FULL; }

  void publish_small() {
    if (random_() % 8 != 0) return put(random_() % 16 == 0 ? damaged() : message('M'));
    const std::string frame = header('N', 0, 0);
    cortex_writer_put(&writer_, frame.data(), frame.size(), 0);
  }

  void publish_large() {
    const auto& said = body();
    const int slot = cortex_slot_acquire(&writer_);
    if (slot < 0) return;
    std::memcpy(cortex_slot_memory(writer_.map, slot), said.data(), said.size());
    const std::string frame = header('S', said.size(), static_cast<std::uint64_t>(slot));
    if (cortex_slot_commit(&writer_, slot, sequence_, frame.data(), frame.size(), 0) == CORTEX_FULL) {
      cortex_slot_abandon(&writer_, slot);
    } else {
      ++sequence_;
      slot_ = slot;
    }
  }

  // A frame with a few bytes changed, or cut off.
  std::string damaged() {
    std::string frame = random_() % 2 == 0 ? message("ML"[random_() % 2]) : header("LNSAR"[random_() % 5], random_() % 4096, 0);
    for (std::uint64_t edits = random_() % 4; edits > 0; --edits) frame[16 + random_() % (frame.size() - 16)] = static_cast<char>(random_());
    frame.resize(frame.size() - (random_() % 4 == 0 ? random_() % frame.size() : 0));
    return frame;
  }

  // Through the socket: such a frame, or parts that do not belong together.
  void send_damaged() {
    const std::string frame = damaged();
    const bool more = random_() % 3 == 0;
    socket_.send(zmq::buffer(frame), more ? zmq::send_flags::sndmore : zmq::send_flags::none);
    if (more) socket_.send(zmq::buffer(body()), zmq::send_flags::none);
  }

  // Another ring, or what is said to be one.
  void welcome() {
    std::uint64_t said[7] = {CORTEX_RING_MAGIC, writer_.capacity, source, writer_.head, 0, writer_.map->slot_count, writer_.map->slot_bytes};
    for (std::uint64_t edits = random_() % 3; edits > 0; --edits) {
      std::uint64_t& each = said[random_() % 7];
      each = nasty(random_, each);
    }
    if (cortex_send(writer_.members[0].socket, said, sizeof said, &writer_.fd, 1) == 0 && random_() % 2 == 0) {
      writer_.head = cortex_ring_move(writer_.ring, writer_.data, writer_.capacity, writer_.head);
    }
  }

  void write_anywhere() {
    const std::uint64_t slots = writer_.map->slot_count * writer_.map->slot_bytes;
    auto* const base = reinterpret_cast<std::uint8_t*>(writer_.ring);
    std::uint64_t expected = random_() % 4096;
    std::uint8_t* place = nullptr;
    const std::uint64_t where = random_() % 256;
    if (where == 0) {  // head, marks, and what readers never look at: often the end of the ring
      place = base + random_() % 320 / 8 * 8;
      expected = writer_.head;
    } else if (where < 8) {
      place = reinterpret_cast<std::uint8_t*>(&writer_.ring->words[random_() % 16]);
      expected = sequence_;
    } else if (where < 16) {  // entries that are about to be read
      place = writer_.data + (writer_.head - random_() % 8192) % writer_.capacity / 8 * 8;
    } else if (where < 24) {
      place = base + random_() % (CORTEX_HEAD_BYTES + writer_.capacity - 8);
    } else if (where < 48) {
      place = writer_.map->slots + random_() % (slots - 8);
    } else {  // where the offsets of a body are that is about to be read
      place = cortex_slot_memory(writer_.map, slot_) + random_() % 512 / 4 * 4;
    }
    write_at(place, nasty(random_, expected), random_);
    ++writes_;
  }

  Random random_;
  zmq::socket_t socket_;
  int listener_;
  std::vector<std::vector<std::uint8_t>> bodies_;
  CortexWriter writer_{};
  bool open_ = false;
  int slot_ = 0;  // that was sent last
  std::uint64_t sequence_ = 0;
  std::uint64_t writes_ = 0;
};

std::uint64_t looked_at = 0;

// Reads a body to its end; false if it is rejected. What lies in a slot changes meanwhile.
bool look(const cortex::detail::Item& item) {
  try {
    const Rich message = cortex::decode<Rich>(item.body);
    const Rich copy = message;
    for (const std::uint8_t byte : cortex::encode(copy)) looked_at += byte;
    return true;
  } catch (const cortex::MalformedMessage&) {
    return false;
  } catch (const std::invalid_argument&) {  // an enum changed between the two
    return false;
  }
}

void be_attacked_by_a_publisher(const std::string& directory, std::uint64_t writes, std::uint64_t seed) {
  zmq::context_t context;
  HostilePublisher publisher(context, directory, seed);
  std::thread thread([&] { publisher.run(writes); });
  const cortex::Policy policy = cortex::reliable(64, std::chrono::milliseconds(0));
  const cortex::detail::TypeId type{cortex::Codec<Rich>::fingerprint, true};
  std::uint64_t taken = 0, looks = 0, decoded = 0, rejected = 0;
  while (!publisher.done) {
    publisher.is_expected = true;
    while (!publisher.is_silent && !publisher.done) {
      publisher.steps.count();
      std::this_thread::yield();
    }
    const auto counters = std::make_shared<cortex::SubscriberCounters>();
    const auto complaints = std::make_shared<cortex::net::Complaints>(cortex::Log{});
    cortex::detail::Link link(context, "ipc://" + directory + "/1.strict", source, type, policy, true, [](zmq::socket_t&) {},
                              counters, complaints);
    std::deque<cortex::detail::Item> queue, held;
    std::uint64_t accepted = 0;
    for (int idle = 0; link.wakeup_fd() >= 0 && !publisher.done && idle < 500;) {
      const bool none = in_time([&] { return link.drain(queue, 1); });
      publisher.steps.count();
      if (link.is_crowded()) link.pass_over();
      idle = none && link.attached() ? idle + 1 : 0;
      if (none) std::this_thread::yield();
      looks += !held.empty();
      decoded += !held.empty() && in_time([&] { return look(held.back()); });  // once more: it may have changed
      while (!queue.empty()) {
        ++accepted;
        const std::uint64_t uncounted = queue.front().sequence + 1 - accepted - counters->lost;
        expect(uncounted <= counters->rejected, "every message is received, lost or rejected");
        held.push_back(std::move(queue.front()));
        queue.pop_front();
        if (held.size() > 4) held.pop_front();
      }
    }
    taken += accepted;
    rejected += counters->rejected;
  }
  thread.join();
  std::cout << "publisher: " << publisher.sessions << " sessions, " << taken << " messages, " << decoded << " of " << looks
            << " decoded, " << rejected << " frames rejected" << std::endl;
  expect(taken > 0 && decoded > 0 && decoded < looks && rejected > 0, "some messages are good, and some are not");
}

// A message that says itself whether it is whole: all its words are its number.
struct Message {
  std::uint64_t words[1500];
  std::size_t size;  // bytes

  Message(std::uint64_t number, std::size_t count) : size(8 * count) {
    for (std::size_t index = 0; index < count; ++index) words[index] = number;
  }
};

// Someone who reads as is right; all messages in order if it is reliable.
class Honest {
 public:
  explicit Honest(const CortexReader& reader, bool reliable) : reader_(reader), reliable_(reliable) {}
  Honest(const Honest&) = delete;
  Honest& operator=(const Honest&) = delete;
  ~Honest() { cortex_reader_close(&reader_); }

  void read_all() {
    const std::uint8_t* data = nullptr;
    std::int64_t size = 0;
    while ((size = cortex_reader_peek(&reader_, &data)) > 0) {
      const std::vector<std::uint8_t> frame(data, data + size);
      CortexBody body;
      if (cortex_reader_finish(&reader_, frame.data(), size, &body) == 1) {
        const bool in_slot = body.data != nullptr;
        std::vector<std::uint64_t> words((in_slot ? body.size : static_cast<std::uint64_t>(size)) / 8);
        std::memcpy(words.data(), in_slot ? body.data : frame.data(), 8 * words.size());
        for (const std::uint64_t word : words) expect(word == words[0], "a message is whole");
        expect(reliable_ ? words[0] == next : words[0] >= next, "messages come in order, and all to a reliable reader");
        next = words[0] + 1;
      }
      cortex_body_end(&body);
    }
    expect(size == 0, "an honest ring stays sound");
    cortex_reader_arm(&reader_);
  }

  std::uint64_t next = 0;

 private:
  CortexReader reader_;
  bool reliable_;
};

class Attacked {
 public:
  Attacked(const std::string& directory, std::uint64_t seed)
      : random_(seed), path_(directory + "/2.ring"), listener_(cortex_listen(path_.c_str())) {
    expect(listener_ >= 0 && cortex_writer_open(&writer_, source, 1 << 16) == 0, "a publisher begins");
    reliable_ = std::make_unique<Honest>(join(true), true);
    lossy_ = std::make_unique<Honest>(join(false), false);
    for (int index = 0; index < 3; ++index) hostile_.push_back(join(index < 2));
  }
  Attacked(const Attacked&) = delete;
  Attacked& operator=(const Attacked&) = delete;
  ~Attacked() {
    for (auto& reader : hostile_) cortex_reader_close(&reader);
    cortex_writer_close(&writer_);
    ::close(listener_);
  }

  void run(std::uint64_t writes) {
    std::atomic<bool> done{false};
    std::thread attacker([&, seed = random_()] {
      Random random(seed);
      for (std::uint64_t count = 0; count < writes; count += batch) {
        steps_.wait();
        const std::lock_guard<std::mutex> lock(mutex_);
        for (int index = 0; index < batch; ++index) write_anywhere(hostile_[random() % hostile_.size()], random);
      }
      done = true;
    });
    std::uint64_t number = 0;
    for (; !done; ++number) {
      const Message message(number, 9 + random_() % (sizeof Message::words / 8 - 9));
      in_time([&] { return random_() % 4 == 0 ? publish_large(message, number) : publish([&] { return put(message); }, message.size); });
      steps_.count();
      reliable_->read_all();
      if (random_() % 8 == 0) lossy_->read_all();
      if (random_() % 256 == 0) replace();
    }
    attacker.join();
    lossy_->read_all();
    expect(number > 0 && reliable_->next == number && lossy_->next == number, "every message was received");
    std::cout << "readers: " << number << " messages" << std::endl;
  }

 private:
  CortexReader join(bool strict) {
    CortexReader reader;
    CortexHello hello;
    expect(cortex_reader_open(&reader, path_.c_str(), source, 1) == 0, "a reader asks");
    const int fd = cortex_accept(listener_);
    expect(fd >= 0 && cortex_hear(fd, &hello) == 0, "it is heard");
    expect(cortex_writer_add(&writer_, &hello, strict, static_cast<std::uint32_t>(random_() % 3), 0) >= 0, "it is taken in");
    expect(cortex_reader_welcomed(&reader) == 1, "it is welcome");
    return reader;
  }

  // One of the attackers leaves, or dies, and another one comes.
  void replace() {
    const std::lock_guard<std::mutex> lock(mutex_);
    const std::size_t index = random_() % hostile_.size();
    int member = -1;  // the honest ones came first
    for (int each = 2; each < writer_.count; ++each) {
      if (writer_.members[each].used && !writer_.members[each].left && random_() % 2 == 0) member = each;
    }
    cortex_reader_close(&hostile_[index]);
    if (member >= 0) cortex_writer_remove(&writer_, member);
    for (int each = 2; each < writer_.count; ++each) {
      if (writer_.members[each].used && cortex_is_gone(writer_.members[each].socket)) cortex_writer_forget(&writer_, each);
    }
    hostile_[index] = join(index < 2);
  }

  int put(const Message& message) { return cortex_writer_put(&writer_, message.words, message.size, 0); }

  // Attempts something until it works: whoever stands in the way has had its time at once.
  template <class Attempt>
  bool publish(Attempt attempt, std::size_t size) {
    for (int tries = 0; tries < 8; ++tries) {
      const int found = attempt();
      if (found == CORTEX_WRITTEN || found == CORTEX_LAGGING) return true;
      expect(found == CORTEX_FULL, "a message fits");
      reliable_->read_all();
      if (cortex_writer_patience(&writer_, size) >= 0) cortex_writer_give_up(&writer_, size, 1000);
    }
    expect(false, "nobody holds up a publisher for longer than its time");
    return false;
  }

  bool publish_large(const Message& message, std::uint64_t number) {
    cortex_writer_provide(&writer_, message.size, 0, 0);
    const int slot = cortex_slot_acquire(&writer_);
    if (slot < 0) return publish([&] { return put(message); }, message.size);  // attackers have leased them all
    std::memcpy(cortex_slot_memory(writer_.map, slot), message.words, message.size);
    std::uint8_t header[cortex::wire::header_size];
    cortex::wire::write_header(header, {'S', 0, source, 1, number, 0, 0, message.size, static_cast<std::uint64_t>(slot)});
    return publish([&] { return cortex_slot_commit(&writer_, slot, number, header, sizeof header, 0); }, sizeof header);
  }

  void write_anywhere(CortexReader& reader, Random& random) {
    auto* const page = reinterpret_cast<std::uint8_t*>(reader.page);
    const std::uint64_t places[] = {0, offsetof(CortexPage, sleeping), offsetof(CortexPage, generation),
                                    offsetof(CortexPage, leases) + random() % 64, random() % (CORTEX_PAGE_BYTES - 8)};
    write_at(page + places[random() % 5], nasty(random, std::as_const(writer_).head), random);
    if (random() % 64 == 0) {
      const std::uint64_t count = nasty(random, 1);
      if (::write(reader.wakeup, &count, sizeof count) < 0) return;  // it is signalled already, or that is no count
    }
    if (random() % 1024 == 0) ::send(reader.socket, &random, random() % 64, MSG_DONTWAIT | MSG_NOSIGNAL);
  }

  Random random_;
  Steps steps_;
  std::string path_;
  int listener_;
  CortexWriter writer_{};
  std::unique_ptr<Honest> reliable_, lossy_;
  std::mutex mutex_;
  std::vector<CortexReader> hostile_;
};

}  // namespace

int main(int argc, char** argv) {
  expect(argc == 4, "usage: hostile_test DIRECTORY WRITES SEED");
  const std::string directory = argv[1];
  const std::uint64_t writes = std::strtoull(argv[2], nullptr, 10), seed = std::strtoull(argv[3], nullptr, 10);
  be_attacked_by_a_publisher(directory, writes / 2, seed);
  Attacked(directory, seed + 1).run(writes / 2);
}
