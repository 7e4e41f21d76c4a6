"""All experiments of `st identify`, in the order they are best done."""

from .experiment import Experiment
from .scales import SCALES

EXPERIMENTS: dict[str, Experiment] = {one.name: one for one in (SCALES,)}
