"""`magtwin net`: work with networks."""

from pathlib import Path

from cyclopts import App

from magtwin.cli.app import app
from magtwin.cli.terminal import Force, Json, check_suffix, print_report, say, step

net_app = App(name="net", help="Work with networks.")
app.command(net_app)


@net_app.command(name="convert")
def net_convert(pth: Path, *, out: Path, licence: str = "", force: Force = False) -> None:
    """Convert a released checkpoint (.pth) to safetensors, without executing its content.

    Parameters
    ----------
    pth
        Checkpoint with the weights and the two scalers.
    out
        File to write, .safetensors.
    licence
        Licence of the weights, an SPDX identifier such as MIT, kept in their metadata.
    force
        Replace an existing file.
    """
    from magtwin.learn.models.network import convert

    check_suffix(out, (".safetensors",), "a network")
    step("Reading the checkpoint")
    net = convert(pth, out, licence=licence, force=force)
    print_report(net.report(str(out)), as_json=False)
    say(f"Wrote {out}")


@net_app.command(name="export")
def net_export(weights: Path, *, onnx: Path, force: Force = False, json: Json = False) -> None:
    """Export a network as ONNX, which runs in onnxruntime without torch and without magtwin.

    The input is float64 features in their units, as magtwin info lists them; the outputs are the disturbance
    and the standard deviation of its error [nT]. Scalers are inside. onnxruntime is compared with torch
    before the file is written. Needs the extra onnx.

    Parameters
    ----------
    weights
        Weights, .safetensors or .pth.
    onnx
        File to write, .onnx.
    force
        Replace an existing file.
    json
        Print its content as JSON.
    """
    from magtwin.learn.inference.onnx import export_onnx

    check_suffix(onnx, (".onnx",), "an ONNX file")
    step("Exporting the network")
    report = export_onnx(weights, onnx, force=force)
    print_report(report, json)
    if not json:
        say(f"Wrote {onnx}")
