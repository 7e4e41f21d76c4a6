"""Violations by 50 cars at gates, with the constraints of a controller unchanged and tightened by a band.

Writes its table to docs/measurements/mpc.md. It takes fifteen minutes of processor time; ST_CORRIDOR_SEEDS changes the
number of cars.
"""

import os
import sys

from st_recordings.paths import project_root

from ._pages import format_records, replace_part

MODEL = "linear"
PAGE = project_root() / "docs" / "measurements" / "mpc.md"


def run() -> dict:
    """Violations, errors and cost for each variant of the constraint; see examples/mpc/corridor.py."""
    sys.path.insert(0, str(project_root() / "examples" / "mpc"))
    from corridor import compare

    variants = compare(int(os.environ.get("ST_CORRIDOR_SEEDS", "50")), MODEL)
    rows = [{"constraint": name, "cars": str(result["seeds"]), "touch a post": str(result["violations"]),
             "deepest, m": f"{result['deepest']:.2f}", "median depth, m": f"{result['depth_median']:.2f}",
             "rms deviation, m": f"{result['error_rms']:.3f}", "cost": f"{result['cost']:.2f}"}
            for name, result in variants.items()]
    replace_part(PAGE, "corridor", format_records(rows))
    return {"corridor": {row["constraint"]: row for row in rows}}
