"""Draws the figure of the packages and their imports, from the syntax trees of the sources."""

import ast
from collections.abc import Iterator, Mapping
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.patches import FancyArrowPatch

FIGURE = "images/architecture.png"  # in docs/
BOX = {"boxstyle": "round,pad=0.5", "facecolor": "#eef3f8", "edgecolor": "#2f4b66", "linewidth": 1.2}
DIRECT_COLOUR, IMPLIED_COLOUR = "#2f4b66", "#b4c0cc"
CENTRES = {
    "st_cli": (0.45, 5.0), "st_live": (0.68, 4.0), "st_offline": (0.29, 3.0), "st_predictor": (0.64, 3.0),
    "st_recordings": (0.44, 2.0), "st_sim": (0.88, 2.0), "canedge_bridge": (0.29, 1.0), "oxts_bridge": (0.71, 1.0),
    "st_msgs": (0.32, 0.0), "st_core": (0.6, 0.0), "st_ros": (0.88, 0.0)}
"""Centre of the box of each package: fraction of the width, row; chosen so that the arrows avoid the boxes."""

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
    arrows = find_edges(sources)
    implied = find_implied(arrows)
    figure, axes = plt.subplots(figsize=(9.0, 7.0), dpi=110)
    axes.set(xlim=(0.0, 1.0), ylim=(-0.4, 5.4))
    axes.set_axis_off()
    figure.tight_layout(pad=0.2)
    boxes = {name: axes.text(*centre, name, ha="center", va="center", fontsize=11, family="monospace", zorder=3,
                             bbox=BOX) for name, centre in CENTRES.items()}
    figure.canvas.draw()  # computes the sizes of the boxes, because the arrows end at their borders
    for arrow in sorted(arrows, key=lambda a: (a not in implied, a)):
        start, end = arrow
        is_implied = arrow in implied
        axes.add_patch(FancyArrowPatch(
            CENTRES[start], CENTRES[end], patchA=boxes[start].get_bbox_patch(), patchB=boxes[end].get_bbox_patch(),
            arrowstyle="-|>", mutation_scale=11, shrinkA=1, shrinkB=1, linewidth=0.9 if is_implied else 1.5,
            color=IMPLIED_COLOUR if is_implied else DIRECT_COLOUR, zorder=1 if is_implied else 2))
    file.parent.mkdir(parents=True, exist_ok=True)
    lines = "\n".join(f"{a} -> {b}" for a, b in sorted(arrows))
    figure.savefig(file, metadata={"Description": lines, "Software": None})
    plt.close(figure)


def read_edges(metadata: Mapping[str, str]) -> set[Edge]:
    """Arrows in the metadata of a figure that `draw_structure` wrote."""
    return {(a, b) for a, _, b in (line.partition(" -> ") for line in metadata["Description"].splitlines())}
