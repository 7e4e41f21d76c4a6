"""Parameters of the node: name, default, unit, range. The same list is in config/nodes.yaml."""

import math
from pathlib import Path
from types import SimpleNamespace

from st_ros.parameters import ConfigurationError, Parameter

from .motion import FIRST_FIX, GIVEN, UNIT
from .sources import is_address

TOPICS = ("ncom", "odometry", "imu", "nav_sat_fix", "velocity", "time_reference", "status", "trigger", "origin")
NCOM, RECEIVE = "ncom", "receive"

PARAMETERS = (
    Parameter("autostart", True, "configure and activate at start; false: wait for a lifecycle manager"),
    Parameter("bind_address", "127.0.0.1", "local address to listen on; 0.0.0.0: all networks of this host"),
    Parameter("udp_port", 3000, "UDP port the unit sends to", "", 1, 65535),
    Parameter("sender_filter", "", "IP address of the unit; empty: the first one that sends NCOM"),
    Parameter("replay_file", "", "NCOM file to replay instead of listening"),
    Parameter("speed_factor", 1.0, "replay: file seconds per second", "1", 0.01, 1000.0),
    Parameter("loop", False, "replay: start again at the end"),
    Parameter("start_offset", 0.0, "replay: start this long after the first time in the file", "s", 0.0, 1e9),
    Parameter("publish_clock", False, "replay: publish /clock with the file's time"),
    Parameter("topics", list(TOPICS), "topics under ins/ to publish"),
    Parameter("publish_tf", True, "publish map -> odom -> base_link -> ins_link"),
    Parameter("map_frame", "map", "frame of odometry: east, north, up from the origin"),
    Parameter("odom_frame", "odom", "REP-105 frame between map and base; identical to map here"),
    Parameter("base_frame", "base_link", "frame of the vehicle: forward, left, up"),
    Parameter("ins_frame", "ins_link", "frame of the INS point, parallel to base_frame"),
    Parameter("base_to_ins", [0.0, 0.0, 0.0], "INS point seen from base_frame: forward, left, up, in m"),
    Parameter("origin_source", FIRST_FIX, "origin of the map frame", choices=(FIRST_FIX, GIVEN, UNIT)),
    Parameter("origin_latitude", math.nan, "for origin_source given", "deg", -90.0, 90.0),
    Parameter("origin_longitude", math.nan, "for origin_source given", "deg", -180.0, 180.0),
    Parameter(
        "origin_altitude", math.nan, "for origin_source given; geoid or ellipsoid as the unit sends", "m", -1e4, 1e5
    ),
    Parameter("altitude_is_ellipsoidal", False, "the unit is configured to send ellipsoidal altitude"),
    Parameter(
        "stamp_source", NCOM, "header stamps: UTC measured by the unit, or host receive time", choices=(NCOM, RECEIVE)
    ),
    Parameter("status_period", 1.0, "ins/status at least this often, and at every change of mode", "s", 0.05, 60.0),
    Parameter("silence_after", 1.0, "no packet for this long is an error", "s", 0.05, 60.0),
    Parameter("angular_velocity_stddev", 0.0, "for covariances, the unit sends none; 0: unknown", "rad/s", 0.0, 10.0),
    Parameter(
        "linear_acceleration_stddev", 0.0, "for covariances, the unit sends none; 0: unknown", "m/s^2", 0.0, 100.0
    ),
)


def check(settings: SimpleNamespace, node_name: str) -> None:
    """Check parameters that depend on each other. Raises ConfigurationError with the key and the required value."""

    def refuse(key: str, reason: str) -> None:
        raise ConfigurationError(f"{node_name}.{key}: {reason}")

    for topic in settings.topics:
        if topic not in TOPICS:
            refuse("topics", f"{topic!r} is none of {', '.join(TOPICS)}")
    if not is_address(settings.bind_address):
        refuse("bind_address", f"{settings.bind_address!r} is not an IP address")
    if settings.sender_filter and not is_address(settings.sender_filter):
        refuse("sender_filter", f"{settings.sender_filter!r} is not an IP address")
    lever = settings.base_to_ins
    if len(lever) != 3 or not all(isinstance(v, int | float) and math.isfinite(v) and abs(v) <= 100 for v in lever):
        refuse("base_to_ins", f"{list(lever)} is not three lengths in m, each within 100 m")
    if settings.origin_source == GIVEN:
        for key in ("origin_latitude", "origin_longitude", "origin_altitude"):
            if math.isnan(getattr(settings, key)):
                refuse(key, "needed because origin_source is given")
    frames = [settings.map_frame, settings.odom_frame, settings.base_frame, settings.ins_frame]
    if settings.publish_tf and len(set(frames)) != len(frames):
        refuse("map_frame", f"the four frames {', '.join(frames)} must differ while publish_tf is true")
    if settings.replay_file and not Path(settings.replay_file).is_file():
        refuse("replay_file", f"{settings.replay_file} is not a file")
