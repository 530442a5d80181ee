"""Settings: options that are set in magtwin.toml of the working folder and in the environment.

Every option of a command can be set there. Those of a class below are rare, and can only be set there:
no flag and no help has them. docs/runs.md lists them.
"""

import difflib
import os
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import App, Argument, ArgumentCollection, Parameter
from cyclopts.config import Env, Toml
from cyclopts.exceptions import CycloptsError

from magtwin.cli.options import Names
from magtwin.errors import InputError, RepairWarning


@dataclass(frozen=True, kw_only=True)
class SensorSettings:
    """How a simulated robot reads its sensors."""

    model_error: bool = True
    tracking_error: bool = True
    lidar: Literal["schedule", "on", "off"] = "schedule"
    outside: Literal["nan", "clamp", "raise"] = "nan"


@dataclass(frozen=True, kw_only=True)
class RunSettings(SensorSettings):
    """Settings of `magtwin run`."""

    rate_hz: float | None = None
    controller: Literal["follower", "release"] = "follower"
    meet: Literal["refuse", "flag"] | None = None
    out_unit: Literal["T", "nT"] | None = None
    usd_fps: float | None = None
    viewer: str | None = None
    pace: float | None = None


@dataclass(frozen=True, kw_only=True)
class SweepSettings(SensorSettings):
    """Settings of `magtwin sweep`."""

    speed: float | None = None
    lab: str = ""
    network: Path | None = None
    keep: Names = None


_HIDDEN = Parameter(name="*", show=False)
RunOptions = Annotated[RunSettings, _HIDDEN]
SweepOptions = Annotated[SweepSettings, _HIDDEN]
RUN, SWEEP = RunSettings(), SweepSettings()


def is_setting(argument: Argument) -> bool:
    """Whether an argument has no flag."""
    return argument.parameter.show is False


def setting_text(typed: str, commands: tuple[str, ...], name: str = "") -> str:
    """How the setting of a command is set, that was typed as an option; `name` is its own."""
    key = (name or typed).removeprefix("--").replace("-", "_")
    variable = f"MAGTWIN_{_in_capitals('_'.join((*commands, key)))}"
    place = f"below [{' '.join(commands)}] in magtwin.toml"
    return f"{typed} is a setting: put `{key} = ...` {place}, or set {variable}"


class Settings(Toml):
    """Options in magtwin.toml, which is read as any TOML of a user."""

    def _load_config(self, path: Path) -> dict[str, Any]:
        from magtwin.files.settings import read_toml

        try:
            return read_toml(path)
        except InputError as error:
            raise CycloptsError(msg=str(error)) from error


class Environment(Env):
    """Options in the environment; warns of a variable that names no option of the command."""

    def __call__(self, app: App, commands: tuple[str, ...], arguments: ArgumentCollection) -> None:
        """Refuse flags of settings, and add the options in the environment to those of the command line."""
        for argument in arguments:
            if is_setting(argument) and argument.tokens:
                typed = str(argument.tokens[0].keyword)
                raise CycloptsError(msg=setting_text(typed, commands, argument.name))
        super().__call__(app, commands, arguments)
        if not commands:
            return
        prefix = f"{self.prefix}{_in_capitals('_'.join(commands))}_"
        known = {_in_capitals(name) for argument in arguments for name in argument.names}
        inner = tuple(f"{_in_capitals(name)}_" for name in app if not name.startswith("-"))
        for name in sorted(os.environ):
            option = name.removeprefix(prefix)
            if option == name or option.startswith(inner):  # bench and REPORT_OUT: of `bench report`
                continue
            try:
                arguments.match(option, transform=_in_capitals, delimiter="_")
            except ValueError:
                words, near = " ".join(commands), difflib.get_close_matches(option, known, n=1)
                said = f"; did you mean {prefix}{near[0]}?" if near else ""
                text = f"{name}: magtwin {words} has no such option, it is ignored{said}"
                warnings.warn(text, RepairWarning, stacklevel=2)


def _in_capitals(option: str) -> str:
    """An option's name as it is in the environment."""
    return option.upper().replace("-", "_").replace(".", "_").lstrip("_")
