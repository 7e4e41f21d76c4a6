"""Draws the confusion matrix of hidden and stated effects."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("Agg")
from matplotlib import pyplot as plt

from .effects import KNOWN
from .evaluation import plant_differences
from .score import relevant_effects

OTHERS = ("several", "unknown", "none")


def count_confusion(records: Sequence[dict[str, Any]]) -> tuple[list[str], list[str], np.ndarray]:
    """(hidden effects, stated effects, counts) for the cases of block A with a relevant effect.

    If several effects are stated, the hidden one counts if it is among them.
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
    # True differences between plant and model count only if they are hidden.
    names = [e["name"] for e in r["effects"] if e["name"] in r["hidden"]
             or e["name"] not in plant_differences(r["plant"])]
    if r["hidden"][0] in names:
        return r["hidden"][0]
    return "several" if len(names) > 1 else names[0] if names else "unknown" if r["outcome"] == "unknown" else "none"


def draw_confusion(records: Sequence[dict[str, Any]], file: Path) -> None:
    truths, columns, counts = count_confusion(records)
    figure, axes = plt.subplots(figsize=(11, 8.5), layout="constrained")
    fraction = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    image = axes.imshow(fraction, cmap="Blues", vmin=0, vmax=1, aspect="auto")
    axes.set_xticks(range(len(columns)), columns, rotation=90)
    axes.set_yticks(range(len(truths)), [f"{t} ({n})" for t, n in zip(truths, counts.sum(axis=1), strict=True)])
    for i, j in zip(*np.nonzero(counts), strict=True):
        axes.text(j, i, counts[i, j], ha="center", va="center", color="white" if fraction[i, j] > 0.6 else "black")
    axes.axvline(len(columns) - len(OTHERS) - 0.5, color="0.5", lw=0.8)
    axes.set_xlabel("stated effect")
    axes.set_ylabel("hidden effect (block A, relevant)")
    figure.colorbar(image, label="fraction of the row [1]")
    figure.savefig(file, dpi=110)
    plt.close(figure)
