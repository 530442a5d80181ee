"""The command line: one typed function a subcommand, a module a noun, nothing else."""

from magtwin.cli import (  # noqa: F401 - each registers its commands
    compare,
    compensate,
    dataset,
    drive,
    evaluate,
    export,
    file,
    map,  # noqa: A004
    net,
    new,
    picture,
    report,
    rerun_of,
    robot,
    ros,
    run,
    runs,
    scene,
    train,
    validate,
)
from magtwin.cli.app import main

__all__ = ["main"]
