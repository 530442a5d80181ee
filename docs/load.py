"""Draw the figure of docs/load.md, and print its numbers: a minute of calibration with a magnet on board.

python docs/load.py
"""

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import magtwin as mt
from magtwin.figures.style import styled
from magtwin.files.file import shipped
from magtwin.learn.data.alignment import alignment_of
from magtwin.learn.data.labels import labelled
from magtwin.learn.inference.magnetometer import NeuralMagnetometer
from magtwin.path import loops, path_named
from magtwin.report.verdict import Z_90

LOAD_NT = (420.0, -390.0, 695.0)
"""Field of the load at the magnetometer, 900 nT, in base_link axes."""

MINUTE_S = 60.0


def load(columns, robot, rng):
    """The field of a magnet that does not move on the robot."""
    return np.tile(LOAD_NT, (len(columns["t"]), 1))


@styled
def draw(run, label, readings):
    """Measured and predicted field of the robot over time."""
    figure = Figure(figsize=(8.0, 5.4), layout="constrained")
    axes = figure.subplots(2, 1, sharex=True, sharey=True)
    for axis, (name, read) in zip(axes, readings.items(), strict=True):
        t, width = run["t"], Z_90 * read.stated_sd_nt
        axis.fill_between(
            *(t, read.disturbance_nt - width, read.disturbance_nt + width),
            alpha=0.25,
            linewidth=0,
            label="90 % interval",
        )
        axis.plot(t, read.disturbance_nt, label="predicted")
        axis.plot(t, label, "k", linewidth=0.8, label="measured less the map")
        axis.axvspan(0, MINUTE_S, color="0.5", alpha=0.12)
        axis.set_title(name, loc="left")
        axis.set_ylabel("field of the robot [nT]")
        axis.margins(x=0)
    figure.legend(*axes[0].get_legend_handles_labels(), ncols=3, loc="outside lower center", frameon=False)
    axes[1].text(MINUTE_S / 2, 0.03, "the minute", ha="center", transform=axes[1].get_xaxis_transform())
    axes[1].set_xlabel("time [s]")
    return figure


def main():
    """Drive with the load, predict before and after calibration, draw and print."""
    field = mt.load_map(shipped("maps", "lab", "lab.usdc"))
    minute, after = loops(), path_named("curvilinear")
    ways = [way.at(np.linspace(0, length, 1000)) for way, length in ((minute, 13.5), (after, after.length))]
    options = {"magnetometer": "physical", "rate_hz": 10.0, "seed": 3}
    run = mt.simulate("lab", np.vstack(ways), interference=[load], **options)
    model = mt.load_predictor(shipped("weights", "turtlebot4_mixed.safetensors"))
    today = mt.calibrate(None, run, anomaly_map=field, duration_s=MINUTE_S)
    exact = labelled(run, field, alignment_of(model.metadata))
    late = (run["t"] > MINUTE_S) & np.isfinite(exact["label_nt"])
    naive = np.mean(np.abs(exact["label_nt"] - model.metadata["label_mean_nt"])[late])
    readings = {}
    for name, each in (
        ("before: trained on other robots of its type", model.open_loop()),
        ("after a minute", today),
    ):
        read = NeuralMagnetometer(each).read([exact], known=[True], outside=False)[0]
        error = np.abs(read.disturbance_nt - exact["label_nt"])[late]
        held = np.mean(error < Z_90 * read.stated_sd_nt[late])
        readings[name] = read
        ratio = error.mean() / naive
        sys.stdout.write(
            f"{name}: {error.mean():.0f} nT, {ratio:.2f} of naive, {held:.0%} in 90 % intervals\n"
        )
    draw(run, exact["label_nt"], readings).savefig(Path(__file__).with_name("load.png"), dpi=110)


if __name__ == "__main__":
    main()
