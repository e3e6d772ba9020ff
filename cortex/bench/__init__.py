"""`cortex bench`: Cortex beside raw pyzmq, DDS, ROS 2, memory copies and its own past, in one run."""
