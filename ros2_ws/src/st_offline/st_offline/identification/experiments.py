"""All experiments of `st identify`, in the order they are best done."""

from .axle_lift import CG_HEIGHT
from .driving import DRIVING
from .experiment import Experiment
from .flat_plank import LAMBDA, TYRE
from .scales import SCALES
from .turntable import STEERING_RATIO

EXPERIMENTS: dict[str, Experiment] = {
    one.name: one for one in (SCALES, CG_HEIGHT, STEERING_RATIO, TYRE, *DRIVING, LAMBDA)}
