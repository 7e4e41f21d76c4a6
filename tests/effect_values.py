"""Parameter values of the effects for tests that cover the whole registry."""

from st_core.effects import EFFECTS


def values_of(name: str, share: float) -> dict[str, float]:
    """From null (share 0) over initial (1) to the bound on the side of initial (2)."""
    result = {}
    for p in EFFECTS[name].parameters:
        bound = p.bounds[1] if p.initial >= p.null else p.bounds[0]
        begin, end, part = (p.null, p.initial, share) if share <= 1.0 else (p.initial, bound, share - 1.0)
        result[p.name] = end if part == 1.0 else begin + part * (end - begin)
    return result


def values_towards_bound(name: str, share: float) -> dict[str, float]:
    """From null (share 0) to the upper bound (1) or the lower bound (-1; the upper one where null is the lower)."""
    result = {}
    for p in EFFECTS[name].parameters:
        bound = p.bounds[1] if share > 0.0 or p.bounds[0] == p.null else p.bounds[0]
        value = p.null + abs(share) * (bound - p.null) if p.fit else p.null
        result[p.name] = min(max(value, p.bounds[0]), p.bounds[1])
    return result
