"""Runs the cases with each limit of the decision halved and doubled."""

import json
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import Any

from st_core.discovery.settings import Limits

from .run import run_all, try_case

Record = dict[str, Any]
FACTORS = (0.5, 2.0)


def list_variants() -> list[tuple[str, float, Limits]]:
    """(field, factor, limits) of each variant; the first has the unchanged limits and an empty field."""
    default = Limits()
    rows: list[tuple[str, float, Limits]] = [("", 1.0, default)]
    for field in fields(Limits):
        for factor in FACTORS:
            value = getattr(default, field.name) * factor
            changed = max(round(value), 1) if isinstance(getattr(default, field.name), int) else value
            rows.append((field.name, factor, replace(default, **{field.name: changed})))
    return rows


def run_variants(cases: Sequence, out: Path, until: float | None, report: Callable[[Record], None]) -> None:
    """Runs all cases with each variant; writes a file of JSON lines for each, next to `out`, with the limit in each
    record."""
    for name, factor, limits in list_variants():
        file = out.with_name(f"{out.stem}_{name or 'usual'}_{factor:g}.jsonl")
        records = run_all(cases, file, until, partial(try_case, limits=limits, whole=False), report)
        file.write_text("".join(json.dumps({**r, "limit": [name, factor]}) + "\n" for r in records))
