"""Compares path-following controllers with different models and horizons.

    ./st shell -- python examples/mpc/nmpc.py                     all models, a minute of processor time
    ./st shell -- python examples/mpc/nmpc.py --quick             one road, two horizons, a few seconds
    ./st shell -- python examples/mpc/nmpc.py --model model.yaml  a model file instead of the three models

Writes drives.json, trade_off.png and paths.png. docs/manual/mpc.md explains the result.
"""

import argparse
import json
import platform
import sys
from collections.abc import Callable
from pathlib import Path

from closed_loop import DriveResults, drive
from controller import SOLVERS, Controller, Tuning
from drawing import draw_paths, draw_trade_off
from st_core.errors import StCoreError
from st_recordings.car import read_model
from st_recordings.paths import config, new_folder
from st_sim.path import lane_shift, straight
from st_sim.scenarios import Plan, RoadPlan, load_plan
from st_sim.settings import read_vehicle, resolve_settings

MODELS = ["kinematic", "linear", "nonlinear"]
HORIZONS = [0.5, 1.0, 2.0, 3.0]  # s


def lane_change_at_the_limit() -> Plan:
    """The double lane change of the scenarios at 15 m/s, with lateral accelerations up to 7 m/s^2."""
    speed = 15.0
    return RoadPlan([*straight(40, speed), *lane_shift(3.5, 30, speed), *straight(25, speed),
                     *lane_shift(-3.5, 30, speed), *straight(35, speed)])


ROADS: dict[str, tuple[Callable[[], Plan], float, str]] = {
    "S6": (lambda: load_plan("S6"), 30.0, "S6: U-turns, 4 to 6 m/s"),
    "lane_change": (lambda: load_plan("lane_change"), 13.0, "double lane change, 12 m/s"),
    "lane_change_limit": (lane_change_at_the_limit, 10.0, "double lane change, 15 m/s"),
}


def main() -> int:
    options = _parse_arguments()
    try:
        folder = new_folder(options.output, "mpc")
        vehicle, settings = read_vehicle(options.vehicle), resolve_settings(options.plant)
        models = {}
        for name in options.model:
            # --vehicle describes the plant; a model file may contain an identified vehicle for the controller.
            model, model_vehicle = read_model(name, vehicle, str(options.vehicle), vehicle_is_given=False)
            models[model.name] = model, model_vehicle
    except (OSError, StCoreError) as error:
        print(f"nmpc.py: {error}", file=sys.stderr)
        return 2
    tuning, rows, tables = Tuning(), [], {}
    for road in options.road:
        make_plan, duration, _ = ROADS[road]
        for solver in options.solver:
            for name, (model, model_vehicle) in models.items():
                for horizon in options.horizon:
                    controller = Controller(model, model_vehicle, round(horizon / tuning.step), tuning, solver)
                    results, table = drive(controller, vehicle, settings, make_plan(), duration)
                    rows.append({"road": road, "solver": solver, "model": name, "horizon": horizon,
                                 **results.as_dict()})
                    tables[road, solver, name, horizon] = table
                    print(_format_row(rows[-1], results), flush=True)
    document = {"plant": options.plant, "vehicle": vehicle.hash, "tuning": vars(tuning), "python":
                platform.python_version(), "machine": platform.machine(), "drives": rows}
    (folder / "drives.json").write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    titles = {road: ROADS[road][2] for road in options.road}
    draw_trade_off(rows, titles, folder / "trade_off.png")
    draw_paths(tables, titles, folder / "paths.png")
    print(folder)
    return 0


def _format_row(row: dict, results: DriveResults) -> str:
    end = "" if results.finished else f"   left the path after {results.duration:.1f} s"
    return (f"{row['road']:18} {row['solver']:6} {row['model']:10} {row['horizon']:4.1f} s   "
            f"error rms {results.error_rms:6.3f} m, max {results.error_max:6.3f} m; processor time median "
            f"{results.cpu_median:6.2f} ms, p95 {results.cpu_p95:6.2f} ms; failed solves {results.unsolved}{end}")


def _parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", nargs="+", default=MODELS, help="names or model files (.yaml)")
    parser.add_argument("--horizon", nargs="+", type=float, default=HORIZONS, help="s")
    parser.add_argument("--road", nargs="+", choices=ROADS, default=list(ROADS))
    parser.add_argument("--solver", nargs="+", choices=SOLVERS, default=list(SOLVERS))
    parser.add_argument("--plant", default="realistic", help="ideal, realistic or a YAML file, as for virtual_leaf")
    parser.add_argument("--vehicle", type=Path, default=config("vehicle/leaf.yaml"))
    parser.add_argument("--output", type=Path, help="folder; default runs/mpc-<time>")
    parser.add_argument("--quick", action="store_true", help="lane change, 1 and 2 s, rti only")
    options = parser.parse_args()
    if options.quick:
        options.road, options.horizon, options.solver = ["lane_change"], [1.0, 2.0], ["rti"]
    return options


if __name__ == "__main__":
    raise SystemExit(main())
