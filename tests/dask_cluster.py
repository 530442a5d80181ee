"""A dask scheduler and its workers on this machine, each in a process, for tests."""

import contextlib
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path


class Cluster:
    """A scheduler and its workers, each in a process."""

    def __init__(self, folder):
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
        self.folder = folder
        tests = str(Path(__file__).parent)
        self.environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join([tests, *filter(None, sys.path)]),
            "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "2",
        }
        port = self.address.rpartition(":")[2]
        self.processes = [self.start("scheduler", "--host", "127.0.0.1", "--port", port, "--no-dashboard")]

    def start(self, kind, *options, **environment):
        return subprocess.Popen(
            [sys.executable, "-m", "dask", kind, *options],
            env={**self.environment, **environment},
            stderr=subprocess.DEVNULL,
            cwd=self.folder,
            start_new_session=True,
        )

    def add_worker(self, *options, **environment):
        common = ["--nthreads", "1", "--no-dashboard", "--local-directory", str(self.folder)]
        worker = self.start("worker", self.address, *common, *options, **environment)
        self.processes.append(worker)
        return worker

    def close(self):
        for process in self.processes[::-1]:
            with contextlib.suppress(ProcessLookupError):  # a test has killed it
                os.killpg(process.pid, signal.SIGTERM)
        for process in self.processes:
            process.wait(10)
