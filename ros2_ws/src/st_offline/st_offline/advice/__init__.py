"""Which model is good enough, for which horizon and speed: cost, error and band width of each model and step."""
