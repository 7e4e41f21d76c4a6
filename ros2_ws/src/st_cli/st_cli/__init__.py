"""The st command: options and messages only."""
