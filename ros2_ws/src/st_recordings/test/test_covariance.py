"""Imported odometry: orientation, velocity and covariances of all packets equal those of the live bridge, packet by
packet."""

import numpy as np
import pytest
from oxts_bridge.channels import encode_channel
from oxts_bridge.geometry import Attitude
from oxts_bridge.ncom import Packet, encode
from st_recordings.runs.ncom import NcomLog, read_ncom
from st_recordings.runs.write import UNKNOWN_VARIANCE, Covariances

ACCURACY = {3: {"NorthAcc": 0.02, "EastAcc": 0.03, "AltAcc": 0.05}, 4: {"VnAcc": 0.01, "VeAcc": 0.02, "VdAcc": 0.03},
            5: {"HeadingAcc": 0.2, "PitchAcc": 0.1, "RollAcc": 0.05}}


@pytest.fixture(scope="module")
def ins(tmp_path_factory: pytest.TempPathFactory) -> NcomLog:
    """Packets 0 to 9 without accuracies, then all three."""
    stream = b""
    for k in range(40):
        channel, batch = 0, (23_000_000).to_bytes(4, "little") + bytes(4)
        if k in (10, 11, 12):
            channel = k - 7
            batch = encode_channel(channel, ACCURACY[channel])
        stream += encode(Packet(
            milliseconds=10 * k, acceleration=(0.0, 0.0, -9.8), angular_rate=(0.0, 0.0, 0.1), navigation_status=4,
            latitude=0.8, longitude=0.3, altitude=10.0, velocity_ned=(3.0, 4.0, 0.5), heading=-3.0 + 0.15 * k,
            pitch=0.1, roll=-0.2, channel=channel, batch_s=batch))
    file = tmp_path_factory.mktemp("ncom") / "turn.ncom"
    file.write_bytes(stream)
    return read_ncom(file)


def live_attitude(ins: NcomLog, row: int) -> Attitude:
    return Attitude.from_ned(ins.columns.heading[row], ins.columns.pitch[row], ins.columns.roll[row])


def test_orientation_and_velocity_equal_those_of_the_bridge(ins: NcomLog) -> None:
    quaternions = np.stack(ins.select_attitude(slice(None)).to_quaternion(), axis=1)
    for k, row in enumerate(ins.rows):
        attitude = live_attitude(ins, row)
        np.testing.assert_allclose(quaternions[k], attitude.to_quaternion(), atol=1e-12)
        north, east, down = ins.columns.velocity_ned[:, row]
        velocity = [axis[k] for axis in ins.motion.body_velocity]
        np.testing.assert_allclose(velocity, attitude.to_body((east, north, -down)), atol=1e-12)


def test_covariances_equal_those_of_the_bridge(ins: NcomLog) -> None:
    pose, twist = Covariances(ins).compute(slice(0, 40))
    for k in range(40):
        attitude = live_attitude(ins, int(ins.rows[k]))
        expected_pose, expected_twist = np.zeros((6, 6)), np.zeros((6, 6))
        expected_pose[range(6), range(6)] = expected_twist[range(6), range(6)] = UNKNOWN_VARIANCE
        if k >= 10:
            expected_pose[range(3), range(3)] = np.square([0.03, 0.02, 0.05])
        if k >= 11:
            expected_twist[:3, :3] = np.reshape(attitude.rotate_covariance((0.02**2, 0.01**2, 0.03**2)), (3, 3))
        if k >= 12:
            expected_pose[3:, 3:] = np.reshape(
                attitude.rotate_orientation_covariance(tuple(np.radians([0.05, 0.1, 0.2])**2)), (3, 3))
        # The unit sends angle accuracies in steps of 1e-5 rad.
        np.testing.assert_allclose(pose[k].reshape(6, 6), expected_pose, rtol=0.02, atol=1e-12)
        np.testing.assert_allclose(twist[k].reshape(6, 6), expected_twist, rtol=1e-3, atol=1e-12)
