"""OxTS NCOM (UDP or file) to ROS 2 topics: codec, converter, lifecycle node."""
