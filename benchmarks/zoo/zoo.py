"""The robot zoo: convert public robot descriptions, validate them, compare them, and try them in an engine.

    python benchmarks/zoo/zoo.py [--from DIR] [--only NAME ...] [--jobs N] [--engine newton physx] [--docs]

`robots.toml` lists the descriptions. Each repository is fetched at its commit into build/zoo, or lies in DIR
as OWNER+NAME. A robot is a process with limits on time and memory. Its row is kept in build/zoo/rows, and a
repeat does only what is missing or has changed. `--docs` writes the table into docs/zoo.md.

NVIDIA's rules come with the extra dev; Isaac Sim's with `magtwin fetch isaac-rules`;
Newton with the extra physics; PhysX where MAGTWIN_PHYSX is the path of a Python with ovphysx (`make physx`).
"""

import argparse
import hashlib
import json
import os
import shutil
import subprocess
import sys
import tomllib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import Queue

import table
from serving import Server

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
LIST = HERE / "robots.toml"
DOCS = ROOT / "docs" / "zoo.md"
FORGE = "https://github.com"
"""Host of the repositories."""

BUILD = ROOT / "build" / "zoo"

LIMIT_S, ENGINE_LIMIT_S = 900.0, 600.0
"""Time limits of a robot, and of its trial in an engine, on an idle machine [s]."""

FIXED = ("arm", "hand")
"""Kinds that are fixed to the world."""


def checkout(source: str, commit: str, folder: Path | None, build: Path) -> Path:
    """Folder of a repository at a commit; fetched if no folder of checkouts is given."""
    place = (folder or build / "checkouts") / source.replace("/", "+")
    mark = place / ".commit"
    at = mark.read_text().strip() if mark.is_file() else ""
    if at == commit:
        return place
    if folder is not None:
        raise ValueError(f"{place} is {f'at {at}' if at else 'absent'}; wanted commit {commit}")
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir(parents=True)
    for words in (
        ["init"],
        ["fetch", "--depth", "1", f"{FORGE}/{source}.git", commit],
        ["checkout", "FETCH_HEAD"],
    ):
        subprocess.run(["git", "-C", place, "-c", "advice.detachedHead=false", *words, "-q"], check=True)
    mark.write_text(commit + "\n")
    return place


def job_of(robot: dict, commits: dict, folder: Path | None, engines: list, build: Path) -> dict:
    """The job of a robot for `robot.py`."""

    def inside(place: str) -> str:
        source, _, path = place.partition(":")
        return str(checkout(source, commits[source], folder, build) / path)

    work = build / "robots" / robot["name"]
    stem = Path(robot["path"]).name.split(".")[0]
    return {
        "urdf": inside(f"{robot['source']}:{robot['path']}"),
        "packages": {name: inside(place) for name, place in robot.get("packages", {}).items()},
        "arguments": robot.get("arguments", {}),
        "options": robot.get("options", {}),
        "fix_base": robot["kind"] in FIXED,
        "out": str(work / stem),
        "engines": engines,
        "answer": str(work / "answer.json"),
    }


def run(
    robot: dict, commits: dict, folder: Path | None, servers: dict, fresh: bool, patience: float, build: Path
) -> dict:
    """The row of a robot, kept or made; the time limits are multiplied by `patience`."""
    engines, known = [name for name in servers if name != "robot"], robot.get("known", "")
    robot = {key: value for key, value in robot.items() if key != "known"}
    kept = build / "rows" / f"{robot['name']}.json"
    key = hashlib.sha256(json.dumps([robot, commits[robot["source"]], sorted(engines)]).encode()).hexdigest()
    if kept.is_file() and not fresh:
        row = json.loads(kept.read_text())
        if row["key"] == key:
            return row | {"known": known}
    row = {"key": key, "known": known, **robot, "commit": commits[robot["source"]]}
    try:
        job = job_of(robot, commits, folder, engines, build)
        work = Path(job["answer"]).parent
        shutil.rmtree(work, ignore_errors=True)
        work.mkdir(parents=True)
        (work / "job.json").write_text(json.dumps(job))
        ended = servers["robot"].do(work / "job.json", patience * LIMIT_S)
        if Path(job["answer"]).is_file():
            row |= json.loads(Path(job["answer"]).read_text())
        else:
            row["steps_failed"] = {"process": ended}
        for name in engines if "convert_cpu_s" in row else ():
            ended = servers[name].do(work / f"{name}_job.json", patience * ENGINE_LIMIT_S)
            answer = work / f"{name}.json"
            row[name] = json.loads(answer.read_text()) if answer.is_file() else {"failed": ended}
    except (ValueError, OSError, subprocess.CalledProcessError) as error:
        row["steps_failed"] = {"source": str(error)}
    kept.parent.mkdir(parents=True, exist_ok=True)
    aside = kept.with_suffix(".part")
    aside.write_text(json.dumps(row, indent=1))
    aside.replace(kept)
    return row


def main() -> int:
    """Make the rows and print the table's summary; the status is 1 if a robot fails."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--from", dest="folder", type=Path, help="folder of checkouts, OWNER+NAME each")
    parser.add_argument("--only", nargs="+", default=[], help="names of robots")
    parser.add_argument("--jobs", type=int, default=1, help="robots at a time")
    parser.add_argument("--engine", nargs="*", choices=("newton", "physx"), default=["newton"])
    parser.add_argument("--list", type=Path, default=LIST, help="descriptions (.toml)")
    parser.add_argument("--build", type=Path, default=BUILD, help="folder of checkouts, assets and rows")
    parser.add_argument("--patience", type=float, default=1.0, help="factor of the time limits")
    parser.add_argument("--fresh", action="store_true", help="do rows again that are kept")
    parser.add_argument("--docs", action="store_true", help="write the table into docs/zoo.md")
    given = parser.parse_args()
    build = given.build.resolve()
    listed = tomllib.loads(given.list.read_text())
    robots = [r for r in listed["robot"] if not given.only or r["name"] in given.only]
    unknown = set(given.only) - {r["name"] for r in robots}
    if unknown:
        parser.error(f"no robot called {', '.join(sorted(unknown))} in {given.list.name}")
    pythons = {"newton": sys.executable, "physx": os.environ.get("MAGTWIN_PHYSX", sys.executable)}
    idle: Queue = Queue()
    for _ in range(given.jobs):
        servers = {"robot": Server(sys.executable, HERE / "robot.py")}
        idle.put(servers | {n: Server(pythons[n], HERE / f"{n}_trial.py") for n in given.engine})

    def row_of(robot: dict) -> dict:
        servers = idle.get()
        try:
            fresh, patience = given.fresh, given.patience
            return run(robot, listed["commits"], given.folder, servers, fresh, patience, build)
        finally:
            idle.put(servers)

    rows = []
    with ThreadPoolExecutor(given.jobs) as pool:
        for count, row in enumerate(pool.map(row_of, robots), 1):
            rows.append(row)
            print(
                f"{count:3d}/{len(robots)} {row['name']:18} {'; '.join(table.faults(row)) or 'good'}",
                flush=True,
            )
    while not idle.empty():
        for server in idle.get().values():
            server.close()
    (build / "zoo.json").write_text(json.dumps(rows, indent=1))
    print(table.summary(rows))
    if given.docs:
        text = DOCS.read_text()
        DOCS.write_text(table.replaced(text, rows))
    return int(any(table.faults(row) for row in rows))


if __name__ == "__main__":
    sys.exit(main())
