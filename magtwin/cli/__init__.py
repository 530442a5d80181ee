"""The command line: one typed function a subcommand, a module a noun, nothing else."""

from magtwin.cli import ros  # noqa: F401 - each registers its commands
from magtwin.cli.app import main
from magtwin.cli.learn import compensate, dataset, evaluate, network, train  # noqa: F401
from magtwin.cli.maps import map  # noqa: A004, F401
from magtwin.cli.runs import compare, drive, file, picture, report, reproduce, run, sweep  # noqa: F401
from magtwin.cli.scenes import export, new, robot, scene, validate  # noqa: F401

__all__ = ["main"]
