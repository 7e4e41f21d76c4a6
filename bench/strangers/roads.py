"""Random roads for the drives."""

import math

import numpy as np

ROADS = ("town", "country", "roundabouts", "motorway", "hills", "avenue")


def road(name: str, rng: np.random.Generator, comfort: float, stops: bool = True) -> np.ndarray:
    """Rows of x, y [m], yaw [rad] and speed [m/s] every 0.5 m.

    comfort: lateral acceleration that the driver accepts [m/s^2]. stops: whether the road has stops. The curvature
    changes over 12 m, and the driver brakes at 1.8 m/s^2.
    """
    parts = _parts(name, rng, comfort)
    if not stops:
        parts = [(length, k, limit or 8.0) for length, k, limit in parts]
    return _line(parts, comfort)


def _parts(name: str, rng: np.random.Generator, comfort: float) -> list[tuple[float, float, float]]:
    """(length [m], curvature [1/m], speed limit [m/s]) of each part of a road; a limit of 0 is a stop."""
    brisk = math.sqrt(comfort / 3.0)

    def bend(radius: float, degrees: float, limit: float) -> tuple[float, float, float]:
        return radius * math.radians(degrees), rng.choice((-1, 1)) / radius, limit * brisk

    if name == "town":
        return [part for _ in range(30) for part in (
            (rng.uniform(60, 160), 0.0, 13.5), bend(rng.uniform(11, 18), 85, 8.0), (rng.uniform(40, 90), 0.0, 13.5),
            bend(rng.uniform(30, 70), 50, 11.0), (3.0, 0.0, rng.choice((0.0, 12.0))))]
    if name == "country":
        return [part for _ in range(40) for part in (
            (rng.uniform(30, 150), 0.0, 23.0), bend(rng.uniform(45, 220), rng.uniform(30, 80), 23.0))]
    if name == "hills":
        return [part for _ in range(60) for part in (
            (rng.uniform(15, 60), 0.0, 19.0), bend(rng.uniform(25, 110), rng.uniform(40, 120), 19.0))]
    if name == "slalom":
        return [part for _ in range(40) for part in (
            (rng.uniform(60, 140), 0.0, 16.0), *((length, sign / 45, 14.0 * brisk) for length, sign in (
                (9.0, 1), (18.0, -1), (18.0, 1), (18.0, -1), (9.0, 1))))]
    if name == "avenue":
        return [part for _ in range(40) for part in (
            (rng.uniform(80, 200), 0.0, 16.0), bend(rng.uniform(60, 160), rng.uniform(15, 45), 15.0),
            bend(rng.uniform(60, 160), rng.uniform(15, 45), 15.0))]
    if name == "roundabouts":
        return [part for _ in range(30) for part in (
            (rng.uniform(50, 120), 0.0, 14.0), (14.0, -1 / 22, 9.0 * brisk), (rng.uniform(20, 75), 1 / 17, 9.0 * brisk),
            (14.0, -1 / 22, 9.0 * brisk))]
    return 10 * [
        (120.0, 0.0, 14.0), (165.0, -1 / 45, 14.0), (250.0, 0.0, 30.0), (60.0, 1 / 700, 30.0), (60.0, -1 / 700, 30.0),
        (500.0, 1 / 900, 30.0), (600.0, -1 / 650, 30.0), (150.0, 0.0, 16.0), (90.0, 1 / 60, 15.0), (80.0, 0.0, 0.0)]


def _line(parts: list, comfort: float) -> np.ndarray:
    curvature = np.concatenate([np.full(max(1, int(length / 0.5)), k) for length, k, _ in parts])
    speed = np.concatenate([np.full(max(1, int(length / 0.5)), v) for length, _, v in parts])
    curvature = np.convolve(curvature, np.full(24, 1 / 24), "same")
    speed = np.minimum(speed, np.sqrt(comfort / np.maximum(abs(curvature), 1e-4)))
    for i in range(len(speed) - 2, -1, -1):
        speed[i] = min(speed[i], math.sqrt(speed[i + 1] ** 2 + 2 * 1.8 * 0.5))
    yaw = np.cumsum(curvature) * 0.5
    return np.column_stack([np.cumsum(np.cos(yaw)) * 0.5, np.cumsum(np.sin(yaw)) * 0.5, yaw, speed])
