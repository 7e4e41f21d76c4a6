"""Random-effects estimate of one quantity from several, with the variance between them beyond their own variances.

Source: DerSimonian and Laird, Meta-analysis in clinical trials, Controlled Clinical Trials 7 (1986).
"""

from typing import NamedTuple

import numpy as np


class Pooled(NamedTuple):
    """Pooled mean and its standard deviation. between: variance between estimates. excess: Cochran's Q [1]."""

    mean: float
    deviation: float
    between: float
    excess: float


def random_effects(values: np.ndarray, variances: np.ndarray) -> Pooled:
    """Pooled estimate by DerSimonian and Laird; values, variances: (n,), n >= 1, variances > 0.

    Checked by: test_discovery_evidence.py.
    """
    w = 1.0 / variances
    excess = float(w @ np.square(values - w @ values / w.sum()))
    surplus = max(excess - max(len(values) - 1, 1), 0.0)
    between = surplus / max(float(w.sum() - np.square(w).sum() / w.sum()), 1e-300)
    w = 1.0 / (variances + between)
    return Pooled(float(w @ values / w.sum()), float(w.sum() ** -0.5), between, excess)
