"""Answers of earlier starts: the same drives, car, base and settings are not searched again."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields, is_dataclass
from itertools import repeat
from pathlib import Path
from types import NoneType
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np
import st_core
from st_core.augmented import AugmentedModel, augment
from st_core.discovery import Discovery, DiscoverySettings
from st_core.discovery.result import MODELS
from st_core.errors import StCoreError
from st_core.log import DriveLog
from st_core.models import Model
from st_core.vehicle import VehicleParameters

from .drives import code_of, name_of, put

FORMAT = 2  # of what is kept; another number makes older files useless


def key(runs: Sequence[DriveLog], reference: Sequence[DriveLog], vehicle: VehicleParameters, base: Model,
        settings: DiscoverySettings, effects: Mapping[str, str], identities: Mapping[str, Sequence[float]]) -> str:
    """Of everything an answer depends on, the code included."""
    values = base.values if isinstance(base, AugmentedModel) else {}
    content = [FORMAT, code_of(st_core), [_digest(log) for log in runs], [_digest(log) for log in reference],
               vehicle.hash, sorted((key, one.uncertainty) for key, one in vehicle.provenance.items()),
               _base(base), {effect: dict(entry) for effect, entry in values.items()}, asdict(settings),
               sorted(effects.items()), sorted((name, list(value)) for name, value in identities.items())]
    return name_of(content)


def keep(file: Path, found: Discovery) -> None:
    """Into the file that `kept` reads; nothing where it cannot be written."""
    models = {name: getattr(found, name) for name in MODELS}
    content = found.document() | {name: model and _model(model) for name, model in models.items()}
    put(file, lambda temporary: temporary.write_text(json.dumps(content), encoding="utf-8"))


def kept(file: Path) -> Discovery | None:
    """The answer in a file of `keep`; None where there is none, or a damaged one."""
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        hints = get_type_hints(Discovery)
        parts = {name: restored(kind, content[name]) for name, kind in hints.items() if name not in MODELS}
        parts |= {name: content[name] and augment(*content[name]) for name in MODELS}
        return Discovery(**parts)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, StCoreError):
        return None


def restored(kind: Any, value: Any) -> Any:
    """What `Discovery.document` made lists and dicts of, as dataclasses, tuples and mappings of the type `kind`."""
    origin, inner = get_origin(kind), get_args(kind)
    if isinstance(kind, type) and is_dataclass(kind):
        hints = get_type_hints(kind)
        return kind(**{name: restored(hints[name], entry) for name, entry in value.items()})
    if origin is tuple:
        return tuple(map(restored, repeat(inner[0]) if inner[-1] is Ellipsis else inner, value))
    if origin is Mapping:
        return {name: restored(inner[1], entry) for name, entry in value.items()}
    if NoneType in inner:
        return None if value is None else restored(next(one for one in inner if one is not NoneType), value)
    return value


def _base(model: Model) -> str:
    return model.base.name if isinstance(model, AugmentedModel) else model.name


def _model(model: AugmentedModel) -> list[Any]:
    return [_base(model), {effect: dict(values) for effect, values in model.values.items()}]


def _digest(log: DriveLog) -> str:
    content = hashlib.sha256(log.name.encode())
    for field in fields(DriveLog):
        values = getattr(log, field.name)
        if isinstance(values, np.ndarray):
            content.update(field.name.encode() + values.tobytes())
    return content.hexdigest()
