"""Values of the effects for tests that go over the whole registry."""

from st_core.effects import EFFECTS


def values_of(name: str, share: float) -> dict[str, float]:
    """From null (0) over initial (1) on towards the bound of that side (2)."""
    result = {}
    for p in EFFECTS[name].parameters:
        bound = p.bounds[1] if p.initial >= p.null else p.bounds[0]
        begin, end, part = (p.null, p.initial, share) if share <= 1.0 else (p.initial, bound, share - 1.0)
        result[p.name] = end if part == 1.0 else begin + part * (end - begin)
    return result
