"""World process: a stage in a physics engine in another process, asked line by line."""

import json
import subprocess
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path as FilePath
from types import MappingProxyType
from typing import Any

from magtwin.errors import InputError
from magtwin.files.children import caches, end, limited, own_home


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
        changes: Mapping[str, str | None] = MappingProxyType({}),
        limit_s: float | None = None,
        files: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        """Prepare the process; the block starts it."""
        self._command, self._job, self._engine = list(command), dict(job), engine
        self._changes, self._limit_s, self._files = changes, limit_s, files

    def __enter__(self) -> "WorldProcess":
        self._held = ExitStack()
        changes = {"XDG_CACHE_HOME": caches(), **self._changes}  # engines compile kernels for a minute
        environment = self._held.enter_context(own_home(changes))
        folder = environment["HOME"]  # engines write logs there
        for name, text in self._files.items():
            FilePath(folder, name).write_text(text, encoding="utf-8")
        self._log = open(FilePath(folder, "log"), "w+", encoding="utf-8", errors="replace")
        self._held.enter_context(self._log)
        pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": self._log}
        options: Any = {"text": True, "bufsize": 1, "cwd": folder, "env": environment}
        self._process = subprocess.Popen(self._command, **pipes, **options)
        self._late = self._held.enter_context(limited(self._process, self._limit_s))
        self._send(self._job)
        return self

    def __exit__(self, *_: object) -> None:
        end(self._process, patience_s=5)
        self._held.close()

    def seen(self) -> list[float]:
        """The next answer."""
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            if self._late.is_set():
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

    def _send(self, message: object) -> None:
        assert self._process.stdin is not None
        with suppress(OSError):  # it has ended; `seen` reports why
            self._process.stdin.write(json.dumps(message) + "\n")
            self._process.stdin.flush()
