"""Measure every table of results again, and write docs/results.md and the figures of README: `make paper`.

    python docs/results.py [--work build/paper] [--surveys aprilab/map] [--released network.pth]

Parts that `--work` contains already are not measured again. `--surveys` is the folder of the published survey
(`magtwin fetch aprilab` downloads it); without it, the tables of the second twin are left as they are in
docs/results.md.
"""

import argparse
import datetime
import json
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PAGE, README = ROOT / "docs" / "results.md", ROOT / "README.md"

PAPER = "| in the paper, the real robot | .966 | .756 | .700 | .855 | .791 | .81 | |"

BENCHMARKS = {"plants": "benchmarks/plants.py", "magnetometers": "benchmarks/unknown_plants.py"}
"""Scripts that print tables, by the block of docs/results.md that gets it."""

ROWS = {
    "turtlebot4_paper": "the paper's network, trilinear map",
    "nn_magnetometer_model_v0.0.1": "the network that APRILab released, not trained on this twin",
    "Tolles-Lawson, trilinear": "Tolles-Lawson ridge, trilinear map",
    "Tolles-Lawson, {harmonic} aligned": "Tolles-Lawson ridge, harmonic map, fitted lever arm and latency",
    "turtlebot4_hybrid": "the hybrid of magtwin, on the same map",
}
"""Models of the evaluation, and their names in the table."""


def number(value: float) -> str:
    """A ratio as the paper prints it: .769."""
    return f"{value:.3f}".removeprefix("0")


def table_1(evaluation: dict[str, Any], harmonic: str) -> str:
    """The paper's Table 1 on a twin: MAE divided by the naive MAE, by path."""
    cases = {case["name"]: case["models"] for case in evaluation["cases"]}
    lines = ["| | A | B | C | D | E | mean | MAE |", "|---|---|---|---|---|---|---|---|", PAPER]
    for key, name in ROWS.items():
        model = key.format(harmonic=harmonic)
        if model not in cases["mean"]:
            continue
        cells = [number(cases[path][model]["ratio"]) for path in "ABCDE"]
        mean = number(cases["mean"][model]["ratio"])
        low, high = cases["mean"][model]["ratio_interval"]
        mean += f" ({number(low)} to {number(high)})"
        lines.append(f"| {name} | {' | '.join(cells)} | {mean} | {cases['all'][model]['mae_nt']:.0f} nT |")
    hybrid, naive = cases["all"]["turtlebot4_hybrid"], cases["all"]["naive"]
    low, high = (100 * bound for bound in hybrid["coverage_interval"])
    held = f"{100 * hybrid['coverage']:.1f} ({low:.1f} to {high:.1f})"
    lines += [
        "",
        f"Naive MAE: {naive['mae_nt']:.0f} nT. The hybrid's 90 % intervals hold {held} % of the readings.",
    ]
    return "\n".join(lines)


def means(evaluation: dict[str, Any], harmonic: str) -> str:
    """The column `mean` of Table 1, a model a line."""
    cases = {case["name"]: case["models"] for case in evaluation["cases"]}
    models = {key.format(harmonic=harmonic): name for key, name in ROWS.items()}
    return "\n".join(
        f"- {name}: {number(cases['mean'][key]['ratio'])}, {cases['all'][key]['mae_nt']:.0f} nT"
        for key, name in models.items()
        if key in cases["mean"]
    )


def budget(evaluation: dict[str, Any]) -> str:
    """Error after the terms are closed one after the other, by model."""
    models = [
        m for m in evaluation["budget"]["models"] if m["model"] in ("turtlebot4_paper", "turtlebot4_hybrid")
    ]
    names = [term["name"] for term in models[0]["terms"]]
    lines = ["| MAE [nT] | all | " + " | ".join(f"without {name}" for name in names) + " |"]
    lines.append("|---" * (len(names) + 2) + "|")
    for model in models:
        cells = " | ".join(f"{term['mae_closed_in_turn_nt']:.0f}" for term in model["terms"])
        lines.append(f"| {model['model'].removeprefix('turtlebot4_')} | {model['mae_nt']:.0f} | {cells} |")
    return "\n".join(lines)


def put(file: Path, block: str, text: str) -> None:
    """Replace the lines between the comments `<!-- BLOCK -->` and `<!-- end -->` of a page."""
    page = file.read_text(encoding="utf-8")
    pattern = re.compile(rf"(<!-- {re.escape(block)} -->\n).*?(<!-- end -->)", re.DOTALL)
    if not pattern.search(page):
        sys.exit(f"{file}: no block {block!r}")
    file.write_text(pattern.sub(lambda found: f"{found[1]}{text}\n{found[2]}", page), encoding="utf-8")


def run(*words: object) -> str:
    """Run a script of the repository; its output goes to the terminal, and is returned."""
    process = subprocess.Popen(
        [sys.executable, *map(str, words)], cwd=ROOT, stdout=subprocess.PIPE, text=True, encoding="utf-8"
    )
    assert process.stdout is not None
    lines = []
    for line in process.stdout:
        sys.stdout.write(line)
        sys.stdout.flush()
        lines.append(line)
    if process.wait():
        sys.exit(f"{words[0]} failed")
    return "".join(lines)


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument(
        "--work", type=Path, default=ROOT / "build" / "paper", help="folder of intermediate results"
    )
    parser.add_argument("--surveys", type=Path, help="folder of the published survey")
    parser.add_argument("--released", type=Path, help="the released network")
    given = parser.parse_args()
    started = time.perf_counter()
    given.work.mkdir(parents=True, exist_ok=True)
    released = ("--released", given.released.resolve()) if given.released else ()
    labs = {"lab": ()}
    if given.surveys is not None:
        labs["aprilab"] = ("--lab", "aprilab", "--surveys", given.surveys.resolve())
    for lab, options in labs.items():
        out = given.work / lab
        if not (out / "report").is_dir():
            run("weights/protocol.py", "--out", out, *options, *released)
        if not (out / "factorial.md").is_file():
            run("weights/factorial.py", out)
        evaluation = json.loads((out / "report" / "evaluation.json").read_text(encoding="utf-8"))
        harmonic = "lab" if lab == "lab" else "harmonic"
        put(PAGE, f"table 1, {lab}", table_1(evaluation, harmonic))
        put(PAGE, f"budget, {lab}", budget(evaluation))
        put(PAGE, f"factorial, {lab}", (out / "factorial.md").read_text(encoding="utf-8").rstrip())
        if lab == "lab":
            put(README, "means", means(evaluation, harmonic))
    for block, script in BENCHMARKS.items():
        kept = given.work / f"{block}.md"
        if not kept.is_file():
            printed = run(script).splitlines()
            tables = [line for line in printed if line.startswith("|") or not line]
            kept.write_text("\n".join(tables).strip(), encoding="utf-8")
        put(PAGE, block, kept.read_text(encoding="utf-8"))
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=False
    ).stdout.strip()
    today = datetime.datetime.now(datetime.UTC).date()
    put(PAGE, "date", f"Measured on {today} with the code of commit {commit or 'unknown'}.")
    sys.stdout.write(f"docs/results.md and README.md, in {(time.perf_counter() - started) / 60:.0f} min\n")


if __name__ == "__main__":
    main()
