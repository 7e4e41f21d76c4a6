"""Decodes CAN frames, live or logged, with a DBC and publishes their signals as ROS 2 topics."""
