"""Figures saved as files and embedded in the page."""

import re
from xml.etree import ElementTree

import matplotlib.pyplot as plt
import numpy as np
import pytest
from st_core.clock_types import Alignment, SharedSignal
from st_core.palette import MODEL_COLOUR
from st_offline.alignment_figure import draw_alignment
from st_offline.evaluation.drawing import (
    MAX_POINTS,
    FigureOutput,
    cut_at_gaps,
    reduce_points,
    save_figure,
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("figures")


@pytest.fixture(scope="module")
def drawn(folder):
    figure, axes = plt.subplots()
    axes.plot([0, 1], [0.123456789, 1], color=MODEL_COLOUR["nonlinear"])
    axes.plot([0, 1], [1, 0], ".", rasterized=True)
    axes.set_xlabel("time, s")
    return save_figure(figure, FigureOutput(folder, ("png", "pdf"), "S6-"), "test", "x < y & z", "how to read it")


def test_figure_is_saved_in_every_format(drawn, folder):
    assert (folder / "test.png").read_bytes()[:4] == b"\x89PNG"
    assert (folder / "test.pdf").read_bytes()[:4] == b"%PDF"
    assert not plt.get_fignums()


def test_svg_uses_the_colours_and_fonts_of_the_page(drawn):
    assert ElementTree.fromstring(drawn.svg).tag.endswith("svg")
    assert "var(--nonlinear)" in drawn.svg and MODEL_COLOUR["nonlinear"] not in drawn.svg
    assert "font-family" not in drawn.svg and "var(--text)" in drawn.svg
    assert "time, s" in drawn.svg and "x &lt; y" not in drawn.svg  # the page shows the title outside the figure


@pytest.mark.parametrize("label", ["kinematic", "steering_ratio.csv:to the right"])
def test_legend_is_not_wider_than_the_figure(label):
    figure, axes = plt.subplots(figsize=(9.0, 3.0))
    for k in range(6):
        axes.plot([0, 1], [k, k], label=f"{label}{k}")
    save_figure(figure, FigureOutput(None, ()), "legend", "title", "")
    assert figure.legends[0].get_window_extent().x1 < figure.bbox.width


@pytest.mark.parametrize("has_own", [False, True])
def test_legend_lists_each_label_once_unless_an_axis_has_its_own(has_own):
    figure, panels = plt.subplots(1, 2)
    for axes in panels:
        axes.plot([0, 1], [0, 1], label="linear")
        axes.plot([0, 1], [1, 0])
    panels[1].plot([0, 1], [1, 1], label="measured")
    if has_own:
        panels[0].legend()
    save_figure(figure, FigureOutput(None, ()), "test", "title", "caption")
    texts = [[text.get_text() for text in legend.get_texts()] for legend in figure.legends]
    assert texts == ([] if has_own else [["linear", "measured"]])


def test_svg_ids_have_the_prefix_and_references_resolve(drawn):
    ids = re.findall(r'\bid="([^"]+)"', drawn.svg)
    used = re.findall(r'(?:url\(#|href="#)([^")]+)', drawn.svg)
    assert used and set(used) <= set(ids) and all(i.startswith("S6-test-") for i in ids)


def test_svg_loads_no_external_content(drawn):
    assert all(link.startswith(("#", "data:")) for link in re.findall(r'href="([^"]*)"', drawn.svg))


def test_reduced_lines_keep_extremes_and_gaps():
    time = np.arange(100_000.0)
    values = np.sin(time / 500.0)
    values[77_777], values[12_345] = 9.0, -9.0
    values[50_000:60_000] = values[70_000] = np.nan
    few_times, few = reduce_points(time, values)
    assert len(few) <= MAX_POINTS + 3 and np.nanmax(few) == 9.0 and np.nanmin(few) == -9.0
    assert (np.diff(few_times) > 0).all() and np.isnan(few).sum() > 10 and 70_000.0 in few_times[np.isnan(few)]
    assert len(reduce_points(time[:100], values[:100])[0]) == 100


def test_lines_break_at_gaps_only():
    time, values = cut_at_gaps(np.array([0.0, 1.0, 5.0, 6.0]), np.array([1.0, 2.0, 3.0, 4.0]), gap=2.0)
    assert np.isnan(values).tolist() == [False, False, True, False, False] and len(time) == 5


def test_alignment_is_drawn_with_gaps_in_the_steering_angle(tmp_path):
    time_ns = (50e6 * np.arange(2000)).astype(np.int64)
    curvature = 0.05 * np.sin(time_ns * 1e-9)
    angle = np.where(np.arange(2000) // 5 == 60, np.nan, 16.0 * curvature)
    signal = SharedSignal("curvature against steering", time_ns, curvature, time_ns, angle)
    draw_alignment([signal], Alignment(), "title", tmp_path)
    assert (tmp_path / "alignment.png").stat().st_size > 20_000
