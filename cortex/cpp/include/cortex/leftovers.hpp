// SPDX-License-Identifier: Apache-2.0
// What publishers that have closed owe their readers still; their node delivers it as long as it lives.
#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "cortex/pipe.hpp"
#include "cortex/ring.hpp"
#include "cortex/wire.hpp"

namespace cortex::detail {

struct Outlet;

// Of one publisher: the rests of frames that pipes had room for in part only, behind them the number of the message
// that would have come next, by which readers know what they lost, and messages in slots.
struct Leftover {
  struct Reader {
    std::string key;
    Outlet* outlet = nullptr;
    std::uint32_t column = wire::no_column;
    std::unique_ptr<pipe::Writer> pipe;  // null: it has got all that it can get
    bool told = false;                   // that this was all
    std::uint64_t number = 0;            // the reader's own
    bool owes = false;                   // it has not said yet that it has everything: a socket may lose what it took
  };

  std::vector<Reader> readers;
  std::vector<std::shared_ptr<Ring>> rings;
  std::uint64_t sequence = 0;                       // of the message that would have come next
  std::array<std::uint8_t, wire::header_size> end{};  // the last frame

  // Writes what there is room for, and lets the rings go that nobody reads; whether there was room in some pipe.
  bool deliver() {
    bool written = false;
    for (auto& reader : readers) {
      if (reader.pipe == nullptr) continue;
      const std::size_t left = reader.pipe->left();
      reader.told = reader.told || reader.pipe->write({end.data(), end.size()});
      const bool done = reader.told && reader.pipe->flush();
      written = written || done || reader.pipe->left() != left;
      if (done) reader.pipe.reset();
    }
    rings.erase(std::remove_if(rings.begin(), rings.end(), [](const auto& ring) { return !ring->is_leased(); }),
                rings.end());
    return written;
  }

  void detach(const std::string& key) noexcept {
    for (auto& reader : readers) {
      if (reader.key != key) continue;
      reader.pipe.reset();
      reader.owes = false;
      if (reader.column == wire::no_column) continue;
      for (const auto& ring : rings) ring->free_column(reader.column);
    }
  }

  void confirm(std::uint64_t number, std::uint64_t up_to) noexcept {
    for (auto& reader : readers) {
      if (reader.number == number && up_to >= sequence) reader.owes = false;
    }
  }

  bool empty() const noexcept {
    return rings.empty() && std::all_of(readers.begin(), readers.end(), [](const auto& reader) {
             return reader.pipe == nullptr && !reader.owes;
           });
  }
};

// Of all publishers of a node. Calls are made under the lock of its outlets.
class Leftovers {
 public:
  void add(Leftover leftover) {
    leftover.deliver();
    if (!leftover.empty()) list_.push_back(std::move(leftover));
  }

  // A reader has left or died.
  void detach(const std::string& key) noexcept {
    for (auto& leftover : list_) leftover.detach(key);
  }

  // A reader has accounted for all below a sequence.
  void confirm(std::uint64_t number, std::uint64_t up_to) noexcept {
    for (auto& leftover : list_) leftover.confirm(number, up_to);
  }

  // Delivers what can be delivered now; whether that was something.
  bool deliver() {
    bool written = false;
    for (auto& leftover : list_) written = leftover.deliver() || written;
    list_.erase(std::remove_if(list_.begin(), list_.end(), [](const auto& leftover) { return leftover.empty(); }),
                list_.end());
    return written;
  }

  bool empty() const noexcept { return list_.empty(); }
  const std::vector<Leftover>& all() const noexcept { return list_; }
  void clear() noexcept { list_.clear(); }

 private:
  std::vector<Leftover> list_;
};

}  // namespace cortex::detail
