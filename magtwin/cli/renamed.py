"""Names of commands and options in the previous release, and what they are called now."""

from cyclopts.exceptions import CycloptsError, UnknownOptionError

COMMANDS = {
    ("runs",): "sweep",
    ("rerun-of",): "reproduce",
    ("net",): "network",
    ("map", "check"): "map validate",
    ("map", "continue"): "map upward",
}
"""Commands by the words of their old name."""

OPTIONS = {
    **dict.fromkeys(("--rrd", "--parquet", "--bag", "--csv", "--usd"), "--out FILE"),
    "--columns": "--keep",
    "--against": "--overlay",
    "--align": "--alignment",
    "--density": "--density-kg-m3",
    "--dest": "--out",
    "--duration": "--duration-s",
    "--field-unit": "--unit",
    "--heading-error": "--heading-error-deg",
    "--headings": "--headings-deg",
    "--height": "--height-m",
    "--exact": "--truth",
    "--keep-latched": "--keep-stuck",
    "--latency": "--latency-s",
    "--lever-arm": "--lever-arm-m",
    "--mass": "--mass-kg",
    "--net": "--network",
    "--no-magnetometer": "--magnetometer none",
    "--no-view": "--no-live",
    "--offset": "--offset-s",
    "--onnx": "--out",
    "--position-error": "--position-error-m",
    "--profile": "--target",
    "--ridge": "--penalty",
    "--spacing": "--spacing-m",
    "--speed": "--pace",
    "--stamped-commands": "--commands TwistStamped",
    "--time": "--time-s",
    "--to-urdf": "--out FILE.urdf",
    "--topic": "--remap OURS:=THEIRS",
    "--units": "--out-unit",
    "--view": "--live",
    "--what": "--quantity",
    "--within": "--within-m",
}
"""Options by their old name; looked up if a command has no such option."""

OF_COMMAND = {
    ("ros", "--name"): "--node-name",
    ("ros", "--profile"): "--out-unit nT",
    ("ros", "--robot"): "--asset",
}
"""Options that differ by the first word of the command."""


def renamed(error: CycloptsError, arguments: list[str]) -> str:
    """A line with the new name of the command or option that an error found unknown; "" if there is none."""
    words = tuple(word for word in arguments if not word.startswith("-"))
    if isinstance(error, UnknownOptionError):
        option = "--" + (error.token.keyword or error.token.value).lstrip("-").partition("=")[0]
        new = OF_COMMAND.get((words[0] if words else "", option)) or OPTIONS.get(option)
        return f"{option} is called {new} now" if new else ""
    for old, command in COMMANDS.items():
        if words[: len(old)] == old:
            return f"magtwin {' '.join(old)} is called magtwin {command} now"
    return ""
