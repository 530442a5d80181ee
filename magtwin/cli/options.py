"""Options that several commands share: one type and one help text for each."""

import warnings
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from math import radians
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from cyclopts import Parameter

from magtwin.errors import InputError, RepairWarning


def _whole(kind: type, tokens: Any, said: str = "a whole number is wanted,") -> int:
    """A whole number; cyclopts itself would round 1.5 to 2."""
    try:
        return int(tokens[0].value)
    except ValueError:
        raise ValueError(f"{said} got {tokens[0].value!r}") from None


def _session(kind: Any, tokens: Any) -> int | str:
    """A session: its number, or "survey"."""
    said = "a session is a whole number, or survey;"
    return "survey" if tokens[0].value == "survey" else _whole(int, tokens, said)


def pairs(
    option: str, texts: list[str] | None, form: str = "NAME=VALUE", *, empty: bool = False
) -> dict[str, str]:
    """NAME=VALUE or NAME:=VALUE texts of an option as a table; `form` is shown if one is wrong."""
    table: dict[str, str] = {}
    for text in texts or ():
        name, equals, value = text.partition("=")
        name = name.removesuffix(":")
        if not (name and equals and (value or empty)) or name in table:
            raise InputError(f"--{option} takes {form}, each once, got {text!r}")
        table[name] = value
    return table


Command = TypeVar("Command", bound=Callable[..., Any])

LEAST_PACE = 0.001
"""Lowest pace: 17 minutes for a second of a run."""


def check_pace(pace: float) -> None:
    """Refuse a pace at which nothing would happen."""
    if not pace > 0:
        raise InputError(f"pace must be above 0 simulated seconds per second, got {pace:g}")
    if pace < LEAST_PACE:
        raise InputError(f"pace must be at least {LEAST_PACE:g}, got {pace:g}")


MOST_HEADINGS = 720
"""Most headings of a map."""


def headings_rad(text: str) -> list[float]:
    """Headings such as 0,90,180,270 [deg] in radians, each once, ascending; warns of repeated ones."""
    try:
        given = [float(word) % 360 for word in text.split(",")]
    except ValueError:
        given = []
    degrees = sorted(set(given))
    if not degrees or any(h != h for h in degrees):
        form = "headings are degrees with commas between, such as 0,90,180,270"
        raise InputError(f"--headings-deg: {form}; got {text!r}")
    if len(degrees) > MOST_HEADINGS:
        raise InputError(f"--headings-deg names {len(degrees):,} headings; take {MOST_HEADINGS} at most")
    if len(degrees) < len(given):
        count = f"{len(degrees)} heading{'s' if len(degrees) > 1 else ''}"
        said = f"--headings-deg {text}: {count}, as some are equal (360 is 0)"
        warnings.warn(said, RepairWarning, stacklevel=2)
    return [radians(h) for h in degrees]


Scene = Annotated[Path, Parameter(help="USD stage, or the name of a scene that ships with magtwin: lab.")]
Weights = Annotated[Path, Parameter(help="Weights to write, .safetensors.")]
TrainedMap = Annotated[
    Path,
    Parameter(help="Map that the weights were trained on: a layer or stage, or a folder of survey CSVs."),
]
Method = Annotated[
    str,
    Parameter(
        help="Name of a method, such as rbpf or odometry; or a class of your own as MODULE:CLASS, in the "
        "current folder or an installed package."
    ),
]
Sensor = Annotated[
    list[str] | None,
    Parameter(
        consume_multiple=True,
        help="Values of the magnetometer's noise model that the method is told, as NAME=VALUE: "
        "white_nt (100), drift_nt (250), drift_s (2.5), offset_nt (500), iron_nt (400), lever_arm_m "
        "(that of the run). The defaults fit the shipped robot in a new session.",
    ),
]
Odometry = Annotated[
    list[str] | None,
    Parameter(
        consume_multiple=True,
        help="Values of the odometry's noise model that the method is told, as NAME=VALUE: position_std, "
        "yaw_std, turn_std, position_std_s, yaw_std_s, scale_std. docs/localize.md has their defaults.",
    ),
]
OptionsOf = Annotated[
    list[str] | None, Parameter(consume_multiple=True, help="Options of the method, as NAME=VALUE.")
]
MapLength = Annotated[
    float, Parameter(help="Correlation length of the map's error that the method is told [m].")
]
Folder = Annotated[Path, Parameter(help="Folder to make.")]
AnyRun = Annotated[Path, Parameter(help="A run in any format that magtwin reads.")]
Whole = Annotated[int, Parameter(converter=_whole)]
Flag = Annotated[bool, Parameter(negative="")]
Names = Annotated[list[str] | None, Parameter(consume_multiple=True)]
Force = Annotated[bool, Parameter(name="--force", negative="", help="Replace outputs that exist.")]
Json = Annotated[
    bool, Parameter(name="--json", negative="", help="Print the result as one JSON document on stdout.")
]
Quiet = Annotated[
    bool, Parameter(name="--quiet", negative="", help="Print no report and no progress; errors remain.")
]
Jobs = Annotated[int | None, Parameter(converter=_whole)]
Shard = Annotated[
    str | None,
    Parameter(
        help="I/N: do every N-th part of the work, from the I-th, counted from 0; another machine does the "
        "others, into the same folder."
    ),
]
Dask = Annotated[
    str | None,
    Parameter(
        help="Let the workers of a dask cluster do the work: address of its scheduler, such as "
        "tcp://10.0.0.1:8786. Needs the extra cluster."
    ),
]
Seed = Annotated[int, Parameter(converter=_whole, help="Seed of all random draws.")]
Session = Annotated[
    int | Literal["survey"] | None,
    Parameter(
        converter=_session,
        show_choices=False,
        help="Number of the session, in which the seed draws battery charge, IMU offsets, wheels, odometry "
        "and the robot's own field; or survey, the robot as it was when the map was surveyed. Default: 0.",
    ),
]
Sessions = Annotated[int | Literal["survey"] | None, Parameter(converter=_session, show_choices=False)]
Plant = Annotated[
    str | None,
    Parameter(
        name="--plant",
        help="Effects in the robot's field that its linear platform model lacks: one of hysteresis, "
        "warm-up, nonlinear, moving-part, drawn (larger random differences between sessions), all, nominal "
        "(none). NAME:SEED draws the constants of an effect from another seed. Default: the scene's.",
    ),
]
Lab = Annotated[
    str,
    Parameter(
        name="--lab",
        help="Lab to use on a stage of several: path of its root prim, such as /Building/LabB. Default: the "
        "only lab.",
    ),
]
MapLayer = Annotated[
    Path | None,
    Parameter(
        name="--map",
        help="Map that the magnetometer reads, such as one of the same room on another day (.usdc, .usd). "
        "Default: the scene's.",
    ),
]
Network = Annotated[
    Path | None,
    Parameter(
        name="--network",
        help="Network of the magnetometer (.safetensors, .pth). none: no network, but a physical "
        "magnetometer. Default: the scene's.",
    ),
]
Magnetometer = Annotated[
    Literal["physical", "neural", "map-only"] | None,
    Parameter(
        help="What the magnetometer reads: the exact field (physical), the map and a network's prediction "
        "(neural), or the map alone (map-only). Default: the scene's."
    ),
]
ModelError = Annotated[
    bool,
    Parameter(
        help="Add a random model error to neural readings, as large as the network's error on recordings "
        "outside its training set. With --no-model-error a reading is the prediction plus sensor noise."
    ),
]
Lidar = Annotated[
    Literal["schedule", "on", "off"],
    Parameter(help="Whether the LiDAR follows its schedule, or stays on or off."),
]
RateHz = Annotated[
    float | None, Parameter(help="Magnetometer readings per second [Hz]. Default: the scene's.")
]
OutUnit = Annotated[
    Literal["T", "nT"] | None,
    Parameter(help="Unit of the field in a bag or ROS message. Default: T, as in ROS."),
]
Unit = Annotated[
    Literal["nT", "uT", "T", "mG", "G"] | None,
    Parameter(help="Unit of the field in the input. Default: found from its size."),
]
UsdFps = Annotated[
    float | None,
    Parameter(name="--usd-fps", help="Frames per second in USD. 0: one per reading. Default: 30."),
]
RunScene = Annotated[
    Path | None,
    Parameter(
        help="Scene of the run: its stage, or a shipped scene's name, lab. Default: the one that the run's "
        "metadata names."
    ),
]
OURS_THEIRS = "OURS:=THEIRS, such as /robot/enu/pose:=/vrpn/pose"
Remap = Annotated[
    list[str] | None,
    Parameter(
        help="Name of a topic in the bag, as OURS:=THEIRS: /robot/enu/pose:=/vrpn/pose. May be repeated."
    ),
]
Scale = Annotated[
    float | None,
    Parameter(help="Factor from the values of the field in the input to nT, in place of a unit."),
]
Licence = Annotated[str, Parameter(help="Licence, an SPDX identifier such as MIT.")]
Gamepad = Annotated[
    Path | None,
    Parameter(
        help="Linux gamepad such as /dev/input/js0. The left stick drives, Start ends. Default: the keyboard."
    ),
]


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """How a robot's own bag is read; options of the commands that read one."""

    field_topic: str | None = None
    """Topic of the field in a robot's bag, if it has several."""

    pose_topic: str | None = None
    """Topic of the poses in a robot's bag, if it has several; tf: the pose of its base by /tf."""

    remap: Remap = None
    unit: Unit = None
    scale: Scale = None

    @property
    def options(self) -> dict[str, Any]:
        """Options of `magtwin.io.formats.read_run`, as far as they were given."""
        chosen = {"/robot/qtfm/magnitude": self.field_topic, "/robot/enu/pose": self.pose_topic}
        topics = pairs("remap", self.remap, OURS_THEIRS) | {n: t for n, t in chosen.items() if t}
        given = {"topics": topics or None, "unit": self.unit, "scale": self.scale}
        return {name: value for name, value in given.items() if value is not None}

    def reading(self) -> AbstractContextManager[None]:
        """Until its end, these options hold for all robots' bags, if any were given."""
        if not self.options:
            return nullcontext()
        from magtwin.io.formats import recordings

        return recordings(**self.options)


RecordedOptions = Annotated[Recorded, Parameter(name="*")]
RECORDED = Recorded()


def reads_recordings(command: Command) -> Command:
    """Give a command the options of robots' bags, which then hold for all runs that it reads."""
    command.reads_recordings = True  # type: ignore[attr-defined]
    return command
