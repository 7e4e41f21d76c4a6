"""The faults: how each is put in and taken away again, and what the suite is to do about it."""

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

GO_ON, STOP, ANY = "go on", "stop", "may pause"
Undo = Callable[[], None]
NODES = ("oxts_bridge", "canedge_bridge", "predictor", "evaluator", "recorder")


@dataclass(frozen=True)
class Fault:
    """One fault. seconds: its duration. put: inserts it, returns the function that removes it. expected: behaviour, for
    the table.

    check: diagnostic that has to report it, "" for none; words: required in its text. predictions: meanwhile. short:
    also in the quick run. restarts: a node that is started again. settles: time for recovery [s].
    """

    name: str
    seconds: float
    put: Callable[[Rig], Undo]
    expected: str
    check: str = ""
    words: str = ""
    predictions: str = GO_ON
    short: bool = False
    restarts: str = ""
    open: str = ""
    settles: float = 30.0


def on_ins(make: Callable[[], Change]) -> Callable[[Rig], Undo]:
    def put(rig: Rig) -> Undo:
        rig.car.ins.change = make()
        return lambda: setattr(rig.car.ins, "change", unchanged)

    return put


def on_can(make: Callable[[], Change], extra: tuple[bytes, ...] = ()) -> Callable[[Rig], Undo]:
    def put(rig: Rig) -> Undo:
        rig.car.can.change, rig.car.extra = make(), extra

        def undo() -> None:
            rig.car.can.change, rig.car.extra = unchanged, ()

        return undo

    return put


def signalled(name: str, number: int, after: int | None = None) -> Callable[[Rig], Undo]:
    def put(rig: Rig) -> Undo:
        pid = rig.pid(name)
        os.kill(pid, number)
        return (lambda: os.kill(pid, after)) if after else (lambda: None)

    return put


def slowed(name: str) -> Callable[[Rig], Undo]:
    """It runs for a tenth of a second, then stands still for four: a recorder that is slower than its data."""

    def put(rig: Rig) -> Undo:
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

    return put


def second_car(address: str, away: float) -> Callable[[Rig], Undo]:
    """Another car's packets beside the own ones. address: sent from; away: to the north [m]."""

    def put(rig: Rig) -> Undo:
        other = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        other.bind((address, 0))
        elsewhere = changes.moved(away / changes.EARTH_RADIUS)

        def twice(data: bytes) -> Sequence[bytes]:
            other.sendto(elsewhere(data)[0], rig.car.ins.to)
            return (data,)

        rig.car.ins.change = twice

        def undo() -> None:
            rig.car.ins.change = unchanged
            other.close()

        return undo

    return put


def second_publisher(rig: Rig) -> Undo:
    process = subprocess.Popen([sys.executable, str(ROOT / "tests" / "intruder.py")], env=rig.suite.environment,
                               stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    rig.run(20.0, lambda: rig.says(PUBLISHERS, "/intruder"))

    def undo() -> None:
        process.terminate()
        process.wait()

    return undo


def full_disk(rig: Rig) -> Undo:
    """The limit of the file size stands for the disk: a new file has room again."""
    pid = rig.pid("recorder")
    newest = next(newest_bag(rig).glob("*.mcap"))
    limit = newest.stat().st_size + 100_000
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))

    return lambda: resource.prlimit(pid, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))


def newest_bag(rig: Rig) -> Path:
    return max(rig.folder.glob("bag*/*.mcap"), key=lambda path: path.stat().st_mtime_ns).parent


def renamed_bag(rig: Rig) -> Undo:
    newest_bag(rig).rename(rig.folder / "bag_kept_aside")
    return lambda: None


def deleted_bag(rig: Rig) -> Undo:
    """What is recorded until the end of the fault goes with it: a copy keeps what came before for the other lines."""
    bag = newest_bag(rig)
    shutil.copytree(bag, rig.folder / f"{bag.name}_copied")
    shutil.rmtree(bag)
    return lambda: None


def changed_vehicle(rig: Rig) -> Undo:
    file, kept = rig.folder / "leaf.yaml", rig.folder / "kept.yaml"
    shutil.copy(file, kept)
    file.write_text("name: [not a vehicle\n")
    return lambda: kept.replace(file)


SUBSCRIBER = """
import rclpy
from st_msgs.msg import Prediction
rclpy.init()
node = rclpy.create_node("slow")
node.create_subscription(Prediction, "predictor/linear/prediction", lambda message: None, 1)
rclpy.spin(node)
"""


def slow_subscriber(rig: Rig) -> Undo:
    process = subprocess.Popen([sys.executable, "-c", SUBSCRIBER], env=rig.suite.environment,
                               stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    rig.run(20.0, lambda: "slow" in rig.monitor.node_names())
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
    Fault("INS silent 0.1 s", 0.1, on_ins(changes.silent), "predictions go on; the gap is counted", STREAM, "gaps"),
    Fault("INS silent 1 s", 1.0, on_ins(changes.silent), "no prediction from stale input; back by itself", PREDICTION,
          "INS", STOP, short=True),
    Fault("INS silent 10 s", 10.0, on_ins(changes.silent), "the same", STREAM, "no packet", STOP),
    Fault("RTK to float", 3.0, on_ins(lambda: changes.position_mode(5)), "predictions go on; the mode is reported",
          SOLUTION, "RTK float", short=True),
    Fault("RTK to none", 3.0, on_ins(lambda: changes.position_mode(0)), "predictions go on; the mode is reported",
          SOLUTION, "none"),
    Fault("INS restart: silent, initialising, locking", 6.0, on_ins(lambda: changes.Restart().change),
          "no prediction while there is no fix; back by itself", SOLUTION, "no fix", ANY),
    Fault("INS clock +1 s", 3.0, on_ins(lambda: changes.shifted(1000)), "no prediction from the future; reported",
          PREDICTION, "future", ANY),
    Fault("INS clock -1 s", 3.0, on_ins(lambda: changes.shifted(-1000)), "no prediction from stale input", PREDICTION,
          "INS", STOP),
    Fault("UDP loss 1 %", 5.0, on_ins(lambda: changes.Random(0.01).lose), "predictions go on; gaps counted", STREAM,
          "gaps"),
    Fault("UDP loss 10 %", 5.0, on_ins(lambda: changes.Random(0.1).lose), "the same", STREAM, "gaps", short=True),
    Fault("UDP loss 50 %", 5.0, on_ins(lambda: changes.Random(0.5).lose), "predictions go on while no gap passes 0.1 s",
          STREAM, "gaps", ANY),
    Fault("UDP duplication", 3.0, on_ins(lambda: changes.twice), "nothing is published or recorded twice"),
    Fault("UDP reordering (neighbours)", 3.0, on_ins(lambda: changes.Swap().change),
          "late packets are recorded, not published backwards", STREAM, "late"),
    Fault("UDP bursts of 0.15 s", 3.0, on_ins(lambda: changes.Burst(0.15).change), "predictions go on", "", "", ANY),
    Fault("second unit on the port", 4.0, second_car(OTHER_UNIT, 6400.0), "ignored, counted by address", short=True),
    Fault("two cars on one address", 4.0, second_car(LOOPBACK, 640.0), "the one that was there stays; reported", SOURCE,
          "second sender", short=True),
    Fault("second publisher of ins/odometry", 4.0, second_publisher, "reported at once with its name; not used",
          PUBLISHERS, "/intruder"),
    *(Fault(f"position jumps by {size:g} m, and back", 3.0,
            on_ins(lambda size=size: changes.moved(size / changes.EARTH_RADIUS)),
            "no prediction and no score across it; reported, counted", POSITION, f"jump of {size:g}", short=size == 0.5)
      for size in (0.5, 6.4, 640.0)),
    Fault("RTK float for 2 s drifts by 0.8 m, then fixed again", 4.0, on_ins(lambda: changes.Refix().change),
          "no prediction and no score across it; reported, counted", POSITION, "jump of 0."),
    Fault("latitude NaN", 2.0, on_ins(lambda: changes.at_latitude(math.nan)), "not used; reported by the bridge",
          STREAM, "impossible positions", STOP),
    Fault("latitude of 2 rad", 2.0, on_ins(lambda: changes.at_latitude(2.0)), "not used; reported by the bridge",
          STREAM, "impossible positions", STOP),
    Fault("INS a week ahead", 3.0, on_ins(lambda: changes.shifted(WEEK_MS)), "no prediction; reported by the bridge",
          TIME, "+7.0 days", STOP, short=True),
    Fault("1 % corrupt packets, final checksum right", 4.0, on_ins(lambda: changes.Random(0.01).corrupt),
          "nothing: all three sums are right",
          open="no sum can tell; a prediction that starts from such a packet is wrong"),
    Fault("GPS minute wraps", 61.0, lambda rig: lambda: None, "nothing to be seen"),
)
CAN = (
    Fault("CAN silent 2 s", 2.0, on_can(changes.silent), "no prediction from stale steering", BUS, "silent",
          STOP, short=True),
    Fault("CAN bus-off (error frame, then silence)", 2.0, on_can(lambda: changes.Once(BUS_OFF).change),
          "reported; back with the first frame", BUS, "bus-off", STOP),
    Fault("steering frames with wrong checksum", 2.0, on_can(lambda: changes.Steering().wrong_checksum),
          "marked invalid, not used", FRAMES, "bad frames", STOP, short=True),
    Fault("steering frames with a stuck counter", 2.0, on_can(lambda: changes.Steering().stuck_counter),
          "marked invalid, not used", FRAMES, "bad frames", STOP),
    Fault("steering jumps by 90 deg in one frame", 1.0, on_can(lambda: changes.Steering().jump),
          "that frame is not used", FRAMES, "bad frames", ANY),
    Fault("one identifier babbles, 3000 frames/s", 3.0, on_can(lambda: unchanged, BABBLE), "predictions go on",
          predictions=ANY),
    Fault("full bus, 2000 frames/s more", 3.0, on_can(lambda: unchanged, NOISE), "predictions go on",
          predictions=ANY),
)
KILLED = tuple(
    Fault(f"{name} killed (-9)", 1.0, signalled(name, signal.SIGKILL), "started again", f"suite: {name}", "ended with",
          GO_ON if name in ("evaluator", "recorder") else ANY, name == "predictor", name) for name in NODES)
HANGING = tuple(
    Fault(f"{name} hangs (SIGSTOP)", 12.0, signalled(name, signal.SIGSTOP), "killed after 8 s without a word, started "
          "again", f"suite: {name}", "was silent", GO_ON if name in ("evaluator", "recorder") else ANY,
          name == "oxts_bridge", name) for name in NODES)
MACHINE = (
    Fault("recorder runs a fifth of the time, 6 s", 6.0, slowed("recorder"), "queues hold it: nothing lost",
          predictions=ANY, short=True),
    Fault("recorder stands still for 3 s", 3.0, signalled("recorder", signal.SIGSTOP, signal.SIGCONT),
          "catches up: nothing lost", predictions=ANY),
    Fault("slow subscriber (stopped for 5 s)", 5.0, slow_subscriber, "nobody else waits for it"),
    Fault("vehicle file broken under running nodes", 3.0, changed_vehicle, "nothing changes: files are read at start"),
    Fault("disk full", 6.0, full_disk, "reported; bag closed whole; goes on in bag_2 when there is room", RECORDING,
          "recording stopped", ANY, short=True),
)
MACHINE += (
    Fault("bag renamed while recording", 4.0, renamed_bag, "reported; closed whole; goes on in a new one", RECORDING,
          "was renamed to", short=True),
    Fault("bag deleted while recording", 4.0, deleted_bag, "reported; goes on in a new one", RECORDING, "was deleted"),
)
LONG = (Fault("INS silent 120 s", 120.0, on_ins(changes.silent), "as 1 s", STREAM, "no packet", STOP),)
CONSISTENCY, WITHIN = "evaluator: consistency", "reported within 60 s of ordinary driving, gone within 90 s"
DRIVING = (
    Fault("yaw rate in deg/s", 60.0, on_ins(lambda: changes.yaw_rate_times(math.degrees(1.0))), WITHIN, CONSISTENCY,
          "yaw_rate is 57.", short=True, settles=90.0),
    Fault("yaw rate 0.3 s late", 60.0, on_ins(lambda: changes.yaw_rate_late(30)), WITHIN, CONSISTENCY,
          "yaw_rate lags yaw by 0.3", settles=90.0),
    Fault("steering angle frozen, counter runs", 60.0, on_can(lambda: changes.Steering().frozen), WITHIN, STEERING,
          "constant at", short=True, settles=90.0),
    Fault("steering counts the other way", 60.0, on_can(lambda: changes.Steering().flipped), WITHIN, CONSISTENCY,
          "opposite sign", short=True, settles=90.0),
)
FAULTS = (*INS, *CAN, *KILLED, *HANGING, *MACHINE)
