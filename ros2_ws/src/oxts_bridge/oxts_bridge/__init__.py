"""OxTS NCOM: codec without ROS, conversion to ROS messages, and the lifecycle node that publishes them."""
