"""Identification of vehicle parameters from experiments and from driving, with their uncertainty."""
