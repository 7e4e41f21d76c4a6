"""The faults: how each is injected and removed, and the required behaviour of the suite."""

import math
import os
import resource
import shutil
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from support import ROOT

from . import changes
from .rig import Rig
from .wires import LOOPBACK, OTHER_UNIT, Change, datagram, unchanged

CONTINUE, STOP, ANY = "continue", "stop", "may pause"
Undo = Callable[[], None]
NODES = ("oxts_bridge", "canedge_bridge", "predictor", "evaluator", "recorder")


@dataclass(frozen=True)
class Fault:
    """One fault. seconds: its duration. inject: injects it, returns the function that removes it.

    expected: required behaviour, for the table. check: diagnostic that has to report it, "" for none, with these words
    in its text. predictions: required behaviour of predictions during the fault. short: whether the short run includes
    it. restarts: node that is restarted. open: known deviation from the required behaviour. recovery_timeout: [s].
    """

    name: str
    seconds: float
    inject: Callable[[Rig], Undo]
    expected: str
    check: str = ""
    words: str = ""
    predictions: str = CONTINUE
    short: bool = False
    restarts: str = ""
    open: str = ""
    recovery_timeout: float = 30.0


def change_ins(make: Callable[[], Change]) -> Callable[[Rig], Undo]:
    def inject(rig: Rig) -> Undo:
        rig.car.ins.change = make()
        return lambda: setattr(rig.car.ins, "change", unchanged)

    return inject


def change_can(make: Callable[[], Change], extra: tuple[bytes, ...] = ()) -> Callable[[Rig], Undo]:
    def inject(rig: Rig) -> Undo:
        rig.car.can.change, rig.car.extra = make(), extra

        def undo() -> None:
            rig.car.can.change, rig.car.extra = unchanged, ()

        return undo

    return inject


def send_signal(name: str, number: int, after: int | None = None) -> Callable[[Rig], Undo]:
    def inject(rig: Rig) -> Undo:
        pid = rig.pid(name)
        os.kill(pid, number)
        return (lambda: os.kill(pid, after)) if after else (lambda: None)

    return inject


def slow_down(name: str) -> Callable[[Rig], Undo]:
    """Lets a process run 0.1 s of every 0.5 s: a recorder that is slower than its data."""

    def inject(rig: Rig) -> Undo:
        pid, ending = rig.pid(name), threading.Event()

        def stop_and_go() -> None:
            while not ending.is_set():
                os.kill(pid, signal.SIGSTOP)
                ending.wait(0.4)
                os.kill(pid, signal.SIGCONT)
                ending.wait(0.1)

        thread = threading.Thread(target=stop_and_go, daemon=True)
        thread.start()

        def undo() -> None:
            ending.set()
            thread.join()

        return undo

    return inject


def add_second_car(address: str, distance: float) -> Callable[[Rig], Undo]:
    """Adds the packets of another car. address: of its sender; distance: to the north [m]."""

    def inject(rig: Rig) -> Undo:
        other = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        other.bind((address, 0))
        moved = changes.moved(distance / changes.EARTH_RADIUS)

        def twice(data: bytes) -> Sequence[bytes]:
            other.sendto(moved(data)[0], rig.car.ins.to)
            return (data,)

        rig.car.ins.change = twice

        def undo() -> None:
            rig.car.ins.change = unchanged
            other.close()

        return undo

    return inject


def add_second_publisher(rig: Rig) -> Undo:
    process = subprocess.Popen([sys.executable, str(ROOT / "tests" / "intruder.py")], env=rig.suite.environment,
                               stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    rig.run(20.0, lambda: rig.reports(PUBLISHERS, "/intruder"))

    def undo() -> None:
        process.terminate()
        process.wait()

    return undo


def fill_disk(rig: Rig) -> Undo:
    """Limits the file size in place of the disk; a new file has room again."""
    pid = rig.pid("recorder")
    newest = next(find_newest_bag(rig).glob("*.mcap"))
    limit = newest.stat().st_size + 100_000
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))

    return lambda: resource.prlimit(pid, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))


def find_newest_bag(rig: Rig) -> Path:
    return max(rig.folder.glob("bag*/*.mcap"), key=lambda path: path.stat().st_mtime_ns).parent


def rename_bag(rig: Rig) -> Undo:
    find_newest_bag(rig).rename(rig.folder / "bag_renamed")
    return lambda: None


def delete_bag(rig: Rig) -> Undo:
    """Deletes the bag of the recorder; a copy keeps the earlier messages for the rows of other faults."""
    bag = find_newest_bag(rig)
    shutil.copytree(bag, rig.folder / f"{bag.name}_copied")
    shutil.rmtree(bag)
    return lambda: None


def break_vehicle_file(rig: Rig) -> Undo:
    file, original = rig.folder / "leaf.yaml", rig.folder / "original.yaml"
    shutil.copy(file, original)
    file.write_text("name: [not a vehicle\n")
    return lambda: original.replace(file)


SUBSCRIBER = """
import rclpy
from st_msgs.msg import Prediction
rclpy.init()
node = rclpy.create_node("slow")
node.create_subscription(Prediction, "predictor/linear/prediction", lambda message: None, 1)
rclpy.spin(node)
"""


def add_slow_subscriber(rig: Rig) -> Undo:
    process = subprocess.Popen([sys.executable, "-c", SUBSCRIBER], env=rig.suite.environment,
                               stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    rig.run(20.0, lambda: "slow" in rig.monitor.find_node_names())
    process.send_signal(signal.SIGSTOP)

    def undo() -> None:
        process.kill()
        process.wait()

    return undo


BUS_OFF = datagram(0x040, bytes(8), error=True)
BABBLE = (datagram(0x001, bytes(8)),) * 6  # 3000 frames/s: what 500 kbit/s carry
NOISE = tuple(datagram(0x100 + k, bytes([k] * 8)) for k in range(4))  # 2000 frames/s more
STREAM, SOLUTION = "oxts_bridge: stream", "oxts_bridge: solution"
POSITION, PUBLISHERS, STEERING = "predictor: position", "predictor: publishers", "predictor: steering"
SOURCE, TIME = "oxts_bridge: source", "oxts_bridge: time"
WEEK_MS = 7 * 86_400 * 1000
PREDICTION, BUS, FRAMES = "predictor: prediction", "canedge_bridge: bus", "canedge_bridge: frames"
RECORDING = "recorder: recording"

INS = (
    Fault("INS silent 0.1 s", 0.1, change_ins(changes.silent), "predictions continue; the gap is counted", STREAM,
          "gaps"),
    Fault("INS silent 1 s", 1.0, change_ins(changes.silent),
          "no prediction from stale input; recovers without restart", PREDICTION, "INS", STOP, short=True),
    Fault("INS silent 10 s", 10.0, change_ins(changes.silent), "the same", STREAM, "no packet", STOP),
    Fault("RTK to float", 3.0, change_ins(lambda: changes.position_mode(5)),
          "predictions continue; the mode is reported", SOLUTION, "RTK float"),
    Fault("RTK to none", 3.0, change_ins(lambda: changes.position_mode(0)),
          "predictions continue; the mode is reported", SOLUTION, "none"),
    Fault("INS restart: silent, initialising, locking", 6.0, change_ins(lambda: changes.Restart().change),
          "no prediction without a fix; recovers without restart", SOLUTION, "no fix", ANY),
    Fault("INS clock +1 s", 3.0, change_ins(lambda: changes.shifted(1000)), "no prediction from the future; reported",
          PREDICTION, "future", ANY),
    Fault("INS clock -1 s", 3.0, change_ins(lambda: changes.shifted(-1000)), "no prediction from stale input",
          PREDICTION, "INS", STOP),
    Fault("UDP loss 1 %", 5.0, change_ins(lambda: changes.Random(0.01).lose), "predictions continue; gaps counted",
          STREAM, "gaps"),
    Fault("UDP loss 10 %", 5.0, change_ins(lambda: changes.Random(0.1).lose), "the same", STREAM, "gaps", short=True),
    Fault("UDP loss 50 %", 5.0, change_ins(lambda: changes.Random(0.5).lose),
          "predictions continue while no gap exceeds 0.1 s", STREAM, "gaps", ANY),
    Fault("UDP duplication", 3.0, change_ins(lambda: changes.twice), "nothing is published or recorded twice"),
    Fault("UDP reordering (neighbours)", 3.0, change_ins(lambda: changes.Swap().change),
          "late packets are recorded, but not published", STREAM, "late"),
    Fault("UDP bursts of 0.15 s", 3.0, change_ins(lambda: changes.Burst(0.15).change), "predictions continue", "", "",
          ANY),
    Fault("second unit on the port", 4.0, add_second_car(OTHER_UNIT, 6400.0), "the first sender is kept; reported",
          SOURCE, f"ignored so far: {OTHER_UNIT}"),
    Fault("two cars on one address", 4.0, add_second_car(LOOPBACK, 640.0), "the first sender is kept; reported", SOURCE,
          "ignored since", short=True),
    Fault("second publisher of ins/odometry", 4.0, add_second_publisher, "reported at once by name; not used",
          PUBLISHERS, "/intruder"),
    *(Fault(f"position jumps by {size:g} m, and back", 3.0,
            change_ins(lambda size=size: changes.moved(size / changes.EARTH_RADIUS)),
            "no prediction and no score across it; reported, counted", POSITION, f"jump of {size:g}", short=size == 0.5)
      for size in (0.5, 6.4, 640.0)),
    Fault("RTK float for 2 s drifts by 0.8 m, then fixed again", 4.0, change_ins(lambda: changes.Refix().change),
          "no prediction and no score across it; reported, counted", POSITION, "jump of 0."),
    Fault("latitude NaN", 2.0, change_ins(lambda: changes.at_latitude(math.nan)), "not used; reported by the bridge",
          STREAM, "impossible positions", STOP),
    Fault("latitude of 2 rad", 2.0, change_ins(lambda: changes.at_latitude(2.0)), "not used; reported by the bridge",
          STREAM, "impossible positions", STOP),
    Fault("INS a week ahead", 3.0, change_ins(lambda: changes.shifted(WEEK_MS)),
          "no prediction; reported by the bridge", TIME, "+7.0 days", STOP, short=True),
    Fault("1 % corrupt packets, final checksum right", 4.0, change_ins(lambda: changes.Random(0.01).corrupt),
          "none: all three checksums are valid",
          open="no checksum can detect it; a prediction that starts from such a packet is wrong"),
    Fault("GPS minute wraps", 61.0, lambda rig: lambda: None, "no effect"),
)
CAN = (
    Fault("CAN silent 2 s", 2.0, change_can(changes.silent), "no prediction from stale steering", BUS, "silent",
          STOP, short=True),
    Fault("CAN bus-off (error frame, then silence)", 2.0, change_can(lambda: changes.Once(BUS_OFF).change),
          "reported; recovers with the first frame", BUS, "bus-off", STOP),
    Fault("steering frames with wrong checksum", 2.0, change_can(lambda: changes.Steering().wrong_checksum),
          "marked invalid, not used", FRAMES, "bad frames", STOP, short=True),
    Fault("steering frames with a stuck counter", 2.0, change_can(lambda: changes.Steering().stuck_counter),
          "marked invalid, not used", FRAMES, "bad frames", STOP),
    Fault("steering jumps by 90 deg in one frame", 1.0, change_can(lambda: changes.Steering().jump),
          "that frame is not used", FRAMES, "bad frames", ANY),
    Fault("one identifier babbles, 3000 frames/s", 3.0, change_can(lambda: unchanged, BABBLE), "predictions continue",
          predictions=ANY),
    Fault("full bus, 2000 frames/s more", 3.0, change_can(lambda: unchanged, NOISE), "predictions continue",
          predictions=ANY),
)
KILLED = tuple(
    Fault(f"{name} killed (-9)", 1.0, send_signal(name, signal.SIGKILL), "restarted", f"suite: {name}", "ended with",
          CONTINUE if name in ("evaluator", "recorder") else ANY, name == "predictor", name) for name in NODES)
HANGING = tuple(
    Fault(f"{name} hangs (SIGSTOP)", 12.0, send_signal(name, signal.SIGSTOP), "killed after 8 s of silence, "
          "restarted", f"suite: {name}", "was silent", CONTINUE if name in ("evaluator", "recorder") else ANY,
          name == "oxts_bridge", name) for name in NODES)
MACHINE = (
    Fault("recorder runs a fifth of the time, 6 s", 6.0, slow_down("recorder"), "the queues suffice: nothing is lost",
          predictions=ANY, short=True),
    Fault("recorder stands still for 3 s", 3.0, send_signal("recorder", signal.SIGSTOP, signal.SIGCONT),
          "catches up: nothing is lost", predictions=ANY),
    Fault("slow subscriber (stopped for 5 s)", 5.0, add_slow_subscriber, "no other node waits for it"),
    Fault("vehicle file broken under running nodes", 3.0, break_vehicle_file, "no effect: files are read at the start"),
    Fault("disk full", 6.0, fill_disk, "reported; bag closed intact; continues in bag_2 when there is space", RECORDING,
          "recording stopped", ANY, short=True),
)
MACHINE += (
    Fault("bag renamed while recording", 4.0, rename_bag, "reported; closed intact; continues in a new bag", RECORDING,
          "was renamed to"),
    Fault("bag deleted while recording", 4.0, delete_bag, "reported; continues in a new bag", RECORDING, "was deleted"),
)
LONG = (Fault("INS silent 120 s", 120.0, change_ins(changes.silent), "as 1 s", STREAM, "no packet", STOP),)
CONSISTENCY, WITHIN = "evaluator: consistency", "reported within 60 s of ordinary driving, gone within 90 s"
DRIVING = (
    Fault("yaw rate in deg/s", 60.0, change_ins(lambda: changes.yaw_rate_times(math.degrees(1.0))), WITHIN, CONSISTENCY,
          "yaw_rate is 57.", short=True, recovery_timeout=90.0),
    Fault("yaw rate 0.3 s late", 60.0, change_ins(lambda: changes.yaw_rate_late(30)), WITHIN, CONSISTENCY,
          "yaw_rate lags yaw by 0.3", recovery_timeout=90.0),
    Fault("steering angle frozen, counter runs", 60.0, change_can(lambda: changes.Steering().frozen), WITHIN, STEERING,
          "constant at", short=True, recovery_timeout=90.0),
    Fault("steering counts the other way", 60.0, change_can(lambda: changes.Steering().flipped), WITHIN, CONSISTENCY,
          "opposite sign", recovery_timeout=90.0),
)
FAULTS = (*INS, *CAN, *KILLED, *HANGING, *MACHINE)
