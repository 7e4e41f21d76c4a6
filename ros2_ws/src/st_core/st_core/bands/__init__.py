"""Calibrated bands: how far from its predicted path the car will be, and how often that is true.

For every model and two questions kept apart - hindsight: the model alone; forecast: model and driver - half-widths
along, across and in yaw at every point of the horizon, so that the whole measured path lies inside with a stated
probability. Learnt from errors of scored starts (`run_samples`, `calibrate`), kept in a file (`Bands`).
docs/manual/bands.md.
"""

from .adaptive import AdaptiveBand
from .calibration import LEVELS, RELIABILITY, Band, calibrate, conformal_factors, highest_level, runs_needed
from .conditions import CONDITIONS, CalibrationDomain, activity_instants, conditions, conditions_at, steering_activity
from .file import Bands
from .live import AdaptiveBands, Coverage, Coverages, LiveBands, conditions_now
from .samples import NotFiniteError, RunSamples, run_samples, to_predicted_frame, together

__all__ = ["CONDITIONS", "LEVELS", "RELIABILITY", "AdaptiveBand", "AdaptiveBands", "Band", "Bands", "CalibrationDomain",
           "Coverage", "Coverages", "LiveBands", "NotFiniteError", "RunSamples", "activity_instants", "calibrate",
           "conditions", "conditions_at", "conditions_now", "conformal_factors", "highest_level", "run_samples",
           "runs_needed", "steering_activity", "to_predicted_frame", "together"]
