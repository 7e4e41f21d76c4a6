"""The file bands.yaml: the bands of one car, by model and mode, with their settings and the recordings used.

    schema: 3
    units: "..."                                         text for the reader; not part of the hash
    vehicle: {name: "...", hash: "..."}
    settings: {horizon: 5.0, step: 0.05, ...}            settings of the predictions; SI
    runs: 12
    calibration_domain: {starts_per_cell: [[...]], upper_limits: [...]}
    recordings: {"run.csv": "sha256 ..."}
    bands: {linear: {configuration_hash: "...", hindsight: {...}, forecast: {...}}}
    hash: "..."

Floors are in m, m, rad; coefficients give the natural logarithm of a scale in m, m, rad; factors and ratios are
dimensionless. hindsight: predictions with the inputs as measured; forecast: with those at the start held constant.
An edited file is rejected, because its hash no longer matches.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from ..errors import ConfigurationError, add_prefix
from ..log_evaluation import MODES, EvaluationSettings
from ..prediction import PredictionSettings, configuration_hash
from ..vehicle import VehicleParameters
from ..yaml_text import check_keys, dump, hash_content, load
from .calibration import Band, ModelMode
from .scale import KNOTS, CalibrationDomain, Scale, compute_features

SCHEMA = 3
HEADER = "# Prediction bands by model and mode. Written by `st calibrate`.\n"
UNITS = "floor: m, m, rad; coefficients: natural logarithm of m, m, rad; factors, ratios: 1; upper_limits: m/s^2, rad/s"
CHECKED_SETTINGS = ("horizon", "step", "minimum_speed", "maximum_gap", "filter_cutoff", "acceleration", "inputs")
"""Settings that affect the errors or limit the speed at the start; the others (interval, stale_after) do neither."""


@dataclass(frozen=True, eq=False)
class Bands:
    """All bands of a car."""

    vehicle_name: str
    vehicle_hash: str
    settings: Mapping[str, Any]  # from `EvaluationSettings.as_dict`
    recordings: Mapping[str, str]  # sha256 (hex) by name
    runs: int  # number of runs
    domain: CalibrationDomain
    bands: Mapping[ModelMode, Band]  # by (model, mode)
    hashes: Mapping[str, str] = field(default_factory=dict)  # `prediction.configuration_hash` by model

    @property
    def models(self) -> tuple[str, ...]:
        return tuple(self.hashes)

    @property
    def time(self) -> np.ndarray:
        """Times (points,) of the half-widths [s], without the start at 0."""
        return make_times(self.settings["horizon"], self.settings["step"])

    def half_widths(self, model: str, mode: str, conditions: np.ndarray, level: float) -> np.ndarray:
        """Half-widths (n, points + 1, 3) along and across the predicted heading [m] and in yaw [rad]; 0 at the start.
        With probability `level`, the whole measured path of the INS point is inside all three half-widths. NaN outside
        the calibration domain (`CalibrationDomain.describe_outside`). conditions: (n, 4), from `compute_conditions`.
        Raises KeyError for a model, mode or level that is not in the file."""
        band = self.bands[model, mode]
        conditions = np.atleast_2d(np.asarray(conditions, float))
        inside = self.domain.contains(conditions)
        result = np.full((len(conditions), len(band.scale.time) + 1, 3), np.nan)
        result[inside, 0] = 0.0
        result[inside, 1:] = band.half_widths(conditions[inside], level)
        return result

    def check(self, vehicle: VehicleParameters, models: Mapping[str, str],
              settings: EvaluationSettings | None = None) -> None:
        """Raises a one-line ConfigurationError if the bands belong to a different car, model or configuration. models:
        hash of the model file of each model to use, "" for a built-in model. settings: None for any."""
        if vehicle.hash != self.vehicle_hash:
            raise ConfigurationError(f"vehicle: the bands are for {self.vehicle_name!r} {self.vehicle_hash[:12]}, "
                                     f"this is {vehicle.name!r} {vehicle.hash[:12]}; calibrate with drives of this car")
        current = self.settings if settings is None else settings.as_dict()
        for key in CHECKED_SETTINGS:
            if current[key] != self.settings[key]:
                raise ConfigurationError(f"settings.{key}: the bands are for {self.settings[key]}, not {current[key]}; "
                                         "use the same value, or calibrate with this one")
        for model, digest in models.items():
            if model not in self.hashes:
                raise ConfigurationError(f"bands.{model}: missing; the file has {', '.join(self.models)}; calibrate "
                                         "with that model")
            if hash_configuration(vehicle, self.settings, digest) != self.hashes[model]:
                raise ConfigurationError(f"bands.{model}: calibrated with a different model of this name; recalibrate")

    def to_yaml(self) -> str:
        """Text of the file, which `from_yaml` reads."""
        entries: dict[str, Any] = {model: {"configuration_hash": digest} for model, digest in self.hashes.items()}
        for (model, mode), band in self.bands.items():
            entries[model][mode] = {
                "factors": {f"{level:g}": c for level, c in band.factors.items()}, "floor": band.scale.floor.tolist(),
                "ratios": band.ratios.tolist(), "coefficients": band.scale.coefficients.tolist()}
        document: dict[str, Any] = {
            "vehicle": {"name": self.vehicle_name, "hash": self.vehicle_hash}, "settings": dict(self.settings),
            "recordings": dict(self.recordings), "runs": self.runs,
            "calibration_domain": {"starts_per_cell": self.domain.starts.tolist(),
                                   "upper_limits": list(self.domain.upper_limits)}, "bands": entries}
        return HEADER + dump({"schema": SCHEMA, "units": UNITS, **document, "hash": hash_content(document)})

    @classmethod
    def from_yaml(cls, text: str, origin: str = "bands") -> "Bands":
        """The bands in a file. origin: name for messages, usually the path. Raises a one-line ConfigurationError."""
        return add_prefix(f"{origin}: ", lambda: cls._read(load(text)),
                          "not a complete bands file; write one with st calibrate")

    @classmethod
    def _read(cls, document: Any) -> "Bands":
        if not isinstance(document, dict):
            raise ConfigurationError("not a bands file; write one with st calibrate")
        keys = ["schema", "units", "vehicle", "settings", "recordings", "runs", "calibration_domain", "bands", "hash"]
        if (schema := document.get("schema", SCHEMA)) != SCHEMA:
            raise ConfigurationError(f"schema: {schema} is not supported, only {SCHEMA}; run st calibrate again")
        check_keys("", document, keys, required=keys)
        if hash_content({key: document[key] for key in keys[2:-1]}) != document["hash"]:
            raise ConfigurationError("hash: the content was edited; run st calibrate again")
        settings = document["settings"]
        time = make_times(settings["horizon"], settings["step"])
        bands: dict[ModelMode, Band] = {}
        hashes = {model: str(entry["configuration_hash"]) for model, entry in document["bands"].items()}
        for model, entry in document["bands"].items():
            for mode in (m for m in MODES if m in entry):
                mode_entry = entry[mode]
                coefficients = np.array(mode_entry["coefficients"], float)
                if coefficients.shape != (3, len(KNOTS), compute_features(np.zeros((1, 4))).shape[1]):
                    raise ConfigurationError("coefficients: written by a different version; calibrate again")
                scale = Scale(coefficients, np.array(mode_entry["floor"], float), time)
                bands[model, mode] = Band(scale, {float(k): float(v) for k, v in mode_entry["factors"].items()},
                                          np.array(mode_entry["ratios"], float))
        domain_entry = document["calibration_domain"]
        acceleration, activity = map(float, domain_entry["upper_limits"])
        domain = CalibrationDomain(np.array(domain_entry["starts_per_cell"], int), (acceleration, activity))
        return cls(document["vehicle"]["name"], document["vehicle"]["hash"], settings, document["recordings"],
                   int(document["runs"]), domain, bands, hashes)


def make_times(horizon: float, step: float) -> np.ndarray:
    """Times (points,) of the horizon without the start [s]."""
    return step * np.arange(1, round(horizon / step) + 1)


def hash_configuration(vehicle: VehicleParameters, settings: Mapping[str, Any], model_hash: str) -> str:
    """The configuration hash of predictions with these settings. model_hash: "" for a built-in model."""
    prediction = PredictionSettings(**{setting.name: settings[setting.name] for setting in fields(PredictionSettings)})
    return configuration_hash(vehicle, prediction, model_hash)
