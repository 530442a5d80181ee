"""What objects show of themselves: at a prompt, in a notebook, as a picture, as a DataFrame."""

import dataclasses
import pickle
import re
from html.parser import HTMLParser
from pathlib import Path as FilePath

import numpy as np
import pytest

from magtwin.field.fit.fit import fit
from magtwin.field.maps.difference import difference
from magtwin.field.survey.readings import Readings
from magtwin.files.file import shipped
from magtwin.learn.data.alignment import Alignment
from magtwin.learn.data.dataset import build_dataset
from magtwin.learn.data.recording import Source
from magtwin.learn.data.split import split
from magtwin.learn.evaluation.candidates import Candidate, Mean, named_map
from magtwin.learn.evaluation.evaluate import evaluate
from magtwin.learn.inference.magnetometer import NeuralMagnetometer
from magtwin.learn.models.predictor import load_predictor
from magtwin.learn.training.config import TrainConfig
from magtwin.learn.training.train import fit as train
from magtwin.path import path_named
from magtwin.report.report import Figure, Report
from magtwin.report.summary import LINES, WIDTH, Summarized
from magtwin.run.compare import compare
from magtwin.run.run import Column, Run
from magtwin.sim.motion.commands import Commands
from magtwin.spec.base import spelled
from magtwin.spec.magnetics import SourceSpec
from magtwin.spec.plant import PlantSpec
from magtwin.spec.robot import PlacedRobot
from magtwin.spec.scene import Scene
from magtwin.twin import open_twin, scan, simulate, sweep

HOSTILE = '<script>alert("1")</script>&amp;\x1b[31m\n\u2028name'
WEIGHTS = sorted(shipped("weights").glob("*.safetensors"))


@pytest.fixture(scope="module")
def twin(lab_scene):
    return open_twin(lab_scene)


@pytest.fixture(scope="module")
def run(twin):
    return simulate(twin, "figure8", duration_s=50.0)


@pytest.fixture(scope="module")
def learnt(twin, run, tmp_path_factory):
    """A data set of three drives, a model trained on it, and an evaluation."""
    physical = open_twin(twin.scene_file, magnetometer="physical")
    drives = list(sweep(physical, "figure8", range(6), duration_s=20.0, rate_hz=20.0))
    runs = {f"d{k}": drive for k, drive in enumerate(drives)}
    data = build_dataset(runs, twin.field, tmp_path_factory.mktemp("learnt") / "set")
    config = TrainConfig(model="linear", features="circular")
    parts = split(data.recordings, config.split, rng=np.random.default_rng(0))
    trained = train(config, data, parts, rng=np.random.default_rng(0))
    chart = named_map("lab", twin.field)
    baseline = Candidate("naive", Mean(0.0, 1.0), chart)
    models = [Candidate("net", NeuralMagnetometer(trained.predictor), chart)]
    trials = [Source(name, lambda run=run: run) for name, run in runs.items()]
    return (
        data,
        parts,
        trained,
        evaluate(models, trials, baseline=baseline, rng=np.random.default_rng(0), truth=True),
    )


def nouns(twin, run, learnt):
    """Objects that a user holds at a prompt, by what they are."""
    data, parts, trained, evaluation = learnt
    field, rng = twin.field, np.random.default_rng(0)
    p, yaw = rng.uniform(-1, 1, (200, 2)), rng.uniform(-3, 3, 200)
    readings = Readings(p_xy=p, yaw=yaw, b_nt=field.lookup(p, yaw), runs=("a",), name="walk")
    named = {
        "run": run,
        "empty run": Run({}),
        "run of texts": Run({"t": np.arange(3.0), "a": np.array(["x"] * 3)}),
        "run of nan": Run({"t": np.arange(3.0), "b_total_nt": np.full(3, np.nan)}),
        "twin": twin,
        "scene": twin.scene,
        "robot": twin.scene.robot,
        "placed": twin.scene.robots[0],
        "source": twin.scene.sources[0],
        "map": field,
        "masked map": dataclasses.replace(field, valid=np.zeros_like(field.valid)),
        "grid": field.grid,
        "readings": readings,
        "difference": difference(field, dataclasses.replace(field, created="2027-01-01")),
        "gp": fit(readings, "gp"),
        "cubic": fit(readings, "cubic"),
        "obstacles": twin.obstacles,
        "path": path_named("A"),
        "commands": Commands("mine", np.array([[0.0, 0.1, 0.0], [2.0, 0.2, 0.1]])),
        "scans": scan(twin, run),
        "runs": sweep(twin, "figure8", range(100), duration_s=5.0),
        "report": run.report(),
        "comparison": compare(run, run),
        "magnetometer": twin.magnetometer,
        "read": twin.magnetometer.read([run])[0],
        "alignment": Alignment((0.1, -0.02), 0.013, (0.001, 0.002), 0.004),
        "data set": data,
        "split": parts,
        "trained": trained,
        "net": trained.predictor,
        "inputs": trained.predictor.inputs,
        "evaluation": evaluation,
        "judged": evaluation.judged[0],
        "case": evaluation.cases[0],
        "candidate": evaluation.candidates[1],
        "chart": evaluation.maps[0],
    }
    return named | {file.stem: load_predictor(file) for file in WEIGHTS}


class Tags(HTMLParser):
    """The tags of an HTML text."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.open = set(), []
        self.feed(text)
        assert not self.open, self.open

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_every_noun_shows_itself_in_five_lines_and_in_html(twin, run, learnt):
    for name, noun in nouns(twin, run, learnt).items():
        text = repr(noun)
        assert isinstance(noun, Summarized), name
        assert len(text.splitlines()) <= LINES, f"{name}: {text}"
        assert len(text) <= 500, f"{name}: {text}"
        assert max(map(len, text.splitlines())) <= WIDTH, f"{name}: {text}"
        assert type(noun).__name__ in text or name in ("report", "split"), f"{name}: {text}"
        assert "array(" not in text, f"{name}: {text}"
        allowed = {"div", "strong", "table", "tr", "th", "td", "details", "summary", "p"}
        assert Tags(noun._repr_html_()).tags <= allowed, name


def test_hostile_names_stay_in_their_line_and_are_escaped_in_html(twin, run):
    field = dataclasses.replace(twin.field, name=HOSTILE, method=HOSTILE, source=HOSTILE)
    named = {
        "run": run.with_metadata(scene=HOSTILE, path=HOSTILE, network=HOSTILE).with_columns(
            **{HOSTILE: run["t"]}
        ),
        "spec": Run({"t": run["t"], "a": run["t"]}, {}, {"a": Column(HOSTILE, HOSTILE, HOSTILE)}),
        "map": field,
        "twin": dataclasses.replace(twin, field=field, scene_file=FilePath(HOSTILE)),
        "scene": dataclasses.replace(twin.scene, name=HOSTILE),
        "magnetometer": NeuralMagnetometer(twin.magnetometer.net, name=HOSTILE),
        "report": Report(HOSTILE, (Figure(HOSTILE, HOSTILE, HOSTILE, note=HOSTILE),), {HOSTILE: HOSTILE}),
        "path": dataclasses.replace(path_named("A"), name=HOSTILE, file=HOSTILE),
    }
    for name, noun in named.items():
        text, html = repr(noun), noun._repr_html_()
        assert len(text.splitlines()) <= LINES, name
        assert len(text) <= 500, name
        assert "\x1b" not in text + html, name
        assert "script" not in Tags(html).tags, name
        assert "&lt;script&gt;" in html, name
        assert "<script" not in html, name


def labels_of(figure):
    return [ax.get_xlabel() for ax in figure.axes], [ax.get_ylabel() for ax in figure.axes]


def test_a_run_is_drawn_with_units_on_every_axis(run, twin):
    figure = run.plot(twin.field)
    x, y = labels_of(figure)
    words = {text.replace("\n", " ") for text in (*x, *y) if text}
    assert {"x [m]", "y [m]", "field [nT]", "what the map lacks [nT]", "error [nT]"} <= words
    assert {"speed [m/s]", "battery [V]", "reading − map [nT]", "map, mean over headings [nT]"} <= words
    assert "time [s]; shaded while the LiDAR is on" in words
    assert figure._repr_png_().startswith(b"\x89PNG")
    pickle.dumps(figure)


CAME_LATER = {
    "plant": PlantSpec(),
    "more_left_wheel_joints": (),
    "more_right_wheel_joints": (),
    "turning_radius_m": 0.0,
    **dict.fromkeys(("floor", "walls", "doors", "windows"), ()),
}
"""Fields that came later: with these values, checksums are those of scenes before."""


def plain(value):
    """A value with every dataclass in it as a plain one of the same name, whose repr is Python's own."""
    if dataclasses.is_dataclass(value):
        names = [f.name for f in dataclasses.fields(value)]
        kept = [n for n in names if n not in CAME_LATER or getattr(value, n) != CAME_LATER[n]]
        made = dataclasses.make_dataclass(type(value).__qualname__, kept)
        return made(**{name: plain(getattr(value, name)) for name in kept})
    return tuple(map(plain, value)) if type(value) is tuple else value


def test_checksums_of_scenes_rest_on_what_a_plain_dataclass_shows(twin):
    scene = twin.scene
    one = dataclasses.replace(scene, sources=scene.sources[:1], furniture=())
    other = PlacedRobot(robot=dataclasses.replace(scene.robot, name="second"), path=FilePath("a b.csv"))
    for case in (
        scene,
        one,
        dataclasses.replace(scene, others=(other,)),
        scene.robot,
        SourceSpec(name="a'b", p_world=(0.0, -0.0, 1e-300), m_world=(1.0, 2.0, 3.0)),
    ):
        assert spelled(case) == repr(plain(case))
    assert isinstance(scene, Scene)
    assert not re.search(r"\n", spelled(scene))
