"""ROS nodes of the running suite: monitor, player, passenger's page and relay."""
