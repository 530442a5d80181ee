"""Start: the entry of the command line, which Ctrl-C ends with status 130 at any moment, without a traceback.

Modules are imported under a handler that ends the process at once: nothing has been written by then.
While a command runs, Ctrl-C raises `KeyboardInterrupt`, so that partial outputs are removed.
"""

import os
import signal

INTERRUPTED = 130
"""Exit status after Ctrl-C."""

AGAIN_S = 0.02
"""Time after which an interrupt that came at a wrong moment is sent again [s]."""


def _end(*_: object) -> None:
    os._exit(INTERRUPTED)


# Only the entry of the program imports this module, so it acts here, before the imports below.
_ignored = signal.getsignal(signal.SIGINT) is signal.SIG_IGN  # started in the background: not for us
if not _ignored:
    signal.signal(signal.SIGINT, _end)

import _thread  # noqa: E402
import sys  # noqa: E402
import threading  # noqa: E402
from typing import Any  # noqa: E402


def main() -> None:
    """Run the `magtwin` command of the command line."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # closed by the shell, as by `>&-`
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115
    from magtwin.cli import main as run

    if _ignored:
        run()
        return
    came: list[int] = []

    def interrupt(number: int, frame: Any) -> None:
        if _in_pxr(frame):
            _send_again()
            return
        came.append(number)
        raise KeyboardInterrupt

    sys.unraisablehook = _sent_again
    try:
        signal.signal(signal.SIGINT, interrupt)
        run()
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
    except SystemExit as end:
        if came and end.code == 1:  # an interrupt that a library turned into another error
            sys.exit(INTERRUPTED)
        raise
    finally:
        signal.signal(signal.SIGINT, _end)


def _in_pxr(frame: Any) -> bool:
    """Whether a module of OpenUSD is being imported: it swallows an interrupt, and is half imported then."""
    while frame is not None:
        if frame.f_code.co_name == "<module>" and frame.f_globals.get("__name__", "").startswith("pxr"):
            return True
        frame = frame.f_back
    return False


def _sent_again(fault: Any) -> None:
    """Send an interrupt again that was raised where nobody could catch it; report other faults as usual."""
    if fault.exc_type is not None and issubclass(fault.exc_type, KeyboardInterrupt):
        _send_again()
    else:
        sys.__unraisablehook__(fault)


def _send_again() -> None:
    """Interrupt this process in a moment."""
    timer = threading.Timer(AGAIN_S, _interrupt)
    timer.daemon = True
    timer.start()


def _interrupt() -> None:
    """Send Ctrl-C to this process."""
    if os.name == "nt":  # where os.kill ends the process
        _thread.interrupt_main()
    else:
        os.kill(os.getpid(), signal.SIGINT)
