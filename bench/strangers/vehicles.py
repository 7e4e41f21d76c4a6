"""Cars of this benchmark: equations, parameters in SI units, and their sources."""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

ROLLING, FOUR_WHEELS, ELASTIC, MULTI_BODY, BRISTLE, SPRUNG, RIGID = range(7)
EQUATIONS = {
    ROLLING: "axles with a rolling body: Dugoff, Burckhardt or Fiala tyres, load transfer, compliance, relaxation",
    FOUR_WHEELS: "four wheels, each with its own slip and load, Ackermann linkage: TMeasy or two-friction brush tyres",
    ELASTIC: "elastic steering and axles: the pneumatic trail of brush tyres twists the column; relaxation",
    MULTI_BODY: "multi-body car of 29 states, package commonroad-vehicle-models",
    BRISTLE: "LuGre tyres with bristle states, steering gear of second order",
    SPRUNG: "body with roll and pitch on four springs, tabulated tyres interpolated in slip and load",
    RIGID: "rigid body of six degrees of freedom on springs and anti-roll bars, Magic Formula of 1994 with camber, ply "
           "steer and combined slip, toe, downforce: equations and car files of VDrift",
}
DUGOFF, BURCKHARDT, FIALA, TMEASY, BRUSH, TABLE, TOURING, S2000 = range(8)
GRAVITY = 9.81


class Parameters(NamedTuple):
    """Parameters of a car and its tyres, all float."""

    mass: float
    inertia: float
    wheelbase: float
    front: float  # from the CG to the front axle [m]
    height: float  # of the CG [m]
    track: float
    stiffness_front: float  # of the axle at static load [N/rad]
    stiffness_rear: float  # of the axle at static load [N/rad]
    grip: float  # peak friction [1]
    tyre: float  # DUGOFF to S2000
    drive_front: float  # fraction of the drive force on the front axle
    sliding: float = 0.8  # friction of full sliding over grip [1]
    load_loss: float = 0.25  # loss of the stiffness per load, relative, for a relative increase of the load
    steer_lag: float = 0.0  # [s]
    compliance: float = 0.0  # front steer angle per lateral force of the axle, to the outside [rad/N]
    compliance_rear: float = 0.0  # the same of the rear axle [rad/N]
    column: float = 0.0  # steer angle per aligning torque [rad/(N m)]
    trail: float = 0.0  # pneumatic trail at small slip [m]
    roll_steer: float = 0.0  # rear steer angle per roll angle, understeer + [1]
    roll_stiffness: float = 1e6  # [N m/rad]
    roll_damping: float = 2e4  # [N m s/rad]
    roll_inertia: float = 500.0  # [kg m^2]
    roll_front: float = 0.55  # fraction of the lateral load transfer on the front axle
    relaxation: float = 0.0  # [m]
    ackermann: float = 0.0  # 0: parallel steering, 1: full Ackermann geometry
    # Of RIGID only; springs, dampers and bars act at a wheel, toe and camber are those of the left wheel [deg].
    pitch_inertia: float = 2000.0  # [kg m^2]
    spring_front: float = 5e4  # [N/m]
    spring_rear: float = 5e4
    damper_front: float = 3000.0  # [N s/m]
    damper_rear: float = 3000.0
    bar_front: float = 0.0  # force per difference of the spring travels [N/m]
    bar_rear: float = 0.0
    camber_front: float = 0.0  # top outwards +
    camber_rear: float = 0.0
    toe_front: float = 0.0  # toe-out +
    toe_rear: float = 0.0
    downforce: float = 0.0  # at the rear axle, over the square of the speed [N s^2/m^2]
    rear_angle: float = 0.0  # constant steer angle of the rear axle [rad]
    rear_steer: float = 0.0  # rear steer angle over the front steer angle [1]
    trailer: float = 0.0  # mass of a trailer with one axle [kg]


@dataclass(frozen=True)
class Car:
    """A car whose equations differ from those of the project."""

    name: str
    equations: int  # key of EQUATIONS
    origin: str  # source of the parameters
    parameters: Parameters
    ratio: float  # steering wheel angle over road wheel angle [1]
    ins: float  # position of the INS ahead of the CG [m]
    ins_rate: int = 100  # [Hz]
    steering_rate: int = 100  # [Hz]
    steering_step: float = 0.1  # resolution of the steering sensor [deg]
    package: str = ""  # name of a multi-body car
    settings: tuple[tuple[str, float], ...] = ()  # values that differ from those of the package
    ins_height: float = 0.0  # of the INS above the CG, of cars RIGID [m]


TEXTBOOK = "typical textbook values"
DEVELOPMENT = (
    Car("saloon", ROLLING, TEXTBOOK, Parameters(
        1580.0, 2650.0, 2.71, 1.19, 0.55, 1.56, 118e3, 142e3, 0.95, DUGOFF, 1.0, compliance=2.7e-6,
        roll_stiffness=62e3, roll_damping=4200.0, roll_inertia=620.0, relaxation=0.45), 15.1, -0.35),
    Car("light_ev", ROLLING, TEXTBOOK, Parameters(
        1010.0, 1080.0, 2.49, 1.37, 0.46, 1.38, 62e3, 88e3, 0.9, BURCKHARDT, 0.0), 17.2, 0.22, 200, 50, 0.5),
    Car("van", ROLLING, TEXTBOOK, Parameters(
        2800.0, 7900.0, 3.66, 1.72, 0.82, 1.73, 145e3, 205e3, 0.85, FIALA, 1.0, steer_lag=0.06, roll_stiffness=110e3,
        roll_damping=8000.0, roll_inertia=1500.0, relaxation=0.6), 19.0, -1.05, 50, 25, 1.5),
    Car("hatchback", FOUR_WHEELS, "mass, wheelbase, ratio, weight split: opendbc, Honda Civic; inertia: openpilot;"
             " tyres: two-friction brush, Hindiyeh and Gerdes", Parameters(
                 1462.0, 2500.0, 2.70, 1.08, 0.52, 1.54, 112e3, 128e3, 0.98, BRUSH, 1.0, sliding=0.85, ackermann=0.6),
             15.38, -0.40),
    Car("suv", FOUR_WHEELS, "mass, wheelbase, ratio, weight split: opendbc, GWM Haval H6; tyres: TMeasy, form of "
             "Rill", Parameters(
                 2040.0, 3300.0, 2.73, 1.20, 0.66, 1.63, 126e3, 150e3, 0.9, TMEASY, 0.5, load_loss=0.3, ackermann=0.4),
             16.0, -0.70, 100, 50, 0.5),
    Car("estate", ELASTIC, "mass, lengths, inertia, stiffness: BMW 5 of IPG CarMaker as published; brush tyres",
             Parameters(
        1564.0, 2230.0, 2.888, 1.268, 0.56, 1.56, 150e3, 165e3, 0.93, BRUSH, 0.0, sliding=0.8, steer_lag=0.03,
        column=2.0e-5, trail=0.035, compliance_rear=4e-7, relaxation=0.35), 15.8, -0.55),
    Car("city_car", ELASTIC, "mass, wheelbase, ratio, weight split: opendbc, Opel Corsa F; brush tyres", Parameters(
        1530.0, 1950.0, 2.54, 1.12, 0.54, 1.49, 105e3, 118e3, 0.9, BRUSH, 1.0, sliding=0.75, column=2.5e-5,
        trail=0.03, relaxation=0.3), 17.6, -0.15, 100, 100, 0.1),
    *(Car(name, MULTI_BODY, "commonroad-vehicle-models, parameter set of the package", Parameters(
        mass, inertia, wheelbase, front, height, 1.4, 0.0, 0.0, 1.0, 0.0, drive), ratio, ins, 100, 100, 0.1, name)
      for name, mass, inertia, wheelbase, front, height, drive, ratio, ins in (
          ("escort", 1225.9, 1538.9, 2.391, 0.884, 0.557, 1.0, 18.5, -0.45),
          ("bmw_320i", 1093.3, 1791.6, 2.579, 1.156, 0.574, 0.0, 15.5, -0.25),
          ("vanagon", 1478.9, 2473.1, 2.465, 1.169, 0.670, 0.0, 20.5, 0.30))),
)
SEALED = (
    Car("coupe", ROLLING,
             "mass, lengths, inertia, stiffness: Rajamani, Vehicle Dynamics and Control; Dugoff tyres",
             Parameters(1573.0, 2873.0, 2.68, 1.10, 0.50, 1.55, 160e3, 160e3, 1.0, DUGOFF, 0.0, compliance=1.2e-6,
                     roll_stiffness=80e3, roll_damping=5000.0, roll_inertia=550.0, relaxation=0.3), 14.2, -0.30),
    Car("minivan", ROLLING, "mass, wheelbase, ratio: opendbc, Chrysler Pacifica; Fiala tyres", Parameters(
        2242.0, 4300.0, 3.089, 1.36, 0.68, 1.73, 135e3, 165e3, 0.88, FIALA, 1.0, steer_lag=0.04, roll_stiffness=90e3,
        roll_damping=6000.0, roll_inertia=1000.0, relaxation=0.5), 16.2, -0.80, 100, 50, 0.5),
    Car("crossover", FOUR_WHEELS, "mass, wheelbase, ratio, weight split: opendbc, Toyota Yaris Cross; TMeasy",
             Parameters(
        1386.0, 2050.0, 2.62, 1.15, 0.60, 1.52, 92e3, 104e3, 0.92, TMEASY, 1.0, load_loss=0.2, ackermann=0.5),
             17.0, -0.35, 50, 50, 0.5),
    Car("luxury_ev", FOUR_WHEELS, "mass, wheelbase, ratio, weight split: opendbc, BYD Han; brush tyres", Parameters(
        2150.0, 3950.0, 2.92, 1.285, 0.53, 1.64, 165e3, 190e3, 1.0, BRUSH, 0.4, sliding=0.9, ackermann=0.7),
             14.8, -0.60, 100, 100, 0.1),
    Car("leaf_2018", ELASTIC, "mass, wheelbase, ratio, weight split: opendbc, Nissan Leaf 2018; brush tyres",
             Parameters(
        1594.0, 2450.0, 2.70, 1.377, 0.53, 1.54, 110e3, 160e3, 0.92, BRUSH, 1.0, sliding=0.8, steer_lag=0.02,
        column=1.8e-5, trail=0.032, compliance_rear=3e-7, relaxation=0.4), 17.68, -0.20),
    Car("roadster", ELASTIC, "mass, wheelbase, ratio, weight split: opendbc, Porsche 911 (997); brush tyres",
             Parameters(
        1455.0, 1850.0, 2.35, 1.457, 0.47, 1.50, 105e3, 190e3, 1.05, BRUSH, 0.0, sliding=0.85, column=1.2e-5,
        trail=0.028, relaxation=0.25), 13.7, 0.10, 200, 100, 0.1),
    *(Car(f"{name}_other", MULTI_BODY, "commonroad-vehicle-models, other tyres and mass", Parameters(
        mass, inertia, wheelbase, front, height, 1.4, 0.0, 0.0, 1.0, 0.0, drive), ratio, ins, 100, 50, 0.2, name,
               settings)
      for name, mass, inertia, wheelbase, front, height, drive, ratio, ins, settings in (
          ("escort", 1225.9, 1538.9, 2.391, 0.884, 0.557, 1.0, 18.5, -0.45,
           (("front_stiffness_factor", 0.85), ("rear_stiffness_factor", 1.15))),
          ("bmw_320i", 1093.3, 1791.6, 2.579, 1.156, 0.574, 0.0, 15.5, -0.25,
           (("mass_factor", 1.2), ("yaw_inertia_factor", 1.1), ("friction_factor", 0.85))))),
    Car("sports_saloon", BRISTLE, TEXTBOOK + "; LuGre tyres, form of Canudas de Wit and Velenis", Parameters(
        1740.0, 3050.0, 2.81, 1.36, 0.51, 1.58, 140e3, 175e3, 1.0, 0.0, 0.0, sliding=0.78, steer_lag=0.03,
        relaxation=0.22), 14.6, -0.45),
    Car("family_car", BRISTLE, TEXTBOOK + "; LuGre tyres", Parameters(
        1380.0, 2150.0, 2.64, 1.06, 0.54, 1.52, 95e3, 108e3, 0.9, 0.0, 1.0, sliding=0.8, steer_lag=0.045,
        relaxation=0.28), 16.4, -0.25, 100, 50, 0.5),
    Car("pickup", SPRUNG, TEXTBOOK + "; tabulated tyres", Parameters(
        2260.0, 5400.0, 3.27, 1.42, 0.71, 1.68, 120e3, 145e3, 0.85, TABLE, 0.0, roll_stiffness=85e3,
        roll_damping=7000.0, roll_inertia=950.0, relaxation=0.55, roll_steer=0.03), 17.8, -0.90, 100, 50, 0.5),
    Car("hot_hatch", SPRUNG, TEXTBOOK + "; tabulated tyres", Parameters(
        1430.0, 2200.0, 2.63, 1.03, 0.52, 1.55, 128e3, 132e3, 1.02, TABLE, 1.0, roll_stiffness=75e3,
        roll_damping=4500.0, roll_inertia=480.0, relaxation=0.35, roll_steer=0.02), 14.0, -0.30, 200, 100, 0.1),
)
def _vdrift(name: str, mass: float, inertias: tuple[float, float, float], lengths: tuple[float, float, float, float],
            stiffness: tuple[float, float], drive_front: float, springs: tuple[float, float],
            dampers: tuple[float, float], bars: tuple[float, float], camber: tuple[float, float],
            toe: tuple[float, float], ratio: float, ins: float, **others: Any) -> Car:
    """A car file of VDrift. inertias: about z, x and y; lengths: wheelbase, CG to front axle, height, track; stiffness:
    of the axles, from its tyre file at the static load. Steering ratio, compliance, lag and sensors are not in it."""
    sensors = {key: others.pop(key) for key in ("steering_rate", "steering_step", "ins_rate") if key in others}
    return Car(name, RIGID, f"VDrift, car file {name.upper()}", Parameters(
        mass, inertias[0], *lengths, *stiffness, others.pop("grip", 0.85), others.pop("tyre", TOURING), drive_front,
        roll_inertia=inertias[1], pitch_inertia=inertias[2], spring_front=springs[0], spring_rear=springs[1],
        damper_front=dampers[0], damper_rear=dampers[1], bar_front=bars[0], bar_rear=bars[1], camber_front=camber[0],
        camber_rear=camber[1], toe_front=toe[0], toe_rear=toe[1], **{"compliance": 1e-6, "steer_lag": 0.02, **others}),
        ratio, ins, ins_height=0.25, **sensors)


VDRIFT = (
    _vdrift("m3", 1311.0, (2565.0, 300.0, 2370.0), (2.58, 1.102, 0.683, 1.42), (177e3, 145e3), 0.0, (75e3, 62e3),
            (6600.0, 6000.0), (6000.0, 5500.0), (-2.0, -3.0), (-0.2, 0.0), 15.6, -0.35, ackermann=0.5, downforce=0.45),
    _vdrift("mi", 716.0, (548.0, 109.0, 464.0), (1.95, 0.708, 0.453, 1.22), (123e3, 75e3), 1.0, (40e3, 20e3),
            (3800.0, 1950.0), (1200.0, 1000.0), (-0.5, -1.5), (0.0, 0.0), 16.4, -0.10, ackermann=0.5, steering_rate=50,
            steering_step=0.5),
    _vdrift("350z", 1556.0, (3216.0, 266.0, 3011.0), (2.65, 1.478, 0.511, 1.6), (167e3, 200e3), 0.0, (49132.0, 51137.0),
            (5800.0, 5950.0), (7000.0, 6000.0), (-1.33, -0.45), (0.0, 0.0), 16.2, -0.45, ackermann=0.5, downforce=0.15),
    _vdrift("co", 1164.0, (1836.0, 246.0, 1625.0), (2.66, 1.285, 0.591, 1.7), (153e3, 160e3), 0.0, (50e3, 40e3),
            (5050.0, 4525.0), (6000.0, 4000.0), (-1.33, -0.45), (0.5, 0.0), 17.0, -0.20, downforce=0.15,
            steering_step=1.0, steering_rate=50),
    _vdrift("ns", 1566.0, (2216.0, 306.0, 2026.0), (2.74, 1.098, 0.724, 1.66), (198e3, 157e3), 0.4, (50e3, 40e3),
            (6400.0, 5000.0), (16e3, 10e3), (-1.0, -0.5), (-0.5, 1.0), 15.8, -0.55, downforce=0.6),
    _vdrift("tl2", 1004.0, (1840.0, 160.0, 1725.0), (2.41, 1.371, 0.633, 1.436), (118e3, 150e3), 0.0, (40e3, 40e3),
            (1700.0, 2200.0), (7000.0, 15500.0), (-0.5, 0.0), (0.0, -0.2), 17.4, 0.10, downforce=0.6),
    _vdrift("rs2", 1371.0, (1581.0, 303.0, 1370.0), (2.46, 1.421, 0.778, 1.52), (149e3, 190e3), 0.5, (40e3, 55e3),
            (4600.0, 6400.0), (10e3, 20e3), (-1.0, -0.5), (-0.5, 0.0), 16.0, -0.30, ackermann=0.5, downforce=0.6,
            compliance=1.5e-6),  # rear toe-out of the file, 1 deg, left out: the car spins with it
    _vdrift("gtv6", 1398.0, (2518.0, 399.0, 2157.0), (2.44, 1.285, 0.598, 1.37), (163e3, 175e3), 0.0, (76e3, 63e3),
            (9350.0, 9500.0), (10e3, 6000.0), (-0.12, -0.65), (-0.3, 0.14), 18.2, -0.25, downforce=0.38),
    _vdrift("att", 1680.0, (3535.0, 355.0, 3222.0), (2.466, 1.03, 0.504, 1.59), (201e3, 169e3), 0.6, (72e3, 68e3),
            (6250.0, 6250.0), (3700.0, 8000.0), (-1.33, -0.45), (0.0, 0.0), 15.4, -0.60, ackermann=0.5, downforce=0.36,
            steering_rate=50, steering_step=0.2),
    _vdrift("cs", 1166.0, (1550.0, 205.0, 1421.0), (2.23, 1.247, 0.724, 1.4), (136e3, 172e3), 0.0, (23e3, 28750.0),
            (4750.0, 4750.0), (15e3, 20e3), (-1.0, -0.5), (0.5, 0.0), 17.8, 0.15, downforce=0.6),
    _vdrift("xm", 1253.0, (2466.0, 300.0, 2264.0), (2.86, 1.282, 0.649, 1.68), (168e3, 145e3), 0.0, (100e3, 90e3),
            (8000.0, 6650.0), (20e3, 10e3), (-0.5, -1.5), (0.9, 0.0), 15.0, -0.40, downforce=0.6),
    _vdrift("sv", 1286.0, (2314.0, 199.0, 2149.0), (2.48, 1.547, 0.522, 1.45), (129e3, 205e3), 0.0, (40e3, 62e3),
            (4000.0, 6000.0), (6000.0, 4000.0), (-1.33, -0.45), (0.0, 0.0), 16.5, 0.20, ackermann=0.5, compliance=2e-6,
            steering_rate=50, steering_step=0.5),
    _vdrift("xs", 1296.0, (2491.0, 213.0, 2328.0), (2.42, 1.36, 0.653, 1.52), (127e3, 160e3), 0.0, (49132.0, 51137.0),
            (2600.0, 2850.0), (8000.0, 6000.0), (-1.33, -0.45), (0.0, 0.0), 15.0, -0.15, tyre=S2000, grip=1.0,
            downforce=0.6, compliance=1.5e-6),
)
CARS = {car.name: car for car in (*DEVELOPMENT, *SEALED, *VDRIFT)}
CARS["own_car"] = replace(CARS["hatchback"], name="own_car", parameters=CARS["hatchback"].parameters._replace(
    ackermann=1.0))
