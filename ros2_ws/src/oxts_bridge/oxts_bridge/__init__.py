"""OxTS NCOM: codec (free of ROS), conversion to ROS messages, and the lifecycle node that publishes them."""
