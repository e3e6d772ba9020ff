// SPDX-License-Identifier: Apache-2.0
// One publisher's pipes to many readers, written by a thread of their own.
#pragma once

#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <memory>
#include <mutex>
#include <new>
#include <thread>
#include <utility>
#include <vector>

#include <poll.h>

#include "cortex/array.hpp"
#include "cortex/pipe.hpp"
#include "cortex/socket.hpp"

namespace cortex::pipe {

// To write to each of many readers for each message wakes each of them each time. Here the publisher leaves a frame for
// each, and goes on; the thread writes to one after the other what has come for it since: the longer a round takes, the
// more each write carries.
class Relay {
 public:
  // What waits for one reader.
  class Member {
   public:
    explicit Member(Writer& writer) noexcept : writer_(writer) {}

   private:
    friend class Relay;
    Writer& writer_;  // the thread's, under the relay's lock
    std::mutex mutex_;
    std::vector<std::uint8_t> waiting_;  // under this mutex, and copied into under it: the publisher waits for no write
  };

  // Throws std::system_error if there is no thread, or no descriptor to wake it with.
  Relay() : thread_([this] { run(); }) {}
  Relay(const Relay&) = delete;
  Relay& operator=(const Relay&) = delete;
  // All members must have been removed.
  ~Relay() {
    {
      const Change change(*this);
      stopping_ = true;
    }
    thread_.join();
  }

  // Writes through this from now on; it must stay until `remove`.
  std::shared_ptr<Member> add(Writer& writer) {
    auto member = std::make_shared<Member>(writer);
    const Change change(*this);
    members_.push_back(member);
    return member;
  }

  // What has not been written is left to the writer, which the thread does not touch any more.
  void remove(const std::shared_ptr<Member>& member) noexcept {
    const Change change(*this);
    members_.erase(std::remove(members_.begin(), members_.end(), member), members_.end());
    try {
      member->writer_.queue(member->waiting_);
    } catch (const std::bad_alloc&) {  // whole frames are lost, which their reader sees by their numbers
    }
  }

  // Has a frame written; false if there is no room.
  bool put(Member& member, Span<const std::uint8_t> frame) {
    {
      const std::lock_guard<std::mutex> lock(member.mutex_);
      auto& waiting = member.waiting_;
      if (!waiting.empty() && waiting.size() + frame.size() > waiting_bytes) return false;
      waiting.insert(waiting.end(), frame.begin(), frame.end());
    }
    if (sleeping_ && sleeping_.exchange(false)) waker_.set();
    return true;
  }

 private:
  static constexpr std::size_t waiting_bytes = 1 << 16;  // most that waits for one reader besides what is being written

  // The right to change something between two rounds of the thread, which would hardly let go of its lock for long.
  class Change {
   public:
    explicit Change(Relay& relay) : relay_(relay) {
      ++relay_.asking_;
      relay_.waker_.set();
      lock_ = std::unique_lock<std::mutex>(relay_.mutex_);
    }
    Change(const Change&) = delete;
    Change& operator=(const Change&) = delete;
    ~Change() {
      --relay_.asking_;
      relay_.changed_.notify_all();
    }

   private:
    Relay& relay_;
    std::unique_lock<std::mutex> lock_;
  };

  void run() {
    std::unique_lock<std::mutex> lock(mutex_);
    while (!stopping_) {
      bool written = false;
      for (const auto& member : members_) written = serve(*member) || written;
      if (!written) await_work(lock);
      changed_.wait(lock, [this] { return asking_ == 0; });
    }
  }

  // Writes what there is room for; whether that was something.
  static bool serve(Member& member) {
    Writer& writer = member.writer_;
    const std::size_t before = writer.left();
    if (!writer.flush()) return writer.left() != before;
    {
      const std::lock_guard<std::mutex> lock(member.mutex_);
      if (member.waiting_.empty()) return before > 0;
      writer.queue(member.waiting_);
    }
    const std::size_t taken = writer.left();
    writer.flush();
    return before > 0 || writer.left() != taken;
  }

  // Sleeps until there is a frame, or room in a full pipe.
  void await_work(std::unique_lock<std::mutex>& lock) {
    sleeping_ = true;  // before looking: what comes after the look wakes us
    bool hungry = false;
    bool found = false;
    std::vector<pollfd> fds{{waker_.fd(), POLLIN, 0}};
    for (const auto& member : members_) {
      if (member->writer_.left() > 0) {
        fds.push_back({member->writer_.fd(), POLLOUT, 0});
        continue;
      }
      hungry = true;
      const std::lock_guard<std::mutex> waiting(member->mutex_);
      found = found || !member->waiting_.empty();
    }
    if (found || !hungry) sleeping_ = false;  // where all are full a frame is no reason to wake up
    if (found) return;
    lock.unlock();
    ::poll(fds.data(), fds.size(), -1);
    if ((fds[0].revents & POLLIN) != 0) waker_.clear();
    lock.lock();
    sleeping_ = false;
  }

  net::Waker waker_;
  std::mutex mutex_;  // of the members, and of their writers; never held while a message is awaited
  std::condition_variable changed_;
  std::vector<std::shared_ptr<Member>> members_;
  std::atomic<int> asking_{0};
  std::atomic<bool> sleeping_{false};  // until there is a frame
  bool stopping_ = false;
  std::thread thread_;
};

}  // namespace cortex::pipe
