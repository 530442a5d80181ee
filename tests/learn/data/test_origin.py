"""Origin: a network that is used with another map, at another place or on another robot is found out."""

import dataclasses
import warnings

import numpy as np
import pytest
from test_network import a_net

from magtwin import simulate
from magtwin.cli import main
from magtwin.errors import InputError, MismatchWarning
from magtwin.field.maps.map import AnomalyMap
from magtwin.files.file import sha256, shipped
from magtwin.learn.data.origin import label_frame, map_metadata, mismatches
from magtwin.sim.runs.simulate import robot_metadata
from magtwin.spec.sensors import MocapSpec
from magtwin.twin import in_session, open_twin, sweep
from magtwin.usd.maps.layer import save_map
from magtwin.usd.robot import load_robot

ROBOT = load_robot(shipped("robots", "turtlebot4", "turtlebot4.usda"))
SLOPE = 4000.0


def a_map(shift_nt=0.0, slope_nt_m=SLOPE, name="hills"):
    """A plane that rises towards x."""
    x, y = np.arange(-2, 2.01, 0.1), np.arange(-1.5, 1.51, 0.1)
    values = np.broadcast_to(41e3 + shift_nt + slope_nt_m * x, (1, len(y), len(x)))
    return AnomalyMap(
        values_nt=values,
        origin_m=(-2.0, -1.5),
        cell_m=(0.1, 0.1),
        headings_rad=np.zeros(1),
        name=name,
        method="harmonic",
        height_m=0.4,
    )


def learned(field=None, robot=ROBOT, **metadata):
    """Metadata of a network that learned there, without an alignment from true poses."""
    about = {"map": "hills", "map_sha256": "a" * 64, "lever_arm_m": "0, 0", "latency_s": 0.0, "poses": "true"}
    about |= {"label_mean_nt": 268.0, "label_sd_nt": 346.0, "platform_sha256": "p"}
    return about | map_metadata(field or a_map()) | robot_metadata(robot) | metadata


def found(metadata, *, field=None, map_sha256="a" * 64, robot=ROBOT, platform="p", residual_sd_nt=140.0):
    return mismatches(
        metadata,
        "f.safetensors",
        residual_sd_nt=residual_sd_nt,
        field=field or a_map(),
        map_sha256=map_sha256,
        robot=robot,
        platform_sha256=platform,
    )


@pytest.mark.parametrize(("other", "rms"), [(a_map(250.0), 250.0), (a_map(0, 4300.0), 300 * 2 / 3**0.5)])
def test_another_map_is_told_with_the_rms_difference_of_the_two(other, rms):
    (one,) = found(learned(), field=other, map_sha256="b" * 64)
    assert "learned on the map 'hills' (harmonic)" in one.text
    told = float(one.text.split("differ by ")[1].split(" nT")[0])
    assert told == pytest.approx(rms, rel=0.1)
    assert not one.grave


def test_unaligned_labels_are_told_with_the_effect_of_the_place_where_they_took_the_map():
    robot = dataclasses.replace(ROBOT, mocap=MocapSpec(offset_m=(0.06, 0.0), latency_s=0.0, jitter_s=0.0))
    (one,) = found(learned(robot=robot, poses="mocap"))
    # 6 cm and half a period at 0.2 m/s, in all directions over a plane: SLOPE * 6.1 cm / sqrt(2)
    told = float(one.text.split("about ")[1].split(" nT")[0])
    assert told == pytest.approx(SLOPE * (0.06 + 0.2 * 0.5 / 120) / 2**0.5, rel=0.1)
    assert "6.0 cm" in one.text
    assert "--alignment fit" in one.text


def test_labels_that_were_aligned_or_took_true_poses_lie_in_the_frame_of_a_run():
    robot = dataclasses.replace(ROBOT, mocap=MocapSpec(offset_m=(0.06, -0.02), latency_s=0.05, jitter_s=0.0))
    aligned = learned(robot=robot, poses="mocap", lever_arm_m="0.06, -0.02", latency_s=-0.05 - 0.5 / 120)
    np.testing.assert_allclose(label_frame(aligned), 0, atol=1e-6)
    assert label_frame(learned(robot=robot)) == (0.0, 0.0, 0.0)
    assert found(aligned) == found(learned(robot=robot)) == ()


def test_another_robot_with_its_sensor_elsewhere_is_grave():
    other = dataclasses.replace(ROBOT, name="husky", p_base_magnetometer=(0.3, 0.0, 0.9))
    (one,) = found(learned(), robot=other, platform="q")
    assert one.grave
    assert one.text.startswith("WRONG ROBOT: f.safetensors learned the robot 'turtlebot4'")
    assert "'husky' with its sensor at (0.3, 0, 0.9) m" in one.text
    assert "268 ± 346 nT" in one.text


def test_a_sensor_that_was_moved_is_told_with_the_map_s_change_over_the_way():
    x, y, z = ROBOT.p_base_magnetometer
    (one,) = found(learned(), robot=dataclasses.replace(ROBOT, p_base_magnetometer=(x + 0.1, y, z)))
    told = float(one.text.split("at least ")[1].split(" nT")[0])
    assert told == pytest.approx(SLOPE * 0.1 / 2**0.5, rel=0.1)


@pytest.mark.parametrize(
    "fact", [{"sensor_m": "here"}, {"lever_arm_m": "1"}, {"map_samples_nt": "1 2 3", "map_sha256": "b" * 64}]
)
def test_metadata_that_are_no_numbers_are_refused_by_name(fact):
    with pytest.raises(InputError, match=f"f.safetensors: its metadata '{next(iter(fact))}' must list"):
        found(learned() | fact)


def test_a_run_tells_its_robot_and_motion_capture_as_it_was_in_the_session(lab_scene):
    twin = open_twin(lab_scene, magnetometer="physical")
    short = {"duration_s": 0.5, "rate_hz": 20.0}
    drawn = simulate(twin, "sine", session=2, **short)
    surveyed = simulate(twin, "sine", session="survey", **short)
    (many,) = sweep(twin, "sine", [0], robots=in_session(twin, 2), **short)
    assert drawn.metadata["robot_name"] == "turtlebot4"
    assert drawn.metadata["mocap_offset_m"] == many.metadata["mocap_offset_m"] == "0.055, -0.03"
    assert surveyed.metadata["mocap_offset_m"] == "0, 0"
    assert drawn.metadata["platform_sha256"] == surveyed.metadata["platform_sha256"]


@pytest.fixture
def strange(tmp_path):
    """Weights that learned on a map that is off by 300 nT, on another robot."""
    scene_map = shipped("maps", "lab", "lab.usdc")
    from magtwin.usd.maps.layer import load_map

    field = load_map(scene_map)
    off = dataclasses.replace(field, values_nt=field.values_nt + 300.0, harmonic=None, name="off")
    save_map(off, tmp_path / "off.usdc")
    other = dataclasses.replace(ROBOT, name="husky", p_base_magnetometer=(0.3, 0.0, 0.9))
    metadata = learned(off, other) | {"map": "off", "map_sha256": sha256(tmp_path / "off.usdc")}
    metadata |= {"residual_offset_sd_nt": 50.0, "residual_time_s": 1.0}
    file = tmp_path / "strange.safetensors"
    a_net("full", (4,), residual_sd_nt=100.0, metadata=metadata).save(file)
    return file


def test_open_twin_warns_and_runs_keep_what_it_said(lab_scene, strange):
    with pytest.warns(MismatchWarning) as told:
        twin = open_twin(lab_scene, network=strange)
    texts = [str(one.message) for one in told]
    assert texts[0].startswith("WRONG ROBOT")
    assert "differ by 300 nT RMS" in texts[1]
    run = simulate(twin, "sine", duration_s=0.5, rate_hz=20.0)
    assert run.metadata["network_mismatch"] == "; ".join(texts)


def test_the_shipped_scene_s_network_belongs_to_its_map_and_robot(lab_scene):
    with warnings.catch_warnings():
        warnings.simplefilter("error", MismatchWarning)
        twin = open_twin(lab_scene)
    assert "network_mismatch" not in twin.metadata
    assert twin.magnetometer.net.metadata["map_sha256"] == sha256(shipped("maps", "lab", "lab.usdc"))


def test_a_command_says_each_mismatch_once_on_stderr_and_info_shows_it(lab_scene, strange, tmp_path, capsys):
    out = tmp_path / "run"
    main(["run", str(lab_scene), "--network", str(strange), "--duration-s", "1", "--out", str(out)])
    shown = capsys.readouterr()
    lines = [line for line in shown.err.splitlines() if "warning" in line]
    assert len(lines) == 3
    assert lines[0].startswith("magtwin: warning: WRONG ROBOT: strange.safetensors")
    assert "WRONG ROBOT" in shown.out
    main(["info", str(out / "run.parquet")])
    assert "WRONG ROBOT" in capsys.readouterr().out
