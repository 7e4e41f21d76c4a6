"""Sets the style of all figures, saves figures as files, and converts them to SVG in the colours of the HTML page."""

import io
import itertools
import re
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox
from st_core.errors import ConfigurationError
from st_core.palette import FIGURE_STYLE, MEASURED_COLOUR, MODEL_COLOUR

TEXT_COLOUR, GRID_COLOUR, BAD_COLOUR, WARN_COLOUR = "#1c2126", "#e6e6e6", "#b3261e", "#b26a00"
# Colour in figures -> variable of the style sheet of the page.
_CSS_VARIABLES = {
    TEXT_COLOUR: "var(--text)", GRID_COLOUR: "var(--rule)", BAD_COLOUR: "var(--bad)", WARN_COLOUR: "var(--warn)",
    MEASURED_COLOUR: "var(--measured)",
    **{colour: f"var(--{model})" for model, colour in MODEL_COLOUR.items()},
}
plt.rcParams.update({
    **FIGURE_STYLE, "grid.color": GRID_COLOUR, "svg.fonttype": "none", "svg.hashsalt": "st",
    "font.family": "sans-serif",
    **dict.fromkeys(("text.color", "axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color"), TEXT_COLOUR),
    "pdf.fonttype": 42,
})
FORMATS = ("png", "pdf", "svg")
WIDTH = 9.0  # inch; the page scales figures to its own width
TITLE_CHARACTERS = 104  # per line of a title, at WIDTH
LEGEND_HANDLE_WIDTH = 7  # width of a line or marker with its margins in the legend, in characters
HALF_TICK_LABEL_HEIGHT = 0.09  # inch
PAGE_DPI = 110  # of raster images inside an SVG
MAX_POINTS = 900  # per line; more cannot be distinguished at WIDTH


@dataclass(frozen=True)
class PageFigure:
    """A figure of a page. key: part of file names and ids. title: states the result."""

    key: str
    title: str
    caption: str
    svg: str


@dataclass(frozen=True)
class FigureOutput:
    """Destination of figures. folder: folder of the files, None for no files. prefix: start of ids in the SVG."""

    folder: Path | None
    formats: tuple[str, ...]
    prefix: str = ""


def check_formats(formats: Sequence[str]) -> None:
    """Raise ConfigurationError for an unknown format."""
    unknown_formats = [name for name in formats if name not in FORMATS]
    if unknown_formats:
        raise ConfigurationError(f"--figures: {unknown_formats[0]} is not one of {', '.join(FORMATS)}")


def save_figure(figure: Figure, output: FigureOutput, key: str, title: str, caption: str) -> PageFigure:
    """Save a figure as files, with its title, and as an SVG for the page, without the title; close the figure. A legend
    below the figure lists each label once, unless one of the axes has a legend."""
    entries = {label: handle for axes in figure.axes
               for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)}
    characters = round(TITLE_CHARACTERS * figure.get_figwidth() / WIDTH)
    if entries and not any(axes.get_legend() for axes in figure.axes):
        widths = {n: sum(max(map(len, column)) + LEGEND_HANDLE_WIDTH for column in np.array_split(list(entries), n))
                  for n in range(1, min(len(entries), 6) + 1)}
        columns = max([n for n, width in widths.items() if width <= 1.2 * characters], default=1)
        figure.legend(entries.values(), entries.keys(), loc="outside lower left", ncols=columns)
    lines = textwrap.wrap(title, characters)
    heading = figure.suptitle("\n".join(lines), x=0.01, ha="left", fontweight="bold", fontsize=10)
    # The layout is computed once, because it takes longer than the drawing. Then the layout engine is removed, which in
    # Matplotlib requires both this setting and `None`.
    figure.draw_without_rendering()
    with plt.rc_context({"figure.constrained_layout.use": False}):
        figure.set_layout_engine(None)
        if output.folder is not None and output.formats:
            output.folder.mkdir(parents=True, exist_ok=True)
            for extension in output.formats:
                figure.savefig(output.folder / f"{key}.{extension}",
                               metadata={"CreationDate": None} if extension == "pdf" else None)
        width, height = figure.get_size_inches()
        # The highest tick label extends half its height above the axes.
        top = heading.get_window_extent().y0 / figure.dpi + HALF_TICK_LABEL_HEIGHT
        heading.set_visible(False)
        svg = io.StringIO()
        figure.savefig(svg, format="svg", transparent=True, metadata={"Date": None}, dpi=PAGE_DPI,
                       bbox_inches=Bbox([[0.0, 0.0], [width, min(top, height)]]))
    plt.close(figure)
    return PageFigure(key, title, caption, make_page_svg(svg.getvalue(), f"{output.prefix}{key}-"))


def make_page_svg(svg: str, prefix: str) -> str:
    """The <svg> element for a page, with CSS colour variables, the page's fonts, unique ids and rounded numbers."""
    svg = svg[svg.index("<svg"):]
    svg = re.sub(r"<metadata>.*?</metadata>|<!--.*?-->", "", svg, flags=re.S)
    for colour, variable in _CSS_VARIABLES.items():
        svg = svg.replace(colour, variable)
    svg = svg.replace("#000000", "var(--text)")
    svg = re.sub(r"font-family: [^;\"]*;? ?", "", svg)
    svg = re.sub(r'<g id="[^"]*"', "<g", svg)
    svg = re.sub(r'(\bid="|url\(#|xlink:href="#)', rf"\g<1>{prefix}", svg)
    # Numbers are rounded inside tags only, not in the text between them.
    svg = re.sub(r"<[^>]*>", lambda tag: re.sub(r"-?\d+\.\d{2,}", _round_number, tag.group()), svg)
    svg = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", svg, count=1)
    svg = re.sub(r'(<svg[^>]*?) width="[^"]*"', r'\1 role="img"', svg, count=1)
    return re.sub(r"\s*\n\s*", " ", svg)


def _round_number(number: re.Match) -> str:
    # Coordinates need a resolution of 0.1 points at a width of 650; small numbers may be opacities and line widths.
    value = float(number.group())
    return f"{value:.1f}" if abs(value) >= 2.0 else f"{value:.3g}"


def reduce_points(time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Reduce a long line to the smallest and largest value and the first NaN of each of MAX_POINTS / 2 sections."""
    if len(time) <= MAX_POINTS:
        return time, values
    edges = np.linspace(0, len(time), MAX_POINTS // 2 + 1).astype(int)
    indices: list[int] = []
    for a, b in itertools.pairwise(edges.tolist()):
        part = values[a:b]
        is_nan = np.isnan(part)
        selected = {int(is_nan.argmax())} if is_nan.any() else set()
        selected |= set() if is_nan.all() else {int(np.nanargmin(part)), int(np.nanargmax(part))}
        indices += [a + k for k in sorted(selected)]
    return time[indices], values[indices]


def cut_at_gaps(time: np.ndarray, values: np.ndarray, gap: float) -> tuple[np.ndarray, np.ndarray]:
    """Insert a NaN, which interrupts a line, between points that are more than `gap` [s] apart."""
    starts = np.flatnonzero(np.diff(time) > gap) + 1
    return np.insert(time.astype(float), starts, np.nan), np.insert(values.astype(float), starts, np.nan)
