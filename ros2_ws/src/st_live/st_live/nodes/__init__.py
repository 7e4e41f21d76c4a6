"""Processes of st that speak ROS."""
