"""Makes and serialises ROS messages with rosbags, without ROS."""

from typing import Any

import numpy as np
from st_recordings.runs.bag import ODOMETRY
from st_recordings.runs.cdr import load_typestore

STORE = load_typestore()


def make(name: str, /, **values: Any) -> Any:
    return STORE.types[name](**values)


def serialise(name: str, /, **values: Any) -> bytes:
    return bytes(STORE.serialize_cdr(make(name, **values), name))


def definition(name: str) -> str:
    return STORE.generate_msgdef(name, ros_version=2)[0]


def stamp(time_ns: int) -> Any:
    sec, nanosec = divmod(time_ns, 10**9)
    return make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)


def header(time_ns: int, frame: str = "") -> Any:
    return make("std_msgs/msg/Header", stamp=stamp(time_ns), frame_id=frame)


def odometry(time_ns: int, x: float, y: float, yaw: float, velocity_x: float = 0.0, velocity_y: float = 0.0,
             yaw_rate: float = 0.0, *, frame: str = "map", child_frame: str = "ins_link") -> bytes:
    """A serialised Odometry in SI units: pose in the map, velocity in the axes of the child frame."""
    pose = make("geometry_msgs/msg/Pose",
                position=make("geometry_msgs/msg/Point", x=float(x), y=float(y), z=1.0),
                orientation=make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=float(np.sin(yaw / 2)),
                                 w=float(np.cos(yaw / 2))))
    twist = make("geometry_msgs/msg/Twist",
                 linear=make("geometry_msgs/msg/Vector3", x=float(velocity_x), y=float(velocity_y), z=0.0),
                 angular=make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=float(yaw_rate)))
    return serialise(ODOMETRY, header=header(time_ns, frame), child_frame_id=child_frame,
                     pose=make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=np.zeros(36)),
                     twist=make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)))
