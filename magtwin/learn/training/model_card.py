"""Card: what a model is, on what it was trained, how it does and how to repeat it, in Markdown."""

import math
import textwrap
from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING

from magtwin.learn.data.split import PARTS

if TYPE_CHECKING:
    from magtwin.learn.training.result import Trained

MOST_NAMES = 40
"""Paths, and recordings of the test, that a card tells of one by one."""

NOUNS: Mapping[str, str] = MappingProxyType(
    {
        "mlp": "A multilayer perceptron, float32",
        "linear": "A linear model by ridge regression",
        "hybrid": "A linear base by ridge regression and a small network for what it leaves",
        "ensemble": "An ensemble of perceptrons with a mean and a variance each, float32",
        "tcn": "A temporal network of causal convolutions with a mean and a variance, float32",
    }
)
"""What a card calls each kind."""


def card_of(trained: "Trained", name: str, checksum: str) -> str:
    """The card of a model that was trained.

    Args:
        trained: The model with its errors.
        name: Of the weights file.
        checksum: Its SHA-256.
    """
    net, metadata = trained.net, trained.net.metadata
    what = (
        "Predicts what a robot adds to a map of the magnetic field at its magnetometer [nT]. "
        f"{NOUNS[net.kind]}: {net.layers_text}, {net.parameters_count:,} parameters. SHA-256 `{checksum}`."
    )
    if trained.config.licence:
        what += f" Licence: {trained.config.licence}."
    if trained.config.init is not None:
        kept = ", ".join(trained.config.freeze) or "no layer"
        what += f" It goes on from `{metadata['init']}` (SHA-256 `{metadata['init_sha256']}`), {kept} frozen."
    parts = [
        f"# {name}",
        _wrapped(what),
        _wrapped(f"Inputs: {', '.join(net.features)}."),
        _wrapped(f"**Warning: {trained.split.leak}.**") if trained.split.leak else "",
        "## Data",
        _data(trained),
        "## Errors",
        _wrapped(f"**{trained.verdict()}**"),
        _wrapped(_how(trained)),
        _table(trained),
        _wrapped(_spread(net.kind)),
        "## To repeat it",
        _repeat(trained, name),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def _data(trained: "Trained") -> str:
    metadata, split = trained.net.metadata, trained.split
    counts = ", ".join(f"{len(split.names(part))} in {part}" for part in PARTS)
    names = ", ".join(split.test[:MOST_NAMES])
    names += f" and {len(split.test) - MOST_NAMES} more" if len(split.test) > MOST_NAMES else ""
    dataset, field = (_plain(str(metadata[key])) for key in ("dataset", "map"))
    label = f"{trained.label_mean_nt:.1f} +- {trained.label_sd_nt:.1f} nT"
    points = (
        f"Data set `{dataset}`, SHA-256 of its manifest `{metadata['dataset_sha256']}`.",
        f"Labelled on the map `{field}`, SHA-256 `{metadata['map_sha256']}`: what was measured less the map, "
        f"at "
        f"a lever arm of {metadata['lever_arm_m']} m and a latency of {metadata['latency_s']:g} s.",
        f"{trained.rows:,} training rows, labels {label}.",
        f"Recordings split by {split.by}: {counts}.",
        f"Test: {names}.",
    )
    return "\n".join(_wrapped(point, bullet=True) for point in points)


def _how(trained: "Trained") -> str:
    """What the figures of the table are, and what validation was for."""
    best, chosen = trained.best, "Validation calibrated the intervals; "
    if best is not None:
        chosen = f"Validation chose the epoch that was kept, {best.number} of {trained.history[-1].number}; "
    if trained.choice:
        chosen += f"{trained.choice.text()}; "
    return (
        "Of the total field at the sensor [nT]. Naive: the mean training label on every row. Ridge: Tolles "
        "and Lawson's terms (heading harmonics, speed, turning, current, LiDAR) by ridge regression on the "
        "same training rows. Within 90 %: the share of rows inside the predicted interval of 90 %. "
        f"{chosen}the test was looked at once."
    )


def _table(trained: "Trained") -> str:
    """Errors by part, and of the test by path."""
    before = trained.config.init is not None
    heads = ["rows of", "recordings", "rows", "MAE", "RMSE", "naive MAE", "naive RMSE", "MAE / naive"]
    heads += ["ridge MAE", "ridge RMSE", "within 90 %", *(["MAE before"] if before else [])]
    lines = [_line(heads), _line(["---"] * len(heads))]
    shown = trained.paths[:MOST_NAMES] if len(trained.paths) > 1 else ()
    for one in (*trained.parts, *shown):
        errors = (one.mae_nt, one.rmse_nt, one.naive_mae_nt, one.naive_rmse_nt)
        cells = [one.name, f"{one.recordings:,}", f"{one.rows:,}", *(f"{e:.1f}" for e in errors)]
        cells += [f"{one.ratio:.3f}", f"{one.ridge_mae_nt:.1f}", f"{one.ridge_rmse_nt:.1f}"]
        cells += ["-" if math.isnan(one.coverage) else f"{one.coverage:.3f}"]
        lines.append(_line([*cells, *([f"{one.before_mae_nt:.1f}"] if before else [])]))
    if len(trained.paths) > MOST_NAMES:
        lines.append(f"\nThe first {MOST_NAMES} of {len(trained.paths)} paths are shown.")
    return "\n".join(lines)


def _spread(kind: str) -> str:
    """How wide the intervals are and why."""
    alike = "Rows of a recording are alike: the spread of these errors is that between recordings, not rows."
    if kind == "mlp":
        return (
            "The intervals are those of the RMSE on validation. The file keeps the RMSE of the test as "
            "`residual_sd_nt`, which is the standard deviation of a prediction, the `b_sd_nt` of a Run. "
            f"{alike}"
        )
    return (
        "The standard deviation of a prediction is its own, row by row, and the `b_sd_nt` of a Run; it was "
        "scaled so that intervals of 90 % hold 90 % on recordings left out, none of them the test's. The "
        f"file keeps the RMSE of the test as `residual_sd_nt`. {alike}"
    )


def _repeat(trained: "Trained", name: str) -> str:
    metadata = trained.net.metadata
    by = f"magtwin {metadata['magtwin']}"
    if "torch" in metadata:
        by += f", torch {metadata['torch']}, with --threads {metadata['threads']} on {metadata['device']}"
    command = f"magtwin train {_plain(str(metadata['dataset']))} --config F.toml --out {name}"
    said = _wrapped(f"{by}, and as `F.toml` in `{command}`:")
    return f"{said}\n\n```toml\n{str(metadata['config']).rstrip()}\n```"


def _wrapped(text: str, *, bullet: bool = False) -> str:
    """Text in lines of 110 letters, no word of it broken."""
    first, later = ("* ", "  ") if bullet else ("", "")
    return textwrap.fill(
        text,
        110,
        initial_indent=first,
        subsequent_indent=later,
        break_long_words=False,
        break_on_hyphens=False,
    )


def _plain(text: str) -> str:
    """A name from a data set, without what would end a cell, a line or a code of Markdown."""
    return "".join(" " if c in "|`<>" or not c.isprintable() else c for c in text)


def _line(cells: list[str]) -> str:
    return f"| {' | '.join(map(_plain, cells))} |"
