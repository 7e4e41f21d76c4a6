"""What the page says in words, as Markdown: large for whoever sits in the car, the running table, what is not well."""

import math
from collections.abc import Sequence
from typing import Protocol

from st_recordings import counted


class Row(counted.Row, Protocol):
    """One model and mode of st_msgs/ErrorSummary."""

    n_starts: int
    longitudinal_rmse: float
    lateral_rmse: float


# Names of the light, by the level of the worst check; a stale one is as bad as an error.
LIGHTS = ("all well", "warning", "error", "error")
NOTHING = "nothing heard"
OLD = 1.0  # s; an older picture is one the car is no longer in
SILENT = 3.0  # s; every node says once a second how it is
STATUS_OLD = 5.0  # s; the INS says its mode every second
LEVELS = ("ok", "warning", "**error**", "stale")


def page(rows: Sequence[Row], ticks: str, health: Sequence[tuple[int, str, str]]) -> str:
    """rows: statistics so far. ticks: one line. health: (level, name, message) of everything that was heard."""
    lines = ["| model | mode | starts | RMSE long., m | lat., m |", "|---|---|--:|--:|--:|"]
    for mode in ("forecast", "hindsight"):
        for row in (r for r in rows if r.mode == mode and r.n_starts):
            errors = (row.longitudinal_rmse, row.lateral_rmse)
            numbers = " | ".join("-" if math.isnan(e) else f"{e:.2f}" for e in errors)
            lines.append(f"| {row.model} | {mode} | {row.n_starts} | {numbers} |")
    if len(lines) == 2:
        lines = ["Waiting for the first complete horizon."]
    lines += ["", *(f"- {line}" for line in counted.lines(rows)), "", ticks, ""]
    wrong = [entry for entry in health if entry[0] > 0]
    lines += [f"- {LEVELS[min(level, 3)]}: {name}: {message}" for level, name, message in sorted(wrong, reverse=True)]
    if health and not wrong:
        lines.append("All nodes well.")
    return "\n".join(lines)


def light(health: Sequence[tuple[int, str, str]], age: float | None = None) -> tuple[str, str]:
    """(name of the light, what is said beside it): of the worst check; grey where none was heard, red where the
    picture is old. age: as for `passenger`.
    """
    if age is not None and age > OLD:
        return LIGHTS[2], "no position comes"
    if not health:
        return NOTHING, ""
    level, name, message = max(health)
    if level == 0:
        return LIGHTS[0], ""
    others = sum(entry[0] > 0 for entry in health) - 1
    return LIGHTS[min(level, 3)], f"{name}: {message}" + (f", and {others} more" if others else "")


def passenger(velocity_x: float, yaw_rate: float, road_wheel_angle: float | None, mode: str, mode_age: float,
              health: tuple[str, str], age: float | None) -> str:
    """What the car does and whether all is well, in large letters.

    velocity_x [m/s], yaw_rate [rad/s], road_wheel_angle [rad, left +]. mode: of the INS's position, "" while unknown,
    said mode_age [s] ago. health: of `light`. age: since the measurement shown was heard [s]; None for a recording.
    """
    name, said = health
    lateral = velocity_x * yaw_rate
    angle = "-" if road_wheel_angle is None else _sided(math.degrees(road_wheel_angle), "°")
    position = mode or "position mode not heard"
    if mode and mode_age > STATUS_OLD:
        position += f" ({mode_age:.0f} s ago)"
    # Two to a line: all of it stays in sight in a window of 1100 by 560 pixels.
    lines = [f"# {3.6 * velocity_x:.0f} km/h", f"## wheels {angle} · {_sided(lateral, ' m/s²')}",
             f"## {position} · {name}", said]
    if age is not None:
        lines.append(f"## the picture stands: {age:.0f} s old" if age > OLD else f"picture {age:.1f} s old")
    return "\n\n".join(line for line in lines if line)


def _sided(value: float, unit: str) -> str:
    """A signed value, left +, as it is said."""
    text = f"{abs(value):.1f}"
    return f"0.0{unit}" if text == "0.0" else f"{text}{unit} {'left' if value > 0 else 'right'}"
