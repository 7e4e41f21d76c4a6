"""Model files, model.yaml: base model, effects with values and confidence intervals, and their provenance.

    base: nonlinear
    vehicle: {name: "Nissan Leaf ZE0", hash: "...", parameters: {...}}    # parameters: optional, a vehicle file
    effects:
      steering_lag:
        time_constant: {value: 0.08, unit: "s", interval: [0.07, 0.09], source: "..."}
    provenance: {date: "2026-11-21", version: "0.1.0", data: {"run.ncom": "sha256 ..."}, note: "..."}
    hash: "..."

The values are valid for one car, identified by `vehicle.hash`. A value with `effective: true` improves the prediction
but is not a property of the car. An interval is a 95 % confidence interval, null if unknown. `hash` is that of base,
values and vehicle; a file in which it differs is rejected as edited. A file without `hash` is not checked.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from . import __version__
from .augmented import AugmentedModel, augment
from .effects import get_effect
from .errors import ConfigurationError, add_prefix
from .vehicle import VEHICLE_QUANTITIES, VehicleParameters
from .yaml_text import check_keys, dump, hash_content, load

Interval = tuple[float, float] | None
MAX_LISTED_DIFFERENCES = 3  # differences between two cars listed in a message
HEADER = "# Model file: base model, its effects (SI units, 95 % intervals), and their provenance.\n"


@dataclass(frozen=True)
class EffectValue:
    """Value of one parameter of an effect, in the unit of the parameter, with 95 % interval if known, and source."""

    value: float
    interval: Interval = None
    source: str = "not stated"
    effective: bool = False  # improves the prediction but is not a property of the car


@dataclass(frozen=True)
class ModelProvenance:
    """Origin of the values of a model file."""

    date: str = ""  # day of the estimate, ISO 8601
    version: str = __version__  # of st_core
    data: Mapping[str, str] = field(default_factory=dict)  # sha256 of each run, by name
    note: str = ""  # free text


@dataclass(frozen=True)
class ModelFile:
    """Content of a model.yaml."""

    base: str  # name of the base model
    effects: Mapping[str, Mapping[str, EffectValue]]  # by effect and parameter
    vehicle: VehicleParameters | None = None  # the car, if embedded
    vehicle_name: str = ""  # car for which the values are valid; "" if not stated
    vehicle_hash: str = ""  # hash of that car
    provenance: ModelProvenance = field(default_factory=ModelProvenance)

    @classmethod
    def from_model(cls, model: AugmentedModel, vehicle: VehicleParameters, provenance: ModelProvenance,
                   intervals: Mapping[tuple[str, str], Interval] | None = None,
                   source: str = "not stated") -> "ModelFile":
        """The content for a model and its vehicle. intervals: by (effect, parameter). source: of the fitted values."""
        effects = {effect.name: {
            p.name: EffectValue(value, (intervals or {}).get((effect.name, p.name)), source if p.fit else p.source)
            for p in effect.parameters if (value := model.values[effect.name][p.name]) != p.null or p.fit}
            for effect in model.effects}
        return cls(model.base.name, effects, vehicle, vehicle.name, vehicle.hash, provenance)

    def model(self) -> AugmentedModel:
        """The model. Raises ConfigurationError for an unknown base or effect, or an inapplicable effect or value."""
        return augment(self.base, {effect: {name: estimate.value for name, estimate in estimates.items()}
                                   for effect, estimates in self.effects.items()})

    def check_vehicle(self, vehicle: VehicleParameters, origin: str, prefix: str = "") -> None:
        """Raises ConfigurationError, with this prefix, if the values are for a different car than `vehicle`, which was
        read from `origin`."""
        if self.vehicle_hash and vehicle.hash != self.vehicle_hash:
            expected, given = (f"{name!r} {digest[:12]}" for name, digest in (
                (self.vehicle_name, self.vehicle_hash), (vehicle.name, vehicle.hash)))
            differences = [f"{key}: {a:g}, {b:g} {quantity.si_unit}".removesuffix(" 1")
                           for key, quantity in VEHICLE_QUANTITIES.items()
                           if self.vehicle and (a := getattr(self.vehicle, key)) != (b := getattr(vehicle, key))]
            omitted = len(differences) - MAX_LISTED_DIFFERENCES
            listed = "; ".join(differences[:MAX_LISTED_DIFFERENCES]) + (f"; {omitted} more" if omitted > 0 else "")
            remark = f" (they differ in {listed})" if listed else ""
            raise ConfigurationError(f"{prefix}vehicle.hash: the values are valid for {expected}, but {origin} is "
                                     f"{given}{remark}; use the vehicle file with which they were identified")

    @property
    def hash(self) -> str:
        """sha256 (hex) of base, values and vehicle; intervals, sources and provenance are not included."""
        values = {effect: {name: float(estimate.value).hex() for name, estimate in estimates.items()}
                  for effect, estimates in self.effects.items()}
        return hash_content([self.base, values, self.vehicle_hash])

    def to_yaml(self) -> str:
        """The text of a model file, from which `from_yaml` reads an equal ModelFile."""
        document: dict[str, Any] = {}
        if self.vehicle_hash or self.vehicle_name:
            parameters = {"parameters": self.vehicle.to_document()} if self.vehicle else {}
            document["vehicle"] = {"name": self.vehicle_name, "hash": self.vehicle_hash, **parameters}
        effects = {name: {
            p.name: {"value": estimate.value, "unit": p.unit, "interval": estimate.interval, "source": estimate.source,
                     **({"effective": True} if estimate.effective else {})}
            for p in get_effect(name).parameters if (estimate := estimates.get(p.name))}
            for name, estimates in self.effects.items()}
        document |= {"effects": effects, "provenance": asdict(self.provenance), "hash": self.hash}
        return f"{HEADER}base: {self.base}\n{dump(document)}"

    @classmethod
    def from_yaml(cls, text: str, origin: str = "model") -> "ModelFile":
        """The content of a model file. origin: name shown in errors, usually the path.

        User-defined effects must be loaded first (`effects.load_folder`). Raises a one-line ConfigurationError.
        """
        return add_prefix(f"{origin}: ", lambda: cls._from_document(load(text)))

    @classmethod
    def _from_document(cls, document: Any) -> "ModelFile":
        document = _check_mapping("the file", document)
        check_keys("", document, ["base", "vehicle", "effects", "provenance", "hash"], required=["base", "effects"])
        effects = {str(name): _read_effect(str(name), entry)
                   for name, entry in _check_mapping("effects", document["effects"] or {}).items()}
        section = _check_mapping("provenance", document.get("provenance") or {})
        check_keys("provenance.", section, ["date", "version", "data", "note"])
        data = {str(k): _check_text(f"provenance.data.{k}", v)
                for k, v in _check_mapping("provenance.data", section.get("data") or {}).items()}
        texts = {key: _check_text(f"provenance.{key}", section.get(key, "")) for key in ("date", "version", "note")}
        file = cls(_check_text("base", document["base"]), effects, *_read_vehicle(document.get("vehicle")),
                   ModelProvenance(data=data, **texts))
        file.model()
        digest = document.get("hash")
        if digest is not None and digest != file.hash:
            raise ConfigurationError(f"hash: {str(digest)[:12]} does not match the content ({file.hash[:12]}): base, a "
                                     "value or the vehicle was edited; to accept the edit, remove the line `hash`")
        return file


def _read_effect(name: str, entry: Any) -> dict[str, EffectValue]:
    parameters = {p.name: p for p in get_effect(name).parameters}
    entry = _check_mapping(f"effects.{name}", entry)
    check_keys(f"effects.{name}.", entry, list(parameters), required=[k for k, p in parameters.items() if p.fit])
    estimates = {}
    for key in entry:
        path = f"effects.{name}.{key}"
        unit = parameters[key].unit
        fields = _check_mapping(path, entry[key], f'value: ..., unit: "{unit}"')
        check_keys(f"{path}.", fields, ["value", "unit", "interval", "source", "effective"], required=["value", "unit"])
        if str(fields["unit"]) != unit:
            raise ConfigurationError(f"{path}: unit {str(fields['unit'])!r} is not {unit}; convert the value")
        value = parameters[key].check(fields["value"], path)
        source = _check_text(f"{path}.source", fields.get("source", "not stated"))
        effective, ends = fields.get("effective", False), fields.get("interval")
        if not isinstance(effective, bool):
            raise ConfigurationError(f"{path}.effective: {effective!r} is not true or false")
        is_pair = isinstance(ends, list) and len(ends) == 2 and all(type(end) in (int, float) for end in ends)
        if ends is not None and not (is_pair and ends[0] <= value <= ends[1]):
            raise ConfigurationError(f"{path}.interval: {ends!r} is not [low, high] around the value {value:g}")
        interval = None if ends is None else (float(ends[0]), float(ends[1]))
        estimates[key] = EffectValue(value, interval, source, effective)
    return estimates


def _read_vehicle(section: Any) -> tuple[VehicleParameters | None, str, str]:
    """(embedded vehicle or None, name, hash)."""
    if section is None:
        return None, "", ""
    section = _check_mapping("vehicle", section)
    check_keys("vehicle.", section, ["name", "hash", "parameters"], required=["name", "hash"])
    name, digest = (_check_text(f"vehicle.{key}", section[key]) for key in ("name", "hash"))
    if "parameters" not in section:
        return None, name, digest
    vehicle = add_prefix("vehicle.parameters: ", lambda: VehicleParameters.from_document(section["parameters"]))
    if vehicle.hash != digest:
        raise ConfigurationError(f"vehicle.hash: {digest[:12]} does not match vehicle.parameters ({vehicle.hash[:12]})"
                                 "; restore the vehicle for which the effects were identified")
    return vehicle, name, digest


def _check_mapping(path: str, value: Any, form: str = "key: value, ...") -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ConfigurationError(f"{path}: expected a mapping, {{{form}}}; see docs/manual/effects.md")
    return value


def _check_text(path: str, value: Any) -> str:
    # YAML parses an unquoted date as a date object, which is accepted.
    if isinstance(value, bool | int | float | list | dict) or value is None:
        raise ConfigurationError(f"{path}: {value!r} is not a string; put it in quotes")
    return str(value)
