// SPDX-License-Identifier: Apache-2.0
// Flies a circle: answers each odometry with a velocity, stamped with what it answers, so that lockstep works too.
//
//     ros2 run neurosim_cpp_examples circle_controller --ros-args -p radius_m:=0.4 -p vehicle:=drone
#include <algorithm>
#include <cmath>
#include <memory>
#include <string>

#include <geometry_msgs/msg/twist_stamped.hpp>
#include <nav_msgs/msg/odometry.hpp>
#include <rclcpp/rclcpp.hpp>

namespace neurosim_cpp_examples {

class CircleController : public rclcpp::Node {
 public:
  CircleController() : Node("circle_controller") {
    radius_m_ = declare_parameter("radius_m", 0.4);
    period_s_ = declare_parameter("period_s", 6.0);
    const std::string base = "/" + declare_parameter<std::string>("vehicle", "drone");
    commands_ = create_publisher<geometry_msgs::msg::TwistStamped>(base + "/command_velocity", 1);
    states_ = create_subscription<nav_msgs::msg::Odometry>(
        base + "/odometry", rclcpp::QoS(10), [this](const nav_msgs::msg::Odometry& state) { answer(state); });
  }

 private:
  void answer(const nav_msgs::msg::Odometry& state) {
    const auto& p = state.pose.pose.position;
    const rclcpp::Time now(state.header.stamp);
    if (!has_begun_ || now < begin_) {  // the first state, or one after a reset
      has_begun_ = true;
      begin_ = now;
      center_x_ = p.x - radius_m_;
      center_y_ = p.y;
      height_m_ = p.z;
    }
    const double rate = 2.0 * M_PI / period_s_, angle = rate * (now - begin_).seconds();
    const double x = center_x_ + radius_m_ * std::cos(angle), y = center_y_ + radius_m_ * std::sin(angle);
    geometry_msgs::msg::TwistStamped command;
    command.header.stamp = state.header.stamp;
    command.header.frame_id = "map";
    const double ahead = angle + rate * 0.1;  // 0.1 s later the vehicle has the velocity that it is told
    command.twist.linear.x = -radius_m_ * rate * std::sin(ahead) + correction(x - p.x);
    command.twist.linear.y = radius_m_ * rate * std::cos(ahead) + correction(y - p.y);
    command.twist.linear.z = correction(height_m_ - p.z);
    commands_->publish(command);
  }

  static double correction(double error_m) { return std::clamp(2.0 * error_m, -1.0, 1.0); }

  double radius_m_{}, period_s_{}, center_x_{}, center_y_{}, height_m_{};
  bool has_begun_ = false;
  rclcpp::Time begin_;
  rclcpp::Publisher<geometry_msgs::msg::TwistStamped>::SharedPtr commands_;
  rclcpp::Subscription<nav_msgs::msg::Odometry>::SharedPtr states_;
};

}  // namespace neurosim_cpp_examples

int main(int argc, char** argv) {
  rclcpp::init(argc, argv);
  rclcpp::spin(std::make_shared<neurosim_cpp_examples::CircleController>());
  rclcpp::shutdown();
  return 0;
}
