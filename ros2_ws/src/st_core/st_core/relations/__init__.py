"""Empirical relations beyond the library of effects: smooth curves in one term of the model, fitted by simulation."""

from .candidates import Candidate, find_candidates
from .formulas import Formula
from .relation_search import Relation, RelationSearch, find_relation, needs_search

__all__ = ["Candidate", "Formula", "Relation", "RelationSearch", "find_candidates", "find_relation", "needs_search"]
