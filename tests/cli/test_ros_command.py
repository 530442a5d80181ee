"""`magtwin ros`: nodes from the command line, and one line where they cannot be."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from nodes import DOMAINS

from magtwin.cli import main
from magtwin.files.file import shipped
from magtwin.io.bags.topics import LATCHED
from magtwin.ros.bus import open_bus, to_bytes

pytest.importorskip("cyclonedds", reason="extra ros is not installed")

SCENE = str(shipped("scenes", "lab", "lab.usda"))


@pytest.fixture(autouse=True)
def here(monkeypatch: pytest.MonkeyPatch) -> None:
    """A domain of the test's own, on loopback only."""
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_DOMAIN_ID", str(next(DOMAINS)))
    monkeypatch.delenv("CYCLONEDDS_URI", raising=False)


def test_a_robot_is_simulated_for_a_while(capsys: pytest.CaptureFixture[str]) -> None:
    main(["ros", "sim", SCENE, "--network", "none", "--duration-s", "0.3", "--pace", "2", "--out-unit", "nT"])
    said = capsys.readouterr().err
    assert "simulating by cyclonedds at 2 x real time" in said
    assert "published in nT" in said


def test_the_magnetometer_waits_for_a_robot(capsys: pytest.CaptureFixture[str]) -> None:
    main(["ros", "magnetometer", SCENE, "rate_hz:=50", "--duration-s", "0.3"])
    assert "reading by cyclonedds" in capsys.readouterr().err


def test_the_localizer_waits_for_a_robot_and_runs_any_method(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    main(["new", "own_filter.py", "--quiet"])
    own = ["--method", "own_filter:MyLocalizer", "--option", "particles=10"]
    main(["ros", "localize", "lab", "prior:=0,0,0.5", *own, "--duration-s", "0.3"])
    assert "localizing by cyclonedds" in capsys.readouterr().err


def test_a_recording_of_nothing_is_said(tmp_path: Path, refusal: Callable[..., str]) -> None:
    assert "nothing was recorded" in refusal("ros", "record", tmp_path / "bag", "--duration-s", "0.1")
    assert not list(tmp_path.iterdir())


def test_a_named_topic_that_was_not_recorded_ends_with_status_1_and_the_others_are_kept(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    node, text = open_bus("notes", backend="cyclonedds"), "std_msgs/msg/String"
    publisher = node.publisher("/notes", text, LATCHED)
    publisher.publish(to_bytes(text, {"data": "once"}))
    out = tmp_path / "bag.mcap"
    topics = ["--topic", "/notes", "--topic", "/odomm"]
    with pytest.raises(SystemExit) as ended:
        main(["ros", "record", str(out), *topics, "--duration-s", "4", "--json"])
    node.close()
    assert ended.value.code == 1
    told = json.loads(capsys.readouterr().out)
    assert told["messages"] == {"/notes": 1}
    assert told["missing"] == {"/odomm": "nobody publishes it"}
    assert out.is_file()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["sim", "nowhere.usda"], "nowhere.usda"),
        (["sim", SCENE, "--pace", "-1"], "--pace must be above 0"),
        (["sim", SCENE, "--domain", "300"], "a domain of ROS must be from 0 to 232, got 300"),
        (["sim", SCENE, "--remap", "odom=x"], "a remap is a name:=another"),
        (["sim", SCENE, "--namespace", "my robot"], "namespace 'my robot' is not a ROS name"),
        (["sim", SCENE, "--duration-s", "nan"], "--duration-s must be above 0 s, got nan"),
        (["sim", SCENE, "--rate-hz", "1e9"], "--rate-hz must be at most 1000 Hz live"),
        (["magnetometer", SCENE, "--duration-s", "-1"], "--duration-s must be above 0 s, got -1.0"),
        (["magnetometer", SCENE, "rate_hz:=0"], "parameter rate_hz must be from 1 to 1000"),
        (["magnetometer", SCENE, "--network", "none"], "is physical, which needs the lab itself"),
        (["localize", SCENE, "--method", "odometri"], "did you mean 'odometry'?"),
        (["localize", SCENE, "--method", "odometry", "prior:=here"], "prior is wait, global or x,y,yaw"),
        (["localize", SCENE, "--method", "odometry", "rate_hz:=0"], "rate_hz must be from 0.1 to 1000"),
        (["localize", SCENE, "--method", "smoother"], "is a smoother, which needs a whole run"),
        (["follow", "figur8"], "did you mean 'figure8'"),
        (["follow", "figure8", "--speed", "3"], "--speed must be above 0"),
    ],
)
def test_what_cannot_be_is_one_line(arguments: list[str], said: str, refusal: Callable[..., str]) -> None:
    assert said in refusal("ros", *arguments)
