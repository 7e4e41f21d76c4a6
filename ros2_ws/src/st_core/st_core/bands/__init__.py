"""Prediction bands: regions around a predicted path that contain the whole measured path with a given probability.

A band has half-widths along, across and in yaw at every point of the horizon, for every model, mode and level. In
hindsight it covers the error of the model alone; in a forecast, also the error of the assumed driver inputs. Bands are
calibrated on errors of recorded drives (`compute_error_samples`, `calibrate`) and stored in a file (`Bands`).
"""

from .calibration import Band, ErrorSamples, NotFiniteError, calibrate, compute_error_samples
from .file import Bands
from .live import AdaptiveBand, AdaptiveBands, BandCoverage, CalibratedBands, CoverageMonitor, conditions_now
from .scale import CalibrationDomain, activity_instants, compute_conditions, conditions_at, steering_activity

__all__ = ["AdaptiveBand", "AdaptiveBands", "Band", "BandCoverage", "Bands", "CalibratedBands", "CalibrationDomain",
           "CoverageMonitor", "ErrorSamples", "NotFiniteError", "activity_instants", "calibrate", "compute_conditions",
           "compute_error_samples", "conditions_at", "conditions_now", "steering_activity"]
