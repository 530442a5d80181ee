"""Fuzz the readers of every format: `make fuzz SECONDS=300 SEED=1`, or `python tests/fuzz/fuzz.py npz glb`.

Small files of each format are written, then damaged with the format in mind (words, numbers, lines, counts,
lengths), and read. A right result or an `InputError` in one line is fine; another exception, a crash, a hang
or too much memory is a fault. Batches run in forked processes with limits. Faults are grouped by exception
and innermost frame of magtwin; of each group the smallest input is reduced and kept in build/fuzz.
"""

import argparse
import collections
import json
import os
import random
import re
import resource
import signal
import sys
import tempfile
import time
import traceback
from pathlib import Path

from seeds import FORMATS, read, seeds

BATCH = 60
"""Inputs of a process."""

HANG_S, ROOM = 20, 2_000_000_000
"""Limits of one input: seconds, and bytes of memory beyond those at the start."""

NUMBERS = ("0", "-1", "nan", "1e-320", "1e400", "-0.0", "0x10", str(1 << 31), str(1 << 64), "9" * 23)
WORDS = [
    "",
    "\x00",
    "\ud7ff",
    "é",
    "../../x",
    "/dev/null",
    "a" * 300,
    "{",
    "}",
    "[[",
    "]]",
    "<",
    ">",
    '"',
    "'",
    "@",
]
WHOLE = (0, 1, 0x7F, 0xFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF, 1 << 40, (1 << 63) - 1, (1 << 64) - 1)


def mutated(data: bytes, rng: random.Random) -> bytes:
    """A file with one to four changes."""
    for _ in range(rng.choice((1, 1, 2, 4))):
        text = b"\0" not in data[:2000] and rng.random() < 0.85
        data = _text(data, rng) if text else _binary(data, rng)
    return data


def _text(data: bytes, rng: random.Random) -> bytes:
    pieces = re.split(rb"(\s+|[,;:=<>{}()\[\]\"'/])", data)
    at, kind = rng.randrange(len(pieces)), rng.randrange(8)
    numbers = [i for i, piece in enumerate(pieces) if re.fullmatch(rb"-?[\d.]+(e-?\d+)?", piece)]
    if kind <= 1 and numbers:
        pieces[rng.choice(numbers)] = rng.choice(NUMBERS).encode()
    elif kind == 2:
        pieces[at] = rng.choice(WORDS).encode()
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
    out, at, kind = bytearray(data), rng.randrange(len(data) + 1), rng.randrange(5)
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
    else:
        del out[at:]
    return bytes(out)


def judged(kind: str, data: bytes, folder: Path) -> str:
    """Read one input in this process: "read", "refused", or the group of its fault."""
    from magtwin.errors import InputError

    signal.signal(signal.SIGALRM, lambda *_: (_ for _ in ()).throw(TimeoutError("hang")))
    signal.alarm(HANG_S)
    try:
        read(kind, data, folder)
    except InputError as error:
        return "refused" if "\n" not in str(error) else f"a refusal of several lines, {kind}"
    except BaseException as error:  # every other kind is a fault
        frames = [f for f in traceback.extract_tb(error.__traceback__) if "/magtwin/" in f.filename]
        last = f"{frames[-1].filename.rpartition('/magtwin/')[2]}:{frames[-1].lineno}" if frames else "?"
        return (
            f"{type(error).__name__} in {last}: {str(error)[:90]!r}"
            if not isinstance(error, TimeoutError)
            else f"hang in {last}"
        )
    finally:
        signal.alarm(0)
    return "read"


def forked(kind: str, inputs: list[bytes]) -> list[str]:
    """The judgements of inputs in a process of their own; the last one is its crash, if it ended early."""
    away, end = os.pipe()
    child = os.fork()
    if not child:
        os.close(away)
        with open("/proc/self/statm") as file:
            size = int(file.read().split()[0]) * os.sysconf("SC_PAGE_SIZE")
        resource.setrlimit(resource.RLIMIT_AS, (size + ROOM, resource.RLIM_INFINITY))
        quiet = os.open(os.devnull, os.O_WRONLY)
        os.dup2(quiet, 1)
        os.dup2(quiet, 2)
        with tempfile.TemporaryDirectory() as folder, os.fdopen(end, "w") as answers:
            for i, data in enumerate(inputs):
                answers.write(json.dumps(judged(kind, data, Path(folder, str(i)))) + "\n")
                answers.flush()
            if "magtwin.usd.trial" in sys.modules:
                sys.modules["magtwin.usd.trial"]._TRIAL.stop()
        os._exit(0)
    os.close(end)
    with os.fdopen(away) as answers:
        said = [json.loads(line) for line in answers if line.endswith("\n")]
    status = os.waitpid(child, 0)[1]
    if len(said) < len(inputs):
        said.append(f"crash of the process, status {status}, {kind}")
    return said


def minimised(kind: str, data: bytes, group: str, tries: int = 150) -> bytes:
    """A smaller input of the same group: pieces are removed while the fault stays."""
    size = max(1, len(data) // 2)
    while size and tries > 0:
        at = 0
        while at < len(data) and tries > 0:
            shorter, tries = data[:at] + data[at + size :], tries - 1
            if forked(kind, [shorter])[0] == group:
                data = shorter
            else:
                at += size
        size //= 2
    return data


def main() -> int:
    """Fuzz for some time; the exit status is 1 if a fault was found."""
    parser = argparse.ArgumentParser()
    parser.add_argument("formats", nargs="*")
    parser.add_argument("--seconds", type=float, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("build/fuzz"))
    given = parser.parse_args()
    if unknown := set(given.formats) - set(FORMATS):
        parser.error(f"no format {min(unknown)!r}; known: {', '.join(FORMATS)}")
    rng, corpus = random.Random(given.seed), {}
    with tempfile.TemporaryDirectory() as folder:
        for kind in given.formats or FORMATS:
            corpus[kind] = seeds(kind, Path(folder))
            for said in forked(kind, corpus[kind]):
                if said != "read":
                    sys.exit(f"a seed of {kind} is not read: {said}")
    counts: collections.Counter = collections.Counter()
    faults: dict[str, tuple[str, bytes, int]] = {}
    end, told = time.monotonic() + given.seconds, time.monotonic()
    while time.monotonic() < end:
        for kind, files in corpus.items():
            inputs = [mutated(rng.choice(files), rng) for _ in range(BATCH)]
            for data, said in zip(inputs, forked(kind, inputs), strict=False):
                counts[kind, said if said in ("read", "refused") else "fault"] += 1
                if said not in ("read", "refused"):
                    known = faults.get(said)
                    best = data if known is None or len(data) < len(known[1]) else known[1]
                    faults[said] = (kind, best, 1 + (known[2] if known else 0))
            if time.monotonic() - told > 30:
                told = time.monotonic()
                print(f"  {sum(counts.values()):,} inputs, {len(faults)} groups of faults", flush=True)  # noqa: T201
            if time.monotonic() > end:
                break
    given.out.mkdir(parents=True, exist_ok=True)
    for kind in corpus:
        row = {name: counts[kind, name] for name in ("read", "refused", "fault")}
        print(f"{kind:12}", "  ".join(f"{number:,} {name}" for name, number in row.items()))  # noqa: T201
    for i, (group, (kind, data, count)) in enumerate(sorted(faults.items())):
        file = given.out / f"{kind}-{given.seed}-{i}"
        file.write_bytes(minimised(kind, data, group))
        print(f"{count:5} x {group}\n        {file}")  # noqa: T201
    most = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    print(f"{sum(counts.values()):,} inputs, {len(faults)} groups of faults, at most {most:,.0f} MB")  # noqa: T201
    return int(bool(faults))


if __name__ == "__main__":
    sys.exit(main())
