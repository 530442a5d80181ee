"""Serve jobs, each in a fork of a process that has imported everything: an import costs more than a robot."""

import contextlib
import os
import resource
import select
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

ENDED = "ended:"
"""Begins a server's answers; libraries print as well."""


def serve(work: Callable[[str], None], limit_gb: float) -> None:
    """Do the job of each line of stdin, `SECONDS FILE`; a line out for each: "", or how it ended.

    What a job prints goes to FILE with the suffix .log.
    """
    out = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    for line in sys.stdin:
        seconds, _, job = line.rstrip("\n").partition(" ")
        child = os.fork()
        if not child:
            os.setpgid(0, 0)
            status = 1
            try:
                limit = int(limit_gb * 2**30)
                resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
                with Path(job).with_suffix(".log").open("w") as log:
                    os.dup2(log.fileno(), 1)
                    os.dup2(log.fileno(), 2)
                work(job)
                status = 0
            except BaseException as error:  # the process ends here
                sys.stderr.write(f"{type(error).__name__}: {error}\n")
            finally:
                with contextlib.suppress(OSError, ValueError):
                    sys.stderr.flush()
                os._exit(status)
        out.write(f"{ENDED}{_ended(child, float(seconds), job)}\n")


def _ended(child: int, seconds: float, job: str) -> str:
    """How a child ended; it is killed with its own children after its time."""
    watched = os.pidfd_open(child)
    in_time = bool(select.select([watched], [], [], seconds)[0])
    os.close(watched)
    if not in_time:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child, signal.SIGKILL)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if not in_time:
        return f"took longer than {seconds:.0f} s"
    if not status:
        return ""
    lines = Path(job).with_suffix(".log").read_text(errors="replace").strip().splitlines()
    return f"ended with status {status}: {(lines or ['no output'])[-1][:300]}"


class Server:
    """A process that serves jobs; started at the first job."""

    def __init__(self, python: str, script: Path) -> None:
        self._command = [python, str(script)]
        self._process: subprocess.Popen[str] | None = None

    def do(self, job: Path, seconds: float) -> str:
        """Do a job; "", or how it ended."""
        if self._process is None:
            pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
            self._process = subprocess.Popen(self._command, text=True, **pipes)
        try:
            self._process.stdin.write(f"{seconds} {job}\n")
            self._process.stdin.flush()
            answer = next((line for line in self._process.stdout if line.startswith(ENDED)), "")
        except BrokenPipeError:
            answer = ""
        if not answer:
            status, self._process = self._process.wait(), None
            return f"the server {self._command[-1]} ended with status {status}"
        return answer.removeprefix(ENDED).strip()

    def close(self) -> None:
        if self._process is not None:
            self._process.stdin.close()
            self._process.wait()
