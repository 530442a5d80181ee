"""World process: a stage in a physics engine in another process, asked line by line."""

import json
import os
import subprocess
import tempfile
import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path as FilePath
from types import MappingProxyType
from typing import Any

from magtwin.errors import InputError


class WorldProcess:
    """A program that reads a job and then one line per question, and answers each with a line of JSON.

    It ends with the block. `newton_world` describes the lines.
    """

    def __init__(
        self,
        command: Sequence[str],
        job: Mapping[str, Any],
        engine: str,
        *,
        environment: Mapping[str, str] | None = None,
        limit_s: float | None = None,
        files: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        """Prepare the process; the block starts it.

        Args:
            command: The program and its arguments.
            job: Its first line, with the key `stage`.
            engine: Name of the engine, for messages.
            environment: Its environment. Default: that of this process.
            limit_s: Time after which the process is killed [s]. None for no limit.
            files: Texts of files in the folder that it runs in, by name.
        """
        self._command, self._job, self._engine = list(command), dict(job), engine
        self._environment, self._limit_s = environment, limit_s
        self._files, self._late = files, False

    def __enter__(self) -> "WorldProcess":
        self._folder = tempfile.TemporaryDirectory()  # engines write logs there
        for name, text in self._files.items():
            FilePath(self._folder.name, name).write_text(text, encoding="utf-8")
        self._log = open(FilePath(self._folder.name, "log"), "w+", encoding="utf-8", errors="replace")
        self._process = subprocess.Popen(
            self._command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
            text=True,
            bufsize=1,
            cwd=self._folder.name,
            env=dict(os.environ if self._environment is None else self._environment),
        )
        self._timer = threading.Timer(self._limit_s or 0.0, self._stop)
        if self._limit_s is not None:
            self._timer.daemon = True
            self._timer.start()
        self._send(self._job)
        return self

    def __exit__(self, *_: object) -> None:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._timer.cancel()
        with suppress(OSError):
            self._process.stdin.close()
        try:
            self._process.wait(5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()
        self._log.close()
        self._folder.cleanup()

    def seen(self) -> list[float]:
        """The next answer.

        Raises:
            InputError: The process ended, or took longer than its limit.
        """
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            if self._late:
                raise InputError(f"{self._job['stage']}: {self._engine} took longer than {self._limit_s:g} s")
            self._log.seek(0)
            lines = [text for text in self._log.read().splitlines() if text.strip()]
            reason = lines[-1] if lines else "it gave no reason"
            raise InputError(f"{self._job['stage']}: {self._engine} cannot run it: {reason}")
        row: list[float] = json.loads(line)
        return row

    def ask(self, message: object) -> list[float]:
        """Send a line, and return its answer."""
        self._send(message)
        return self.seen()

    def _stop(self) -> None:
        """Kill the process, which has taken too long."""
        self._late = True
        self._process.kill()

    def _send(self, message: object) -> None:
        assert self._process.stdin is not None
        with suppress(OSError):  # it has ended; `seen` reports why
            self._process.stdin.write(json.dumps(message) + "\n")
            self._process.stdin.flush()
