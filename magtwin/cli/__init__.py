"""The command line: one typed function for each command. Commands parse, call a public function and print."""

import gc
import sys
from importlib import import_module

from magtwin.cli import app as application
from magtwin.cli.help import FLAGS, front, listing
from magtwin.cli.words import GROUPS, as_of_today

MODULES = {
    "bench": ("bench",),
    "compare": ("runs.report",),
    "completion": ("doctor",),
    "convert": ("runs.file",),
    "dataset": ("learn.dataset",),
    "demo": ("runs.run",),
    "doctor": ("doctor",),
    "drive": ("runs.drive",),
    "evaluate": ("learn.evaluate",),
    "export": ("scenes.export",),
    "fetch": ("runs.file",),
    "info": ("runs.file",),
    "localize": ("localize",),
    "map": ("maps.fit", "maps.look"),
    "model": ("learn.model", "learn.compensate"),
    "new": ("scenes.scene",),
    "plot": ("runs.plot",),
    "report": ("runs.report",),
    "reproduce": ("runs.report",),
    "robot": ("scenes.robot",),
    "ros": ("ros", "localize"),
    "run": ("runs.run",),
    "scene": ("scenes.scene",),
    "schema": ("scenes.schema",),
    "sweep": ("runs.sweep",),
    "train": ("learn.train",),
    "validate": ("scenes.validate",),
    "view": ("runs.file",),
}
"""Modules that register each command; the others stay unloaded while it runs."""


GARBAGE = 50_000
"""New objects after which Python looks for circles: the default of 700 takes a tenth of a short command."""


def main(arguments: list[str] | None = None) -> None:
    """Run the `magtwin` command; `arguments` default to those of the command line."""
    arguments = as_of_today(sys.argv[1:] if arguments is None else arguments)
    gc.set_threshold(GARBAGE)
    name = arguments[0] if arguments else "-h"
    group = name.lower() if name.title() in GROUPS and FLAGS & set(arguments) else ""
    if name in FLAGS:
        application.main(arguments, tell=front)
    elif name.startswith("-") or name in MODULES:
        load(name if name in MODULES and name != "completion" else None)
        application.main(arguments)
    elif group or name == "help":
        load()
        application.main(arguments, tell=lambda: listing(application.app, group))
    else:
        application.main(arguments, tell=lambda: application.refuse_command(arguments))


def load(command: str | None = None) -> None:
    """Register one command, or all."""
    for name in MODULES if command is None else (command,):
        for module in MODULES[name]:
            import_module(f"magtwin.cli.{module}")
    application.share_options()


__all__ = ["load", "main"]
