"""Help: the first page, and what `-h` and `--help` show of a command: examples, and options in panels."""

import re
from functools import cache
from pathlib import Path
from typing import Any

from cyclopts import App, Group

from magtwin.cli.words import GROUPS

FLAGS = {"--help", "-h"}

PANELS = {
    "Input": "scene spec file files run runs urdf sources before after a b folders suite data dataset "
    "weights pth map map_layer network recorded reading about earth train overlay calibration "
    "path column config init",
    "Robot": "robot lab fit engine speed session sessions plant controllers package arg drive profile "
    "fix_base merge_fixed single_file skip_missing_includes strict gamepad laps continuous asset "
    "controller duration_s",
    "Sensor": "magnetometer rate_hz lidar scans model_error sensor odometry readings heading_error_deg "
    "height_m position_error_m lever_arm_m latency_s online measured",
    "Options": "",
    "Node": "where sim_time commands stamps frame_prefix tf topic settings",
    "Output": "out force report thumbnail onnx out_unit usd_fps live size fps pace no_tracks licence name "
    "created",
    "Common": "json quiet",
}
"""Panels of options, by the names of parameters; all others are in Options."""

_GROUPS = {panel: Group(panel, sort_key=k) for k, panel in enumerate(PANELS)}
_OF = {name: _GROUPS[panel] for panel, names in PANELS.items() for name in names.split()}

FRONT = """\
Usage: magtwin COMMAND [ARGUMENTS] [OPTIONS]

Magnetic digital twins of labs and robots: what would the magnetometer read?

{groups}

magtwin demo            begin here: a lab, a drive, its page and its pictures
magtwin help            what each command does, in a line
magtwin help plot       a command, whole; magtwin plot -h is short
magtwin help look       a group
magtwin --version, -V

Each command takes --json, --quiet (-q), --debug (the traceback of a refusal),
--allow DIR (inputs may name files in that folder too). Options can be set in
magtwin.toml and in the environment (MAGTWIN_RUN_SEED=1). Exit status: 0 done,
1 an input was refused, 2 wrong usage."""


def panel_of(parameter: str) -> Group:
    """The panel of a parameter."""
    return _OF.get(parameter, _GROUPS["Options"])


@cache
def _examples() -> tuple[list[str], ...]:
    lines = Path(__file__).with_name("examples.txt").read_text(encoding="utf-8").splitlines()
    return tuple(line.split(" | ") for line in lines)


def examples(command: str) -> list[str]:
    """Two examples of a command, without the word magtwin; [] if there is no such command."""
    own = (made for made in _examples() if all(f"{each} ".startswith(f"{command} ") for each in made))
    return next(own, []) if command else []


def front() -> str:
    """The first page: the groups and their commands."""
    rows = (f"{group:9} {', '.join(names.split()):37} {what}" for group, (what, names) in GROUPS.items())
    return FRONT.format(groups="\n".join(rows))


def listing(app: App, group: str = "") -> str:
    """Each command of a group, or of all, with what it does."""
    return "\n\n".join(
        "\n".join([f"{name}: {what}", *(f"  {each:11} {summary(app, each)}" for each in names.split())])
        for name, (what, names) in GROUPS.items()
        if group in ("", name.lower())
    )


def summary(app: App, command: str) -> str:
    """What a command does, in a line."""
    for word in command.split():
        app = app[word]
    return app.help.strip().splitlines()[0]


class Page:
    """Prints the help of a command, with examples; of `-h` only what is typed most, and first sentences."""

    def __init__(self, command: str, *, plain: bool, short: bool) -> None:
        from cyclopts.help import DefaultFormatter, PlainFormatter

        self.command, self.short = command, short
        self.inner: Any = PlainFormatter() if plain else DefaultFormatter()

    def __call__(self, console: Any, options: Any, panel: Any) -> None:
        """Print a panel."""
        if self.short and panel.title == "Common":
            return
        for entry in panel.entries:
            if entry.default in ("False", '""', "()"):  # of a flag, or of nothing
                entry.default = None
            if self.short:
                entry.description = _first(console, entry.description, default=True)
        self.inner(console, options, panel)

    def render_usage(self, console: Any, options: Any, usage: Any) -> None:
        """Print the usage."""
        console.print(f"Usage: {str(usage).strip().removeprefix('Usage: ')}\n", markup=False)

    def render_description(self, console: Any, options: Any, description: Any) -> None:
        """Print what the command does, and its examples."""
        console.print(_first(console, description) if self.short else description)
        made = "".join(f"\n  magtwin {each}" for each in examples(self.command))
        console.print(f"{'' if not self.short else chr(10)}Examples:{made}\n" if made else "", markup=False)


def _first(console: Any, text: Any, *, default: bool = False) -> str:
    """The first sentence of a text to print, and the one that tells its default."""
    wide = console.options.update(width=100_000)
    whole = " ".join("".join(each.text for each in console.render(text, wide) if text).split())
    told = re.search(r"Default: .*", whole) if default else None
    ending = f" {told[0]}" if told else ""
    return f"{first_sentence(whole.removesuffix(ending))}{ending}".strip()


def first_sentence(text: str) -> str:
    """The first sentence of a text."""
    return re.split(r"(?<=[^.][.])(?<! al\.)\s", " ".join(text.split()), maxsplit=1)[0]
