"""The st command: it only hands over."""
