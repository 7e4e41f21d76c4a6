"""Cost of bands: duration of a tick and live latency with and without them, for docs/measurements/bands.md.

ST_BENCH_TURNS and ST_BENCH_SECONDS set number and duration of the live runs. The machine must be idle.
"""

import os

from . import latency, tick
from ._pages import format_records, replace_part
from .bands.page import PAGE

TURNS, SECONDS = 2, 25


def run() -> dict:
    """Durations and latencies without and with bands."""
    turns = int(os.environ.get("ST_BENCH_TURNS", str(TURNS)))
    os.environ.setdefault("ST_BENCH_SECONDS", str(SECONDS))
    ticks, latencies = tick.run(), {"0": [], "1": []}
    for _ in range(turns):
        for bands, results in latencies.items():
            os.environ["ST_BENCH_BANDS"] = bands
            results.append(latency.run())
    rows = [_row(name, ticks[f"{key}ms_p50"], ticks[f"{key}ms_p99"], results)
            for name, key, results in (("no", "", latencies["0"]), ("yes", "with_bands_", latencies["1"]))]
    replace_part(PAGE, "cost of bands", format_records(rows))
    return {row["bands"]: row for row in rows}


def _row(name: str, median: float, quantile_99: float, results: list[dict]) -> dict[str, str]:
    """A row of the table, with a latency and a load for each live run."""
    latencies = [result["samples_to_third_prediction_published_ms"] for result in results]
    return {"bands": name, "tick p50 | p99, ms": f"{median:.2f} | {quantile_99:.2f}",
            "latency p50, ms": ", ".join(f"{latency['p50']:.1f}" for latency in latencies),
            "latency p99, ms": ", ".join(f"{latency['p99']:.1f}" for latency in latencies),
            **{f"{node}, % of a core": ", ".join(f"{result['cpu_percent'][node]:.1f}" for result in results)
               for node in ("predictor", "evaluator", "recorder")}}
