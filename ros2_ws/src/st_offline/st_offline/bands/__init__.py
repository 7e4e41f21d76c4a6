"""Bands from recordings and back: learning them, testing them on other runs, showing how they did."""
