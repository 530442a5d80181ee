"""Type the commands of README and of docs/tour.md in an empty folder, and check the output that they quote.

    python tests/readme.py [--keep FOLDER] [--first TEXT]

`make readme` runs it. Every line of their shell blocks is run as it stands, but for `CHANGES`, which
shorten live commands and give them keys, and `LEFT_OUT`, which need a window or the network. Python blocks
are run in the same folder. Blocks of the language `text` are quoted output: the commands before must have
printed each line, with numbers at most `NEAR` off. my_robot.urdf, which a reader brings along, is that of
docs/own.md. The folder `aprilab`, which README fetches, is taken from the real data beside the checkout; its
commands are left out where these are absent.

Then the promises of the first run and of section 3 are checked, see `check_first_run` and `check_training`.
"""

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
REAL = ROOT.parent / "shared" / "data"

PAGES = ("README.md", "docs/tour.md")

LEFT_OUT = {
    r"make ": "CI runs it by itself",
    r"git clone ": "this is the checkout",
    r"magtwin view ": "needs a window",
    r"magtwin fetch ": "needs the network; the folder is copied from the real data",
}
"""Commands that are not run, and why."""

CHANGES = (
    (r"^(magtwin drive .*)$", r"printf wwwaq | \1 --no-live"),
    (r"^(magtwin ros sim .*)$", r"\1 --duration-s 40 > sim.txt 2>&1 & sleep 5"),
    (r"^(magtwin ros (?:magnetometer|record) .*)$", r"\1 --duration-s 4"),
    (r"^(magtwin ros follow .*)$", r"timeout -s INT 6 \1; test $? = 124"),  # it drives until it is stopped
)
"""Live commands: what is run in their place."""

NEAR = 0.1
"""Relative error up to which a printed number is the one that README quotes."""

SEEDS = 10
"""Seeds of the first run that are tried, on each named path."""

MOST_NT, MOST_RATIO, HELD = 200.0, 0.45, (0.8, 0.97)
"""Promises: mean absolute error of a first run [nT], error of a trained hybrid by the naive one, and share of
readings within 90 % intervals."""


def steps() -> Iterator[tuple[str, str]]:
    """Commands ("run"), Python blocks ("python") and lines of output ("text") of the pages, in order."""
    text = "".join((ROOT / page).read_text(encoding="utf-8") for page in PAGES)
    for language, block in re.findall(r"^```(\w*)\n(.*?)^```", text, re.MULTILINE | re.DOTALL):
        if language == "python":
            yield "python", block
            continue
        for line in block.splitlines():
            if line.strip():
                yield ("text" if language == "text" else "run"), line.strip()


def reason_to_skip(line: str, folder: Path) -> str:
    """Why a command is not run; "" if it is."""
    if "aprilab" in line and not (folder / "aprilab").exists():
        return "the real data are absent"
    return next((why for pattern, why in LEFT_OUT.items() if re.match(pattern, line)), "")


def type_all(folder: Path, first: str) -> None:
    """Run all; ends the process with 1 at the first command that fails or prints something else."""
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    environment = {**os.environ, "PATH": path}
    environment.pop("COLUMNS", None)
    printed: list[str] = []
    skipping = bool(first)
    for kind, text in steps():
        skipping = skipping and first not in text
        if kind == "text":
            if not skipping and not any(near(text, line) for line in printed):
                sys.exit("a page quotes a line that was not printed:\n" + "\n".join([text, "", *printed]))
            continue
        line = text
        if kind == "python":
            (folder / "block.py").write_text(text, encoding="utf-8")
            line = "python block.py"
        why = "before --first" if skipping else reason_to_skip(line, folder)
        if why:
            print(f"left out ({why}): {line}")
            continue
        for pattern, instead in CHANGES:
            line = re.sub(pattern, instead, re.sub(r"\s+#.*$", "", line))
        print(f"$ {line}", flush=True)
        start = time.monotonic()
        out = folder / "out.txt"
        with open(out, "w", encoding="utf-8") as file:
            done = subprocess.run(
                ["bash", "-c", line], cwd=folder, env=environment, stdout=file, stderr=file, timeout=1200
            )
        told = out.read_text(encoding="utf-8").splitlines()
        if done.returncode:
            sys.exit("\n".join([*told, f"failed with {done.returncode}: {line}"]))
        printed = [*printed, *told][-500:]
        verdicts = [row for row in told if re.search(r"\b(Better|WORSE|No better) than\b", row)]
        print(f"  {time.monotonic() - start:.1f} s", *verdicts, sep="\n  ", flush=True)


def near(quoted: str, line: str) -> bool:
    """Whether a printed line is the quoted one, but for small differences of its numbers."""
    number = r"\d[\d,]*\.?\d*"
    if re.sub(number, "#", quoted).split() != re.sub(number, "#", line).split():
        return False
    pairs = zip(re.findall(number, quoted), re.findall(number, line), strict=True)
    values = [(float(a.replace(",", "")), float(b.replace(",", ""))) for a, b in pairs]
    return all(abs(a - b) <= NEAR * max(abs(a), abs(b)) for a, b in values)


def check_first_run(folder: Path) -> None:
    """The lab's neural magnetometer errs by at most `MOST_NT` on each named path, and its intervals hold."""
    from magtwin.path import PATHS
    from magtwin.report.verdict import Tally
    from magtwin.twin import open_twin, sweep

    twin = open_twin(folder / "lab" / "lab.usda")
    failed = False
    for name in PATHS:
        tally = Tally()
        for run in sweep(twin, name, range(SEEDS), rate_hz=20.0):
            run.add_to(tally)
        mae, held = tally.error_nt / tally.readings, tally.within / tally.with_sd
        naive = tally.naive_nt / tally.readings
        print(f"{name:<18} MAE {mae:4.0f} nT, naive {naive:4.0f} nT, {held:.0%} within 90 % intervals")
        failed |= not (mae <= MOST_NT and HELD[0] <= held <= HELD[1])
    if failed:
        sys.exit(f"a first run: at most {MOST_NT:g} nT and {HELD[0]:.0%} to {HELD[1]:.0%} within intervals")


def check_training(folder: Path) -> None:
    """Section 3 ends in at most `MOST_RATIO` of the naive error on each case, and in intervals that hold."""
    told = json.loads((folder / "report" / "evaluation.json").read_text(encoding="utf-8"))
    failed = False
    for case in told["cases"]:
        score = case["models"]["f"]
        print(f"case {case['name']:<5} ratio to naive {score['ratio']:.3f}, coverage {score['coverage']:.0%}")
        failed |= case["name"] in "ABCDE" and not score["ratio"] <= MOST_RATIO
        failed |= case["name"] == "all" and not HELD[0] <= score["coverage"] <= HELD[1]
    if failed:
        sys.exit(f"section 3: at most {MOST_RATIO} of naive, {HELD[0]:.0%} to {HELD[1]:.0%} within intervals")


def bring(folder: Path) -> None:
    """Put what a reader has of their own into the folder."""
    page = (ROOT / "docs" / "own.md").read_text(encoding="utf-8")
    urdf = re.findall(r"^```xml\n(.*?)^```", page, re.MULTILINE | re.DOTALL)[0]
    (folder / "my_robot.urdf").write_text(urdf, encoding="utf-8")
    if REAL.is_dir():
        for name, of in (("map", "maps"), ("models", "models"), ("paths", "paths")):
            shutil.copytree(REAL / "aprilab" / of, folder / "aprilab" / name)


def main() -> None:
    """Read options, type, check."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--keep", type=Path, help="folder to work in and keep; default: a temporary one")
    parser.add_argument("--first", default="", help="begin at the command that holds this text, in --keep")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as aside:
        folder = (given.keep or Path(aside)).resolve()
        folder.mkdir(exist_ok=True)
        if not given.first:
            bring(folder)
        type_all(folder, given.first)
        check_first_run(folder)
        check_training(folder)


if __name__ == "__main__":
    main()
