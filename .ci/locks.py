"""Locks with hashes, a list of licences, and a bill of materials (CycloneDX).

    python .ci/locks.py             write locks/*.txt anew (needs uv: `python -m pip install uv`)
    python .ci/locks.py --check     compare locks with pyproject.toml and constraints.txt, offline
    python .ci/locks.py --bill DIR  write licences.md and sbom.json of this environment into DIR

`locks/default.txt` is the default install; each other file is what an extra adds. They are made for Python
3.11 on Linux, with PyTorch for the CPU, and have the hashes of all files of each version.
"""

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from importlib.metadata import Distribution, distributions
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LOCKS = ROOT / "locks"
NOT_LOCKED = ("all", "simready")  # the first is the sum of others, the second has an environment of its own
PIN = re.compile(r"^([A-Za-z0-9._-]+)==([^\s;]+)", re.MULTILINE)


def normal(name: str) -> str:
    """The name of a package as registries compare it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def pins(path: Path) -> dict[str, str]:
    """Versions by name in a lock or in the constraints, without the build that follows a `+`."""
    return {normal(name): version.partition("+")[0] for name, version in PIN.findall(path.read_text())}


def project() -> dict[str, list[str]]:
    """Requirements of the default install ("default") and of each extra that is locked."""
    table = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = table["optional-dependencies"]
    return {"default": table["dependencies"]} | {k: v for k, v in extras.items() if k not in NOT_LOCKED}


def write() -> None:
    """Resolve each lock, and leave out of those of extras what the default install has."""
    uv = os.environ.get("UV") or shutil.which("uv") or str(Path(sys.executable).with_name("uv"))
    LOCKS.mkdir(exist_ok=True)
    default: set[str] = set()
    for name in project():
        command = [uv, "pip", "compile", "-q", "pyproject.toml", "-c", "constraints.txt", "--generate-hashes"]
        command += ["--python-version", "3.11", "--no-header", "--no-annotate"]
        command += [] if name == "default" else ["--extra", name]
        text = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout
        entries = re.split(r"^(?=\S)", text, flags=re.MULTILINE)
        entries = [entry for entry in entries if entry.strip() and entry not in default]
        if name == "default":
            default = set(entries)
        added = "" if name == "default" else f"# What the extra {name} adds to default.txt.\n"
        (LOCKS / f"{name}.txt").write_text(added + "".join(entries))


def faults() -> Iterator[str]:
    """Where locks, pyproject.toml and constraints.txt disagree."""
    known = pins(ROOT / "constraints.txt")
    default = pins(LOCKS / "default.txt")
    for name, requirements in project().items():
        path = LOCKS / f"{name}.txt"
        if not path.is_file():
            yield f"locks/{name}.txt is missing"
            continue
        locked = pins(path)
        for package, version in locked.items():
            if known.get(package) != version:
                yield f"locks/{name}.txt: {package} {version}, constraints.txt has {known.get(package)}"
        hashed = re.findall(
            r"^(\S+?)==[^\n]*\\\n\s+--hash=sha256:[0-9a-f]{64}", path.read_text(), re.MULTILINE
        )
        yield from (f"locks/{name}.txt: {p} has no hash" for p in locked if p not in map(normal, hashed))
        for requirement in requirements:
            package = normal(re.split(r"[\[<>=!~;\s]", requirement)[0])
            if package not in {*locked, *default, "magtwin"}:
                yield f"locks/{name}.txt lacks {package}"
    torch = re.search(r"^torch==(\S+)", (LOCKS / "default.txt").read_text(), re.MULTILINE)
    if torch is None or not torch[1].endswith("+cpu"):
        yield "locks/default.txt: torch is not the build for the CPU; let uv find that (UV_FIND_LINKS)"


def licence(package: Distribution) -> str:
    """The licence of an installed package: its identifier, else what its metadata call it."""
    about = package.metadata
    classes = [c.rpartition(" :: ")[2] for c in about.get_all("Classifier", []) if c.startswith("License ::")]
    text = about.get("License-Expression") or ", ".join(classes) or about.get("License") or "not stated"
    for words, name in (("Permission is hereby granted", "MIT"), ("Redistribution and use", "BSD")):
        text = name if words in text else text
    return text.strip().splitlines()[0]


def bill(folder: Path) -> list[str]:
    """Write the licences and the bill of materials of this environment; gives what is under the GPL."""
    folder.mkdir(parents=True, exist_ok=True)
    packages = {normal(p.metadata["Name"]): p for p in distributions()}
    rows = [(name, p.version, licence(p)) for name, p in sorted(packages.items()) if name != "magtwin"]
    lines = [
        "| package | version | licence |",
        "|---|---|---|",
        *("| " + " | ".join(row) + " |" for row in rows),
    ]
    (folder / "licences.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    parts = [
        {
            "type": "library",
            "name": name,
            "version": version,
            "purl": f"pkg:pypi/{name}@{version.replace('+', '%2B')}",
            "licenses": [{"license": {"name": words}}],
        }
        for name, version, words in rows
    ]
    version = packages["magtwin"].version
    about = {"component": {"type": "application", "name": "magtwin", "version": version}}
    sbom = {
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "version": 1,
        "metadata": about,
        "components": parts,
    }
    (folder / "sbom.json").write_text(json.dumps(sbom, indent=1) + "\n", encoding="utf-8")
    print(f"{len(rows)} packages in {folder}")
    return [name for name, _, words in rows if re.search(r"\bA?GPL|GNU (Affero )?General", words)]


def main() -> int:
    """Do what the arguments ask for; 1 if a lock is not current."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--bill", type=Path)
    given = parser.parse_args()
    if given.bill:
        strict = bill(given.bill)
        print("\n".join(f"{name} is under the GPL: no user of magtwin may need it" for name in strict))
        return int(bool(strict))
    if given.check:
        found = list(faults())
        print(
            "\n".join([*found, "python .ci/locks.py writes the locks anew"])
            if found
            else "The locks are current"
        )
        return int(bool(found))
    write()
    return 0


if __name__ == "__main__":
    sys.exit(main())
