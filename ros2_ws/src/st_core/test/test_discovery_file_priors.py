"""Values of the vehicle file as prior knowledge: uncertainties, weight in a fit, comparison with fitted values."""

from dataclasses import replace

import numpy as np
import pytest
from discovery_drives import fit_problem, linear_problem
from st_core.discovery.evidence import compare_with_file, covariance
from st_core.discovery.fit import Problem
from st_core.discovery.settings import DiscoverySettings
from st_core.discovery.space import FileQuantity, Space, find_file_quantities, prior_deviations
from st_core.vehicle import DEFAULT_UNCERTAINTIES, TYRES, Provenance


def test_uncertainty_in_the_vehicle_file_replaces_the_default(leaf):
    assert leaf.uncertainty("mass") == pytest.approx(0.03 * leaf.mass)
    assert leaf.uncertainty("steering_ratio") is None
    stated = replace(leaf, provenance={"mass": Provenance(12.0), "steering_ratio": Provenance(0.3)})
    assert stated.uncertainty("mass") == 12.0 and stated.uncertainty("steering_ratio") == 0.3


def test_default_uncertainties_belong_to_vehicle_parameters_and_have_a_source(leaf):
    for key, uncertainty in DEFAULT_UNCERTAINTIES.items():
        assert leaf.uncertainty(key) > 0.0 and uncertainty.source
        assert key.partition(".")[0] in (*TYRES, *leaf.__dataclass_fields__)


@pytest.mark.parametrize(("base", "effect", "key", "slope"), [
    ("nonlinear", "mass", "mass", 1.0), ("linear", "cg_position", "cg_to_front_axle", -1.0),
    ("nonlinear", "longitudinal_load_transfer", "cg_height", 1.0),
    ("nonlinear", "friction", "tyre_front.lambda_muy", 1.0)])
def test_effect_is_linked_to_the_file_quantity_it_changes(leaf, base, effect, key, slope):
    space = Space(base, DiscoverySettings())
    known = find_file_quantities(space, leaf)[space.indices(effect)[0]]
    scale = leaf.mass if key == "mass" else 1.0
    assert known.key == key and known.slope == pytest.approx(slope * scale)
    assert known.z_score(3.0 * known.deviation / known.slope) == pytest.approx(3.0)


def test_load_is_added_to_the_mass_in_the_file(leaf):
    space = Space("nonlinear", DiscoverySettings())
    i = space.indices("load")[0]
    assert find_file_quantities(space, leaf)[i] is None and space.payloads == ("load",)
    assert space.deviation[i] * space.scale[i] == 250.0 and np.isinf(np.delete(space.deviation, i)).all()


def test_linear_base_has_no_prior_on_the_cg_height(leaf):
    space = Space("linear", DiscoverySettings())
    known = find_file_quantities(space, leaf)
    i = space.indices("longitudinal_load_transfer")[0]
    assert known[i].z_score(leaf.cg_height) == 0.0 and known[i].z_score(-0.2) > 3.0
    assert prior_deviations(known, space.scale)[i] == np.inf


def with_known_mass(problem: Problem, deviation: float) -> Problem:
    """The problem with the mass known to a standard deviation of `deviation` typical sizes."""
    quantities: list[FileQuantity | None] = [None] * len(problem.space)
    i = problem.space.indices("mass")[0]
    quantities[i] = FileQuantity("mass", "kg", 1600.0, deviation * problem.space.scale[i] * 1600.0, 1600.0, True,
                                 1600.0)
    known = Problem(problem.loss, problem.start, problem.block, quantities=tuple(quantities))
    known.update_design_effect(known.start)
    return known


def test_known_value_changes_less_the_smaller_its_uncertainty():
    free = linear_problem(["mass", "steering_ratio"], {"mass": 1.0}, seed=1)
    i = free.space.indices("mass")[0]
    moved = []
    for deviation in (1e3, 0.05, 1e-3):
        problem = with_known_mass(free, deviation)
        fit = fit_problem(problem, "mass")
        moved.append((fit.vector[i] - problem.start[i]) / problem.space.scale[i])
        quantity, change = compare_with_file(problem, fit, "mass")
        assert quantity.z_score(change) == pytest.approx(moved[-1] / deviation, rel=1e-6)
    assert moved[0] == pytest.approx(1.0, abs=0.1) and 0.0 < moved[2] < 0.1 < moved[1] < moved[0]


def test_uncertainty_of_an_unidentifiable_parameter_is_that_of_the_file():
    free = linear_problem(["mass"], {}, seed=2)
    free.errors.signatures *= 1e-6
    problem = with_known_mass(free, 0.5)
    fit = fit_problem(problem, "mass")
    place = int(np.searchsorted(fit.indices, problem.space.indices("mass")[0]))
    assert np.sqrt(covariance(problem, fit)[place, place]) == pytest.approx(0.5, rel=0.01)


@pytest.mark.parametrize("common", [0.0, 0.8])
def test_design_effect_is_large_for_correlated_errors(common):
    problem = linear_problem(["mass", "steering_ratio", "friction", "yaw_inertia"], {}, seed=3, common=common)
    problem.update_design_effect(problem.start)
    assert (problem.design_effect > 3.0) == (common > 0.0)
