"""The command line: one typed function a subcommand, a module a noun, nothing else."""

from magtwin.cli import compare, compensate, drive, file, map, net, report, rerun_of, robot, run, runs, scene  # noqa: A004, F401 - each registers its commands
from magtwin.cli.app import main

__all__ = ["main"]
