"""Fuzz the readers of every format: `make fuzz SECONDS=300 SEED=1`, or `python tests/fuzz/fuzz.py npz glb`.

The smallest file of each format (`seeds.py`) is damaged with the format in mind (words, numbers, lines,
counts, lengths, members of containers, types of values), and read. A right result or an `InputError` in one
line is fine; another exception, a crash, a hang or too much memory is a fault. Inputs that are read, or
refused at a new place, are damaged further. Batches run in forked processes with limits of processor time,
time and memory.

Faults are grouped by exception and innermost frame of magtwin. The smallest input of each group is kept in
build/fuzz/faults; copy it to tests/fuzz/corpus, which `test_corpus.py` reads, and mend the fault.
"""

import argparse
import collections
import contextlib
import hashlib
import importlib
import json
import math
import os
import pickle
import random
import re
import resource
import select
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from seeds import FORMATS, Seed, members, read, seed

BATCH, SLOW_BATCH = 100, 25
"""Inputs of a process."""

HANG_S, WALL_S, ROOM = 20, 300, 2_000_000_000
"""Limits of one input: processor seconds, seconds (others may need the processor), and bytes of memory
beyond those at the start."""

LONG = 2000
"""Characters of a refusal that nobody reads."""

KEPT, LARGEST = 100, 1 << 18
"""Inputs of a format that are damaged further, and the bytes of the largest."""

CORPUS = Path(__file__).with_name("corpus")
"""Inputs that were faults once: FORMAT/NAME."""

NUMBERS = ("0", "-1", "nan", "1e-320", "1e400", "-0.0", "0x10")
NUMBERS += (str(1 << 31), str(1 << 64), "9" * 23, "1" * 5000)
WORDS = ("", "\x00", "é", "../../x", "/dev/null", "a" * 300)
WORDS += ("{", "}", "[[", "]]", "<", ">", '"', "'", "@", "\x1b[2J")
WORDS += ("null", "None", "true", "[]", "{}", '""', "*a", "&a", "<<", "${x}", "#", "\\", "\u202e", "inf")
ENCODED = (*(word.encode() for word in WORDS), b"\xed\x9f\xbf", b"\xff\xfe", b"\xed\xa0\x80", b"\xef\xbb\xbf")
FLOATS = (0.0, -1.0, 1e9, -1e300, 1e300, 5e-324, math.nan, math.inf)
USD_VALUES = {
    "asset": "@./x.png@",
    "asset[]": "[@./x.png@, @../x@]",
    "bool": "true",
    "color3f[]": "[(1, 0, 0)]",
    "double": "nan",
    "double[]": "[]",
    "double3": "(1e300, 0, -inf)",
    "float": "-1",
    "float2[]": "[(0, 1), (2, 3)]",
    "half": "7e4",
    "int": "-2147483648",
    "int[]": "[-1, 3, 2147483647]",
    "int64": "-9223372036854775808",
    "matrix4d": "((0,0,0,0), (0,0,0,0), (0,0,0,0), (0,0,0,0))",
    "point3f[]": "[(nan, 0, 1e30)]",
    "quatf": "(0, 0, 0, 0)",
    "quatd[]": "[(1, 0, 0, 0)]",
    "string": '"x"',
    "string[]": '["x", ""]',
    "timecode": "1",
    "token": '"x"',
    "token[]": '["x", "x"]',
    "uchar": "255",
    "uint64": "18446744073709551615",
    "opaque": "None",
    "rel": "</x>",
    "add rel": "[</x>, </World>, </x>]",
}
"""Values of USD by type."""

USD_ATTRIBUTE = re.compile(
    rb"\b(?:(?:half|float|double|point3f|normal3f|vector3f|texCoord2f|color3f|quatf|quatd|matrix4d|u?int|u?int64"
    rb"|bool|token|string|asset|timecode)[234]?[fd]?(?:\[\])?|rel) ([\w:.]+) = ([^\n]*)"
)
"""An attribute or relationship of one line in USD's text."""

WHOLE = (0, 1, 0x7F, 0xFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF, 1 << 40, (1 << 63) - 1, (1 << 64) - 1)


IMPORTED = ("magtwin", "numpy", "scipy", "pxr", "pyarrow", "trimesh", "torch", "yaml")
"""What readers import, so that each child need not."""


class HangError(BaseException):
    """An input takes too long. No reader can catch it as an Exception."""


def mutated(data: bytes, rng: random.Random, sound: bool) -> bytes:
    """A file with one to four changes, each in a member of it if it is a container.

    Libraries open it for that only if it is sound: a damaged file can crash them.
    """
    for _ in range(rng.choice((1, 1, 2, 4))):
        if rng.random() < 0.2 and (found := [*USD_ATTRIBUTE.finditer(data)] if data[:5] == b"#usda" else []):
            match, kind = rng.choice(found), rng.choice(sorted(USD_VALUES))
            other = f"{kind} {match[1].decode()} = {USD_VALUES[kind]}".encode()
            data, sound = data[: match.start()] + other + data[match.end() :], False
            continue
        inside = members(data, sound) if rng.random() < 0.7 else None
        if inside is None or not inside[0]:
            data, sound = _changed(data, rng), False
        else:
            parts, packed = inside
            at = rng.randrange(len(parts))
            with contextlib.suppress(Exception):  # names and lengths that no zip holds
                data = packed(at, _changed(parts[at], rng))
    return data


def _changed(data: bytes, rng: random.Random) -> bytes:
    text = b"\0" not in data[:2000] and rng.random() < 0.85
    return _text(data, rng) if text else _binary(data, rng)


def _text(data: bytes, rng: random.Random) -> bytes:
    pieces = re.split(rb"(\s+|[,;:=<>{}()\[\]\"'/])", data)
    at, kind = rng.randrange(len(pieces)), rng.randrange(8)
    numbers = [i for i, piece in enumerate(pieces) if re.fullmatch(rb"-?[\d.]+(e-?\d+)?", piece)]
    if kind <= 1 and numbers:
        pieces[rng.choice(numbers)] = rng.choice(NUMBERS).encode()
    elif kind == 2:
        pieces[at] = rng.choice(ENCODED)
    elif kind == 3:
        pieces[at] = rng.choice(pieces)  # a word of another place
    elif kind == 4:
        lines = data.splitlines(keepends=True) or [b""]
        line = rng.randrange(len(lines))
        lines[line : line + 1] = rng.choice(
            ([], [lines[line]] * 2, [rng.choice(lines)], lines[line : line + 9])
        )
        return b"".join(lines)
    elif kind == 5:
        del pieces[at : at + rng.choice((1, 2, 8, 64))]
    elif kind == 6:
        pieces[at:at] = pieces[at : at + 16] * rng.choice((1, 8, 64))
    else:
        return _binary(data, rng)
    return b"".join(pieces)


def _binary(data: bytes, rng: random.Random) -> bytes:
    out, at, kind = bytearray(data), rng.randrange(len(data) + 1), rng.randrange(6)
    width = rng.choice((1, 2, 4, 8))
    if kind == 0:
        out[at : at + 1] = rng.randbytes(1)
    elif kind == 1:
        out[at : at + width] = (rng.choice(WHOLE) % (1 << 8 * width)).to_bytes(
            width, rng.choice(("little", "big"))
        )
    elif kind == 2:
        del out[at : at + rng.choice((1, 8, 512))]
    elif kind == 3:
        start = rng.randrange(len(data) + 1)
        out[at:at] = data[start : start + rng.choice((4, 64, 1024))]
    elif kind == 4:
        wide, value = rng.random() < 0.7, rng.choice(FLOATS)
        with np.errstate(over="ignore"):
            number = np.array(value, "<f8" if wide else "<f4").tobytes()
        at -= at % len(number)
        count = rng.choice((1, 1, len(data)))  # to the end
        out[at:] = number * min(count, (len(data) - at) // len(number)) + data[at:][len(number) * count :]
    else:
        del out[at:]
    return bytes(out)


def judged(kind: str, data: bytes, whole: Seed, folder: Path) -> tuple[str, str, str]:
    """Read one input in this process.

    Returns:
        "read", "refused", or the group of its fault; the place of the refusal; and the text of the error.
    """
    from magtwin.errors import InputError

    _limit_time()
    before = _children_s()
    try:
        read(kind, data, whole.beside, folder)
        said = ("read", "", "")
    except InputError as error:
        text = str(error)
        fault = "of several lines" if "\n" in text else f"of over {LONG} characters" * (len(text) > LONG)
        said = (f"a refusal {fault}, {kind}, {_place(error)}" if fault else "refused", _place(error), text)
    except HangError as error:
        said = (f"hang in {_place(error)}", "", f"over {HANG_S} s of the processor")
    except BaseException as error:  # every other kind is a fault
        said = (f"{type(error).__name__} in {_place(error)}", "", str(error))
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
    used = _children_s() - before
    if used > HANG_S and said[0] in ("read", "refused"):
        return f"hang of a child process, {kind}", "", f"{used:.0f} s of the processor; {said[2]}"
    return said


def _limit_time() -> None:
    """Raise `HangError` in Python code that takes too long; end the process if no Python code runs."""

    def stop(*_: object) -> None:
        raise HangError

    signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, HANG_S)
    used = sum(resource.getrusage(resource.RUSAGE_SELF)[:2])
    resource.setrlimit(resource.RLIMIT_CPU, (int(used) + HANG_S + 5, resource.RLIM_INFINITY))


def _children_s() -> float:
    """Processor time of child processes that have ended [s]."""
    return sum(resource.getrusage(resource.RUSAGE_CHILDREN)[:2])


def _place(error: BaseException) -> str:
    """The innermost frame of magtwin."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if "/magtwin/" in f.filename]
    return f"{frames[-1].filename.rpartition('/magtwin/')[2]}:{frames[-1].lineno}" if frames else "?"


class Batch:
    """A forked process that reads inputs, and what it said of those so far.

    Args:
        kind: The format.
        count: How many inputs.
        make: Makes an input from its number; gives the same bytes in this process.
        whole: The seed.
    """

    def __init__(self, kind: str, count: int, make: Callable[[int], bytes], whole: Seed) -> None:
        self.kind, self.count, self.make, self.started = kind, count, make, time.monotonic()
        self.heard, self.said, self._rest = self.started, list[tuple[str, str, str]](), b""
        self.file, end = os.pipe()
        self._child = os.fork()
        if not self._child:
            code = 70
            try:
                os.close(self.file)
                self._judge(end, whole)
                code = 0
            finally:
                os._exit(code)
        os.close(end)

    def _judge(self, end: int, whole: Seed) -> None:
        """The work of the child."""
        with open("/proc/self/statm") as file:
            size = int(file.read().split()[0]) * os.sysconf("SC_PAGE_SIZE")
        resource.setrlimit(resource.RLIMIT_AS, (size + ROOM, resource.RLIM_INFINITY))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        quiet = os.open(os.devnull, os.O_RDWR)
        for number in range(3):
            os.dup2(quiet, number)
        with tempfile.TemporaryDirectory(prefix="fuzz-") as folder, os.fdopen(end, "w") as answers:
            os.environ["TMPDIR"] = tempfile.tempdir = folder
            os.chdir(folder)
            for i in range(self.count):
                said = judged(self.kind, self.make(i), whole, Path(folder, str(i), "x"))
                answers.write(json.dumps(said) + "\n")
                answers.flush()
            if "magtwin.usd.trial" in sys.modules:
                sys.modules["magtwin.usd.trial"]._TRIAL.stop()

    def hear(self) -> bool:
        """Take what the child has said; True while it goes on."""
        block = os.read(self.file, 1 << 16)
        *lines, self._rest = (self._rest + block).split(b"\n")
        self.said += [tuple(json.loads(line)) for line in lines]
        self.heard = time.monotonic()
        if block:
            return True
        self._end("crash")
        return False

    def stop_if_late(self) -> bool:
        """End a child that says nothing for too long; True if so."""
        if time.monotonic() - self.heard < WALL_S:
            return False
        os.kill(self._child, signal.SIGKILL)
        self._end("no answer")
        return True

    def _end(self, why: str) -> None:
        os.close(self.file)
        status = os.waitstatus_to_exitcode(os.waitpid(self._child, 0)[1])
        if len(self.said) < self.count:
            if status == -signal.SIGXCPU:
                why = "hang outside of Python"
            self.said.append((f"{why}, {self.kind}, status {status}", "", ""))

    def run(self) -> list[tuple[str, str, str]]:
        """Wait for the end; gives all that was said."""
        going = True
        while going:
            ready = select.select([self.file], [], [], 1.0)[0]
            going = self.hear() if ready else not self.stop_if_late()
        return self.said


def in_child(work: Callable[[], Any]) -> Any:
    """The result of a function, computed in a forked process; its error ends this process."""
    away, end = os.pipe()
    child = os.fork()
    if not child:
        with os.fdopen(end, "wb") as file:
            try:
                pickle.dump(work(), file)
            except BaseException:
                traceback.print_exc()
        os._exit(0)
    os.close(end)
    with os.fdopen(away, "rb") as file:
        said = file.read()
    os.waitpid(child, 0)
    if not said:
        sys.exit("cannot make a seed")
    return pickle.loads(said)  # of our own child


class Fuzzer:
    """What is known of each format, and the faults found; kept in a folder."""

    def __init__(self, kinds: Sequence[str], number: int, out: Path) -> None:
        self.number, self.out = number, out
        self.seeds: dict[str, Seed] = {}
        self.files: dict[str, list[bytes]] = {}
        self.places: dict[str, set[str]] = {kind: set() for kind in kinds}
        self.counts: collections.Counter[tuple[str, str]] = collections.Counter()
        self.seconds: collections.Counter[str] = collections.Counter()
        self.faults: dict[str, dict[str, Any]] = {}
        self.batches = dict.fromkeys(kinds, 0)
        (out / "faults").mkdir(parents=True, exist_ok=True)
        for kind in kinds:
            self._begin(kind)

    def _begin(self, kind: str) -> None:
        """Write the seed of a format, check that it is read, and take what was found before."""

        def written() -> tuple[Seed, list[str]]:
            before = set(sys.modules)
            with tempfile.TemporaryDirectory() as folder:
                whole = seed(kind, Path(folder, "results-seed"))
            return whole, sorted(name for name in set(sys.modules) - before)

        self.seeds[kind], modules = in_child(written)
        for name in modules:  # now, and not in each child
            if name.partition(".")[0] in IMPORTED:
                with contextlib.suppress(Exception):
                    importlib.import_module(name)
        whole = self.seeds[kind]
        (said,) = Batch(kind, 1, lambda i: whole.data, whole).run()
        if said[0] != "read":
            sys.exit(f"a seed of {kind} is not read: {said}")
        kept = sorted([*(CORPUS / kind).glob("*"), *(self.out / "corpus" / kind).glob("*")])
        self.files[kind] = [whole.data, *(path.read_bytes() for path in kept)]

    def batch(self, kind: str) -> Batch:
        """The next batch of a format."""
        name, files = f"{self.number}/{kind}/{self.batches[kind]}", tuple(self.files[kind])
        self.batches[kind] += 1

        def make(i: int) -> bytes:
            rng = random.Random(f"{name}/{i}")
            at = 0 if rng.random() < 0.5 else rng.randrange(len(files))
            return mutated(files[at], rng, sound=at == 0)

        return Batch(kind, SLOW_BATCH if FORMATS[kind].slow else BATCH, make, self.seeds[kind])

    def take(self, batch: Batch) -> None:
        """Count what a batch said, and keep its faults and what is worth more damage."""
        kind = batch.kind
        self.seconds[kind] += time.monotonic() - batch.started
        for i, (group, place, text) in enumerate(batch.said):
            fine = group in ("read", "refused")
            self.counts[kind, group if fine else "fault"] += 1
            if not fine:
                self._fault(kind, group, batch.make(i), text)
            elif place not in self.places[kind] and (place or random.Random(i).random() < 0.2):
                if place:
                    self.places[kind].add(place)
                self._keep(kind, batch.make(i))

    def _fault(self, kind: str, group: str, data: bytes, text: str) -> None:
        known = self.faults.setdefault(group, {"kind": kind, "count": 0, "data": None, "text": text})
        known["count"] += 1
        if known["data"] is None:
            print(f"  {kind}: {group}: {text[:120]!r}", flush=True)
        if known["data"] is None or len(data) < len(known["data"]):
            known |= {"kind": kind, "data": data, "text": text}
            self._file(group).write_bytes(data)  # at once, should this process be ended

    def _file(self, group: str) -> Path:
        digest = hashlib.sha256(group.encode()).hexdigest()[:8]
        return self.out / "faults" / f"{self.faults[group]['kind']}-{digest}"

    def _keep(self, kind: str, data: bytes) -> None:
        files = self.files[kind]
        if len(data) > max(LARGEST, 2 * len(files[0])) or data in files:
            return
        if len(files) > KEPT:
            del files[1 + self.batches[kind] % KEPT]
        files.append(data)
        if len(data) <= LARGEST:
            place = self.out / "corpus" / kind
            place.mkdir(parents=True, exist_ok=True)
            (place / f"{len(list(place.iterdir())) % KEPT:03}").write_bytes(data)

    def run(self, batches: Iterator[Batch], seconds: float, jobs: int) -> None:
        """Fuzz for some time, in some processes at once."""
        end = time.monotonic() + seconds
        told, running = time.monotonic(), dict[int, Batch]()
        while running or time.monotonic() < end:
            while len(running) < jobs and time.monotonic() < end:
                batch = next(batches)
                running[batch.file] = batch
            ready = select.select(list(running), [], [], 1.0)[0]
            for file in list(running):
                if not (running[file].hear() if file in ready else not running[file].stop_if_late()):
                    self.take(running.pop(file))
            if time.monotonic() - told > 30:
                told = time.monotonic()
                print(f"  {self.summary()}", flush=True)

    def at_random(self) -> Iterator[Batch]:
        """Batches of the formats in turn, without end."""
        while True:
            for kind in self.files:
                yield self.batch(kind)

    def summary(self) -> str:
        """One line: inputs, faults and memory."""
        own = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        most = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
        return (
            f"{sum(self.counts.values()):,} inputs, {len(self.faults)} groups of faults; {own:,.0f} MB here, "
            f"at most {most:,.0f} MB in a child"
        )

    def tell(self) -> None:
        """Print counts and speed of each format, and the faults."""
        for kind in self.files:
            row = [f"{self.counts[kind, name]:,} {name}" for name in ("read", "refused", "fault")]
            total = sum(self.counts[kind, name] for name in ("read", "refused", "fault"))
            speed = total / self.seconds[kind] if self.seconds[kind] else 0
            print(f"{kind:16} {speed:7.1f} a second  {'  '.join(row)}")
        for group, fault in sorted(self.faults.items()):
            print(f"{fault['count']:5} x {group}: {fault['text'][:200]!r}\n        {self._file(group)}")
        print(self.summary())


def main() -> int:
    """Fuzz for some time; the exit status is 1 if a fault was found."""
    parser = argparse.ArgumentParser()
    parser.add_argument("formats", nargs="*", help="some of the formats; all by default")
    parser.add_argument("--seconds", type=float, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1, help="processes at once")
    parser.add_argument("--out", type=Path, default=Path("build/fuzz"))
    given = parser.parse_args()
    if unknown := set(given.formats) - set(FORMATS):
        parser.error(f"no format {min(unknown)!r}; known: {', '.join(FORMATS)}")
    fuzzer = Fuzzer(given.formats or list(FORMATS), given.seed, given.out.resolve())
    try:
        fuzzer.run(fuzzer.at_random(), given.seconds, given.jobs)
    except KeyboardInterrupt:
        print("ended by hand")
    fuzzer.tell()
    return int(bool(fuzzer.faults))


if __name__ == "__main__":
    sys.exit(main())
