"""Predictor, evaluator and recorder nodes and the launch files of the suite."""
