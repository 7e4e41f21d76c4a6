"""Processes of the suite that use ROS."""
