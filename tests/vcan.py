"""A virtual CAN interface of the kernel, created and deleted by a test, and frames that python-can cannot send."""

import shutil
import socket
import struct
import subprocess

ERROR_FLAG, EXTENDED_FLAG, REMOTE_FLAG = 0x20000000, 0x80000000, 0x40000000
_PROBE = "stprobe0"


def ip_link(*words: str) -> subprocess.CompletedProcess:
    """Runs `ip link ...`; the caller evaluates return code and output."""
    command = [shutil.which("ip") or "/sbin/ip", "link", *words]
    return subprocess.run(command, check=False, capture_output=True, text=True)


def unavailable() -> str:
    """Reason why this kernel provides no virtual CAN interface; empty if it does."""
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError as error:
        return f"no CAN in this kernel ({error.strerror})"
    created = ip_link("add", _PROBE, "type", "vcan")
    if created.returncode:
        return f"no virtual CAN interface can be created ({created.stderr.strip()})"
    ip_link("del", _PROBE)
    return ""


class Interface:
    """A vcan interface that carries classical and FD frames."""

    def __init__(self, name: str):
        self.name = name

    def _link(self, *words: str) -> None:
        done = ip_link(*words)
        assert done.returncode == 0, f"ip link {' '.join(words)}: {done.stderr}"

    def create(self, up: bool = True) -> None:
        self._link("add", self.name, "type", "vcan")
        self._link("set", self.name, "mtu", "72")
        if up:
            self.up()

    def up(self) -> None:
        self._link("set", self.name, "up")

    def down(self) -> None:
        self._link("set", self.name, "down")

    def rename(self, name: str) -> None:
        """Only an interface that is down can be renamed."""
        self._link("set", self.name, "name", name)
        self.name = name

    def delete(self) -> None:
        self._link("del", self.name)

    def exists(self) -> bool:
        return ip_link("show", self.name).returncode == 0

    def send(self, identifier: int, data: bytes = b"") -> None:
        """One classical frame; flags in the identifier as in linux/can.h."""
        self._send(struct.pack("=IB3x8s", identifier, len(data), data))

    def send_error(self, error_class: int, data: bytes = bytes(8)) -> None:
        """An error frame as sent by the driver of a controller."""
        self.send(ERROR_FLAG | error_class, data)

    def send_fd(self, identifier: int, data: bytes) -> None:
        """data: 0 to 8, 12, 16, 20, 24, 32, 48 or 64 bytes."""
        self._send(struct.pack("=IBB2x64s", identifier, len(data), 1, data), fd=True)

    def _send(self, frame: bytes, fd: bool = False) -> None:
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as sender:
            if fd:
                sender.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1)
            sender.bind((self.name,))
            sender.send(frame)
