"""Parts of the node that talk to ROS."""
