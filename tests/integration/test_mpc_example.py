"""The NMPC example: path tracking, agreement of both solvers, safety margin by bands, model export for acados."""

import json
import sys

import numpy as np
import pytest
from st_core.augmented import augment
from st_core.models import MODELS
from st_core.vehicle import VehicleParameters
from st_offline.model_export import export_model
from st_sim.scenarios import load_plan
from st_sim.settings import PRESETS, read_vehicle
from support import LEAF as FILE
from support import ROOT

pytest.importorskip("casadi", reason="casadi is not installed")
LEAF = VehicleParameters.from_yaml(FILE.read_text(), str(FILE))
NAMES = ("acados_example", "closed_loop", "controlled_car", "controller", "corridor", "drawing", "nmpc")


@pytest.fixture(autouse=True)
def example(monkeypatch):
    """Puts the folder of the example first on the path, as at its start; removes its modules afterwards."""
    monkeypatch.syspath_prepend(str(ROOT / "examples" / "mpc"))
    yield
    for name in NAMES:
        sys.modules.pop(name, None)


def drive_lane_change(model, solver, seconds=6.5, steps=10):
    from closed_loop import drive
    from controller import Controller

    controller = Controller(model, LEAF, steps, solver=solver)
    return drive(controller, read_vehicle(FILE), PRESETS["realistic"], load_plan("lane_change"), seconds)


def test_linear_model_tracks_a_lane_change_better_than_the_kinematic_one():
    linear, table = drive_lane_change(MODELS["linear"], "rti")
    assert linear.finished and linear.unsolved == 0 and linear.solutions == 65
    assert np.ptp(table[:, 2]) > 3.0  # m, lateral displacement
    assert linear.error_max < 0.15
    kinematic, _ = drive_lane_change(MODELS["kinematic"], "rti")
    assert kinematic.error_rms > 3.0 * linear.error_rms


def test_real_time_iteration_follows_the_path_of_the_converged_solution():
    model = augment("nonlinear", {"tyre_relaxation": {"length": 0.4}})
    (rti, rti_path), (ipopt, ipopt_path) = (drive_lane_change(model, solver, 5.0) for solver in ("rti", "ipopt"))
    assert ipopt.unsolved == 0 and rti.finished
    np.testing.assert_allclose(rti_path[:, 1:3], ipopt_path[:, 1:3], atol=0.03)


def test_band_increases_the_distance_to_a_gate_by_its_half_width(monkeypatch):
    import corridor
    from controller import Controller, Tuning
    from st_core.bands import Band, CalibrationDomain
    from st_core.bands.scale import Scale, compute_features
    from st_offline.model_export import make_half_width_function

    monkeypatch.setattr(corridor, "DURATION", 6.0)
    gates, time = [corridor.Gate(30.0, 36.0, -1, 1.0)], 0.05 * np.arange(1, 51)
    low, high = corridor.compute_limits(gates, np.array([29.0, 33.0]), np.array([0.2, 0.2]))
    assert high == pytest.approx([4.0, -1.2]) and low == pytest.approx([-4.0, -4.0])
    # Half-width 0.3 m at every point under all conditions.
    coefficients = np.full((3, 6, compute_features(np.zeros((1, 4))).shape[1]), 0.0)
    coefficients[:, :, 0] = -30.0
    band = Band(Scale(coefficients, np.stack([np.full(3, 0.3), np.zeros(3)]), time), {0.9: 1.0},
                np.zeros((3, 19)))
    domain = CalibrationDomain(np.full((99, 99), 100), (100.0, 100.0))
    controller = Controller(MODELS["linear"], LEAF, 25, Tuning(), "rti", corridor=True)
    plain, with_margin = (corridor.drive(controller, LEAF, gates, 1, margin)
                          for margin in (None, corridor.Margin(make_half_width_function(band, 0.9, LEAF), domain, 0.5)))
    assert -0.2 < plain.depth < 0.3
    assert with_margin.depth == pytest.approx(plain.depth - 0.3, abs=0.1) and with_margin.error > plain.error
    assert len(plain.log.x) == 300


def test_command_writes_results_and_figures_and_does_not_overwrite_them(tmp_path, monkeypatch, capsys):
    import nmpc

    monkeypatch.setitem(nmpc.ROADS, "lane_change", (lambda: load_plan("lane_change"), 4.0, "short"))
    out = tmp_path / "out"
    monkeypatch.setattr(sys, "argv", ["nmpc.py", "--quick", "--model", "linear", "--vehicle", str(FILE), "--output",
                                      str(out)])
    assert nmpc.main() == 0
    drives = json.loads((out / "drives.json").read_text())["drives"]
    assert [(d["model"], d["horizon"], d["solver"]) for d in drives] == [("linear", h, "rti") for h in (1.0, 2.0)]
    assert all(d["cpu_median"] > 0.0 for d in drives)
    assert {f.name for f in out.iterdir()} == {"drives.json", "trade_off.png", "paths.png"}
    assert nmpc.main() == 2 and "existing files are not overwritten" in capsys.readouterr().err


@pytest.mark.parametrize("free", [[], ["road_bank.angle"]])
def test_exported_model_loads_in_the_acados_example_with_bounds_and_free_parameters(tmp_path, free):
    import acados_example

    model = augment("nonlinear", {"tyre_relaxation": {"length": 0.4}, "road_bank": {"angle": 0.05}})
    export_model(model, LEAF, tmp_path, "casadi", substeps=2, free=free)
    imported = acados_example.load(tmp_path)
    assert imported.x.numel() == 8 and imported.p.numel() == len(free)
    x, u = np.array([0.0, 0.0, 10.0, 0.1, 0.2, 0.3, 0.01, 0.02]), np.array([0.05, 0.5])
    assert acados_example.largest_difference(imported, x, u, 0.05) < 1e-12
    assert imported.state_bounds[0][2] > 0.0 and np.isinf(imported.state_bounds[0][0])
    assert imported.input_bounds[1][0] == pytest.approx(0.61)


def test_acados_integrator_agrees_with_the_exported_step(tmp_path):
    pytest.importorskip("acados_template", reason="acados is not installed")
    import acados_example

    export_model(MODELS["nonlinear"], LEAF, tmp_path, "casadi")
    imported = acados_example.load(tmp_path)
    x, u = np.array([0.0, 0.0, 10.0, 0.1, 0.2, 0.3]), np.array([0.05, 0.5])
    expected = imported.step(x, u, 0.05).full().ravel()
    np.testing.assert_allclose(acados_example.integrate_with_acados(imported, x, u, 0.05), expected, atol=1e-10)
