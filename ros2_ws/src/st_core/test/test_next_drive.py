"""The drive to do next for a law: what is thin, and whether a suggestion brings what it promises once it is driven."""

from dataclasses import replace

import numpy as np
import pytest
from discovery_drives import recorded
from example_discovery import discovery
from st_core.augmented import augment
from st_core.discovery import DiscoverySettings
from st_core.relations import find_relation
from st_core.relations.candidates import NEITHER, ODD, Candidate
from st_core.relations.next_drive import NextDrives, Option, _compute_variance, find_sparse_ranges, suggest_drives
from st_core.relations.relation_fit import RelationFits, RunWindows

LAW = Candidate("yaw_moment", "acceleration_x", NEITHER, -4.0, 2.0)
OTHER = Candidate("front_steer", "acceleration_x", NEITHER, -4.0, 2.0)
AT = np.linspace(LAW.low, LAW.high, 41)
SETTINGS = DiscoverySettings(where=False, block=4.0, windows=100)


def fitted(leaf, names, scale=None):
    """Drives of a car that is pushed in proportion to its forward acceleration; the law and another one fitted.

    scale: of the errors, that of these drives where none is given."""
    heights = np.linalg.lstsq(LAW.compute_splines(AT).T, 0.02 * AT, rcond=1e-6)[0]
    hidden = {LAW.effect: {**{f"c{k}": float(h) for k, h in enumerate(heights)}, **LAW.constants}}
    windows = RunWindows(recorded(leaf, hidden, 3, names), leaf, SETTINGS)
    laws = RelationFits(windows, augment("nonlinear", {}), 0.0, (), SETTINGS)
    laws.loss.scale = laws.loss.scale if scale is None else scale
    without = laws.fit_without_relation()
    return laws, [laws.fit(c, without) for c in (LAW, OTHER)]


def deviation(fit):
    splines = LAW.compute_splines(AT)
    return np.sqrt(np.einsum("ik,ij,jk->k", splines, fit.compute_covariance(), splines))


def test_what_hardly_anything_was_driven_of_is_thin():
    at = np.linspace(-2.0, 2.0, 41)
    density = np.where(np.abs(at - 1.0) < 0.45, 0.0, 1.0 / 41)
    (low, high), = find_sparse_ranges(at, density, NEITHER)
    assert 0.55 < low < 0.8 and 1.2 < high < 1.45
    assert find_sparse_ranges(at, density, ODD) == []  # the mirrored side was driven
    both = np.where(np.abs(np.abs(at) - 1.0) < 0.45, 0.0, 1.0 / 41)
    (positive,) = find_sparse_ranges(at, both, ODD)
    assert positive == pytest.approx((low, high))
    assert find_sparse_ranges(at, np.full(41, 1.0 / 41), NEITHER) == []


def test_nothing_is_suggested_that_brings_nothing():
    now = np.full(41, 0.1)
    assert NextDrives().find_most_precise(now) is None and NextDrives().find_most_separating() is None
    weak = NextDrives((), {"other": 1.0}, [Option(None, now, {"other": 2.0}, ())])
    assert weak.find_most_precise(now) is None and weak.find_most_separating() is None


@pytest.mark.slow
def test_a_suggested_drive_brings_what_it_promises(leaf):
    driven = ("sweep", "lane_change", "slalom", "brake_in_turn")
    laws, (fit, other) = fitted(leaf, driven)
    now = deviation(fit)
    drives = suggest_drives(laws, LAW, fit, {"other": other}, 2.0, AT, now, [(-4.2, -3.8), (-3.0, -1.0)])
    surest, (separating, rival) = drives.find_most_precise(now), drives.find_most_separating()
    assert surest.manoeuvre.name == separating.manoeuvre.name == "brake_in_turn" and rival == "other"
    assert separating.separation["other"] > drives.current_separation["other"]
    assert surest.seconds[0] > 1.0 and surest.seconds[1] < 1.0  # it brakes at 4 m/s^2, and is soon there
    _, (again, _) = fitted(leaf, (*driven, *3 * ["brake_in_turn"]), laws.loss.scale)
    splines = LAW.compute_splines(AT)
    before, after = (np.sqrt(_compute_variance(one.quadratic.hessian.sum(axis=0) + fit.penalty, splines))
                     for one in (fit, again))
    assert surest.deviation.max() < 0.8 * now.max()
    assert after / before == pytest.approx(surest.deviation / now, rel=0.35)
    place = suggest_drives(laws, Candidate("side_force", "position_x", NEITHER, 0.0, 100.0), fit, {}, 2.0, AT, now, [])
    assert place.options == ()


@pytest.mark.slow
def test_a_law_beside_nothing_without_an_accelerometer_has_a_next_drive(leaf):
    heights = np.linalg.lstsq(LAW.compute_splines(AT).T, 0.02 * AT, rcond=1e-6)[0]
    hidden = {LAW.effect: {**{f"c{k}": float(h) for k, h in enumerate(heights)}, **LAW.constants}}
    names = ("lane_change", "slalom", "circle", "brake_in_turn", "brake_in_turn")
    logs = [replace(log, acceleration_y=None) for log in recorded(leaf, hidden, 3, names)]
    channels = ("position", "yaw", "yaw_rate", "velocity_y")
    settings = DiscoverySettings(where=False, block=5.0, windows=60, channels=channels)
    nothing = replace(discovery(logs, (), 1.0), noise=dict.fromkeys(channels, 0.01))
    one = find_relation(nothing, logs, leaf, settings).relation
    assert (one.candidate.term, one.candidate.quantity) == ("yaw_moment", "acceleration_x")
    surest = min(one.next_drives.options, key=lambda o: o.deviation.max())
    assert surest.manoeuvre.name == "brake_in_turn" and surest.deviation.max() < one.deviation.max()
    assert any(low < -2.0 < high for low, high in one.next_drives.sparse)
