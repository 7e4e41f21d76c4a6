"""The NMPC example: a short drive stays on the road, both solvers agree, and the exported model passes for acados."""

import json
import sys

import numpy as np
import pytest
from st_core.augmented import augment
from st_core.models import MODELS
from st_core.vehicle import VehicleParameters
from st_offline.model_export import export_model
from st_sim.car import read_car
from st_sim.scenarios import load_plan
from st_sim.settings import PRESETS
from support import ROOT

pytest.importorskip("casadi", reason="casadi is not installed")
FILE = ROOT / "config" / "vehicle" / "leaf.yaml"
LEAF = VehicleParameters.from_yaml(FILE.read_text(), str(FILE))
NAMES = ("acados_example", "closed_loop", "controlled_car", "controller", "corridor", "drawing", "nmpc")


@pytest.fixture(autouse=True)
def example(monkeypatch):
    """The example's own folder first on the path, as when it is started; gone afterwards."""
    monkeypatch.syspath_prepend(str(ROOT / "examples" / "mpc"))
    yield
    for name in NAMES:
        sys.modules.pop(name, None)


def driven(model, solver, seconds=6.5, steps=10):
    from closed_loop import drive
    from controller import Controller

    controller = Controller(model, LEAF, steps, solver=solver)
    return drive(controller, read_car(FILE), PRESETS["realistic"], load_plan("lane_change"), seconds)


def test_a_lane_change_is_followed_and_slip_matters():
    linear, table = driven(MODELS["linear"], "rti")
    assert linear.finished and linear.unsolved == 0 and linear.solutions == 65
    assert np.ptp(table[:, 2]) > 3.0  # it did change lane
    assert linear.error_max < 0.15
    kinematic, _ = driven(MODELS["kinematic"], "rti")
    assert kinematic.error_rms > 3.0 * linear.error_rms


def test_one_iteration_does_what_the_whole_solution_does():
    model = augment("nonlinear", {"tyre_relaxation": {"length": 0.4}})
    (fast, quick), (whole, full) = (driven(model, solver, 5.0) for solver in ("rti", "ipopt"))
    assert whole.unsolved == 0 and fast.finished
    np.testing.assert_allclose(quick[:, 1:3], full[:, 1:3], atol=0.03)


def test_a_gate_is_passed_along_its_post_and_a_band_keeps_the_car_off(monkeypatch):
    import corridor
    from controller import Controller, Tuning
    from st_core.bands import Band, CalibrationDomain
    from st_core.bands.scale import Scale, compute_features, make_knots
    from st_offline.model_export import make_half_width_function

    monkeypatch.setattr(corridor, "DURATION", 6.0)
    there, time = [corridor.Gate(30.0, 36.0, -1, 1.0)], 0.05 * np.arange(1, 51)
    low, high = corridor.limits(there, np.array([29.0, 33.0]), np.array([0.2, 0.2]))
    assert high == pytest.approx([4.0, -1.2]) and low == pytest.approx([-4.0, -4.0])
    # 0.3 m at every point, whatever the conditions.
    nothing = np.full((3, 6, compute_features(np.zeros((1, 4))).shape[1]), 0.0)
    nothing[:, :, 0] = -30.0
    band = Band(Scale(nothing, np.stack([np.full(3, 0.3), np.zeros(3)]), time, make_knots(2.5)), {0.9: 1.0},
                np.zeros((3, 19)))
    seen = CalibrationDomain(np.full((99, 99), 100), (100.0, 100.0))
    controller = Controller(MODELS["linear"], LEAF, 25, Tuning(), "rti", corridor=True)
    plain, kept_off = (corridor.drive(controller, read_car(FILE), LEAF, there, 1, one)
                       for one in (None, corridor.Margin(make_half_width_function(band, 0.9, LEAF), seen, 0.5)))
    assert -0.2 < plain.depth < 0.3
    assert kept_off.depth == pytest.approx(plain.depth - 0.3, abs=0.1) and kept_off.error > plain.error
    assert len(plain.log.x) == 300


def test_command_writes_figures_and_numbers(tmp_path, monkeypatch, capsys):
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
def test_exported_model_is_what_acados_would_take(tmp_path, free):
    import acados_example

    model = augment("nonlinear", {"tyre_relaxation": {"length": 0.4}, "road_bank": {"angle": 0.05}})
    export_model(model, LEAF, tmp_path, "casadi", substeps=2, free=free)
    imported = acados_example.load(tmp_path)
    assert imported.x.numel() == 8 and imported.p.numel() == len(free)
    x, u = np.array([0.0, 0.0, 10.0, 0.1, 0.2, 0.3, 0.01, 0.02]), np.array([0.05, 0.5])
    assert acados_example.largest_difference(imported, x, u, 0.05) < 1e-12
    assert imported.state_bounds[0][2] > 0.0 and np.isinf(imported.state_bounds[0][0])
    assert imported.input_bounds[1][0] == pytest.approx(0.61)


def test_acados_integrates_the_same(tmp_path):
    pytest.importorskip("acados_template", reason="acados is not installed")
    import acados_example

    export_model(MODELS["nonlinear"], LEAF, tmp_path, "casadi")
    imported = acados_example.load(tmp_path)
    x, u = np.array([0.0, 0.0, 10.0, 0.1, 0.2, 0.3]), np.array([0.05, 0.5])
    expected = imported.step(x, u, 0.05).full().ravel()
    np.testing.assert_allclose(acados_example.integrate_with_acados(imported, x, u, 0.05), expected, atol=1e-10)
