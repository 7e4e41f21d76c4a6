"""Effects of the library that a law makes needless: their names may stand for what the law is."""

from collections.abc import Sequence

import numpy as np

from ..discovery.limits import Limits
from .choice import least
from .curve_fit import Fitted, Laws
from .places import Candidate
from .scrutiny import held_out_positions


def exchanged(laws: Laws, law: Candidate, fit: Fitted, without: Fitted, names: Sequence[str],
              limits: Limits) -> dict[str, float]:
    """Share of the size of the errors [1] that comes back where each of the effects `names` is taken out and everything
    else is fitted anew; those only that the law leaves too little to do.

    The test is that of a law: an effect stays where it surely takes something away on runs it was not fitted to, and
    `limits.worth` of the size of the errors or `limits.worth_position` at that. And without the effect the law must
    surely explain more than the effect did without the law.
    """
    found = {}
    with_both = held_out_positions(laws, fit)
    for name in names:
        alone = laws.less(law, fit, name)
        more = alone.held_out - fit.held_out
        position = float(np.nanmean(held_out_positions(laws, alone) - with_both))
        worth_it = more.sum() >= limits.worth * laws.loss.number or position >= limits.worth_position
        stays = worth_it and least(more, limits.doubt) > 0.0
        if not stays and least(without.held_out - alone.held_out, limits.doubt) > 0.0:
            found[name] = max(float(-np.expm1(-more.sum() / laws.loss.number)), 0.0)
    return found
