// SPDX-License-Identifier: Apache-2.0
// Flies a vehicle by a policy of `neurosim learn`: events and odometry in, thrust and body rates out, also in lockstep.
#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <cstdlib>
#include <iostream>
#include <stdexcept>
#include <string>
#include <vector>

#include <onnxruntime_cxx_api.h>

#include <cortex/messages.hpp>
#include <cortex/node.hpp>

using cortex::messages::Events;
using cortex::messages::Odometry;
using cortex::messages::RateThrustCommand;

// The number, or the list of numbers, of a key in the card of a policy, which is JSON.
std::vector<double> numbers(const std::string& card, const std::string& key) {
  const auto place = card.find('"' + key + "\":");
  if (place == std::string::npos) throw std::runtime_error("the policy does not say its " + key);
  std::vector<double> found;
  for (std::size_t at = place + key.size() + 3;;) {
    at = std::min(card.find_first_not_of(" [,", at), card.size());
    char* end = nullptr;
    const double value = std::strtod(card.c_str() + at, &end);
    if (end == card.c_str() + at) return found;
    found.push_back(value);
    at = static_cast<std::size_t>(end - card.c_str());
  }
}

class Policy {
 public:
  explicit Policy(const char* file) : session_(env_, file, one_thread()) {
    Ort::AllocatorWithDefaultOptions allocator;
    const auto text = session_.GetModelMetadata().LookupCustomMetadataMapAllocated("neurosim", allocator);
    if (!text) throw std::runtime_error(std::string(file) + " is no policy of neurosim learn");
    const std::string card = text.get();
    if (card.find("LeakySurface") == std::string::npos) throw std::runtime_error("only LeakySurface is known here");
    if (card.find("\"mode\":") != std::string::npos && card.find("\"mode\": \"rates\"") == std::string::npos)
      throw std::runtime_error("only policies that command thrust and body rates are flown here");
    if (card.find("\"dtype\":") != std::string::npos && card.find("\"dtype\": \"float32\"") == std::string::npos)
      throw std::runtime_error("only surfaces of float32 are known here");
    rate_hz_ = numbers(card, "rate_hz").at(0);
    tau_s_ = numbers(card, "tau_s");
    width_ = static_cast<std::size_t>(numbers(card, "width").at(0));
    height_ = static_cast<std::size_t>(numbers(card, "height").at(0));
    hover_thrust_n_ = numbers(card, "hover_thrust_n").at(0);
    thrust_span_ = numbers(card, "thrust_span").at(0);
    rate_max_rad_s_ = numbers(card, "rate_max_rad_s");
    surfaces_.resize(2 * tau_s_.size() * height_ * width_);
    added_.resize(surfaces_.size());
    memory_.resize(static_cast<std::size_t>(
        session_.GetInputTypeInfo(2).GetTensorTypeAndShapeInfo().GetElementCount()));
  }

  // Forgets everything: an episode begins.
  void reset() {
    std::fill(surfaces_.begin(), surfaces_.end(), 0.0f);
    std::fill(memory_.begin(), memory_.end(), 0.0f);
    action_.fill(0.0f);
  }

  // Surfaces are sums of exp(-(now - t) / tau), off and on for each tau. Those of the events of a step are added in
  // fixed point and float, as by `neurosim_core/learn/surfaces.py`, so that policies see the same numbers.
  void add(const Events& events, std::int64_t now_ns) {
    if (events.width != width_ || events.height != height_) throw std::runtime_error("events of another camera");
    for (std::size_t event = 0; event < events.t.size(); ++event) {
      const auto age_us = static_cast<float>(now_ns / 1000 - events.t[event]);
      for (std::size_t scale = 0; scale < tau_s_.size(); ++scale) {
        const std::size_t row = (2 * scale + events.polarity[event]) * height_ + events.y[event];
        const float weight = std::exp(-age_us / static_cast<float>(1e6 * tau_s_[scale]));
        added_[row * width_ + events.x[event]] += static_cast<std::int32_t>(std::round(weight * one_));
      }
    }
  }

  // Ends a step: what was seen before fades, and its events are shown.
  void show() {
    const std::size_t plane = height_ * width_;
    for (std::size_t channel = 0; channel < 2 * tau_s_.size(); ++channel) {
      const auto share = static_cast<float>(std::exp(-1.0 / (rate_hz_ * tau_s_[channel / 2])));
      for (std::size_t pixel = channel * plane; pixel < (channel + 1) * plane; ++pixel)
        surfaces_[pixel] = surfaces_[pixel] * share + static_cast<float>(added_[pixel]) / one_;
    }
    std::fill(added_.begin(), added_.end(), 0);
  }

  RateThrustCommand act(const Odometry& state) {
    const auto [x, y, z, w] = state.orientation;  // of it only the direction of gravity in B is used
    const std::array<double, 3> gravity{2.0 * (w * y - x * z), -2.0 * (w * x + y * z), 2.0 * (x * x + y * y) - 1.0};
    std::array<float, 10> vector{};
    for (std::size_t axis = 0; axis < 3; ++axis) {
      vector[axis] = static_cast<float>(gravity[axis]);
      vector[3 + axis] = static_cast<float>(0.3 * state.body_rate[axis]);
    }
    std::copy(action_.begin(), action_.end(), vector.begin() + 6);
    const auto size = [](std::size_t n) { return static_cast<std::int64_t>(n); };
    const std::array<std::int64_t, 4> shape{1, size(2 * tau_s_.size()), size(height_), size(width_)};
    const std::array<std::int64_t, 2> row{1, 10}, memory_row{1, size(memory_.size())};
    const auto host = Ort::MemoryInfo::CreateCpu(OrtArenaAllocator, OrtMemTypeDefault);
    const auto tensor = [&host](auto& values, const auto& dims) {
      return Ort::Value::CreateTensor<float>(host, values.data(), values.size(), dims.data(), dims.size());
    };
    std::array<Ort::Value, 3> inputs{tensor(surfaces_, shape), tensor(vector, row), tensor(memory_, memory_row)};
    constexpr std::array<const char*, 3> in{"events", "vector", "memory"};
    constexpr std::array<const char*, 2> out{"action", "memory_out"};
    auto outputs = session_.Run(Ort::RunOptions{nullptr}, in.data(), inputs.data(), 3, out.data(), 2);
    std::copy_n(outputs[0].GetTensorData<float>(), action_.size(), action_.begin());
    std::copy_n(outputs[1].GetTensorData<float>(), memory_.size(), memory_.begin());
    RateThrustCommand command;
    command.stamp_ns = state.stamp_ns;
    command.thrust_n = hover_thrust_n_ * (1.0 + thrust_span_ * static_cast<double>(action_[0]));
    for (std::size_t axis = 0; axis < 3; ++axis)
      command.body_rate[axis] = rate_max_rad_s_.at(axis) * static_cast<double>(action_[1 + axis]);
    return command;
  }

 private:
  static Ort::SessionOptions one_thread() {
    Ort::SessionOptions options;
    options.SetIntraOpNumThreads(1);
    return options;
  }

  Ort::Env env_;
  Ort::Session session_;
  double rate_hz_ = 0.0, hover_thrust_n_ = 0.0, thrust_span_ = 0.0;
  std::vector<double> tau_s_, rate_max_rad_s_;
  std::size_t width_ = 0, height_ = 0;
  static constexpr float one_ = 65536.0f;
  std::vector<float> surfaces_, memory_;
  std::vector<std::int32_t> added_;
  std::array<float, 4> action_{};
};

int main(int argc, char** argv) {
  using namespace std::chrono_literals;
  if (argc < 2) {
    std::cerr << "usage: policy POLICY.onnx [VEHICLE [COMMANDS]]\n";
    return 2;
  }
  Policy policy{argv[1]};
  const std::string vehicle = argc > 2 ? argv[2] : "drone";
  const std::uint64_t most = argc > 3 ? std::strtoull(argv[3], nullptr, 10) : UINT64_MAX;

  cortex::Node node{"policy"};
  auto packets = node.subscribe<Events>("/" + vehicle + "/events", cortex::reliable());
  auto states = node.subscribe<Odometry>("/" + vehicle + "/odometry", cortex::reliable());
  auto commands = node.advertise<RateThrustCommand>("/" + vehicle + "/command/rates");
  RateThrustCommand command;
  std::int64_t last_ns = -1, seen_ns = 0;
  std::uint64_t count = 0;
  while (count < most) {
    const auto state = states.receive(count == 0 ? 24h : 30s);
    if (!state) break;  // the simulator has ended
    const std::int64_t now_ns = (*state)->stamp_ns;
    if (count == 0 || now_ns < last_ns) {
      policy.reset();
      seen_ns = 0;  // events come with each step but the first
    }
    if (now_ns != last_ns) {  // else it is sent again
      while (seen_ns < now_ns) {
        const auto events = packets.receive(30s);
        if (!events) throw std::runtime_error("the events of a step have not come");
        seen_ns = (*events)->stamp_ns;
        policy.add(**events, now_ns);
      }
      policy.show();
      command = policy.act(**state);
      last_ns = now_ns;
    }
    command.sequence = count++;
    commands.publish(command);
  }
  std::cout << count << " commands\n";
}
