"""The virtual Leaf: a simulated car and its sensors down to NCOM and CAN bytes."""
