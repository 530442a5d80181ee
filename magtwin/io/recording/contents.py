"""Contents: what a bag holds, topic by topic, and what it is fit for. Nothing in a readable bag ends it."""

import re
import warnings
from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np

from magtwin.errors import InputError
from magtwin.io.bags.bag import Bag
from magtwin.io.bags.cdr import NS, Index, Messages, decode
from magtwin.io.bags.topics import NAMES, READING
from magtwin.io.recording.frames import LEAVES
from magtwin.io.recording.run import Recording
from magtwin.io.recording.signal import STAMPS
from magtwin.io.surveys.doctor import examine
from magtwin.report.report import Figure, Report

WHOLE = 400_000_000  # Bytes of the largest bag whose field is examined as a whole; else its beginning is
BEGINNING = 100_000_000  # Bytes of the beginning of a larger bag that are examined
FIRST = 8_000_000  # Bytes of messages from whose headers frames and delays are read
ANOTHER_S = 3600.0  # Delays beyond this are those of another clock [s]
GAP = 5.0  # Intervals longer than this multiple of the median are gaps

NEXT = {
    "fit for a map": "magtwin map fit {bag} --out map.usdc",
    "fit for training": "magtwin dataset build {bag} --map map.usdc --out set",
    "fit for localization": "magtwin localize {bag} --map map.usdc --out estimate.rrd",
}
"""The command to type next, by what a recording is fit for."""


def info_of_bag(path: Path, **reading: Any) -> Report:
    """A report on a bag: its span, storage, topics and roles; and on its field and what it is fit for.

    `reading` are `topics`, `unit` and `scale` of `magtwin.io.bags.read_bag`.
    """
    with Bag(path) as bag, np.errstate(over="ignore", invalid="ignore"):
        size = sum(file.stat().st_size for file in bag.files)
        most = None if size <= WHOLE else BEGINNING
        times = bag.times()
        figures = _storage(bag, times, size)
        field, roles = _field(bag, most, reading)
        topics = _topics(bag, times, roles)
        if bag.damaged:
            figures.append(Figure("damaged", bag.damaged, "chunks or records", note="they are left out"))
    metadata = {"topics": topics, **field.metadata}
    if most is not None:
        metadata["examined"] = f"the first {most:,} bytes of its chunks"
    return Report(str(path), (*figures, *field.figures), metadata)


def _storage(bag: Bag, times: Mapping[str, Index], size: int) -> list[Figure]:
    """Duration, begin, size and storage."""
    ends = [int(each[k]) for each in times.values() if len(each) for k in (0, -1)]
    span = (max(ends) - min(ends)) / NS if ends else 0.0
    count = sum(map(len, times.values()))
    figures = [Figure("duration", float(f"{span:.6g}"), "s"), Figure("messages", count)]
    figures += [Figure("topics", len(bag.topics)), Figure("size", size, "bytes")]
    if ends:
        begin = min(ends)
        known = 0 <= begin < 253_402_300_800 * NS  # what a calendar holds
        date = f"{datetime.fromtimestamp(begin // NS, UTC):%Y-%m-%d %H:%M:%S} UTC" if known else f"{begin} ns"
        figures.append(Figure("start", date))
    codecs = {codec or "none" for reader in bag.readers for codec in reader.compression}
    packed = f"zstd, by {bag.packed}" if bag.packed else ", ".join(sorted(codecs)) or "none"
    kinds = ", ".join(sorted({file.suffix.lower().lstrip(".") for file in bag.files}))
    note = f"{len(bag.files)} files, {bag.chunks} chunks" if len(bag.files) > 1 else f"{bag.chunks} chunks"
    return [*figures, Figure("storage", kinds), Figure("compression", packed, note=note)]


def _field(bag: Bag, most: int | None, reading: Mapping[str, Any]) -> tuple[Report, dict[str, str]]:
    """What the field of a bag is like, and the topic of each role."""
    own = READING.name in bag.kinds and NAMES.name in bag.kinds and not reading
    topics = reading.get("topics") or {}
    recording, fault, told = None, "", dict[str, Any]()
    with warnings.catch_warnings(record=True) as doubts:
        warnings.simplefilter("always")
        try:
            recording = Recording(bag, topics, most=most)
            recording.read(reading.get("unit"), reading.get("scale"), summed=False)
        except InputError as error:
            fault = str(error).removeprefix(f"{bag.path}: ")
        except Exception as error:
            fault = f"it cannot be read ({type(error).__name__}: {error})"[:200]
    roles = {} if recording is None else recording.roles
    texts = [str(each.message).removeprefix(f"{bag.path}: ") for each in doubts]
    if fault:
        brief = re.split(r" \(|; ", fault)[0]
        unfit = dict.fromkeys(NEXT, f"no, because {brief}")
        return Report("", (), {**unfit, "doubts": [fault, *texts]}), roles
    assert recording is not None
    run, said = recording.run, recording.run.metadata
    told |= {"taken": said["taken"]} if "taken" in said else {}
    unit, placed = f"{said['field_unit']}, {said['field_unit_told']}", "p_world_base" in run
    report = examine(
        run.get("b_measured_nt"),
        vector_nt=run.get("b_vector_measured_nt"),
        t=run["t"],
        p_xy=run["p_world_base"][:, :2] if placed else None,
        yaw=run["yaw"] if placed else None,
        roles={role.lower() for role in roles},
        unit=unit,
    )
    fit = {use: str(report.metadata[use]) for use in NEXT}
    if texts := [*texts, *report.metadata.get("doubts", [])]:
        told["doubts"] = texts
    if own:
        told["written by"] = "magtwin; magtwin report, view and reproduce take it"
    if line := next((NEXT[use] for use in NEXT if fit[use].startswith("yes")), ""):
        fit["next"] = line.format(bag=quote(str(bag.path)))
    return replace(report, metadata={**told, **fit}), roles


def _topics(bag: Bag, times: Mapping[str, Index], roles: Mapping[str, str]) -> dict[str, str]:
    """A line for each topic: type, count, rate, gaps, frame, quality of service, delay and role."""
    readable = [name for name, topic in bag.topics.items() if topic.encoding in ("cdr", "ros1")]
    beginning = bag.messages(readable, FIRST)
    lines, role_of = {}, {name: role for role, name in roles.items()}
    for name in sorted(bag.topics):
        parts = [bag.kinds[name] or "of unknown type, as its schema is missing", f"{len(times[name]):,}"]
        parts += [_rate(times[name]), *_header(bag, name, beginning.get(name)), _qos(bag.topics[name].qos)]
        if bag.topics[name].encoding not in ("cdr", "ros1"):
            parts.append(f"encoded as {bag.topics[name].encoding or 'nothing known'}")
        parts.append(f"= {role_of[name]}" if name in role_of else "")
        lines[name] = "  ".join(part for part in parts if part)
    return lines


def _rate(times: Index) -> str:
    """Rate and gaps of messages."""
    steps = np.diff(times)
    if not len(steps) or not times[-1] > times[0]:
        return ""
    usual = float(np.median(steps))
    gaps = steps[steps > max(GAP * usual, 0.1 * NS)]
    text = f"{(len(times) - 1) / (int(times[-1]) - int(times[0])) * NS:.4g} Hz"
    return f"{text}, {len(gaps)} gaps, the longest {gaps.max() / NS:.3g} s" if len(gaps) else text


def _header(bag: Bag, name: str, messages: Messages | None) -> list[str]:
    """Frame of messages, and how long after their stamps they came; nothing if they have no header."""
    if messages is None or not len(messages):
        return []
    try:
        leaves = bag.layout(name)
        kinds = {leaf.name: leaf.kind for leaf in leaves}
        stamp = next((leaf for leaf in STAMPS if kinds.get(leaf) in ("time", "u8")), None)
        fields = decode(leaves, messages, [leaf for leaf in (*LEAVES, stamp) if leaf in kinds])
    except Exception:
        return []
    frames = [" or ".join(sorted({*fields[leaf]})[:3]) for leaf in LEAVES if fields.get(leaf)]
    parts = [f"{word} {frame}" for word, frame in zip(("in", "of"), frames, strict=False) if frame]
    if stamp is None:
        return parts
    stamps = fields[stamp].astype(np.int64) * STAMPS[stamp]
    if not stamps.any():
        return [*parts, "stamps 0"]
    late = (messages.received - stamps) / NS
    usual = float(np.median(late))
    another = abs(usual) > ANOTHER_S
    return [*parts, "stamps of another clock" if another else f"comes {usual * 1e3:.3g} ms after its stamp"]


def _qos(text: str) -> str:
    """Quality of service in words, of its YAML."""
    found = {key: re.search(rf"{key}: *(\w+)", text) for key in ("reliability", "durability", "depth")}
    told = {key: match[1] for key, match in found.items() if match}
    reliability = told.get("reliability", "")
    words = [{"1": "reliable", "2": "best effort"}.get(reliability, reliability)]
    words += ["latched"] * (told.get("durability") in ("1", "transient_local"))
    words += [f"depth {told['depth']}"] if "depth" in told else []
    return ", ".join(word.replace("_", " ") for word in words if word)
