"""`magtwin network`: convert and export networks."""

from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from magtwin.cli.app import app
from magtwin.cli.options import Force, Licence
from magtwin.cli.terminal import Done, check_output, step

net_app = App(name="network", help="Convert and export networks.")
app.command(net_app)


@net_app.command(name="convert")
def net_convert(pth: Path, *, out: Path, licence: Licence = "", force: Force = False) -> Done:
    """Convert a released checkpoint (.pth) to safetensors, without executing its content.

    Parameters
    ----------
    pth
        Checkpoint with the weights and the two scalers.
    out
        File to write, .safetensors.
    licence
        Licence of the weights, an SPDX identifier such as MIT, kept in their metadata.
    """
    from magtwin.learn.models.network import convert

    check_output(out, (".safetensors",), "a network", force=force)
    step("Reading the checkpoint")
    net = convert(pth, out, licence=licence, force=force)
    return Done(net.report(str(out)), out)


@net_app.command(name="export")
def net_export(weights: Path, *, out: Path, force: Force = False) -> Done:
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

    check_output(out, (".onnx",), "an ONNX file", force=force)
    step("Exporting the network")
    report = export_onnx(weights, out, force=force)
    return Done(report, out)


@net_app.command(name="widen")
def net_widen(
    weights: Path,
    *,
    runs: Annotated[list[Path], Parameter(consume_multiple=True)],
    map: Path,  # noqa: A002
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
    map
        Map that the weights were trained on: a layer or stage, or a folder of survey CSVs.
    out
        File to write, .safetensors. A model card beside the weights is carried over.
    """
    from magtwin.tasks.learning import widen

    check_output(out, (".safetensors",), "a network", force=force)
    step("Reading the recordings")
    return Done(widen(weights, runs, anomaly_map=map, out=out, force=force).report(str(out)), out)
