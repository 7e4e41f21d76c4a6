"""Decodes live or logged CAN frames with a DBC, and publishes live signals as ROS 2 topics."""
