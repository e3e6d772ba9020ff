// SPDX-License-Identifier: Apache-2.0
// Both ends of a pipe, for the address sanitizer: frames come out whole and in order however they are cut, a full pipe
// refuses, what is no frame ends it, damaged streams do no harm. And when a reader lets messages gather.
#include <cstdint>
#include <cstdlib>
#include <deque>
#include <iostream>
#include <random>
#include <string>
#include <vector>

#include <dirent.h>
#include <unistd.h>

#include <cortex/pace.hpp>
#include <cortex/pipe.hpp>

namespace {

using Bytes = std::vector<std::uint8_t>;
int failures = 0;

void expect(bool condition, const std::string& what) {
  if (!condition && ++failures < 10) std::cerr << "failed: " << what << "\n";
}

Bytes frame_of(char kind, std::uint64_t sequence, std::size_t size) {
  cortex::wire::Header header;
  header.kind = kind;
  header.source = 1;
  header.sequence = sequence;
  header.body_size = kind == 'S' ? 900'000 : size;
  Bytes frame(cortex::wire::header_size + (kind == 'S' ? cortex::wire::slot_frame_size - cortex::wire::header_size : size));
  cortex::wire::write_header(frame.data(), header);
  for (std::size_t k = cortex::wire::header_size; k < frame.size(); ++k) frame[k] = static_cast<std::uint8_t>(sequence + k);
  return frame;
}

Bytes bytes_of(cortex::Span<const std::uint8_t> frame) { return {frame.begin(), frame.end()}; }

std::size_t names_in(const std::string& directory) {
  std::size_t count = 0;
  DIR* const list = ::opendir(directory.c_str());
  while (const dirent* entry = ::readdir(list)) count += entry->d_name[0] == '.' ? 0 : 1;
  ::closedir(list);
  return count;
}

// A pipe whose writing end takes any bytes.
struct Raw {
  Raw() {
    if (::pipe2(fds, O_NONBLOCK) != 0) std::abort();
  }
  ~Raw() {
    ::close(fds[0]);
    ::close(fds[1]);
  }
  std::size_t put(const std::uint8_t* data, std::size_t size) const {
    const ssize_t count = ::write(fds[1], data, size);
    return count < 0 ? 0 : static_cast<std::size_t>(count);
  }
  int fds[2];
};

void random_frames(const std::string& directory, std::mt19937& random) {
  cortex::pipe::Offer offer(directory, 0xABC);
  const auto writer = cortex::pipe::Writer::open(directory, 0xABC);
  expect(writer != nullptr && !offer.taken(), "an offer is opened by its number");
  expect(names_in(directory) == 0, "its name is removed");
  cortex::pipe::Reader reader(offer.fd());
  std::deque<Bytes> on_their_way;
  std::uint64_t sequence = 0;
  std::size_t refused = 0;
  while (sequence < 20'000 || !on_their_way.empty()) {
    for (auto burst = random() % 200; burst > 0 && sequence < 20'000; --burst) {
      const std::size_t size = random() % 1000 == 0 ? random() % 3'000'000 : random() % 20 == 0 ? random() % 17'000 : random() % 200;
      const char kind = "MBS"[random() % 3];
      Bytes frame = frame_of(kind, sequence, size);
      if (writer->write({frame.data(), frame.size()})) {
        on_their_way.push_back(std::move(frame));
        ++sequence;
      } else {
        ++refused;
        break;
      }
    }
    for (auto burst = random() % 300; burst > 0; --burst) {
      const auto frame = reader.next();
      if (frame.empty()) break;
      expect(!on_their_way.empty() && bytes_of(frame) == on_their_way.front(), "frames come out as they went in");
      if (!on_their_way.empty()) on_their_way.pop_front();
    }
    writer->flush();
  }
  expect(reader.next().empty() && !reader.broken() && writer->flush(), "nothing is left");
  expect(refused > 0, "the pipe was full at times");
}

void cut_anywhere() {
  const Raw raw;
  cortex::pipe::Reader reader(raw.fds[0]);
  const Bytes frame = frame_of('M', 3, 150);
  for (std::size_t cut = 1; cut < frame.size(); ++cut) {
    raw.put(frame.data(), cut);
    expect(reader.next().empty(), "a part is no frame");
    raw.put(frame.data() + cut, frame.size() - cut);
    expect(bytes_of(reader.next()) == frame && reader.next().empty(), "two parts are one frame");
  }
}

void nonsense() {
  Bytes endless = frame_of('M', 0, 0);
  cortex::wire::store(endless.data() + 48, cortex::wire::body_limit + 1);
  for (const Bytes& bytes : {Bytes(100, 0), frame_of('L', 1, 0), frame_of('A', 1, 0), endless}) {
    const Raw raw;
    cortex::pipe::Reader reader(raw.fds[0]);
    const Bytes good = frame_of('M', 0, 10);
    raw.put(good.data(), good.size());
    raw.put(bytes.data(), bytes.size());
    expect(bytes_of(reader.next()) == good && !reader.broken(), "what comes before it is read");
    expect(reader.next().empty() && reader.broken(), "what is no frame ends it");
    raw.put(good.data(), good.size());
    expect(reader.next().empty() && reader.broken(), "and nothing follows");
  }
  // The largest body that can be claimed: memory grows only with what comes.
  const Raw raw;
  cortex::pipe::Reader reader(raw.fds[0]);
  cortex::wire::store(endless.data() + 48, cortex::wire::body_limit);
  raw.put(endless.data(), endless.size());
  expect(reader.next().empty() && !reader.broken(), "a frame of 1 GiB is waited for");
}

void damaged(std::mt19937& random) {
  for (int round = 0; round < 3000; ++round) {
    const Raw raw;
    cortex::pipe::Reader reader(raw.fds[0]);
    Bytes stream;
    for (int frames = 0; frames < 8; ++frames) {
      const Bytes frame = frame_of("MBS"[random() % 3], random(), random() % 300);
      stream.insert(stream.end(), frame.begin(), frame.end());
    }
    for (auto times = random() % 4; times > 0; --times) stream[random() % stream.size()] ^= static_cast<std::uint8_t>(1u << random() % 8);
    std::size_t came = 0;
    for (std::size_t at = 0; at < stream.size();) {
      at += raw.put(stream.data() + at, std::min<std::size_t>(1 + random() % 500, stream.size() - at));
      for (auto frame = reader.next(); !frame.empty(); frame = reader.next()) came += frame.size();
    }
    expect(came <= stream.size(), "no more comes out than went in");
  }
}

void ends_that_go(const std::string& directory) {
  auto offer = std::make_unique<cortex::pipe::Offer>(directory, 1);
  const auto writer = cortex::pipe::Writer::open(directory, 1);
  offer.reset();  // the reader dies: no signal, in the end no room
  const Bytes frame = frame_of('M', 0, 1000);
  int taken = 0;
  while (writer->write({frame.data(), frame.size()}) && taken < 100'000) ++taken;
  expect(taken > 10 && taken < 100'000, "a pipe without a reader is full at last");
  expect(cortex::pipe::Writer::open(directory, 1) == nullptr, "the name went with the offer");
  ::mkfifo(cortex::pipe::path_of(directory, 2).c_str(), 0600);
  expect(cortex::pipe::Writer::open(directory, 2) == nullptr, "nobody reads this one");
  ::unlink(cortex::pipe::path_of(directory, 2).c_str());
  ::close(::open(cortex::pipe::path_of(directory, 3).c_str(), O_CREAT | O_WRONLY, 0600));
  expect(cortex::pipe::Writer::open(directory, 3) == nullptr, "a file is no pipe");
  bool refused = false;
  try {
    cortex::pipe::Offer other(directory, 3);
  } catch (const std::system_error&) {
    refused = true;
  }
  expect(refused && names_in(directory) == 1, "a name that exists is not offered, and not removed");
  ::unlink(cortex::pipe::path_of(directory, 3).c_str());
}

// How long is waited after frames of so many bytes have come for a millisecond, one every `gap_ns`.
std::int64_t gather_after(const cortex::Policy& policy, std::int64_t gap_ns, std::size_t bytes) {
  cortex::detail::Pace pace(policy);
  const std::int64_t begin_ns = 5'000'000'000;
  pace.looked(begin_ns);
  for (std::int64_t passed_ns = gap_ns; passed_ns <= 1'000'000; passed_ns += gap_ns) {
    pace.count(bytes);
    pace.looked(begin_ns + passed_ns);
  }
  return pace.gather_ns();
}

void floods_gather() {
  const auto reliable = cortex::reliable();
  expect(gather_after(reliable, 1'000, 104) == 50'000, "a flood gathers");
  expect(gather_after(reliable, 10'000, 104) == 0, "100 kHz are no flood");
  expect(gather_after(reliable, 1'000, 4'164) == 0, "a pipe that is soon full is looked into at once");
  const std::int64_t between = gather_after(reliable, 1'000, 364);
  expect(between > 20'000 && between < 40'000, "half of a usual pipe may gather, less what timers are late");
  expect(gather_after(cortex::latest(), 1'000, 104) == 0, "the latest message is wanted at once");
  expect(gather_after(cortex::keep_last(64), 1'000, 104) == 0, "a short queue would drop what gathers");
  expect(gather_after(cortex::keep_last(1000), 1'000, 104) == 50'000, "a long one does not");
  cortex::detail::Pace pace(reliable);
  for (std::int64_t now_ns = 1'000; now_ns <= 1'000'000; now_ns += 1'000) {
    pace.count(104);
    pace.looked(now_ns);
  }
  expect(pace.gather_ns() > 0, "a flood gathers from its first moments");
  pace.looked(1'050'000);
  expect(pace.gather_ns() == 0, "and is over with the first look that finds nothing");
}

}  // namespace

int main() {
  char directory[] = "/tmp/cortex-pipe-XXXXXX";
  if (::mkdtemp(directory) == nullptr) return 2;
  std::mt19937 random(7);
  random_frames(directory, random);
  cut_anywhere();
  nonsense();
  damaged(random);
  ends_that_go(directory);
  floods_gather();
  expect(names_in(directory) == 0, "no name is left");
  ::rmdir(directory);
  std::cout << failures << " failures\n";
  return failures == 0 ? 0 : 1;
}
