// SPDX-License-Identifier: Apache-2.0
// A component that reads events from Cortex itself and hands them to the other components of its container, by pointer:
// no bridge, no DDS, one copy (the encoding).
//
//     ros2 component load /ComponentManager neurosim_cpp_examples neurosim_cpp_examples::CortexEvents
//         -e use_intra_process_comms:=true -p cortex_topic:=/drone/events
#include <atomic>
#include <chrono>
#include <memory>
#include <string>
#include <thread>
#include <utility>

#include <cortex/messages.hpp>
#include <cortex/node.hpp>
#include <event_camera_msgs/msg/event_packet.hpp>
#include <rclcpp/rclcpp.hpp>
#include <rclcpp_components/register_node_macro.hpp>

#include "mono.hpp"

namespace neurosim_cpp_examples {

using event_camera_msgs::msg::EventPacket;

class CortexEvents : public rclcpp::Node {
 public:
  explicit CortexEvents(const rclcpp::NodeOptions& options) : Node("cortex_events", options), cortex_("cortex_events") {
    const auto topic = declare_parameter<std::string>("cortex_topic", "/drone/events");
    packets_ = create_publisher<EventPacket>("events", rclcpp::SensorDataQoS().keep_last(128));
    thread_ = std::thread([this, topic] { run(topic); });
  }

  ~CortexEvents() override {
    has_ended_ = true;
    thread_.join();
  }

 private:
  void run(const std::string& topic) {
    using namespace std::chrono_literals;
    auto events = cortex_.subscribe<cortex::messages::Events>(topic, cortex::keep_last(256));
    while (!has_ended_) {
      try {
        const auto received = events.receive(100ms);
        if (received && packets_->get_subscription_count() + packets_->get_intra_process_subscription_count() > 0) {
          packets_->publish(packet_of(**received));
        }
      } catch (const std::exception& error) {  // another type on the topic, or a packet that mono cannot hold
        RCLCPP_ERROR_THROTTLE(get_logger(), *get_clock(), 1000, "%s: %s", topic.c_str(), error.what());
      }
    }
  }

  static std::unique_ptr<EventPacket> packet_of(const cortex::messages::Events& events) {
    auto packet = std::make_unique<EventPacket>();
    packet->time_base = encode_mono(events, packet->events);
    packet->header.stamp = rclcpp::Time(static_cast<std::int64_t>(packet->time_base));
    packet->header.frame_id = events.frame_id;
    packet->width = events.width;
    packet->height = events.height;
    packet->seq = events.sequence;
    packet->encoding = "mono";
    packet->is_bigendian = false;
    return packet;
  }

  cortex::Node cortex_;
  rclcpp::Publisher<EventPacket>::SharedPtr packets_;
  std::atomic<bool> has_ended_{false};
  std::thread thread_;
};

}  // namespace neurosim_cpp_examples

RCLCPP_COMPONENTS_REGISTER_NODE(neurosim_cpp_examples::CortexEvents)
