// SPDX-License-Identifier: Apache-2.0
// What publishers that have closed owe their readers still; their node delivers it as long as it lives.
#pragma once

#include <algorithm>
#include <cstdint>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "cortex/wire.hpp"

namespace cortex::detail {

struct Outlet;

// Of one publisher: the word of readers of its sockets that they have everything.
struct Leftover {
  struct Reader {
    std::string key;
    Outlet* outlet = nullptr;
    std::uint64_t number = 0;  // the reader's own
    bool owes = false;         // it has not said yet that it has everything: a socket may lose what it took
  };

  std::vector<Reader> readers;
  std::uint64_t sequence = 0;  // of the message that would have come next

  void detach(const std::string& key) noexcept {
    for (auto& reader : readers) {
      if (reader.key == key) reader.owes = false;
    }
  }

  void confirm(std::uint64_t number, std::uint64_t up_to) noexcept {
    for (auto& reader : readers) {
      if (reader.number == number && up_to >= sequence) reader.owes = false;
    }
  }

  bool empty() const noexcept {
    return std::none_of(readers.begin(), readers.end(), [](const auto& reader) { return reader.owes; });
  }
};

// Of all publishers of a node. Calls are made under the lock of its outlets.
class Leftovers {
 public:
  void add(Leftover leftover) {
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

  // Lets go of what nobody needs any more.
  void deliver() {
    list_.erase(std::remove_if(list_.begin(), list_.end(), [](const auto& leftover) { return leftover.empty(); }),
                list_.end());
  }

  bool empty() const noexcept { return list_.empty(); }
  void clear() noexcept { list_.clear(); }

 private:
  std::vector<Leftover> list_;
};

}  // namespace cortex::detail
