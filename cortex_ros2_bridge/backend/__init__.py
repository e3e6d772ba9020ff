"""Ways to reach ROS 2: rclpy where it is installed, DDS without it, or a file. All carry CDR bytes."""
