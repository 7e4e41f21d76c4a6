"""CAN frames (live or logged) to ROS 2 topics through a DBC."""
