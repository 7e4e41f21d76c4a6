"""Draws the confusion matrix of hidden and stated effects."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("Agg")
from matplotlib import pyplot as plt

from .effects import KNOWN
from .judge import plant_differences
from .score import relevant_effects

OTHERS = ("several", "unknown", "none")


def count_confusion(records: Sequence[dict[str, Any]]) -> tuple[list[str], list[str], np.ndarray]:
    """(hidden effects, stated effects, counts) for the cases of block A in which the effect matters.

    If several effects are stated and the hidden one is among them, it counts.
    """
    truths = [h.library for h in KNOWN]
    single = [r for r in records if r["block"] == "A" and relevant_effects(r)]
    stated = [_stated(r) for r in single]
    columns = truths + sorted(set(stated) - set(truths) - set(OTHERS)) + list(OTHERS)
    counts = np.zeros((len(truths), len(columns)), int)
    for r, name in zip(single, stated, strict=True):
        counts[truths.index(r["hidden"][0]), columns.index(name)] += 1
    return truths, columns, counts


def _stated(r: dict[str, Any]) -> str:
    names = [e["name"] for e in r["effects"] if is_of_interest(r, e["name"])]
    if r["hidden"][0] in names:
        return r["hidden"][0]
    return "several" if len(names) > 1 else names[0] if names else "unknown" if r["outcome"] == "unknown" else "none"


def is_of_interest(r: dict[str, Any], name: str) -> bool:
    """Whether an effect counts; true differences between plant and model do not, unless they are hidden."""
    return name in r["hidden"] or name not in plant_differences(r["plant"])


def draw_confusion(records: Sequence[dict[str, Any]], file: Path) -> None:
    truths, columns, counts = count_confusion(records)
    figure, axes = plt.subplots(figsize=(11, 8.5), layout="constrained")
    share = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    image = axes.imshow(share, cmap="Blues", vmin=0, vmax=1, aspect="auto")
    axes.set_xticks(range(len(columns)), columns, rotation=90)
    axes.set_yticks(range(len(truths)), [f"{t} ({n})" for t, n in zip(truths, counts.sum(axis=1), strict=True)])
    for i, j in zip(*np.nonzero(counts), strict=True):
        axes.text(j, i, counts[i, j], ha="center", va="center", color="white" if share[i, j] > 0.6 else "black")
    axes.axvline(len(columns) - len(OTHERS) - 0.5, color="0.5", lw=0.8)
    axes.set_xlabel("best name stated")
    axes.set_ylabel("hidden effect (block A, where it matters)")
    figure.colorbar(image, label="share of the row [1]")
    figure.savefig(file, dpi=110)
    plt.close(figure)
