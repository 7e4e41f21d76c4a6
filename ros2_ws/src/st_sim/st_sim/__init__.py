"""Simulated Nissan Leaf and its sensors, with NCOM and CAN output."""
