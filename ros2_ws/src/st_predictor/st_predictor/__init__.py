"""ROS 2 nodes predictor, evaluator, recorder, identifier and markers, and the launch files of the suite."""
