"""Decodes live or logged CAN frames with a DBC, and publishes the signals of a live bus as ROS 2 topics."""
