"""Vehicle parameters; reads, checks and writes vehicle files, in which each value has a unit and a source."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from operator import attrgetter
from typing import Annotated, Any

from .errors import ConfigurationError, add_prefix
from .types import Number, Quantity, quantities_of
from .tyres import GRAVITY, MagicFormula, stiffness_scale
from .yaml_text import check_keys, dump, hash_content, load

STIFFNESS_LIMITS = 0.05, 500.0  # cornering stiffness of an axle, divided by the weight of the car [1/rad]
TYRES = ("tyre_front", "tyre_rear")
PROVENANCE_TEXTS = ("method", "data", "date")
PROVENANCE_KEYS = ("uncertainty", *PROVENANCE_TEXTS)


@dataclass(frozen=True)
class Uncertainty:
    """Default standard deviation of a value."""

    size: float  # fraction of the value if `relative`, else in SI
    relative: bool
    source: str


_TYRE_SOURCE = "spread between makes of one tyre size, published passenger-car tyre data"
_TYRE_UNCERTAINTIES = {
    "lambda_muy": Uncertainty(0.2, True, "friction on dry asphalt 1.0 to 1.3 times that on a drum, 0.85 to 1.15 "
                                         "between makes"),
    "p_ey1": Uncertainty(3.0, False, f"{_TYRE_SOURCE}, E -8 to 0.5"),
    "p_ky2": Uncertainty(0.5, True, f"{_TYRE_SOURCE}, 1.0 to 2.8"),
}
DEFAULT_UNCERTAINTIES: Mapping[str, Uncertainty] = {
    "mass": Uncertainty(0.03, True, "a weighed car, +/- half a tank of fuel and one person"),
    "cg_to_front_axle": Uncertainty(0.03, False, "axle loads weighed to 1 %, +/- half a tank and one person"),
    "cg_height": Uncertainty(0.05, False, "passenger cars by tilt table, 0.45 to 0.65 m (NHTSA, SAE 1999-01-1336)"),
    "yaw_inertia": Uncertainty(0.15, True, "estimates from mass and dimensions compared with measured cars (NHTSA, SAE "
                                           "1999-01-1336)"),
    "cornering_stiffness_front": Uncertainty(0.3, True, "tyres of one size differ by a factor of 2"),
    "cornering_stiffness_rear": Uncertainty(0.3, True, "tyres of one size differ by a factor of 2"),
    **{f"{tyre}.{key}": uncertainty for tyre in TYRES for key, uncertainty in _TYRE_UNCERTAINTIES.items()},
}
"""Used for entries of a vehicle file without `uncertainty`. Values of other keys, such as the steering ratio and the
position of the INS, are often guesses: they constrain a fit only if the file states their `uncertainty`."""
DERIVED_SOURCE = "derived: C / (2 abs(K)) at the static load of one tyre"  # of lambda_ky


@dataclass(frozen=True)
class Provenance:
    """Provenance of an identified value."""

    uncertainty: float | None = None  # standard deviation in SI, None if unknown
    method: str = ""  # free text
    data: str = ""  # free text
    date: str = ""  # YYYY-MM-DD

    def to_document(self) -> dict[str, float | str]:
        """The entries of a vehicle file."""
        return {key: value for key in PROVENANCE_KEYS if (value := getattr(self, key)) not in (None, "")}


def road_wheel_angle(steering_wheel_angle: Number, offset: Number, ratio: Number) -> Number:
    """Road wheel angle (angle - offset) / ratio, mean of the front axle. Angles [rad]: left positive; ratio [1]."""
    return (steering_wheel_angle - offset) / ratio


@dataclass(frozen=True)
class VehicleParameters:
    """One car, in SI units. Raises ConfigurationError, naming the key and the limit, for impossible values. The limits
    are wide, from a 1:16 scale model to a loaded truck; `_check_scale` detects a wrong unit."""

    name: str
    mass: Annotated[float, Quantity("kg", 1.0, 60000.0)]
    yaw_inertia: Annotated[float, Quantity("kg m^2", 1.0e-3, 1.0e6)]  # about the CG
    wheelbase: Annotated[float, Quantity("m", 0.1, 15.0)]
    cg_to_front_axle: Annotated[float, Quantity("m", 0.02, 14.0)]
    cg_height: Annotated[float, Quantity("m", 0.0, 4.0)]
    cg_to_ins_x: Annotated[float, Quantity("m", -15.0, 15.0)]  # INS point ahead of the CG, < 0 behind it
    cg_to_ins_y: Annotated[float, Quantity("m", -3.0, 3.0)]  # INS point to the left of the CG
    steering_ratio: Annotated[float, Quantity("1", 1.0, 60.0)]
    # Reading of the steering wheel sensor when driving straight, positive to the left.
    steering_wheel_offset: Annotated[float, Quantity("rad", -math.pi, math.pi, other_units={"deg": math.pi / 180.0})]
    cornering_stiffness_front: Annotated[float, Quantity("N/rad", 1.0, 5.0e6)]  # per axle
    cornering_stiffness_rear: Annotated[float, Quantity("N/rad", 1.0, 5.0e6)]  # per axle
    # v_eps, lower limit of the speed in the denominator of the slip angle.
    minimum_slip_speed: Annotated[float, Quantity("m/s", 0.1, 20.0)]
    length: Annotated[float, Quantity("m", 0.1, 30.0)]  # of the body, for drawing
    width: Annotated[float, Quantity("m", 0.03, 4.0)]  # of the body, for drawing
    tyre_front: MagicFormula  # of one tyre; its lambda_ky may be derived, see `from_yaml`
    tyre_rear: MagicFormula  # of one tyre
    # Optional values, which only some effects use; the defaults are those of a front-wheel-drive car.
    track_width: Annotated[float, Quantity("m", 0.03, 4.0, required=False)] = 1.54  # of both axles
    # Front fractions of drive force, brake force and lateral load transfer; rear-wheel drive: drive_front 0.
    drive_front: Annotated[float, Quantity("1", 0.0, 1.0, required=False)] = 1.0
    brake_front: Annotated[float, Quantity("1", 0.0, 1.0, required=False)] = 0.65
    load_transfer_front: Annotated[float, Quantity("1", 0.0, 1.0, required=False)] = 0.55
    side_area: Annotated[float, Quantity("m^2", 1.0e-3, 60.0, required=False)] = 2.5  # side force coefficient x area
    side_force_arm: Annotated[float, Quantity("m", -5.0, 5.0, required=False)] = 0.25  # side force ahead of the CG
    # By key in the file, such as "tyre_front.p_cy1".
    sources: Mapping[str, str] = field(default_factory=dict, compare=False, repr=False)
    provenance: Mapping[str, Provenance] = field(default_factory=dict, compare=False, repr=False)

    def __post_init__(self) -> None:
        for key, quantity in FILE_QUANTITIES.items():
            value = value_of(self, key)
            if not quantity.minimum <= value <= quantity.maximum:  # also rejects NaN
                raise ConfigurationError(f"{key}: {value:g} is outside {quantity.limits}; check value and unit")
        if not self.cg_to_front_axle < self.wheelbase:
            raise ConfigurationError(f"cg_to_front_axle: {self.cg_to_front_axle:g} m is not below wheelbase "
                                     f"{self.wheelbase:g} m; the CG must lie between the axles: correct one of the two")

    @property
    def cg_to_rear_axle(self) -> float:
        """l_r = wheelbase - cg_to_front_axle [m]."""
        return self.wheelbase - self.cg_to_front_axle

    @property
    def static_tyre_load_front(self) -> float:
        """m g l_r / l / 2 [N]: one front tyre at rest."""
        return 0.5 * self.mass * GRAVITY * self.cg_to_rear_axle / self.wheelbase

    @property
    def static_tyre_load_rear(self) -> float:
        """m g l_f / l / 2 [N]: one rear tyre at rest."""
        return 0.5 * self.mass * GRAVITY * self.cg_to_front_axle / self.wheelbase

    @property
    def speed_scale(self) -> float:
        """Factor for speed limits of scale models, sqrt(wheelbase / 2 m), at most 1 [1]; its square is the factor for
        radii. If both are scaled, the lateral acceleration v^2 / R at the limits does not depend on the size."""
        return min(1.0, math.sqrt(self.wheelbase / 2.0))

    def uncertainty(self, key: str) -> float | None:
        """Standard deviation [SI] of a value, by its key in the file ("mass", "tyre_front.lambda_muy"): that of the
        file if > 0, else that of DEFAULT_UNCERTAINTIES; None if there is no default or if it is 0."""
        if (entry := self.provenance.get(key)) and entry.uncertainty:
            return entry.uncertainty
        if (default := DEFAULT_UNCERTAINTIES.get(key)) is None:
            return None
        return default.size * (abs(value_of(self, key)) if default.relative else 1.0) or None

    def road_wheel_angle(self, steering_wheel_angle: Number) -> Number:
        """Road wheel angle [rad], mean of the front axle, at a measured steering wheel angle [rad]; left positive."""
        return road_wheel_angle(steering_wheel_angle, self.steering_wheel_offset, self.steering_ratio)

    def steering_wheel_angle(self, road_wheel_angle: Number) -> Number:
        """Reading of the steering wheel sensor [rad] at a road wheel angle [rad]; the inverse of `road_wheel_angle`."""
        return road_wheel_angle * self.steering_ratio + self.steering_wheel_offset

    @classmethod
    def from_yaml(cls, text: str, origin: str = "vehicle") -> "VehicleParameters":
        """Parameters from the text of a vehicle file.

        origin: name shown in errors, usually the path. A missing lambda_ky of a tyre is derived from the cornering
        stiffness of its axle at the static load of one tyre (`tyres.stiffness_scale`).
        Raises ConfigurationError with one line: origin, key, what is wrong, the limit and what to do.
        """
        return add_prefix(f"{origin}: ", lambda: cls.from_document(load(text)))

    @classmethod
    def from_document(cls, document: Any) -> "VehicleParameters":
        """Parameters from a parsed vehicle file. Raises ConfigurationError naming the key."""
        if not isinstance(document, dict):
            raise ConfigurationError("not a mapping of `key: {value, unit, source}`; see config/vehicle/leaf.yaml")
        keys = ["name", *VEHICLE_QUANTITIES, *TYRES]
        check_keys("", document, keys, required=[key for key in keys if key not in OPTIONAL_QUANTITIES])
        name = document["name"]
        if not isinstance(name, str) or not name.strip():
            raise ConfigurationError(f"name: {name!r} is not a string; write the name of the car")
        sources: dict[str, str] = {}
        provenance: dict[str, Provenance] = {}
        values: dict[str, Any] = _read_section("", document, VEHICLE_QUANTITIES, sources, provenance)
        for tyre in TYRES:
            section = document[tyre]
            if not isinstance(section, dict):
                raise ConfigurationError(f"{tyre}: not a mapping of `key: {{value, unit, source}}`")
            required = [key for key, quantity in TYRE_QUANTITIES.items() if quantity.required]
            check_keys(f"{tyre}.", section, list(TYRE_QUANTITIES), required)
            values[tyre] = MagicFormula(**_read_section(f"{tyre}.", section, TYRE_QUANTITIES, sources, provenance))
        vehicle = cls(name=name, **values, sources=sources, provenance=provenance)
        _check_scale(vehicle)
        return vehicle.with_derived_scales([tyre for tyre in TYRES if "lambda_ky" not in document[tyre]])

    def with_derived_scales(self, tyres: Sequence[str] = TYRES) -> "VehicleParameters":
        """The car with lambda_ky of these tyres derived from the cornering stiffness of the axle (see `from_yaml`)."""
        changes: dict[str, Any] = {}
        quantity = TYRE_QUANTITIES["lambda_ky"]
        for name in tyres:
            key, tyre = name.replace("tyre", "cornering_stiffness"), getattr(self, name)
            stiffness, load = getattr(self, key), getattr(self, name.replace("tyre", "static_tyre_load"))
            scale = stiffness_scale(stiffness, load, tyre)
            if not quantity.minimum <= scale <= quantity.maximum:
                raise ConfigurationError(
                    f"{key}: {stiffness:g} N/rad is {scale:.3g} times the stiffness of two tyres of {name} (limit "
                    f"{quantity.limits}); check its value and unit, and {name}.nominal_load")
            changes[name] = tyre._replace(lambda_ky=scale)
        sources = {**self.sources, **{f"{name}.lambda_ky": DERIVED_SOURCE for name in tyres}}
        return replace(self, **changes, sources=sources)

    def with_values(self, values: Mapping[str, float]) -> "VehicleParameters":
        """The car with some values (SI) replaced, by their keys in the file ("mass", "tyre_rear.p_cy1"). A derived
        lambda_ky not in `values` is recomputed. Raises ConfigurationError for a value outside its limits."""
        fields: dict[str, Any] = {key: value for key, value in values.items() if "." not in key}
        for tyre in TYRES:
            changes = {key.partition(".")[2]: value for key, value in values.items() if key.startswith(f"{tyre}.")}
            fields[tyre] = getattr(self, tyre)._replace(**changes)
        derived = [tyre for tyre in TYRES if self.sources.get(f"{tyre}.lambda_ky") == DERIVED_SOURCE
                   and f"{tyre}.lambda_ky" not in values]
        return replace(self, **fields).with_derived_scales(derived)

    def to_yaml(self) -> str:
        """The text of a vehicle file in SI units; `from_yaml` returns the same parameters and hash."""
        return dump(self.to_document())

    def to_document(self) -> dict[str, Any]:
        """The content of a vehicle file in SI units. A derived lambda_ky is left out, so that it follows later changes
        of the cornering stiffness in the file."""
        rederived = self.with_derived_scales()
        derived = [tyre for tyre in TYRES if self.sources.get(f"{tyre}.lambda_ky") == DERIVED_SOURCE
                   and getattr(self, tyre) == getattr(rederived, tyre)]
        return {"name": self.name,
                **{key: self._make_entry(key) for key in VEHICLE_QUANTITIES},
                **{tyre: {key: self._make_entry(f"{tyre}.{key}") for key in TYRE_QUANTITIES
                          if key != "lambda_ky" or tyre not in derived} for tyre in TYRES}}

    def _make_entry(self, key: str) -> dict[str, Any]:
        quantity = FILE_QUANTITIES[key]
        source = self.sources.get(key, "not stated" if quantity.required else "default")
        return {"value": value_of(self, key), "unit": quantity.si_unit, "source": source,
                **self.provenance.get(key, Provenance()).to_document()}

    @cached_property
    def hash(self) -> str:
        """sha256 (hex) of all values in SI, except optional ones at their defaults; without name and provenance."""
        values = {key: value_of(self, key) for key in FILE_QUANTITIES}
        return hash_content({key: float(value).hex() for key, value in values.items()
                             if value != getattr(VehicleParameters, key, None)})


VEHICLE_QUANTITIES, TYRE_QUANTITIES = quantities_of(VehicleParameters), quantities_of(MagicFormula)
FILE_QUANTITIES: Mapping[str, Quantity] = VEHICLE_QUANTITIES | {
    f"{tyre}.{key}": quantity for tyre in TYRES for key, quantity in TYRE_QUANTITIES.items()}
"""Units and limits of all values of a vehicle file, by key ("mass", "tyre_rear.p_ky1")."""
OPTIONAL_QUANTITIES = tuple(key for key, quantity in VEHICLE_QUANTITIES.items() if not quantity.required)


def value_of(vehicle: VehicleParameters, key: str) -> float:
    """A value by its key in the vehicle file ("mass", "tyre_front.p_cy1"), SI."""
    return attrgetter(key)(vehicle)


def _read_section(prefix: str, section: Mapping[str, Any], quantities: Mapping[str, Quantity],
                  sources: dict[str, str], provenance: dict[str, Provenance]) -> dict[str, float]:
    """The values of a section in SI, by key. Their sources and provenance are added to the given dicts."""
    values = {}
    for name, quantity in quantities.items():
        if name not in section:
            continue
        key, entry, units = prefix + name, section[name], " or ".join(quantity.units)
        example = f"write `{name}: {{value: ..., unit: \"{quantity.si_unit}\", source: \"...\"}}`"
        if not isinstance(entry, dict):
            raise ConfigurationError(f"{key}: {entry!r} has no unit and source; {example}")
        for part in entry:
            if part not in ("value", "unit", "source", *PROVENANCE_KEYS):
                raise ConfigurationError(f"{key}.{part}: unknown key; {example}")
        for part in ("value", "unit", "source"):
            if part not in entry:
                raise ConfigurationError(f"{key}: {part} is missing; {example}")
        # YAML parses the unit 1 without quotes as a number.
        value, unit, source = entry["value"], str(entry["unit"]), entry["source"]
        if unit not in quantity.units:
            raise ConfigurationError(f"{key}: unit {unit!r} is not {units}; convert the value and write unit: {units}")
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ConfigurationError(f"{key}: {value!r} is not a number (write 1.0e+3, not 1e3); limit "
                                     f"{quantity.limits}")
        if not isinstance(source, str) or not source.strip():
            raise ConfigurationError(f"{key}: source {source!r} is not a string; state where the value comes from")
        values[name], sources[key] = float(value) * quantity.units[unit], source
        if entry_provenance := _read_provenance(key, entry, quantity.units[unit]):
            provenance[key] = entry_provenance
    return values


def _read_provenance(key: str, entry: Mapping[str, Any], factor: float) -> Provenance | None:
    """The provenance of an entry of a vehicle file, or None. factor: converts the unit of the entry to SI."""
    if not any(name in entry for name in PROVENANCE_KEYS):
        return None
    uncertainty = entry.get("uncertainty")
    if uncertainty is not None:
        if isinstance(uncertainty, bool) or not isinstance(uncertainty, int | float):
            raise ConfigurationError(f"{key}.uncertainty: {uncertainty!r} is not a number (write 1.0e+3, not 1e3)")
        if not (math.isfinite(uncertainty) and uncertainty >= 0.0):
            raise ConfigurationError(f"{key}.uncertainty: {uncertainty:g} is not a standard deviation (finite, >= 0)")
        uncertainty = float(uncertainty) * factor
    texts = {}
    for name in PROVENANCE_TEXTS:
        # YAML parses an unquoted date as a date object, whose text is the same.
        texts[name] = str(entry[name]) if name == "date" and name in entry else entry.get(name, "")
        if not isinstance(texts[name], str):
            raise ConfigurationError(f"{key}.{name}: {texts[name]!r} is not a string")
    return Provenance(uncertainty, **texts)


def _check_scale(car: VehicleParameters) -> None:
    """Raises ConfigurationError for a value that does not fit the size of the car, by a factor of about 15 or more."""
    for key, low, high, reference, basis in (
            ("mass", 3.0, 3000.0, car.wheelbase**3, f"a wheelbase of {car.wheelbase:g} m"),
            ("yaw_inertia", 0.003, 4.0, car.mass * car.wheelbase**2,
             f"{car.mass:g} kg and a wheelbase of {car.wheelbase:g} m"),
            *((f"cornering_stiffness_{axle}", *STIFFNESS_LIMITS, car.mass * GRAVITY, f"{car.mass:g} kg")
              for axle in ("front", "rear"))):
        unit = VEHICLE_QUANTITIES[key].si_unit
        if not low * reference <= (value := getattr(car, key)) <= high * reference:
            raise ConfigurationError(f"{key}: {value:g} {unit} does not fit a car with {basis} (limit "
                                     f"{low * reference:.2g} to {high * reference:.2g} {unit}); check values and units")
