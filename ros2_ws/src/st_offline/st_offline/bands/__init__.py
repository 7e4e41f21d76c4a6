"""Prediction bands: calibration from recordings, test on other runs, report."""
