"""Parameters of the vehicle file from experiments and from driving, each with its uncertainty and a verdict."""
