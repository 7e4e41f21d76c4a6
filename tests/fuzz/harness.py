"""Feeds changed inputs to a reader. A finding is any error but the documented one, a hang, or memory without bound."""

import contextlib
import faulthandler
import hashlib
import json
import os
import random
import re
import resource
import signal
import struct
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

CORPUS = Path(__file__).parent / "corpus"
MOST_SECONDS = 10.0  # for one input, on a machine that does other things as well
MOST_MEMORY = 256 << 20  # more than before, for one input
ADDRESS_SPACE = 2 << 30  # the same, enforced: beyond it the system answers with MemoryError
NUMBERS = (b"0", b"-1", b"1", b"65", b"4294967296", b"99999999999", b"9" * 400, b"1e999", b"-1e999", b"nan", b".nan",
           b".inf", b"0.0", b"-0", b"1_0", b"0x1F", b"1.0e-320", b"1.0e+300", b"")


class Hang(BaseException):
    """One input took too long. Not an Exception, so that no reader takes it for one of its own."""


class Finding(Exception):
    """What a reader must never do. Its text says what and where; `data` is the input; two of one `place` are one."""

    def __init__(self, what: str, data: bytes, place: str):
        super().__init__(what)
        self.data = data
        self.place = place


@dataclass(frozen=True)
class Target:
    """A reader and valid inputs to start from.

    run(data, folder): feeds one input and returns in a few words what came of it; must only return. Errors that the
    reader documents are caught in there, anything else that leaves it is a finding. folder: empty, for files.
    words: fragments worth putting in. repair: makes checksums right again, so that changes get past them. fragile: each
    input in a process of its own.
    """

    name: str
    seeds: Callable[[], Sequence[bytes]]
    run: Callable[[bytes, Path], str]
    words: tuple[bytes, ...] = ()
    text: bool = False
    repair: Callable[[bytes], bytes] | None = None
    fragile: bool = False

    @property
    def corpus(self) -> list[Path]:
        """Inputs that once were findings."""
        return sorted((CORPUS / self.name).glob("*")) if (CORPUS / self.name).is_dir() else []


def check(target: Target, data: bytes) -> str:
    """What came of one input. Raises Finding."""
    return _in_a_child(target, data) if target.fragile else _here(target, data)


def _in_a_child(target: Target, data: bytes) -> str:
    """A library in C may take the whole process with it."""
    sys.stdout.flush()
    reading, writing = os.pipe()
    child = os.fork()
    if not child:
        faulthandler.disable()  # the end is told by the exit status
        try:
            answer = {"outcome": _here(target, data)}
        except Finding as finding:
            answer = {"what": str(finding), "place": finding.place}
        except BaseException as error:
            answer = {"what": repr(error), "place": "harness"}
        with contextlib.suppress(BaseException), os.fdopen(writing, "w") as stream:
            json.dump(answer, stream)
        os._exit(0)
    os.close(writing)
    with os.fdopen(reading) as stream:
        text = stream.read()
    _, status = os.waitpid(child, 0)
    if not text:
        end = os.waitstatus_to_exitcode(status)
        raise Finding(f"{target.name}: the process ended with {end} (a signal, if negative)", data, f"end {end}")
    answer = json.loads(text)
    if "outcome" not in answer:
        raise Finding(answer["what"], data, answer["place"])
    return answer["outcome"]


def _here(target: Target, data: bytes) -> str:
    with tempfile.TemporaryDirectory(prefix="st-fuzz-", dir=_scratch()) as folder:
        before = _peak_memory(reset=True)
        try:
            with _limits():
                outcome = target.run(data, Path(folder)).replace(folder, "")
        except (Exception, Hang) as error:
            calls = "".join(traceback.format_tb(error.__traceback__, limit=-8))
            frame = traceback.extract_tb(error.__traceback__)[-1]
            place = f"{type(error).__name__} {frame.filename}:{frame.name} {_pattern(str(error))}"
            # On a busy machine it may be the memory that took the time: both are told.
            text = "; ".join([f"{type(error).__name__}: {str(error)[:300]}", *_waste(before)])
            raise Finding(f"{target.name}: {text}\n{calls}", data, place) from None
        for waste in _waste(before):
            raise Finding(f"{target.name}: {len(data)} bytes {waste} ({outcome})", data, "memory")
        return outcome


def _waste(before: int) -> list[str]:
    """What to say of the memory taken since it was at most `before` [bytes]; nothing where it was little."""
    grown = _peak_memory() - before
    return [f"took {grown >> 20} MB of memory"] if grown > MOST_MEMORY else []


def one_line(error: Exception, data: bytes) -> str:
    """The text of a documented error as an outcome: one line for a terminal, of bearable length for what was given."""
    text = str(error)
    assert text.isprintable(), f"not a line for a terminal: {text[:300]!r}"
    assert 0 < len(text) < 2000 + len(data), f"{len(text)} characters about {len(data)} bytes: {text[:300]!r}"
    return text


def _scratch() -> str | None:
    return "/dev/shm" if os.access("/dev/shm", os.W_OK) else None


@contextmanager
def _limits() -> Iterator[None]:
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    before = signal.signal(signal.SIGALRM, _hang)
    signal.setitimer(signal.ITIMER_REAL, MOST_SECONDS)
    resource.setrlimit(resource.RLIMIT_AS, (size + ADDRESS_SPACE, hard))
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
        signal.signal(signal.SIGALRM, before)


def _hang(*_: object) -> None:
    raise Hang(f"more than {MOST_SECONDS:g} s")


def _peak_memory(reset: bool = False) -> int:
    """Highest resident size so far [bytes]; reset: start anew from the present one."""
    if reset:
        Path("/proc/self/clear_refs").write_text("5")
    status = Path("/proc/self/status").read_text()
    return int(re.search(r"VmHWM:\s+(\d+) kB", status).group(1)) * 1024


class Mutator:
    """Changes inputs at random: bytes, spans, whole lines, numbers, known words, pieces of other inputs."""

    def __init__(self, rng: random.Random, target: Target):
        self._rng = rng
        self._target = target
        self._ways = [self._flip, self._set, self._delete, self._repeat, self._move, self._insert, self._cut]
        self._ways += [self._number, self._lines, self._lines] if target.text else [self._integer, self._integer]

    def change(self, data: bytes, others: Sequence[bytes]) -> bytes:
        rng = self._rng
        for _ in range(1 + min(int(rng.expovariate(0.6)), 12)):
            data = rng.choice(self._ways)(data)
        if rng.random() < 0.1:
            data = self._splice(data, rng.choice(others))
        if self._target.repair and rng.random() < 0.7:
            data = self._target.repair(data)
        return data

    def _place(self, data: bytes) -> int:
        return self._rng.randrange(len(data) + 1)

    def _span(self, data: bytes) -> tuple[int, int]:
        start = self._place(data)
        return start, min(len(data), start + 1 + int(self._rng.expovariate(0.03)))

    def _flip(self, data: bytes) -> bytes:
        if not data:
            return data
        place = self._rng.randrange(len(data))
        return data[:place] + bytes([data[place] ^ 1 << self._rng.randrange(8)]) + data[place + 1:]

    def _set(self, data: bytes) -> bytes:
        place = self._place(data)
        byte = self._rng.choice((0, 1, 0x7F, 0x80, 0xFF, 0xE7, 0x0A, 0x22, self._rng.randrange(256)))
        return data[:place] + bytes([byte]) + data[place + 1:]

    def _delete(self, data: bytes) -> bytes:
        start, end = self._span(data)
        return data[:start] + data[end:]

    def _repeat(self, data: bytes) -> bytes:
        start, end = self._span(data)
        return data[:end] + data[start:end] * self._rng.choice((1, 2, 10, 100)) + data[end:]

    def _move(self, data: bytes) -> bytes:
        start, end = self._span(data)
        piece, rest = data[start:end], data[:start] + data[end:]
        place = self._place(rest)
        return rest[:place] + piece + rest[place:]

    def _insert(self, data: bytes) -> bytes:
        place = self._place(data)
        word = self._rng.choice(self._target.words) if self._target.words else self._rng.randbytes(8)
        return data[:place] + word + data[place:]

    def _cut(self, data: bytes) -> bytes:
        return data[:self._place(data)] if self._rng.random() < 0.2 else data

    def _splice(self, data: bytes, other: bytes) -> bytes:
        return data[:self._place(data)] + other[self._place(other):]

    def _integer(self, data: bytes) -> bytes:
        """A length, count or offset, little endian."""
        value = self._rng.choice((0, 1, 0x7F, 0xFF, 0xFFFF, 2**31 - 1, 2**32 - 1, 2**60, 2**63 - 1, 2**64 - 1,
                                     len(data), self._rng.getrandbits(self._rng.randrange(1, 65))))
        packed = struct.pack("<Q", value)[:self._rng.choice((2, 4, 8))]
        place = self._place(data)
        return data[:place] + packed + data[place + len(packed):]

    def _number(self, data: bytes) -> bytes:
        numbers = list(re.finditer(rb"-?\d+(\.\d+)?([eE][-+]?\d+)?", data))
        if not numbers:
            return data
        found = self._rng.choice(numbers)
        new = self._rng.choice((*NUMBERS, str(self._rng.randrange(-300, 300)).encode()))
        return data[:found.start()] + new + data[found.end():]

    def _lines(self, data: bytes) -> bytes:
        lines = data.split(b"\n")
        place, other = self._rng.randrange(len(lines)), self._rng.randrange(len(lines))
        way = self._rng.randrange(4)
        if way == 0:
            del lines[place]
        elif way == 1:
            lines.insert(other, lines[place])
        elif way == 2:
            lines[place], lines[other] = lines[other], lines[place]
        else:
            indent = self._rng.choice((b"  ", b"\t", b"- ", b"? ", b"    "))
            lines[place] = indent + lines[place] if self._rng.random() < 0.7 else lines[place].lstrip()
        return b"\n".join(lines)


@dataclass
class Tally:
    """What a run has seen. seconds: of processor time. outcomes: words -> how often, numbers and quoted parts taken
    out."""

    inputs: int = 0
    seconds: float = 0.0
    outcomes: dict[str, int] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)


def fuzz(target: Target, seed: int, seconds: float, most: int = 10**12, keep: int = 5) -> Tally:
    """Until so many seconds of processor time (ten times as many on the clock), `most` inputs, or `keep` different
    findings.

    An input whose outcome is new joins those that are changed further: a cheap guide to where new code is reached.
    """
    rng, tally = random.Random(seed), Tally()
    mutator = Mutator(rng, target)
    seeds = list(target.seeds())
    pool = [*seeds, *(path.read_bytes() for path in target.corpus)]
    started, latest, places = processor_seconds(), time.monotonic() + 10.0 * seconds, set()
    while tally.inputs < most and (elapsed := processor_seconds() - started) < seconds and time.monotonic() < latest:
        # Half of them one step from a valid input, where most of the code is reached.
        data = mutator.change(rng.choice(seeds if rng.random() < 0.5 else pool), pool)
        tally.inputs += 1
        tally.seconds = elapsed
        try:
            outcome = _pattern(check(target, data))
        except Finding as finding:
            if finding.place not in places:
                places.add(finding.place)
                tally.findings.append(finding)
                if len(tally.findings) >= keep:
                    break
            continue
        if outcome not in tally.outcomes and len(pool) < 300 and len(data) < 4 * max(map(len, seeds)):
            pool.append(data)
        tally.outcomes[outcome] = tally.outcomes.get(outcome, 0) + 1
    tally.seconds = processor_seconds() - started
    return tally


def processor_seconds() -> float:
    """Of this process and its children: on a machine with other work the clock on the wall says little."""
    return sum(os.times()[:4])


def _pattern(text: str) -> str:
    """Texts that begin alike, but for numbers and quoted parts, are one outcome."""
    return re.sub(r"'[^']*'|\"[^\"]*\"|0x[0-9a-fA-F]+|[-+]?\d[\d.e+-]*", "#", text)[:70]


def save(target: Target, data: bytes) -> Path:
    """Keep a finding as a regression input."""
    folder = CORPUS / target.name
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / hashlib.sha256(data).hexdigest()[:12]
    path.write_bytes(data)
    return path


def smaller(target: Target, finding: Finding, seconds: float = 30.0) -> bytes:
    """A smaller input with the same finding: spans are left out as long as that goes well."""
    data, end = finding.data, time.monotonic() + seconds
    size = len(data) // 2
    while size and time.monotonic() < end:
        start = 0
        while start < len(data) and time.monotonic() < end:
            candidate = data[:start] + data[start + size:]
            try:
                check(target, candidate)
                start += size
            except Finding as found:
                if found.place == finding.place:
                    data = candidate
                else:
                    start += size
        size //= 2
    return data
