"""`cortex bench`: Cortex beside raw pyzmq, zenoh, iceoryx2, LCM and memory copies, in one run."""
