"""`magtwin net`: work with networks."""

from pathlib import Path

from cyclopts import App

from magtwin.cli.app import app
from magtwin.cli.terminal import Force, check_suffix, print_report, say

net_app = App(name="net", help="Work with networks.")
app.command(net_app)


@net_app.command(name="convert")
def net_convert(pth: Path, *, out: Path, force: Force = False) -> None:
    """Convert a released checkpoint (.pth) to safetensors, executing nothing of what it holds.

    Parameters
    ----------
    pth
        Checkpoint with the weights and the two scalers.
    out
        File to write, .safetensors.
    force
        Replace the file if it exists.
    """
    from magtwin.learn.model import convert

    check_suffix(out, (".safetensors",), "a network")
    net = convert(pth, out, force=force)
    print_report(net.report(str(out)), as_json=False)
    say(f"Wrote {out}")
