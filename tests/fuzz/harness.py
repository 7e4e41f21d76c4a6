"""Feeds mutated inputs to a reader. Findings are undocumented errors, hangs and excessive memory use."""

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
MAX_SECONDS = 10.0  # for one input, with a margin for a busy machine
MAX_MEMORY = 256 << 20  # bytes, growth of the resident memory by one input
ADDRESS_SPACE = 2 << 30  # bytes, growth of the address space beyond which allocations fail with MemoryError
NUMBERS = (b"0", b"-1", b"1", b"65", b"4294967296", b"99999999999", b"9" * 400, b"1e999", b"-1e999", b"nan", b".nan",
           b".inf", b"0.0", b"-0", b"1_0", b"0x1F", b"1.0e-320", b"1.0e+300", b"")


class Hang(BaseException):
    """One input exceeded the time limit. Not an Exception, so that no reader catches it."""


class Finding(Exception):
    """A failure of a reader. data: the input; place: identifies the failure, to count it once."""

    def __init__(self, description: str, data: bytes, place: str):
        super().__init__(description)
        self.data = data
        self.place = place


@dataclass(frozen=True)
class Target:
    """A reader and valid inputs to start from.

    run(data, folder): feeds one input and returns a short description of the outcome. It catches the documented errors
    of the reader; any other exception is a finding. folder: empty, for files.
    fragments: of the format, for insertion. repair: corrects checksums, so that mutations pass them. fragile: runs each
    input in its own process.
    """

    name: str
    seeds: Callable[[], Sequence[bytes]]
    run: Callable[[bytes, Path], str]
    fragments: tuple[bytes, ...] = ()
    text: bool = False
    repair: Callable[[bytes], bytes] | None = None
    fragile: bool = False

    @property
    def corpus(self) -> list[Path]:
        """Inputs of earlier findings."""
        return sorted((CORPUS / self.name).glob("*")) if (CORPUS / self.name).is_dir() else []


def check(target: Target, data: bytes) -> str:
    """Outcome of one input. Raises Finding."""
    return _run_in_child(target, data) if target.fragile else _run(target, data)


def _run_in_child(target: Target, data: bytes) -> str:
    """In a child process, because a library in C may crash."""
    sys.stdout.flush()
    reading, writing = os.pipe()
    child = os.fork()
    if not child:
        faulthandler.disable()  # the exit status reports the crash
        try:
            answer = {"outcome": _run(target, data)}
        except Finding as finding:
            answer = {"description": str(finding), "place": finding.place}
        except BaseException as error:
            answer = {"description": repr(error), "place": "harness"}
        with contextlib.suppress(BaseException), os.fdopen(writing, "w") as stream:
            json.dump(answer, stream)
        os._exit(0)
    os.close(writing)
    with os.fdopen(reading) as stream:
        text = stream.read()
    _, status = os.waitpid(child, 0)
    if not text:
        code = os.waitstatus_to_exitcode(status)
        raise Finding(f"{target.name}: the process ended with {code} (negative: a signal)", data, f"exit {code}")
    answer = json.loads(text)
    if "outcome" not in answer:
        raise Finding(answer["description"], data, answer["place"])
    return answer["outcome"]


def _run(target: Target, data: bytes) -> str:
    with tempfile.TemporaryDirectory(prefix="st-fuzz-", dir=_scratch()) as folder:
        initial_memory = _peak_memory(reset=True)
        try:
            with _limits():
                outcome = target.run(data, Path(folder)).replace(folder, "")
        except (Exception, Hang) as error:
            calls = "".join(traceback.format_tb(error.__traceback__, limit=-8))
            frame = traceback.extract_tb(error.__traceback__)[-1]
            place = f"{type(error).__name__} {frame.filename}:{frame.name} {_pattern(str(error))}"
            # Memory use may cause a time-out on a busy machine, so both are reported.
            text = "; ".join([f"{type(error).__name__}: {str(error)[:300]}", *_excessive_memory(initial_memory)])
            raise Finding(f"{target.name}: {text}\n{calls}", data, place) from None
        for excess in _excessive_memory(initial_memory):
            raise Finding(f"{target.name}: {len(data)} bytes {excess} ({outcome})", data, "memory")
        return outcome


def _excessive_memory(initial: int) -> list[str]:
    """Message about growth above MAX_MEMORY since the peak was `initial` [bytes]; empty below it."""
    growth = _peak_memory() - initial
    return [f"took {growth >> 20} MB of memory"] if growth > MAX_MEMORY else []


def one_line(error: Exception, data: bytes) -> str:
    """Message of a documented error; checks that it is one printable line, not much longer than the input."""
    text = str(error)
    assert text.isprintable(), f"not one printable line: {text[:300]!r}"
    assert 0 < len(text) < 2000 + len(data), f"{len(text)} characters for {len(data)} bytes: {text[:300]!r}"
    return text


def _scratch() -> str | None:
    return "/dev/shm" if os.access("/dev/shm", os.W_OK) else None


@contextmanager
def _limits() -> Iterator[None]:
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    previous = signal.signal(signal.SIGALRM, _hang)
    signal.setitimer(signal.ITIMER_REAL, MAX_SECONDS)
    resource.setrlimit(resource.RLIMIT_AS, (size + ADDRESS_SPACE, hard))
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
        signal.signal(signal.SIGALRM, previous)


def _hang(*_: object) -> None:
    raise Hang(f"more than {MAX_SECONDS:g} s")


def _peak_memory(reset: bool = False) -> int:
    """Peak resident memory [bytes]; reset: restart from the current value."""
    if reset:
        Path("/proc/self/clear_refs").write_text("5")
    status = Path("/proc/self/status").read_text()
    return int(re.search(r"VmHWM:\s+(\d+) kB", status).group(1)) * 1024


class Mutator:
    """Changes inputs at random: bytes, spans, lines, numbers, fragments of the format, parts of other inputs."""

    def __init__(self, rng: random.Random, target: Target):
        self._rng = rng
        self._target = target
        self._mutations = [self._flip, self._set, self._delete, self._repeat, self._move, self._insert, self._cut]
        self._mutations += [self._number, self._lines, self._lines] if target.text else [self._integer, self._integer]

    def mutate(self, data: bytes, others: Sequence[bytes]) -> bytes:
        rng = self._rng
        for _ in range(1 + min(int(rng.expovariate(0.6)), 12)):
            data = rng.choice(self._mutations)(data)
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
        fragments = self._target.fragments
        inserted = self._rng.choice(fragments) if fragments else self._rng.randbytes(8)
        return data[:place] + inserted + data[place:]

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
        old = self._rng.choice(numbers)
        new = self._rng.choice((*NUMBERS, str(self._rng.randrange(-300, 300)).encode()))
        return data[:old.start()] + new + data[old.end():]

    def _lines(self, data: bytes) -> bytes:
        lines = data.split(b"\n")
        place, other = self._rng.randrange(len(lines)), self._rng.randrange(len(lines))
        operation = self._rng.randrange(4)
        if operation == 0:
            del lines[place]
        elif operation == 1:
            lines.insert(other, lines[place])
        elif operation == 2:
            lines[place], lines[other] = lines[other], lines[place]
        else:
            indent = self._rng.choice((b"  ", b"\t", b"- ", b"? ", b"    "))
            lines[place] = indent + lines[place] if self._rng.random() < 0.7 else lines[place].lstrip()
        return b"\n".join(lines)


@dataclass
class Tally:
    """Result of a fuzz run. seconds: processor time. outcomes: description without numbers and quotes -> count."""

    inputs: int = 0
    seconds: float = 0.0
    outcomes: dict[str, int] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)


def fuzz(target: Target, seed: int, seconds: float, max_inputs: int = 10**12, max_findings: int = 5) -> Tally:
    """Runs until `seconds` of processor time (ten times as long in real time), max_inputs or max_findings are reached.

    An input with a new outcome is mutated further: an inexpensive guide to inputs that reach new code.
    """
    rng, tally = random.Random(seed), Tally()
    mutator = Mutator(rng, target)
    seeds = list(target.seeds())
    pool = [*seeds, *(path.read_bytes() for path in target.corpus)]
    started, end, places = processor_seconds(), time.monotonic() + 10.0 * seconds, set()
    while tally.inputs < max_inputs and (elapsed := processor_seconds() - started) < seconds and time.monotonic() < end:
        # Half of the mutations start from valid inputs, which reach most of the code.
        data = mutator.mutate(rng.choice(seeds if rng.random() < 0.5 else pool), pool)
        tally.inputs += 1
        tally.seconds = elapsed
        try:
            outcome = _pattern(check(target, data))
        except Finding as finding:
            if finding.place not in places:
                places.add(finding.place)
                tally.findings.append(finding)
                if len(tally.findings) >= max_findings:
                    break
            continue
        if outcome not in tally.outcomes and len(pool) < 300 and len(data) < 4 * max(map(len, seeds)):
            pool.append(data)
        tally.outcomes[outcome] = tally.outcomes.get(outcome, 0) + 1
    tally.seconds = processor_seconds() - started
    return tally


def processor_seconds() -> float:
    """Processor time of this process and its children [s]; independent of the load of the machine."""
    return sum(os.times()[:4])


def _pattern(text: str) -> str:
    """First 70 characters with numbers and quoted parts replaced, so that similar outcomes count as one."""
    return re.sub(r"'[^']*'|\"[^\"]*\"|0x[0-9a-fA-F]+|[-+]?\d[\d.e+-]*", "#", text)[:70]


def save(target: Target, data: bytes) -> Path:
    """Writes the input of a finding to the corpus, as a regression test."""
    folder = CORPUS / target.name
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / hashlib.sha256(data).hexdigest()[:12]
    path.write_bytes(data)
    return path


def minimise(target: Target, finding: Finding, seconds: float = 30.0) -> bytes:
    """A smaller input with the same finding: spans are removed as long as the finding remains."""
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
