"""Which part of the method lowers the error: maps, alignments, inputs and models in all combinations.

    python weights/factorial.py FOLDER [--shorter N]

FOLDER is the output of weights/protocol.py. The script trains a model for each combination of

    map        trilinear, harmonic
    alignment  none, fitted (lever arm and latency)
    inputs     the paper's 20 signals, the set `platform`
    model      naive (mean label; it has no inputs), ridge regression, the paper's network, hybrid

and judges all of them on the test recordings of the protocol. FOLDER/factorial.md gets the table and
FOLDER/factorial.json all figures: the MAE divided by that of the naive model on the unaligned trilinear map,
the mean of paths A to E, with 95 % intervals from a bootstrap over sessions.
"""

import argparse
import json
import math
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

from rich.console import Console

import magtwin as mt
from magtwin.files.file import sha256, shipped
from magtwin.io.map_files import open_map
from magtwin.learn.data.dataset import open_dataset
from magtwin.learn.evaluation.candidates import Candidate, candidate_of, naive, named_map

CONSOLE = Console()

ALIGNMENTS = {"none": None, "fitted": "fit"}

INPUTS = {"paper's 20": "full", "platform": "platform"}

MODELS: dict[str, dict[str, Any]] = {
    "ridge": {"model": "linear"},
    "paper's network": {"model": "paper", "epochs": 8},
    "hybrid": {"model": "hybrid", "dropout": 0.2, "lr": 3e-4, "epochs": 12},
}
"""Options of training, as in the protocol."""

FACTORS = ("map", "alignment", "inputs", "model")


def factorial(out: Path, *, shorter: int = 1) -> list[dict[str, Any]]:
    """Train and judge every combination; one row of figures each.

    Args:
        out: Output of the protocol.
        shorter: Divisor of the number of epochs.
    """
    own = out / "harmonic.usdc"
    maps = {
        "trilinear": out / "trilinear.usdc",
        "harmonic": own if own.is_file() else shipped("maps", "lab", "lab.usdc"),
    }
    named = {name: named_map(name, open_map(path), sha256(path)) for name, path in maps.items()}
    work = out / "factorial"
    candidates: list[Candidate] = []
    rows: list[dict[str, Any]] = []
    for (field, path), (aligned, alignment) in product(maps.items(), ALIGNMENTS.items()):
        folder = work / f"{field}_{aligned}"
        if not folder.exists():
            mt.build_dataset(out / "train", out=folder, anomaly_map=path, alignment=alignment)
        dataset = open_dataset(folder)
        mean = naive(named[field], dataset=dataset)
        candidates.append(replace(mean, name=f"naive, {field}, {aligned}"))
        rows.append({"map": field, "alignment": aligned, "inputs": "", "model": "naive"})
        for (inputs, features), (model, options) in product(INPUTS.items(), MODELS.items()):
            file = work / f"{field}_{aligned}_{features}_{options['model']}.safetensors"
            CONSOLE.print(f"{field} map, alignment {aligned}, {inputs} inputs, {model} ...", highlight=False)
            if not file.exists():
                epochs = {"epochs": max(options["epochs"] // shorter, 2)} if "epochs" in options else {}
                mt.train(dataset, out=file, features=features, force=True, **{**options, **epochs})
            candidates.append(candidate_of(file, [named[field]]))
            rows.append({"map": field, "alignment": aligned, "inputs": inputs, "model": model})
    evaluation = mt.evaluate(
        candidates[1:], out / "test", anomaly_map=list(maps.values()), baseline=candidates[0]
    )
    mean_case = next(case for case in evaluation.cases if case.name == "mean")
    for row, score, every in zip(rows, mean_case.scores, evaluation.every.scores, strict=True):
        row |= {
            "ratio": score.ratio,
            "ratio_interval": list(score.ratio_interval),
            "mae_nt": every.mae_nt,
            "coverage": None if math.isnan(every.coverage) else every.coverage,
        }
    return rows


def gains(rows: list[dict[str, Any]]) -> dict[str, tuple[float, float]]:
    """Factor of the error that each change alone brings: its geometric mean over the others, and the best."""
    changes = {
        "harmonic map for trilinear": ("map", "trilinear", "harmonic"),
        "fitted alignment": ("alignment", "none", "fitted"),
        "platform inputs": ("inputs", "paper's 20", "platform"),
        "paper's network for ridge": ("model", "ridge", "paper's network"),
        "hybrid for ridge": ("model", "ridge", "hybrid"),
    }
    ratio = {tuple(row[name] for name in FACTORS): row["ratio"] for row in rows}
    result = {}
    for change, (factor, before, after) in changes.items():
        at = FACTORS.index(factor)
        steps = [
            math.log(ratio[(*key[:at], after, *key[at + 1 :])] / ratio[key])
            for key in ratio
            if key[at] == before and (*key[:at], after, *key[at + 1 :]) in ratio and key[3] != "naive"
        ]
        result[change] = math.exp(sum(steps) / len(steps)), math.exp(min(steps))
    return result


def table(rows: list[dict[str, Any]]) -> str:
    """The table, and what each change brings, as Markdown."""
    lines = [
        "| map | alignment | inputs | naive | ridge | paper's network | hybrid |",
        "|---|---|---|---|---|---|---|",
    ]
    cell = {tuple(row[name] for name in FACTORS): row for row in rows}

    def shown(key: tuple[str, ...]) -> str:
        row = cell[key]
        low, high = row["ratio_interval"]
        return f"{row['ratio']:.3f} ({low:.3f} to {high:.3f})".replace("0.", ".")

    for field, aligned in product(("trilinear", "harmonic"), ALIGNMENTS):
        for inputs in INPUTS:
            first = shown((field, aligned, "", "naive")) if inputs == "paper's 20" else ""
            models = " | ".join(shown((field, aligned, inputs, model)) for model in MODELS)
            lines.append(f"| {field} | {aligned} | {inputs} | {first} | {models} |")
    lines += ["", "| change | mean factor of the error | best |", "|---|---|---|"]
    lines += [f"| {change} | {mean:.2f} | {best:.2f} |" for change, (mean, best) in gains(rows).items()]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run as given on the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("out", type=Path, metavar="FOLDER", help="output of weights/protocol.py")
    parser.add_argument("--shorter", type=int, default=1, help="divisor of the number of epochs, for a trial")
    given = parser.parse_args()
    rows = factorial(given.out, shorter=given.shorter)
    (given.out / "factorial.json").write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")
    (given.out / "factorial.md").write_text(table(rows), encoding="utf-8")
    CONSOLE.print(table(rows), markup=False, highlight=False, soft_wrap=True)


if __name__ == "__main__":
    main()
