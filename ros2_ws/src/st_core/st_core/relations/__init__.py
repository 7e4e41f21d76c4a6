"""Empirical relations that no effect of the library describes: smooth curves added to one term of the model."""

from .candidates import Candidate, find_candidates
from .formulas import Formula
from .relation_search import Relation, RelationSearch, find_relation, needs_search

__all__ = ["Candidate", "Formula", "Relation", "RelationSearch", "find_candidates", "find_relation", "needs_search"]
