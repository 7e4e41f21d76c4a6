"""Draws the figure of the packages and their imports, from the syntax trees of the sources."""

import ast
from collections.abc import Iterator, Mapping, Sequence
from graphlib import TopologicalSorter
from itertools import permutations
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.patches import FancyArrowPatch

FIGURE = "images/architecture.png"  # in docs/
BOX = {"boxstyle": "round,pad=0.5", "facecolor": "#eef3f8", "edgecolor": "#2f4b66", "linewidth": 1.2}
DIRECT_COLOUR, IMPLIED_COLOUR = "#2f4b66", "#b4c0cc"
BOX_HALF_WIDTH = 0.13  # fraction of the width of the figure, including a margin
ROW_WIDTH = 0.85  # fraction of the width of the figure
SHIFTS = (0.0, -0.05, 0.05, -0.1, 0.1, -0.15, 0.15)  # tried shifts of a row, fractions of the width of the figure
SWEEPS = 3  # number of times that every row is optimised

Edge = tuple[str, str]


def list_packages(sources: Path) -> list[str]:
    """Names of the ROS packages below ros2_ws/src."""
    return sorted(file.parent.name for file in sources.glob("*/package.xml"))


def find_edges(sources: Path) -> set[Edge]:
    """Pairs (package, imported package), including imports in functions, but not those in tests and setup.py."""
    packages = list_packages(sources)
    files = ((name, file) for name in packages for file in (sources / name).rglob("*.py"))
    return {(name, top) for name, file in files if file.relative_to(sources).parts[1] != "test" and
            file.name != "setup.py" for top in _find_imported_packages(file) if top in packages and top != name}


def _find_imported_packages(file: Path) -> Iterator[str]:
    """Top-level packages that a file imports, except by relative imports, which stay inside the package."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"), str(file))):
        if isinstance(node, ast.Import):
            yield from (alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and not node.level:
            yield (node.module or "").partition(".")[0]


def sort_into_layers(names: list[str], arrows: set[Edge]) -> list[list[str]]:
    """Packages by the length of the longest chain of imports below them; those of the first layer import no package.

    Raises CycleError for a cycle.
    """
    sorter = TopologicalSorter({name: {b for a, b in arrows if a == name} for name in names})
    sorter.prepare()
    rows = []
    while sorter.is_active():
        ready = sorter.get_ready()
        rows.append(sorted(ready, key=names.index))
        sorter.done(*ready)
    return rows


def find_implied(arrows: set[Edge]) -> set[Edge]:
    """Arrows whose packages are also connected by a longer path of arrows."""
    paths = arrows  # end points, extended by one arrow at a time
    connected: set[Edge] = set()
    while paths:
        paths = {(a, d) for a, b in paths for c, d in arrows if b == c} - connected
        connected |= paths
    return arrows & connected


def draw_structure(sources: Path, file: Path) -> None:
    """Write the figure as PNG; its metadata lists the arrows, which `read_edges` reads."""
    names, arrows = list_packages(sources), find_edges(sources)
    centres, implied = _place_boxes(sort_into_layers(names, arrows), arrows), find_implied(arrows)
    figure, axes = plt.subplots(figsize=(9.0, 7.0), dpi=110)
    axes.set(xlim=(0.0, 1.0), ylim=(-0.4, max(y for _, y in centres.values()) + 0.4))
    axes.set_axis_off()
    figure.tight_layout(pad=0.2)
    boxes = {name: axes.text(*centre, name, ha="center", va="center", fontsize=11, family="monospace", zorder=3,
                             bbox=BOX) for name, centre in centres.items()}
    figure.canvas.draw()  # computes the sizes of the boxes, because the arrows end at their borders
    for arrow in sorted(arrows, key=lambda a: (a not in implied, a)):
        start, end = arrow
        is_implied = arrow in implied
        axes.add_patch(FancyArrowPatch(
            centres[start], centres[end], patchA=boxes[start].get_bbox_patch(), patchB=boxes[end].get_bbox_patch(),
            arrowstyle="-|>", mutation_scale=11, shrinkA=1, shrinkB=1, linewidth=0.9 if is_implied else 1.5,
            color=IMPLIED_COLOUR if is_implied else DIRECT_COLOUR, zorder=1 if is_implied else 2))
    file.parent.mkdir(parents=True, exist_ok=True)
    lines = "\n".join(f"{a} -> {b}" for a, b in sorted(arrows))
    figure.savefig(file, metadata={"Description": lines, "Software": None})
    plt.close(figure)


def read_edges(metadata: Mapping[str, str]) -> set[Edge]:
    """Arrows in the metadata of a figure that `draw_structure` wrote."""
    return {(a, b) for a, _, b in (line.partition(" -> ") for line in metadata["Description"].splitlines())}


def _place_boxes(rows: list[list[str]], arrows: set[Edge]) -> dict[str, tuple[float, float]]:
    """Centres of the boxes, one row per layer; rows are permuted and shifted so that the arrows avoid the boxes."""
    best_rows = [_place_row(row, level, 0.0) for level, row in enumerate(rows)]
    for _ in range(SWEEPS):
        for level, row in enumerate(rows):
            trials = [[*best_rows[:level], _place_row(order, level, shift), *best_rows[level + 1:]]
                      for order in permutations(row) for shift in SHIFTS]
            best_rows = min(trials, key=lambda trial: _layout_penalty(_merge_rows(trial), arrows))
    return _merge_rows(best_rows)


def _place_row(order: Sequence[str], level: int, shift: float) -> dict[str, tuple[float, float]]:
    return {name: (0.5 + ROW_WIDTH * ((number + 0.5) / len(order) - 0.5) + shift, float(level))
            for number, name in enumerate(order)}


def _merge_rows(rows: list[dict[str, tuple[float, float]]]) -> dict[str, tuple[float, float]]:
    return {name: centre for row in rows for name, centre in row.items()}


def _layout_penalty(centres: dict[str, tuple[float, float]], arrows: set[Edge]) -> float:
    """Penalty of a layout for arrows through or near boxes, and less for the horizontal length of the arrows."""
    total = 0.0
    for start, end in sorted(arrows):
        (x0, y0), (x1, y1) = centres[start], centres[end]
        total += abs(x1 - x0) * 0.02
        for name, (x, y) in centres.items():
            if name not in (start, end) and y1 < y < y0:
                distance = abs(x0 + (x1 - x0) * (y - y0) / (y1 - y0) - x)
                total += max(0.0, 1.0 - distance / BOX_HALF_WIDTH)
    return total
