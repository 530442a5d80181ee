"""`magtwin model`: convert, export, widen and calibrate networks; `learn.compensate` adds its own."""

from pathlib import Path
from typing import Annotated, Any

from cyclopts import App, Parameter

from magtwin.cli.app import app
from magtwin.cli.options import Flag, Force, Licence, TrainedMap, Weights, reads_recordings
from magtwin.cli.terminal import Done, named, step

model_app = App(name="model", help="Convert, export and calibrate networks; compensate the platform's field.")
app.command(model_app)


@model_app.command
def convert(pth: Path, *, out: Weights, licence: Licence = "", force: Force = False) -> Done:
    """Convert a released checkpoint (.pth) to safetensors, without executing its content.

    Parameters
    ----------
    pth
        Checkpoint with the weights and the two scalers.
    licence
        Licence of the weights, an SPDX identifier such as MIT, kept in their metadata.
    """
    from magtwin.learn.models.network import convert as convert_file

    out = named(out, (".safetensors",), "a network", force=force)
    step("Reading the checkpoint")
    net = convert_file(pth, out, licence=licence, force=force)
    return Done(net.report(str(out)), out, rest=f"magtwin info {out}")


@model_app.command
def export(weights: Path, *, out: Path, force: Force = False) -> Done:
    """Export a network as ONNX, which runs in onnxruntime without torch and without magtwin.

    The input is float64 features in their units, as magtwin info lists them; the outputs are the disturbance
    and the standard deviation of its error [nT]. Scalers are inside. onnxruntime is compared with torch
    before the file is written. Needs the extra onnx.

    Parameters
    ----------
    weights
        Weights, .safetensors or .pth.
    out
        File to write, .onnx.
    """
    from magtwin.learn.inference.onnx import export_onnx

    out = named(out, (".onnx",), "an ONNX file", force=force)
    step("Exporting the network")
    report = export_onnx(weights, out, force=force)
    return Done(report, out, rest=f"magtwin info {out}")


@model_app.command
def widen(
    weights: Path,
    *,
    runs: Annotated[list[Path], Parameter(consume_multiple=True)],
    map: TrainedMap,  # noqa: A002
    out: Path,
    force: Force = False,
) -> Done:
    """Learn how wide a model's intervals are on robots that it was not trained on.

    Predictions do not change. The new intervals hold on any robot but that of the training, which keeps its
    own.

    Parameters
    ----------
    weights
        Weights of any kind but mixed, which learns this in its training.
    runs
        Recordings of at least 4 other robots, or of plants (`magtwin sweep --plant all:1`).
    out
        File to write, .safetensors. A model card beside the weights is carried over.
    """
    from magtwin.tasks.learning import widen as widen_file

    out = named(out, (".safetensors",), "a network", beside=(".md",), force=force)
    step("Reading the recordings")
    report = widen_file(weights, runs, anomaly_map=map, out=out, force=force).report(str(out))
    return Done(report, out, rest=f"magtwin info {out}")


@model_app.command(usage="Usage: magtwin model calibrate --map PATH [OPTIONS] RUN [WEIGHTS]")
@reads_recordings
def calibrate(
    run: Path,
    weights: Path | None = None,
    *,
    map: TrainedMap,  # noqa: A002
    out: Weights = Path("calibrated.safetensors"),
    duration_s: float | None = None,
    pose_sd_m: float = 0.0,
    pose_from_map: Flag = False,
    force: Force = False,
) -> Done:
    """Calibrate a magnetometer by a labelled drive at the start of a session.

    Drive for a minute in curves to all sides, with poses of another source than the map. The new weights
    predict in that session, until the robot is switched off; their metadata name the drive and the model.
    What a drive lacks, such as a battery's current, the model does without.

    Parameters
    ----------
    run
        The drive, of any kind that `magtwin dataset build` reads.
    weights
        Weights of a mixed model, .safetensors (`magtwin train --model mixed`), before or after the drive.
        Default: turtlebot4_mixed, which ships.
    duration_s
        Length of the part to use, from the start [s]. Default: all.
    pose_sd_m
        Standard deviation of the drive's positions, each axis [m].
    pose_from_map
        The poses were estimated on the map: warn.
    """
    from magtwin.tasks.learning import calibrate as calibrate_files

    if weights is not None and run.suffix in (".safetensors", ".pth"):
        run, weights = weights, run
    out = named(out, (".safetensors",), "a network", force=force)
    step("Calibrating on the drive")
    poses: Any = {"pose_sd_m": pose_sd_m, "pose_from_map": pose_from_map}
    options: Any = {"anomaly_map": map, "duration_s": duration_s, "out": out, "force": force}
    calibrated = calibrate_files(weights, run, **poses, **options)
    return Done(calibrated.report(str(out)), out, rest=f"magtwin info {out}")
