"""The command line: one typed function for each command. Commands parse, call a public function and print."""

from magtwin.cli import bench, completion, doctor, localize, ros  # noqa: F401 - each registers its commands
from magtwin.cli.app import main, share_options
from magtwin.cli.learn import calibrate, compensate, dataset, evaluate, network, train  # noqa: F401
from magtwin.cli.maps import fit, look  # noqa: F401
from magtwin.cli.runs import drive, file, picture, report, reproduce, run, sweep  # noqa: F401
from magtwin.cli.scenes import export, robot, scene, schema, validate  # noqa: F401

share_options()

__all__ = ["main"]
