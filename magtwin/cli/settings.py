"""Options that are set in the environment and in magtwin.toml of the working folder."""

import difflib
import os
import warnings
from pathlib import Path
from typing import Any

from cyclopts import App, ArgumentCollection
from cyclopts.config import Env, Toml
from cyclopts.exceptions import CycloptsError

from magtwin.errors import InputError, RepairWarning


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
        """Add the options in the environment to those of the command line."""
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
