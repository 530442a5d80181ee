"""The application: its name, where options come from, and how it ends."""

import signal
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from cyclopts import App
from cyclopts.config import Env, Toml
from cyclopts.exceptions import CycloptsError

from magtwin.cli.progress import watched
from magtwin.errors import InputError, MismatchWarning
from magtwin.version import __version__

app = App(
    name="magtwin",
    help="Magnetic digital twins of robots: author labs and robots as USD, drive them, log what a "
    "neural-network magnetometer reads.",
    version=__version__,
    config=[Env("MAGTWIN_", show=False), Toml("magtwin.toml", search_parents=False)],
    help_epilogue="Options also come from the environment (MAGTWIN_RUN_SEED=1) and from magtwin.toml. "
    "Exit status: 0 done, 1 an input was refused, 2 wrong usage. --debug shows the traceback of a refusal.",
)


HELP = {"--help", "-h"}
"""Options that ask for help."""


def main(arguments: list[str] | None = None) -> None:
    """Entry point of the `magtwin` command; `arguments` are those of the command line unless given."""
    arguments = sys.argv[1:] if arguments is None else arguments
    debug = "--debug" in arguments
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that what is half-written goes
    plain = not sys.stderr.isatty()
    try:
        with watched(), _warnings_in_lines():
            app(
                [a for a in arguments if a != "--debug"],
                exit_on_error=False,
                print_error=not plain,
                result_action="return_value",
                **_help_of(arguments),
            )
    except CycloptsError as error:
        if plain:
            print("magtwin: " + " ".join(str(error).split()), file=sys.stderr)  # noqa: T201
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)
    except BrokenPipeError:  # `magtwin info ... | head`
        sys.stderr.close()
        sys.exit(141)
    except Exception as error:
        if debug:
            raise
        if isinstance(error, InputError):
            _fail(str(error))
        if isinstance(error, OSError | MemoryError):
            _fail(f"{error} ({type(error).__name__})")
        _fail(f"a fault of magtwin's own, {type(error).__name__}: {error}; --debug shows where, do report it")


def _help_of(arguments: list[str]) -> dict[str, Any]:
    """Options that print help for a file or another program: without boxes, no line broken."""
    asked = HELP & set(arguments) or len(arguments) < 2  # `magtwin map` is answered by its help too
    if sys.stdout.isatty() or not asked:
        return {}
    from cyclopts.help import PlainFormatter

    from magtwin.cli.terminal import stdout_console

    app.help_formatter = PlainFormatter()
    return {"console": stdout_console()}


@contextmanager
def _warnings_in_lines() -> Iterator[None]:
    """Show a MismatchWarning as one line on stderr, each text once in a command; other warnings as ever."""
    told: set[str] = set()
    with warnings.catch_warnings():
        warnings.simplefilter("always", MismatchWarning)
        show = warnings.showwarning

        def line(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
            if not issubclass(category, MismatchWarning):
                show(message, category, *where, **more)
            elif str(message) not in told:
                told.add(str(message))
                text = f"magtwin: warning: {' '.join(str(message).split())}"
                loud = sys.stderr.isatty()  # yellow and bold
                print(f"\033[1;33m{text}\033[0m" if loud else text, file=sys.stderr)  # noqa: T201

        warnings.showwarning = line
        yield


def _fail(text: str) -> None:
    print("magtwin: " + " ".join(text.split()), file=sys.stderr)  # noqa: T201
    sys.exit(1)
