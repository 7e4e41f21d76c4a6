"""The node as a process, fed over UDP on loopback; its messages are received over DDS."""

import math
import random
import signal
import socket
import time

import pytest
from trigger_bytes import encode_trigger

pytest.importorskip("rclpy", reason="needs ROS 2")
pytest.importorskip("st_msgs.msg", reason="needs the built workspace")

from ins_rig import InsRig, free_port, stamp_ms
from lifecycle_msgs.srv import ChangeState
from st_msgs.msg import Trigger

pytestmark = [
    pytest.mark.ros,
    pytest.mark.timing("packets and frames are sent in real time; a node without processor time reads them late"),
]

OK, WARN, ERROR = 0, 1, 2
START = 24_015_600 * 60_000 + 1_000  # GPS time [ms]
UTC_MINUS_GPS_MS = (315_964_800 - 18) * 1000
ACCURACY = {
    3: {"NorthAcc": 0.02, "EastAcc": 0.03, "AltAcc": 0.05},
    4: {"VnAcc": 0.01, "VeAcc": 0.02, "VdAcc": 0.03},
    5: {"HeadingAcc": math.degrees(0.003), "PitchAcc": math.degrees(0.002), "RollAcc": math.degrees(0.001)},
    48: {"Undulation": 51.7},
}


@pytest.fixture
def rig(tmp_path):
    """rig(**parameters) -> a connected InsRig; its exit status is checked at the end."""
    rigs = []

    def start(connect=True, **parameters):
        rigs.append(InsRig({"udp_port": free_port()} | parameters, tmp_path))
        if connect:
            rigs[-1].wait_connected()
        return rigs[-1]

    yield start
    for each in rigs:
        each.close()


def test_values_units_and_frames_of_all_topics(rig, packet):
    """Heading 30 deg, pitch 5 deg (nose up), roll -10 deg (left side down); 10 m/s north, 5 m/s east, 0.5 m/s up; the
    INS is ahead of base_link."""
    rig = rig(base_to_ins="[1.0, 0.2, 0.5]", angular_velocity_stddev=0.01, linear_acceleration_stddev=0.05)
    packets = [packet(START + 10 * i, channel, ACCURACY[channel]) for i, channel in enumerate((3, 4, 5, 48), 1)]
    rig.send(packet(START, 0), *packets, packet(START + 50, 255))
    odometry = rig.messages("ins/odometry", 6)[-1]
    rig.messages("/tf", 6)
    assert (odometry.header.frame_id, odometry.child_frame_id) == ("map", "ins_link")
    assert stamp_ms(odometry) == START + 50 + UTC_MINUS_GPS_MS
    q, p = odometry.pose.pose.orientation, odometry.pose.pose.position
    assert (q.x, q.y, q.z, q.w) == pytest.approx((-0.053680547, -0.081168145, 0.494330919, 0.863809628), abs=1e-6)
    assert (p.x, p.y, p.z) == pytest.approx((0, 0, 0), abs=1e-9)
    linear, angular = odometry.twist.twist.linear, odometry.twist.twist.angular
    assert (linear.x, linear.y, linear.z) == pytest.approx((11.16136377, 0.74210656, -0.35105068), abs=1e-4)
    assert (angular.x, angular.y, angular.z) == pytest.approx((0.001, -0.002, -0.1), abs=1e-9)
    c = odometry.pose.covariance
    assert (c[0], c[7], c[14], c[35]) == pytest.approx((0.03**2, 0.02**2, 0.05**2, 0.003**2), rel=0.01)
    # Roll error 1 mrad, pitch error 2 mrad, body x axis 60 deg north of east.
    assert (c[21], c[28], c[22]) == pytest.approx(
        (0.25e-6 + 0.75 * 4e-6, 0.75e-6 + 0.25 * 4e-6, -3e-6 * math.sqrt(3) / 4), rel=0.01
    )
    trace = sum(odometry.twist.covariance[i] for i in (0, 7, 14))
    assert trace == pytest.approx(0.01**2 + 0.02**2 + 0.03**2)
    assert odometry.twist.covariance[35] == pytest.approx(1e-4)

    imu = rig.messages("ins/imu", 6)[-1]
    a = imu.linear_acceleration
    assert imu.header.frame_id == "ins_link"
    assert (a.x, a.y, a.z) == pytest.approx((0.1, 0.2, 9.81))
    assert (imu.angular_velocity.x, imu.angular_velocity.y, imu.angular_velocity.z) == pytest.approx(
        (0.001, -0.002, -0.1)
    )
    assert imu.orientation.w == pytest.approx(q.w)
    assert (imu.angular_velocity_covariance[0], imu.linear_acceleration_covariance[8]) == pytest.approx((1e-4, 25e-4))

    fix = rig.messages("ins/nav_sat_fix", 6)[-1]
    assert (fix.latitude, fix.longitude, fix.altitude) == pytest.approx((52.0, -1.25, 100.5 + 51.7), abs=1e-9)
    assert fix.status.status == 2 and fix.position_covariance_type == 2
    assert list(fix.position_covariance[[0, 4, 8]]) == pytest.approx([0.03**2, 0.02**2, 0.05**2])

    velocity = rig.messages("ins/velocity", 6)[-1]
    assert velocity.header.frame_id == "ins_link"
    assert velocity.twist.twist.linear.x == pytest.approx(linear.x)

    transform = rig.messages("/tf", 6)[-1].transforms[0]
    assert (transform.header.frame_id, transform.child_frame_id) == ("odom", "base_link")
    t = transform.transform.translation
    assert math.sqrt(t.x**2 + t.y**2 + t.z**2) == pytest.approx(math.sqrt(1.0 + 0.04 + 0.25))
    # base_link is behind the INS: south-west of it at a heading of 30 deg.
    assert t.x < 0 and t.y < 0
    frames = {
        (s.header.frame_id, s.child_frame_id): s.transform for m in rig.messages("/tf_static", 1) for s in m.transforms
    }
    assert set(frames) == {("map", "odom"), ("base_link", "ins_link")}
    mount = frames["base_link", "ins_link"].translation
    assert (mount.x, mount.y, mount.z) == (1.0, 0.2, 0.5)
    assert frames["map", "odom"].rotation.w == 1.0

    reference = rig.messages("ins/time_reference", 6)[-1]
    assert reference.time_ref == odometry.header.stamp
    assert abs(stamp_ms(reference) - time.time() * 1000) < 60_000
    raw = rig.messages("ins/ncom", 6)
    assert bytes(raw[0].raw_packet) == packet(START, 0)


def test_first_packet_is_published_and_missing_information_reported(rig, packet):
    """No undulation, no accuracy, no serial number, no UTC offset, no local frame."""
    rig = rig()
    rig.send(packet(START, 0))
    odometry = rig.messages("ins/odometry", 1)[0]
    assert stamp_ms(odometry) == START + UTC_MINUS_GPS_MS
    assert odometry.pose.covariance[0] >= 1e6 and odometry.twist.covariance[0] >= 1e6
    fix = rig.messages("ins/nav_sat_fix", 1)[0]
    assert math.isnan(fix.altitude) and fix.position_covariance_type == 0
    assert list(rig.messages("ins/imu", 1)[0].orientation_covariance) == [0.0] * 9
    status = rig.messages("ins/status", 1)[0]
    assert (status.navigation_status_text, status.position_mode_text) == ("locked", "RTK integer")
    assert status.satellites == 14
    assert math.isnan(status.geoid_undulation) and status.serial_number == -1
    assert rig.spin(lambda: "undulation" in rig.check("completeness")[1])
    level, text, values = rig.check("completeness")
    assert level == WARN and "covariances unknown" in text and "serial number" in values["also missing"]


def test_each_valid_packet_is_published_once(rig, drive, packet):
    """The stream also has reordered, repeated, corrupted, truncated and joined packets, and other data."""
    rig = rig()
    p = drive(12, step_ms=10)
    corrupted = p[5][:40] + bytes([p[5][40] ^ 1]) + p[5][41:]
    rig.send(p[0], p[1], p[3], p[2], p[4], p[4], corrupted, b"junk", p[6][:30], p[7] + p[8],
             random.Random(1).randbytes(500), b"", p[9], p[10], p[11])
    rig.send(packet(START + 120, navigation_status=9), packet(START + 130, navigation_status=99), packet(START + 140))
    # Initialising: rates and accelerations, but no position.
    rig.send(packet(START + 150, navigation_status=2), packet(START + 160))
    rig.messages("ins/odometry", 11)
    imu = rig.messages("ins/imu", 12)
    rig.spin_for(0.3)
    stamps = [stamp_ms(m) - START - UTC_MINUS_GPS_MS for m in rig.received["ins/odometry"]]
    assert stamps == [0, 10, 30, 40, 70, 80, 90, 100, 110, 140, 160]
    assert [stamp_ms(m) - START - UTC_MINUS_GPS_MS for m in rig.received["ins/nav_sat_fix"]] == stamps
    assert [stamp_ms(m) - START - UTC_MINUS_GPS_MS for m in imu] == sorted([*stamps, 150])
    assert [m.orientation_covariance[0] == -1.0 for m in imu] == [False] * 10 + [True, False]
    assert rig.spin(lambda: rig.check("stream")[2].get("late") == "1")
    values = rig.check("stream")[2]
    assert (values["duplicates"], values["reserved navigation status"]) == ("1", "2")
    assert int(values["checksum errors"]) >= 1 and int(values["skipped bytes"]) >= 4 + 72 + 30 + 500


def test_missing_stream_is_reported_with_the_port_and_the_number_of_datagrams(rig):
    rig = rig()
    rig.send(b"no NCOM", b"no NCOM")
    text = f"(udp 127.0.0.1:{rig.port}, datagrams: 2); check the address and port to which the unit sends"
    assert rig.spin(lambda: text in rig.check("stream")[1]), rig.check("stream")


def test_interruption_is_reported_until_packets_return(rig, drive):
    rig = rig(silence_after=0.3)
    packets = drive(300, step_ms=10)
    rig.send(*packets[:20])
    rig.messages("ins/odometry", 20)
    assert rig.spin(lambda: rig.check("stream")[0] == ERROR and "no packet for" in rig.check("stream")[1])
    rig.send(*packets[250:270])
    assert len(rig.messages("ins/odometry", 40)) == 40
    following = iter(packets[270:])

    def is_received():
        rig.send(next(following))
        rig.spin_for(0.05)
        return rig.check("stream")[0] in (OK, WARN)

    assert rig.spin(is_received)


def test_node_without_processor_time_omits_derived_topics_and_reports_it(rig, drive):
    rig = rig()
    packets = drive(110, step_ms=10)
    rig.send(*packets[:10])
    rig.messages("ins/imu", 10)
    rig.process.send_signal(signal.SIGSTOP)
    rig.send(*packets[10:100])
    time.sleep(0.5)
    rig.process.send_signal(signal.SIGCONT)
    rig.messages("ins/odometry", 100)
    rig.messages("ins/ncom", 100)
    assert rig.spin(lambda: "after their receipt, because the computer is busy" in rig.check("stream")[1])
    assert rig.check("stream")[0] == WARN
    rig.send(*packets[100:])
    rig.messages("ins/odometry", 110)
    assert len(rig.messages("ins/imu", 20)) < 30


def test_packets_of_other_senders_are_ignored(rig, drive):
    rig = rig(sender_filter="127.0.0.2")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as unit:
        unit.bind(("127.0.0.2", 0))
        rig.send(*drive(10, START + 600_000))
        for packet in drive(10):
            unit.sendto(packet, ("127.0.0.1", rig.port))
        odometry = rig.messages("ins/odometry", 10)
        assert rig.spin(lambda: rig.check("source")[2].get("sender") == "127.0.0.2")
    assert [stamp_ms(m) for m in odometry] == [START + 4 * i + UTC_MINUS_GPS_MS for i in range(10)]
    assert rig.check("source")[2]["ignored from 127.0.0.1"] == "10"


def test_second_unit_at_another_address_is_reported(rig, drive):
    rig = rig()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.2", 0))
        rig.send(*drive(10))
        rig.messages("ins/odometry", 10)
        other.sendto(drive(1)[0], ("127.0.0.1", rig.port))
        text = ("datagrams ignored since the last report: 1; senders ignored so far: 127.0.0.2; let only one program "
                "send")
        assert rig.spin(lambda: any(text in status.message and status.level == bytes([WARN])
                                    for array in rig.received["/diagnostics"] for status in array.status))


def test_busy_port_is_reported_and_opened_when_it_is_free(rig, drive):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        rig = rig(udp_port=other.getsockname()[1])
        assert rig.spin(lambda: rig.check("source")[0] == ERROR)
        assert f"port {rig.port}: Address already in use; retrying" in rig.check("source")[1]
    assert rig.spin(lambda: rig.check("source")[0] == OK)
    rig.send(*drive(5))
    assert rig.messages("ins/odometry", 5)


def test_port_shared_with_another_program_is_reported(rig):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        other.bind(("127.0.0.1", 0))
        rig = rig(udp_port=other.getsockname()[1])
        assert rig.spin(lambda: rig.check("source")[0] == WARN)
        assert "another program has this port open" in rig.check("source")[1]


def test_trigger_event_is_published_once_with_its_own_time(rig, packet):
    rig = rig()
    event_ns = (START + 5) * 1_000_000 + 432_000
    data = encode_trigger(24, event_ns, 9)
    trigger = packet(START + 5, 24, batch_s=data, navigation_status=22, velocity_ned=(20.0, 0.0, 0.0), heading=0.0,
                     pitch=0.0, roll=0.0)
    rig.send(packet(START, 0), trigger, trigger, packet(START + 10, 24, batch_s=data), packet(START + 20))
    rig.messages("ins/odometry", 3)
    event = rig.messages("ins/trigger", 1)[0]
    rig.spin_for(0.3)
    assert len(rig.received["ins/trigger"]) == 1
    stamp = event.header.stamp.sec * 1_000_000_000 + event.header.stamp.nanosec
    assert stamp == event_ns + UTC_MINUS_GPS_MS * 1_000_000
    assert (event.source, event.count, event.pose_valid) == (Trigger.INPUT_1_FALLING, 9, True)
    assert event.header.frame_id == "map"
    assert (event.twist.linear.x, event.pose.orientation.z) == pytest.approx((20.0, math.sqrt(0.5)))
    # The trigger packet of the next event was lost; a regular packet repeats its time and count.
    rig.send(packet(START + 40, 24, batch_s=encode_trigger(24, event_ns + 25_000_000, 10)))
    event = rig.messages("ins/trigger", 2)[1]
    assert (event.count, event.pose_valid) == (10, False)
    assert {message.navigation_status for message in rig.received["ins/status"]} == {4}


def test_parameters_of_origin_stamps_altitude_frames_and_topics(rig, packet):
    rig = rig(origin_source="given", origin_latitude=52.001, origin_longitude=-1.25, origin_altitude=90.5,
              stamp_source="receive", altitude_is_ellipsoidal=True, publish_tf=False, map_frame="site",
              topics="[odometry, nav_sat_fix, origin, status]")
    before = time.time() * 1000
    rig.send(packet(START, 0), packet(START + 10, 48, {"Undulation": 51.7}), packet(START + 20))
    odometry = rig.messages("ins/odometry", 3)[0]
    p = odometry.pose.pose.position
    assert (p.x, p.y, p.z) == pytest.approx((0, -111.26, 10.0), abs=0.02)
    assert odometry.header.frame_id == "site"
    origin = rig.messages("ins/origin", 1)[0]
    assert (origin.header.frame_id, origin.latitude, origin.longitude, origin.altitude) == ("site", 52.001, -1.25, 90.5)
    assert before - 1 <= stamp_ms(odometry) <= time.time() * 1000 + 1
    assert [fix.altitude for fix in rig.messages("ins/nav_sat_fix", 3)] == [100.5] * 3
    rig.spin_for(0.3)
    assert not rig.received["ins/imu"] and not rig.received["/tf"]


def test_minute_is_taken_from_the_host_clock_without_channel_0(rig, packet):
    rig = rig()


    def send_now():
        rig.send(packet(int(time.time() * 1000) - UTC_MINUS_GPS_MS))
        rig.spin_for(0.02)
        return rig.received["ins/odometry"]

    rig.spin(send_now, 15)
    assert abs(stamp_ms(rig.messages("ins/odometry", 1)[0]) - time.time() * 1000) < 1000
    send_now()
    assert rig.spin(lambda: "minute taken from the host's clock" in rig.check("completeness")[1])
    assert len(rig.received["ins/ncom"]) > 10


def test_replay_equals_live_messages_and_publishes_the_clock(rig, drive, tmp_path):
    packets = drive(120, step_ms=10)
    (tmp_path / "drive.ncom").write_bytes(b"".join(packets))
    replay = rig(replay_file=tmp_path / "drive.ncom", publish_clock=True, loop=True)
    replayed = replay.messages("ins/odometry", 261)
    stamps = [stamp_ms(m) - UTC_MINUS_GPS_MS - START for m in replayed]
    begin = stamps.index(0.0)
    assert stamps[begin : begin + 121] == [10.0 * i for i in range(120)] + [0.0]
    clock = replay.messages("/clock", 20)
    assert all(START <= c.clock.sec * 1000 + c.clock.nanosec / 1e6 - UTC_MINUS_GPS_MS < START + 1200 for c in clock)
    live = rig()
    live.send(packets[0])
    for i in range(1, 120, 10):
        live.send(*packets[i : i + 10])
        live.spin_for(0.02)
    expected = live.messages("ins/odometry", 120)
    by_stamp = {stamp_ms(m): m for m in replayed[begin : begin + 120]}
    # Without accuracies at the start of the first pass, but with them in later ones: compare where both have them.
    assert all(by_stamp[stamp_ms(m)] == m for m in expected[5:])


def change_state(rig, transition):
    client = rig.node.create_client(ChangeState, "oxts_bridge/change_state")
    assert rig.spin(client.service_is_ready)
    request = ChangeState.Request()
    request.transition.id = transition
    future = client.call_async(request)
    assert rig.spin(future.done)
    return future.result().success


def test_messages_are_published_only_in_the_active_state(rig, drive):
    configure, cleanup, activate, deactivate, shutdown = 1, 2, 3, 4, 5
    rig = rig(connect=False, autostart=False)
    packets = drive(60, step_ms=10)
    assert change_state(rig, configure)
    rig.wait_connected()
    rig.send(*packets[:10])
    rig.spin_for(0.3)
    assert not rig.received["ins/odometry"]
    assert change_state(rig, activate)
    rig.send(*packets[10:20], *packets[20:30])
    rig.messages("ins/odometry", 20)
    assert change_state(rig, deactivate)
    count = len(rig.received["ins/odometry"])
    rig.send(*packets[30:40])
    rig.spin_for(0.3)
    assert len(rig.received["ins/odometry"]) == count
    assert change_state(rig, activate)
    rig.send(*packets[40:50])
    rig.messages("ins/odometry", count + 10)
    assert change_state(rig, deactivate) and change_state(rig, cleanup) and change_state(rig, configure)
    assert change_state(rig, cleanup) and change_state(rig, shutdown)


def test_replay_begins_again_when_reactivated(rig, drive, tmp_path):
    activate, deactivate = 3, 4
    (tmp_path / "drive.ncom").write_bytes(b"".join(drive(60, step_ms=10)))
    rig = rig(connect=False, autostart=False, replay_file=tmp_path / "drive.ncom")
    assert change_state(rig, 1)
    rig.wait_connected()
    stamps = []
    for count in (60, 120):
        assert change_state(rig, activate)
        stamps.append([stamp_ms(m) for m in rig.messages("ins/odometry", count)[count - 60 :]])
        assert change_state(rig, deactivate)
    assert stamps[0] == stamps[1]


def test_packets_without_a_heading_are_reported_and_published_without_odometry(rig, packet):
    """A single antenna before the heading is initialised, or a unit that marks single values as invalid."""
    rig = rig()
    rig.send(packet(START, 0), *(packet(START + 10 * i, 3, heading=math.nan) for i in range(1, 20)))
    assert len(rig.messages("ins/imu", 20)) == 20 and len(rig.messages("ins/odometry", 1)) == 1
    assert rig.spin(lambda: rig.check("stream")[2].get("packets without a complete solution") == "19")
