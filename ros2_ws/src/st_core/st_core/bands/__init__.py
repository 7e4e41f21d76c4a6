"""Prediction bands: regions around a predicted path that contain the whole measured path with a given probability.

A band has half-widths along, across and in yaw at every point of the horizon, for every model, mode and level. In
hindsight it covers the error of the model alone, in a forecast also the error of the assumed driver inputs. Bands are
calibrated on errors of recorded drives (`compute_error_samples`, `calibrate`) and stored in a file (`Bands`).
"""

from .calibration import (
    LEVELS,
    RELIABILITY_LEVELS,
    Band,
    ErrorSamples,
    NotFiniteError,
    calibrate,
    compute_error_samples,
    compute_highest_level,
    join_runs,
    to_predicted_frame,
)
from .file import Bands
from .live import AdaptiveBand, AdaptiveBands, BandCoverage, CalibratedBands, CoverageMonitor, conditions_now
from .scale import (
    CONDITIONS,
    CalibrationDomain,
    activity_instants,
    compute_conditions,
    conditions_at,
    steering_activity,
)

__all__ = ["CONDITIONS", "LEVELS", "RELIABILITY_LEVELS", "AdaptiveBand", "AdaptiveBands", "Band", "BandCoverage",
           "Bands", "CalibratedBands", "CalibrationDomain", "CoverageMonitor", "ErrorSamples", "NotFiniteError",
           "activity_instants", "calibrate", "compute_conditions", "compute_error_samples", "compute_highest_level",
           "conditions_at", "conditions_now", "join_runs", "steering_activity", "to_predicted_frame"]
