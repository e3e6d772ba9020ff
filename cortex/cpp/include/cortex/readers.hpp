// SPDX-License-Identifier: Apache-2.0
// Who reads one publisher, and which way each reader gets its frames.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <string>
#include <system_error>
#include <utility>
#include <vector>

#include "cortex/outlet.hpp"
#include "cortex/pipe.hpp"
#include "cortex/relay.hpp"
#include "cortex/ring.hpp"
#include "cortex/wire.hpp"

namespace cortex::detail {

// One subscriber's link to this publisher.
struct Reader {
  std::string key;
  wire::AttachKey request;
  Outlet* outlet = nullptr;
  std::uint32_t column = wire::no_column;
  std::unique_ptr<pipe::Writer> pipe;  // where its frames go; null: through the outlet
  std::shared_ptr<pipe::Relay::Member> member;  // of the relay that writes the pipe; null: we do
  bool late = false;  // its pipe was full for too long: it holds up nothing until it has room again
  bool left = false;
  std::uint64_t confirmed = 0;  // it has accounted for all below this
};

// Calls are made under the publisher's lock. Readers are shared so that one may leave while the publisher, having let
// go of the lock, waits for it.
class Readers {
 public:
  using List = std::vector<std::shared_ptr<Reader>>;

  const List& all() const noexcept { return all_; }
  const List& piped() const noexcept { return piped_; }
  bool empty() const noexcept { return all_.empty(); }
  std::size_t size() const noexcept { return all_.size(); }
  // Those that the outlet itself serves.
  std::size_t socket_count(const Outlet& outlet) const noexcept { return outlet.strict ? strict_ : lossy_; }

  // Takes a reader in; with a column of the lease table, and through its pipe, if it offers that and there is room.
  const std::shared_ptr<Reader>& add(Outlet& outlet, const std::string& key, const wire::AttachKey& request,
                                     bool shared_memory, const std::string& folder) {
    auto reader = std::make_shared<Reader>();
    reader->key = key;
    reader->request = request;
    reader->outlet = &outlet;
    if (request.shared_memory && shared_memory) reader->column = free_column();
    if (reader->column != wire::no_column) reader->pipe = pipe::Writer::open(folder, request.reader);
    if (reader->pipe == nullptr) {
      ++(outlet.strict ? strict_ : lossy_);
    } else {
      piped_.push_back(reader);
    }
    return all_.emplace_back(std::move(reader));
  }

  // Null if there is no such reader.
  std::shared_ptr<Reader> remove(const std::string& key) {
    const auto found =
        std::find_if(all_.begin(), all_.end(), [&](const auto& reader) { return reader->key == key; });
    if (found == all_.end()) return nullptr;
    const std::shared_ptr<Reader> reader = std::move(*found);
    all_.erase(found);
    if (reader->pipe == nullptr) --(reader->outlet->strict ? strict_ : lossy_);
    take_back(*reader);
    piped_.erase(std::remove(piped_.begin(), piped_.end(), reader), piped_.end());
    reader->left = true;
    settle();
    return reader;
  }

  // Lets a relay write the pipes if there are many, else their publisher; what is to be written directly is written.
  void settle() {
    if (piped_.size() <= direct_max) return end_relay();
    try {
      if (relay_ == nullptr) relay_ = std::make_unique<pipe::Relay>();
    } catch (const std::system_error&) {
      return;  // slower, but as well
    }
    for (const auto& reader : piped_) {
      if (reader->member == nullptr) reader->member = relay_->add(*reader->pipe);
    }
  }

  // Writes a frame into a reader's pipe, or as much of it as there is room for, and keeps the rest; false if there is
  // no room.
  bool write(Reader& reader, Span<const std::uint8_t> frame) {
    return reader.member == nullptr ? reader.pipe->write(frame) : relay_->put(*reader.member, frame);
  }

  // Writes what is left of frames.
  void flush() {
    for (const auto& reader : piped_) {
      if (reader->member == nullptr) reader->pipe->flush();
    }
  }

  // Gives all readers away.
  List release() noexcept {
    end_relay();
    for (const auto& reader : all_) reader->left = true;
    piped_.clear();
    lossy_ = strict_ = 0;
    return std::exchange(all_, {});
  }

  // Readers that share the slots, so that one slow reader cannot take the ring from the others.
  std::uint32_t shares() const noexcept {
    std::uint32_t columns = 0;
    for (const auto& reader : all_) columns += reader->column == wire::no_column ? 0 : 1;
    return std::max<std::uint32_t>(1, columns + (columns < all_.size() ? 1 : 0));
  }

  // The slots of a ring that may be pinned, or leased to one reader.
  std::uint32_t quota(const Ring& ring) const noexcept {
    return std::max<std::uint32_t>(1, (ring.slots() - 1) / shares());
  }

  bool has_room(const Reader& reader, Ring& ring) const noexcept {
    std::uint32_t slots = quota(ring);
    if (reader.request.quota != 0) slots = std::min<std::uint32_t>(slots, reader.request.quota);
    return ring.outstanding(reader.column, slots) < slots;
  }

  // The columns that get a lease of the next message of a ring, and whether some reader is passed over.
  std::uint64_t grant(Ring& ring, bool& passed_over) const noexcept {
    std::uint64_t mask = 0;
    for (const auto& reader : all_) {
      if (reader->column == wire::no_column) continue;
      if (has_room(*reader, ring)) {
        mask |= std::uint64_t{1} << reader->column;
      } else {
        passed_over = true;
      }
    }
    return mask;
  }

  // Whether some reader of this outlet has no part in shared memory.
  bool any_inline(const Outlet& outlet) const noexcept {
    return std::any_of(all_.begin(), all_.end(), [&](const auto& reader) {
      return reader->outlet == &outlet && reader->column == wire::no_column;
    });
  }

  // The longest that a reader which this outlet itself serves may hold up the publisher.
  std::uint32_t timeout_ms(const Outlet& outlet) const noexcept {
    std::uint32_t longest = 0;
    for (const auto& reader : all_) {
      if (reader->outlet == &outlet && reader->pipe == nullptr) longest = std::max(longest, reader->request.timeout_ms);
    }
    return longest;
  }

 private:
  // So many pipes a publisher writes itself: what is quickest for one reader is a storm of wake-ups for many.
  static constexpr std::size_t direct_max = 2;

  void take_back(Reader& reader) noexcept {
    if (reader.member != nullptr) relay_->remove(reader.member);
    reader.member.reset();
  }

  void end_relay() noexcept {
    if (relay_ == nullptr) return;
    for (const auto& reader : piped_) take_back(*reader);
    relay_.reset();
  }

  std::uint32_t free_column() const noexcept {
    for (std::uint32_t column = 0; column < wire::column_count; ++column) {
      if (std::none_of(all_.begin(), all_.end(), [&](const auto& other) { return other->column == column; })) {
        return column;
      }
    }
    return wire::no_column;
  }

  List all_;
  List piped_;
  std::unique_ptr<pipe::Relay> relay_;
  std::size_t lossy_ = 0;
  std::size_t strict_ = 0;
};

}  // namespace cortex::detail
