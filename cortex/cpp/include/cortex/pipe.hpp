// SPDX-License-Identifier: Apache-2.0
// Frames between two processes of one host through a FIFO (WIRE.md, section 3.3): one wake-up from publisher to reader.
#pragma once

#include <algorithm>
#include <cerrno>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <memory>
#include <string>
#include <system_error>
#include <utility>
#include <vector>

#include <fcntl.h>
#include <poll.h>
#include <sys/stat.h>
#include <unistd.h>

#include "cortex/array.hpp"
#include "cortex/runtime.hpp"
#include "cortex/wire.hpp"

namespace cortex::pipe {

constexpr int pipe_bytes = 1 << 18;  // what a pipe holds; where the system grants less, the usual 64 KiB
constexpr std::size_t read_bytes = 1 << 16;
constexpr std::size_t kept_bytes = 1 << 20;  // a buffer that grew beyond this for one frame is let go after it

// Where a reader offers a pipe to a publisher, for as long as that takes to open it.
inline std::string path_of(const std::string& directory, std::uint64_t reader) {
  return directory + "/pipe." + runtime::hexadecimal(reader);
}

// Bytes of the frame that begins here; 0: its header is not there yet; -1: it is no frame.
inline std::ptrdiff_t frame_size(Span<const std::uint8_t> bytes) noexcept {
  if (bytes.size() < wire::header_size) return 0;
  if (std::memcmp(bytes.data(), "CTX", 3) != 0) return -1;
  const auto kind = static_cast<char>(bytes[3]);
  if (kind == 'S') return wire::slot_frame_size;
  const auto body = wire::load<std::uint64_t>(bytes.data() + 48);
  if ((kind != 'M' && kind != 'B') || body > wire::body_limit) return -1;
  return static_cast<std::ptrdiff_t>(wire::header_size + body);
}

// A pipe that a reader offers to one publisher, and its own end of it. Throws std::system_error.
class Offer {
 public:
  Offer(const std::string& directory, std::uint64_t reader) : name_(path_of(directory, reader)) {
    read_ = open(O_RDONLY);
    write_ = open(O_WRONLY);  // with an end of our own it never looks closed
  }

  int fd() const noexcept { return read_.get(); }

  // Whether the publisher has opened the pipe, and said so with a first frame; the name is removed.
  bool taken() noexcept {
    name_.remove();
    pollfd look{fd(), POLLIN, 0};
    return ::poll(&look, 1, 0) > 0;
  }

 private:
  class Name {
   public:
    explicit Name(std::string path) : path_(std::move(path)) {
      if (::mkfifo(path_.c_str(), 0600) != 0) throw std::system_error(errno, std::generic_category(), path_);
    }
    Name(const Name&) = delete;
    Name& operator=(const Name&) = delete;
    ~Name() { remove(); }
    const std::string& path() const noexcept { return path_; }
    void remove() noexcept {
      if (!path_.empty()) ::unlink(path_.c_str());
      path_.clear();
    }

   private:
    std::string path_;
  };

  runtime::Descriptor open(int flags) const {
    runtime::Descriptor fd(::open(name_.path().c_str(), flags | O_NONBLOCK | O_CLOEXEC | O_NOFOLLOW));
    if (fd.get() < 0) throw std::system_error(errno, std::generic_category(), name_.path());
    return fd;
  }

  Name name_;
  runtime::Descriptor read_;
  runtime::Descriptor write_;
};

// Takes frames from a pipe. Not for several threads at once.
class Reader {
 public:
  explicit Reader(int fd) : fd_(fd) { reserve(2 * read_bytes); }

  // The next frame where it lies, until the next call; empty if none is whole yet.
  Span<const std::uint8_t> next() {
    while (!broken_) {
      const std::size_t held = end_ - begin_;
      const std::ptrdiff_t size = frame_size({buffer_.get() + begin_, held});
      if (size < 0) {
        broken_ = true;
      } else if (size > 0 && static_cast<std::size_t>(size) <= held) {
        const Span<const std::uint8_t> frame(buffer_.get() + begin_, static_cast<std::size_t>(size));
        begin_ += frame.size();
        return frame;
      } else if (!read_more()) {
        break;
      }
    }
    return {};
  }

  // Whether something came that is no frame: nothing that follows can be read.
  bool broken() const noexcept { return broken_; }

 private:
  bool read_more() {
    if (begin_ == end_) {
      begin_ = end_ = 0;
      if (capacity_ > kept_bytes) reserve(2 * read_bytes);
    }
    if (capacity_ - end_ < read_bytes) make_room();
    ssize_t count = 0;
    do {
      count = ::read(fd_, buffer_.get() + end_, capacity_ - end_);
    } while (count < 0 && errno == EINTR);
    if (count <= 0) return false;
    end_ += static_cast<std::size_t>(count);
    return true;
  }

  // The memory grows with what has come, not with what a header says will come.
  void make_room() {
    const std::size_t held = end_ - begin_;
    if (capacity_ - held >= read_bytes) {
      std::memmove(buffer_.get(), buffer_.get() + begin_, held);
      begin_ = 0;
      end_ = held;
    } else {
      reserve(2 * capacity_);
    }
  }

  void reserve(std::size_t capacity) {
    std::unique_ptr<std::uint8_t[]> larger(new std::uint8_t[capacity]);
    const std::size_t held = end_ - begin_;
    if (held > 0) std::memcpy(larger.get(), buffer_.get() + begin_, held);
    buffer_ = std::move(larger);
    capacity_ = capacity;
    begin_ = 0;
    end_ = held;
  }

  int fd_;
  std::unique_ptr<std::uint8_t[]> buffer_;
  std::size_t capacity_ = 0;
  std::size_t begin_ = 0;
  std::size_t end_ = 0;
  bool broken_ = false;
};

// Puts frames into a pipe. Not for several threads at once.
class Writer {
 public:
  // The pipe that a reader offers; null if it offers none.
  static std::unique_ptr<Writer> open(const std::string& directory, std::uint64_t reader) {
    const std::string path = path_of(directory, reader);
    runtime::Descriptor write(::open(path.c_str(), O_WRONLY | O_NONBLOCK | O_CLOEXEC | O_NOFOLLOW));
    if (write.get() < 0) return nullptr;  // no such pipe, or nobody reads it
    struct stat status {};
    if (::fstat(write.get(), &status) != 0 || !S_ISFIFO(status.st_mode)) return nullptr;
    // With an end of our own to read from, the death of the reader is no SIGPIPE: its subscription tells.
    runtime::Descriptor read(::open(path.c_str(), O_RDONLY | O_NONBLOCK | O_CLOEXEC | O_NOFOLLOW));
    struct stat other {};
    if (read.get() < 0 || ::fstat(read.get(), &other) != 0 || other.st_dev != status.st_dev ||
        other.st_ino != status.st_ino) {
      return nullptr;
    }
#if defined(F_SETPIPE_SZ)
    [[maybe_unused]] const int granted = ::fcntl(write.get(), F_SETPIPE_SZ, pipe_bytes);
#endif
    return std::unique_ptr<Writer>(new Writer(std::move(write), std::move(read)));
  }

  // Writes a frame, or as much of it as there is room for, and keeps the rest; false if there is no room at all.
  bool write(Span<const std::uint8_t> frame) {
    if (!flush()) return false;
    const std::size_t written = write_some(frame);
    if (written == 0) return false;
    rest_.assign(frame.begin() + written, frame.end());
    return true;
  }

  int fd() const noexcept { return write_.get(); }

  // Bytes that are to be written before anything else.
  std::size_t left() const noexcept { return rest_.size() - written_; }

  // Keeps more that is to be written; takes it out of what it was in.
  void queue(std::vector<std::uint8_t>& bytes) {
    if (rest_.empty()) {
      rest_.swap(bytes);
    } else {
      rest_.insert(rest_.end(), bytes.begin(), bytes.end());
      bytes.clear();
    }
  }

  // Writes what is left; whether all is written.
  bool flush() {
    if (rest_.empty()) return true;
    written_ += write_some({rest_.data() + written_, rest_.size() - written_});
    if (written_ < rest_.size()) return false;
    rest_.clear();
    if (rest_.capacity() > kept_bytes) rest_ = {};
    written_ = 0;
    return true;
  }

 private:
  Writer(runtime::Descriptor write, runtime::Descriptor read) noexcept
      : write_(std::move(write)), read_(std::move(read)) {}

  std::size_t write_some(Span<const std::uint8_t> bytes) noexcept {
    std::size_t written = 0;
    while (written < bytes.size()) {
      const ssize_t count = ::write(write_.get(), bytes.data() + written, bytes.size() - written);
      if (count >= 0) {
        written += static_cast<std::size_t>(count);
      } else if (errno != EINTR) {
        break;
      }
    }
    return written;
  }

  runtime::Descriptor write_;
  runtime::Descriptor read_;
  std::vector<std::uint8_t> rest_;  // of a frame that was written in part, or more
  std::size_t written_ = 0;         // of the rest
};

}  // namespace cortex::pipe
