"""Next drive for an empirical relation: sparse ranges, and whether a suggested drive gives the predicted precision."""

from dataclasses import replace

import numpy as np
import pytest
from discovery_drives import recorded, relation
from example_discovery import discovery
from st_core.augmented import augment
from st_core.discovery import DiscoverySettings
from st_core.discovery.windows import Windows
from st_core.relations import find_relation
from st_core.relations.candidates import NO_PARITY, ODD, Candidate
from st_core.relations.next_drive import NextDrives, Option, _compute_variance, find_sparse_ranges, simulate_drives
from st_core.relations.relation_fit import RelationFits

RELATION = Candidate("yaw_moment", "acceleration_x", NO_PARITY, -4.0, 2.0)
OTHER = Candidate("front_steer", "acceleration_x", NO_PARITY, -4.0, 2.0)
AT = np.linspace(RELATION.low, RELATION.high, 41)
HIDDEN = relation(RELATION, lambda acceleration: 0.02 * acceleration)
SETTINGS = DiscoverySettings(locate_errors=False, block=4.0, windows=100)


def fit_relations(leaf, names, scale=None):
    """Fits of the true relation and of a wrong one to drives with a yaw moment proportional to forward acceleration.

    scale: residual scale, by default that of these drives."""
    windows = Windows(recorded(leaf, HIDDEN, 3, names), leaf, SETTINGS)
    fits = RelationFits(windows, augment("nonlinear", {}), 0.0, (), SETTINGS)
    fits.loss.scale = fits.loss.scale if scale is None else scale
    without = fits.fit_without_relation()
    return fits, [fits.fit(c, without) for c in (RELATION, OTHER)]


def standard_deviation(fit):
    """Standard deviation of the curve at AT."""
    splines = RELATION.compute_splines(AT)
    return np.sqrt(np.einsum("ik,ij,jk->k", splines, fit.compute_covariance(), splines))


def test_sparse_ranges_are_those_with_little_driving():
    at = np.linspace(-2.0, 2.0, 41)
    density = np.where(np.abs(at - 1.0) < 0.45, 0.0, 1.0 / 41)
    (low, high), = find_sparse_ranges(at, density, NO_PARITY)
    assert 0.55 < low < 0.8 and 1.2 < high < 1.45
    assert find_sparse_ranges(at, density, ODD) == []  # an odd curve: the opposite sign was driven
    both = np.where(np.abs(np.abs(at) - 1.0) < 0.45, 0.0, 1.0 / 41)
    (positive,) = find_sparse_ranges(at, both, ODD)
    assert positive == pytest.approx((low, high))
    assert find_sparse_ranges(at, np.full(41, 1.0 / 41), NO_PARITY) == []


def test_drive_without_a_gain_in_precision_is_not_suggested():
    now = np.full(41, 0.1)
    assert NextDrives().find_most_precise(now) is None and NextDrives().find_most_separating() is None
    without_gain = NextDrives((), {"other": 1.0}, [Option(None, now, {"other": 2.0}, ())])
    assert without_gain.find_most_precise(now) is None and without_gain.find_most_separating() is None


@pytest.mark.slow
def test_suggested_drive_gives_the_predicted_precision(leaf):
    names = ("sweep", "lane_change", "slalom", "brake_in_turn")
    fits, (fit, other) = fit_relations(leaf, names)
    now = standard_deviation(fit)
    drives = simulate_drives(fits, fit, {"other": other}, 2.0, AT, now, [(-4.2, -3.8), (-3.0, -1.0)])
    most_precise, (separating, rival) = drives.find_most_precise(now), drives.find_most_separating()
    assert most_precise.manoeuvre.name == separating.manoeuvre.name == "brake_in_turn" and rival == "other"
    assert separating.separation["other"] > drives.current_separation["other"]
    assert most_precise.seconds[0] > 1.0 and most_precise.seconds[1] < 1.0  # it brakes at 4 m/s^2
    _, (refitted, _) = fit_relations(leaf, (*names, *3 * ["brake_in_turn"]), fits.loss.scale)
    splines = RELATION.compute_splines(AT)
    before, after = (np.sqrt(_compute_variance(one.quadratic.hessian.sum(axis=0) + fit.penalty, splines))
                     for one in (fit, refitted))
    assert most_precise.deviation.max() < 0.8 * now.max()
    assert after / before == pytest.approx(most_precise.deviation / now, rel=0.35)
    over_position = Candidate("side_force", "position_x", NO_PARITY, 0.0, 100.0)
    assert simulate_drives(fits, replace(fit, candidate=over_position), {}, 2.0, AT, now, []).options == ()


@pytest.mark.slow
def test_relation_found_without_an_accelerometer_has_a_next_drive(leaf):
    names = ("lane_change", "slalom", "circle", "brake_in_turn", "brake_in_turn")
    logs = [replace(log, acceleration_y=None) for log in recorded(leaf, HIDDEN, 3, names)]
    channels = ("position", "yaw", "yaw_rate", "velocity_y")
    settings = DiscoverySettings(locate_errors=False, block=5.0, windows=60, channels=channels)
    no_effects = replace(discovery(logs, (), 1.0), noise=dict.fromkeys(channels, 0.01))
    one = find_relation(no_effects, logs, leaf, settings).relation
    assert (one.candidate.term, one.candidate.quantity) == ("yaw_moment", "acceleration_x")
    most_precise = min(one.next_drives.options, key=lambda o: o.deviation.max())
    assert most_precise.manoeuvre.name == "brake_in_turn" and most_precise.deviation.max() < one.deviation.max()
    assert any(low < -2.0 < high for low, high in one.next_drives.sparse_ranges)
