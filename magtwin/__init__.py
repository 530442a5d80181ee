"""magtwin: magnetic digital twins of robots, authored in USD.

    import magtwin as mt

    run = mt.simulate("lab.usda", "figure8", seed=1)
    run.save("run.rrd")

A scene describes a lab and a robot; `open_twin` opens it and `simulate` gives a `Run`. Names are loaded when
first used, so that `import magtwin` is fast.
"""

import importlib
from typing import TYPE_CHECKING

from magtwin.version import __version__ as __version__

if TYPE_CHECKING:
    from magtwin import extend as extend
    from magtwin.author.from_urdf import from_urdf as from_urdf
    from magtwin.author.rooms import Room as Room
    from magtwin.bench.results import read_results as read_results
    from magtwin.bench.runner import benchmark as benchmark
    from magtwin.errors import InputError as InputError
    from magtwin.errors import MismatchWarning as MismatchWarning
    from magtwin.export.package import export_scene as export_scene
    from magtwin.export.validation.validate import validate as validate
    from magtwin.field.fit.fit import fit_map as fit_map
    from magtwin.field.maps.map import AnomalyMap as AnomalyMap
    from magtwin.field.survey.readings import Readings as Readings
    from magtwin.figures.plot import plot as plot
    from magtwin.files.folders import allow as allow
    from magtwin.io.formats import read_run, write_run
    from magtwin.io.provenance import repeat_of
    from magtwin.io.recording.run import read_recording as read_recording
    from magtwin.io.surveys.survey import read_survey as read_survey
    from magtwin.io.sweeps import save_runs as save_runs
    from magtwin.learn.models.predictor import load_predictor as load_predictor
    from magtwin.learn.training.train import train as train
    from magtwin.run.run import COLUMNS as COLUMNS
    from magtwin.run.run import Run as Run
    from magtwin.sim.plant_families import draw_plant as draw_plant
    from magtwin.spec.drive import DriveSpec as DriveSpec
    from magtwin.spec.furniture import FurnitureSpec as FurnitureSpec
    from magtwin.spec.lab import LabSpec as LabSpec
    from magtwin.spec.lab import SurveySpec as SurveySpec
    from magtwin.spec.magnetics import EarthFieldSpec as EarthFieldSpec
    from magtwin.spec.magnetics import PlatformFieldSpec as PlatformFieldSpec
    from magtwin.spec.magnetics import SourceSpec as SourceSpec
    from magtwin.spec.plant import PlantSpec as PlantSpec
    from magtwin.spec.robot import PlacedRobot as PlacedRobot
    from magtwin.spec.robot import RobotSpec as RobotSpec
    from magtwin.spec.scene import Scene as Scene
    from magtwin.spec.sensors import BatterySpec as BatterySpec
    from magtwin.spec.sensors import ImuSpec as ImuSpec
    from magtwin.spec.sensors import LidarSpec as LidarSpec
    from magtwin.spec.sensors import MagnetometerSpec as MagnetometerSpec
    from magtwin.spec.sensors import MocapSpec as MocapSpec
    from magtwin.spec.walls import Door as Door
    from magtwin.spec.walls import Wall as Wall
    from magtwin.spec.walls import Window as Window
    from magtwin.tasks.learning import build_dataset as build_dataset
    from magtwin.tasks.learning import calibrate as calibrate
    from magtwin.tasks.learning import error_budget as error_budget
    from magtwin.tasks.learning import evaluate as evaluate
    from magtwin.tasks.localizing import localize as localize
    from magtwin.twin import Twin as Twin
    from magtwin.twin import author_scene as author_scene
    from magtwin.twin import in_session as in_session
    from magtwin.twin import new_scene as new_scene
    from magtwin.twin import open_twin as open_twin
    from magtwin.twin import scene_from_toml as scene_from_toml
    from magtwin.twin import simulate as simulate
    from magtwin.twin import simulate_robots as simulate_robots
    from magtwin.twin import sweep as sweep
    from magtwin.twin.maps import survey as survey
    from magtwin.usd.maps.layer import load_map as load_map
    from magtwin.usd.maps.layer import save_map as save_map
    from magtwin.usd.scene import read_scene as read_scene

    load_run, save_run, reproduce = read_run, write_run, repeat_of

_NAMES = {
    "Room": "author.rooms",
    "BatterySpec": "spec.sensors",
    "DriveSpec": "spec.drive",
    "EarthFieldSpec": "spec.magnetics",
    "FurnitureSpec": "spec.furniture",
    "ImuSpec": "spec.sensors",
    "LabSpec": "spec.lab",
    "LidarSpec": "spec.sensors",
    "MagnetometerSpec": "spec.sensors",
    "MocapSpec": "spec.sensors",
    "PlacedRobot": "spec.robot",
    "PlatformFieldSpec": "spec.magnetics",
    "RobotSpec": "spec.robot",
    "SourceSpec": "spec.magnetics",
    "SurveySpec": "spec.lab",
    "Wall": "spec.walls",
    "Door": "spec.walls",
    "Window": "spec.walls",
    "read_scene": "usd.scene",
    "survey": "twin.maps",
    "AnomalyMap": "field.maps.map",
    "COLUMNS": "run.run",
    "InputError": "errors",
    "MismatchWarning": "errors",
    "PlantSpec": "spec.plant",
    "Readings": "field.survey.readings",
    "Run": "run.run",
    "Scene": "spec.scene",
    "Twin": "twin",
    "allow": "files.folders",
    "author_scene": "twin",
    "benchmark": "bench.runner",
    "build_dataset": "tasks.learning",
    "calibrate": "tasks.learning",
    "draw_plant": "sim.plant_families",
    "error_budget": "tasks.learning",
    "evaluate": "tasks.learning",
    "export_scene": "export.package",
    "fit_map": "field.fit.fit",
    "from_urdf": "author.from_urdf",
    "in_session": "twin",
    "load_map": "usd.maps.layer",
    "localize": "tasks.localizing",
    "load_predictor": "learn.models.predictor",
    "load_run": "io.formats:read_run",
    "new_scene": "twin",
    "open_twin": "twin",
    "plot": "figures.plot",
    "read_results": "bench.results",
    "read_recording": "io.recording.run",
    "read_survey": "io.surveys.survey",
    "reproduce": "io.provenance:repeat_of",
    "save_map": "usd.maps.layer",
    "save_run": "io.formats:write_run",
    "save_runs": "io.sweeps",
    "scene_from_toml": "twin",
    "simulate": "twin",
    "simulate_robots": "twin",
    "sweep": "twin",
    "train": "learn.training.train",
    "validate": "export.validation.validate",
}
"""Module of each public name, and its name there if it differs."""

__all__ = sorted(_NAMES)


def __getattr__(name: str) -> object:
    if name == "extend":  # its decorators are used as `magtwin.extend.network`
        return importlib.import_module("magtwin.extend")
    if name not in _NAMES:
        raise AttributeError(f"module 'magtwin' has no attribute {name!r}")
    module, _, attribute = _NAMES[name].partition(":")
    return getattr(importlib.import_module(f"magtwin.{module}"), attribute or name)


def __dir__() -> list[str]:
    return sorted([*__all__, "extend"])
