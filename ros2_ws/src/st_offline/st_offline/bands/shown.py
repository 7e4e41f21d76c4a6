"""How bands did, on the terminal and on the page."""

from collections.abc import Sequence
from typing import Any

from rich.table import Table

from ..terminal import rows_table
from .sums import finished, pooled_sums

HOW_TO_GET = ("[dim]bands: none given; `st calibrate RUN… --vehicle FILE --output bands.yaml` learns them from "
              "other runs of this car, `--bands bands.yaml` tests them on these[/dim]")


def band_rows(content: dict[str, Any] | None) -> list[dict[str, str]]:
    """One row for each model and question of a finished document; columns by their titles."""
    rows = []
    for model, modes in (content or {"models": {}})["models"].items():
        for mode, one in modes.items():
            worst, end = one["worst_cell"], _last(one["half_width"].get("0.9"))
            scores, crps = one["interval_score"].get("0.9"), one["crps"]
            rows.append({
                "model": model, "question": {"hindsight": "model", "forecast": "forecast"}[mode],
                "starts": str(one["starts"]), "no band": str(one["without_band"]),
                "50 % covers": _share(one["coverage"].get("0.5")), "90 % covers": _share(one["coverage"].get("0.9")),
                "worst cell": f"{worst['coverage']:.0%} ({worst['cell']}, {worst['starts']} starts)" if worst else "-",
                "interval score 90 %, along | across, m": _pair(scores), "CRPS, along | across, m": _pair(crps),
                "half-width 90 %, along | across, m": _pair(end)})
    return rows


def bands_table(reports: Sequence[Any], width: int) -> Table | None:
    """Of all runs together; None where no bands were tested."""
    if not any(report.bands for report in reports):
        return None
    content = finished(pooled_sums([report.bands for report in reports]))
    known = content["known_recordings"]
    caption = f"{len(known)} of the files were calibrated with: that is no test of the bands" if known else None
    return rows_table(band_rows(content), title="Bands: how often the whole path lies inside", caption=caption,
                      width=min(width, 200))


def _last(seconds: dict[str, dict[str, float]] | None) -> dict[str, float] | None:
    return list(seconds.values())[-1] if seconds else None


def _share(value: float | None) -> str:
    return "-" if value is None else f"{value:.1%}"


def _pair(axes: dict[str, float] | None) -> str:
    if not axes or axes["longitudinal"] is None:
        return "-"
    return f"{axes['longitudinal']:.2f} | {axes['lateral']:.2f}"
