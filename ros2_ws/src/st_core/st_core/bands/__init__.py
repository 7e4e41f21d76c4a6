"""Prediction bands: regions around a predicted path that contain the whole measured path with a given probability.

A band has half-widths along, across and in yaw at every point of the horizon, for every model, mode and level. In
hindsight it covers the error of the model alone, in a forecast also the error of the assumed driver inputs. Bands are
calibrated on errors of recorded drives (`error_samples`, `calibrate`) and stored in a file (`Bands`).
"""

from .adaptive import AdaptiveBand
from .calibration import LEVELS, RELIABILITY, Band, calibrate, conformal_factors, highest_level, runs_needed
from .conditions import CONDITIONS, CalibrationDomain, activity_instants, conditions, conditions_at, steering_activity
from .file import Bands
from .live import AdaptiveBands, BandCoverage, CoverageMonitor, LiveBands, conditions_now
from .samples import ErrorSamples, NotFiniteError, error_samples, join_runs, to_predicted_frame

__all__ = ["CONDITIONS", "LEVELS", "RELIABILITY", "AdaptiveBand", "AdaptiveBands", "Band", "BandCoverage", "Bands",
           "CalibrationDomain", "CoverageMonitor", "ErrorSamples", "LiveBands", "NotFiniteError", "activity_instants",
           "calibrate", "conditions", "conditions_at", "conditions_now", "conformal_factors", "error_samples",
           "highest_level", "join_runs", "runs_needed", "steering_activity", "to_predicted_frame"]
