"""A bridge between Cortex and ROS 2, in both directions, with or without a ROS installation."""
