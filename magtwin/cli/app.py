"""The application: configuration, options that every command has, warnings, errors and exit status."""

import errno
import functools
import inspect
import os
import re
import signal
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Annotated, Any, NoReturn

from cyclopts import App, Parameter
from cyclopts.exceptions import CycloptsError

from magtwin.cli.help import FLAGS, panel_of
from magtwin.cli.options import RECORDED, Json, Quiet, RecordedOptions
from magtwin.cli.progress import watched
from magtwin.cli.settings import Environment, Settings, is_setting
from magtwin.cli.terminal import Done, output_mode, print_error, print_json, refusal
from magtwin.errors import TERMINATED, CalibrationWarning, InputError, MismatchWarning, RepairWarning
from magtwin.files.folders import allow
from magtwin.version import __version__

app = App(
    name="magtwin",
    help="Author magnetic digital twins of labs and robots in USD, simulate what a robot's magnetometer "
    "reads, fit field maps and train neural magnetometers.",
    version=__version__,
    version_flags=("--version", "-V"),
    config=[Environment("MAGTWIN_", show=False), Settings("magtwin.toml")],
    default_parameter=Parameter(negative_iterable="", negative_none=""),
    help_epilogue="magtwin --help tells of settings, --debug, --allow and the exit status.",
)

ALIASES = {
    "anomaly_map": "map",
    "duration": "duration_s",
    "fps": "usd_fps",
    "map_layer": "map",
    "localizers": "localizer",
    "net": "network",
    "profile": "target",
    "ridge": "penalty",
}
"""Options of the command line whose parameter has another name in Python."""

_TOO_LITTLE = re.compile(r"can't allocate memory|out of memory|std::bad_alloc", re.IGNORECASE)
"""Texts of errors of libraries that found too little memory, beside MemoryError."""

_running: list[App] = []
"""The command that is running."""

_typed: list[str] = []
"""The arguments."""

_read: list[Path] = []
"""The files that the command may read."""


def main(arguments: list[str], *, tell: Callable[[], str] | None = None) -> None:
    """Run the `magtwin` command, or print the text that `tell` gives in place of it."""
    debug = "--debug" in arguments
    _end_by_exceptions()
    _running.clear()
    _read.clear()
    _typed[:] = arguments
    try:
        arguments, folders = _allowed([a for a in arguments if a != "--debug"])
        with watched(), _warnings_in_lines(), allow(*folders):
            if tell is not None:
                print(tell())  # noqa: T201
            else:
                how: Any = {"exit_on_error": False, "print_error": False, "result_action": "return_value"}
                app(arguments, **how, **_help_options(arguments))
            sys.stdout.flush()  # a fault is reported here
    except CycloptsError as error:
        from magtwin.cli.mistakes import explain

        _fail(explain(error), status=2)
    except KeyboardInterrupt:
        sys.exit(130)
    except BrokenPipeError:  # `magtwin info ... | head`
        sys.stderr.close()
        sys.exit(141)
    except Exception as error:
        if debug:
            raise
        if isinstance(error, InputError):
            _running[:] = _running or [app.parse_commands(arguments)[1][-1]]
            _fail(_named_as_typed(error.in_flags(_flags())))
        if text := _wrong_name(error, arguments):
            _fail(text)
        if isinstance(error, MemoryError) or _TOO_LITTLE.search(str(error)):
            text = str(error).partition(" for an array")[0].partition(". Error code")[0]
            _fail(f"not enough memory{f' ({text})' if text else ''}; give less data or smaller options")
        if isinstance(error, OSError):
            from magtwin.files.outputs import FULL

            full = "" if error.errno not in FULL or error.filename else _stdout_full()
            _fail(full or f"{error} ({type(error).__name__})")
        if text := _no_room(error):
            _fail(text)
        _fail(f"a fault in magtwin, {type(error).__name__}: {error}; please report it, with --debug")


def refuse_command(arguments: list[str]) -> str:
    """Refuse a command that there is not, with the one that is meant."""
    from magtwin.cli.mistakes import unknown_command

    _fail(unknown_command(arguments[0], more=arguments[1:2]), status=2)


def _named_as_typed(text: str) -> str:
    """A refusal that names the user's file in place of what was made of it in a temporary folder."""
    import tempfile

    for match in re.finditer(rf"({re.escape(tempfile.gettempdir())}/tmp\w{{8}})/[^\s:,;]*", text):
        if _read and not any(file.absolute().is_relative_to(match[1]) for file in _read):
            text = text.replace(match[0], str(_read[0]))
    return text


def _end_by_exceptions() -> None:
    """Turn signals that end the process into exceptions, so that partial outputs are removed."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(TERMINATED))
    if not hasattr(signal, "SIGHUP") or signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:  # Windows, nohup
        return

    def hang_up(*_: object) -> None:
        signal.signal(signal.SIGHUP, signal.SIG_IGN)  # the kernel and the shell both send it
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # the terminal is gone: each line would be an error
        sys.exit(129)

    signal.signal(signal.SIGHUP, hang_up)


def _allowed(arguments: list[str]) -> tuple[list[str], list[str]]:
    """The arguments without --allow DIR, and the folders. No magtwin.toml can allow any."""
    others, folders = list[str](), list[str]()
    words = iter(arguments)
    for word in words:
        if word == "--allow":
            folders.append(next(words, ""))
        elif word.startswith("--allow="):
            folders.append(word.partition("=")[2])
        else:
            others.append(word)
    if "" in folders:
        _fail("--allow wants a folder: --allow DIR", status=2)
    return others, folders


def _stdout_full() -> str:
    """The refusal of a stdout on a full disk, of which Python does not speak; "" if it can be written."""
    try:
        print(flush=True)  # noqa: T201
    except OSError as error:
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115 - else Python tries once more, at its end
        return f"stdout cannot be written ({error.strerror}); make room there, or send it elsewhere"
    return ""


def _no_room(error: Exception) -> str:
    """The refusal of a full disk of temporary files, of which libraries do not speak; "" if it has room."""
    import tempfile

    from magtwin.files.outputs import why_full

    folder = tempfile.gettempdir()
    if reason := why_full(Path(folder), error):
        return f"{folder}: no room for temporary files ({reason}); set TMPDIR to a folder with room"
    return ""


def _wrong_name(error: Exception, arguments: list[str]) -> str:
    """The refusal of a file whose name is too long, not UTF-8 or a circle; "" if the error is another one."""
    if isinstance(error, RuntimeError) and str(error).startswith("Symlink loop from "):  # before Python 3.13
        name = str(error).removeprefix("Symlink loop from ").strip("'")
        return f"{name}: its links form a circle; give another file"
    if isinstance(error, OSError) and error.errno == errno.ENAMETOOLONG:
        name = str(error.filename)
        return f"{name[:60]}...: its name of {len(name)} characters is too long for a file; shorten it"
    if isinstance(error, UnicodeEncodeError):
        for word in arguments:
            if any("\udc80" <= letter <= "\udcff" for letter in word):
                return f"{word}: its name is not UTF-8, and the file format stores names as UTF-8; rename it"
    return ""


def share_options(group: App = app) -> None:
    """Give every command of a group --json and --quiet."""
    for name in group:
        if not name.startswith("-"):
            share_options(group[name])
    shared = getattr(group.default_command, "shares_options", False)
    if group.default_command is not None and group is not app and not shared:
        group.default_command = _with_output_options(group, group.default_command)


def _with_output_options(command: App, function: Callable[..., Any]) -> Callable[..., Any]:
    """A command's function that takes --json and --quiet too, and shows the `Done` that it returns."""
    signature = inspect.signature(function)
    records = getattr(function, "reads_recordings", False)

    @functools.wraps(function)
    def wrapped(*args: Any, json: bool = False, quiet: bool = False, **options: Any) -> None:
        from magtwin.files.outputs import reading

        how = options.pop("recorded", RECORDED).reading() if records else nullcontext()
        _running[:] = [command]
        _read[:] = _files(signature.bind_partial(*args, **options).arguments)
        with output_mode(as_json=json, quiet=quiet), reading(_read), how:
            done = function(*args, **options)
            if isinstance(done, Done):
                done.show()

    added = {"json": Json, "quiet": Quiet} | ({"recorded": RecordedOptions} if records else {})
    parameters = list(signature.parameters.values())
    for name in added:
        default = RECORDED if name == "recorded" else False
        parameters.append(inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default))
    hints = {p.name: _shown(p.name, added.get(p.name, p.annotation)) for p in parameters}
    wrapped.__signature__ = signature.replace(  # type: ignore[attr-defined]
        parameters=[p.replace(annotation=hints[p.name]) for p in parameters]
    )
    wrapped.shares_options = True  # type: ignore[attr-defined]
    wrapped.__annotations__ = {**function.__annotations__, **hints}
    return wrapped


SHORT = {"out": "-o", "force": "-f", "quiet": "-q"}
"""Short flags, by parameter."""


def _shown(name: str, annotation: Any) -> Any:
    """The annotation of a parameter, with its panel in the help and its short flag."""
    return Annotated[annotation, Parameter(group=panel_of(name), alias=SHORT.get(name, ()))]


_WRITTEN = ("out", "report", "rrd")
"""Parameters that name outputs."""

_FOLDERS = ("data", "earth", "map", "spec", "suite")
"""Parameters of text that may name a folder in one word. In others a word is a choice, as in --path sine."""


def _files(given: dict[str, Any]) -> list[Path]:
    """Files and folders among the values of a command's parameters that it may read."""
    found = []
    for name, value in given.items():
        for each in value if isinstance(value, list | tuple) else [value]:
            is_name = isinstance(each, str) and (name in _FOLDERS or Path(each).name != each or "." in each)
            if name not in _WRITTEN and (is_name or isinstance(each, Path)):
                found.append(Path(each))
    return found


def _flags() -> dict[str, str]:
    """Flag of each parameter of the command that is running, assembled only for an error: it takes long."""
    flags = {"allow": "--allow"}
    for command in _running:
        for argument in command.assemble_argument_collection(parse_docstring=False):
            if argument.name.startswith("--"):
                name = argument.name.removeprefix("--").replace("-", "_")
                flags[name] = f"[{command.name[0]}] {name}" if is_setting(argument) else argument.name
    return flags | {name: flags[key] for name, key in ALIASES.items() if key in flags}


def _help_options(arguments: list[str]) -> dict[str, Any]:
    """Options that print help: for a file or another program no boxes, no broken lines."""
    asked = FLAGS & set(arguments) or len(arguments) < 2  # `magtwin map` prints its help too
    if not asked:
        return {}
    from magtwin.cli.help import Page
    from magtwin.cli.terminal import stdout_console

    plain, command = not sys.stdout.isatty(), " ".join(app.parse_commands(arguments)[0]).removesuffix(" -h")
    app.help_formatter = Page(command.removesuffix(" --help"), plain=plain, short="-h" in arguments)
    return {"console": stdout_console()} if plain else {}


@contextmanager
def _warnings_in_lines() -> Iterator[None]:
    """Print each warning once, as a line on stderr."""
    printed: set[str] = set()
    with warnings.catch_warnings():
        for own in (MismatchWarning, CalibrationWarning, RepairWarning):
            warnings.simplefilter("always", own)

        def line(message: Warning | str, *_: Any, **__: Any) -> None:
            if str(message) not in printed:
                printed.add(str(message))
                print_error(f"warning: {InputError(str(message)).in_flags(_flags())}", style="1;33")

        warnings.showwarning = line
        yield


def _fail(text: str, status: int = 1) -> NoReturn:
    print_error(text, style="1;31" if status == 2 else "")
    if "--json" in _typed:
        print_json({"error": refusal(text)})
    sys.exit(status)
