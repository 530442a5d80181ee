"""`magtwin network`: convert and export networks."""

from pathlib import Path

from cyclopts import App

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
def net_widen(weights: Path, *, out: Path, force: Force = False) -> Done:
    """Write a mixed model without a drive whose intervals hold on plants other than the nominal one.

    Its predictions are those for the nominal plant, with the spread of all plants that it was trained with.

    Parameters
    ----------
    weights
        Weights of a mixed model, .safetensors (`magtwin train --model mixed`).
    out
        File to write, .safetensors.
    """
    from magtwin.learn.inference.calibrate import mixed_of_kind
    from magtwin.learn.models.predictor import load_predictor

    check_output(out, (".safetensors",), "a network", force=force)
    model = mixed_of_kind(load_predictor(weights)).open_loop(unknown_plant=True)
    model.save(out, force=force)
    return Done(model.report(str(out)), out)
