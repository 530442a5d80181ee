import json

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from magtwin.errors import InputError
from magtwin.io.formats import read_run, write_run
from magtwin.io.release import read_release
from magtwin.learn.data.features import features


def frame(i, **changes):
    """A frame of the i-th tenth of a second; every second one is another sensor's message."""
    told = {
        "timestamp": 1.7e9 + i / 10,
        "nn_magnetic_magnitude": 41_000.5 + i if i % 2 == 0 else 0.0,
        "map_magnetic_magnitude": 40_800.0 + i,
        "pose_data": [0.1 * i, -0.2 * i, 3.0 + 0.1 * i],
        "odom": [[0.2, 0.01 * i, 0.0], [0.0, 0.0, 0.1 * i]],
        "imu_data": [[0.0, 0.0, 0.6, -0.8], [0.01, 0.02, 0.1 * i], [0.5, -0.25, 0.0]],
        "battery_data": [15.7 - 0.01 * i, 0.9],
        "lidar": i % 4 // 2,
    }
    return {**told, **changes}


def text(frames, end="]"):
    return "[\n" + "".join(json.dumps(one) + ",\n" for one in frames) + end


def recorded(tmp_path, content, name="sine_3.json"):
    path = tmp_path / name
    path.write_text(content)
    return path


def test_every_frame_with_a_reading_is_a_row_with_what_was_known_by_then(tmp_path):
    run = read_run(recorded(tmp_path, text([frame(i) for i in range(9)])))
    i = np.arange(0, 9, 2)
    assert_allclose(run["t"], i / 10, atol=1e-6)
    assert_array_equal(run["b_measured_nt"], 41_000.5 + i)
    assert_array_equal(run["b_map_nt"], 40_800.0 + i)
    assert_allclose(run["mocap_p"], np.column_stack([0.1 * i, -0.2 * i, 0 * i]))
    assert_allclose(run["yaw"], (3.0 + 0.1 * i + np.pi) % (2 * np.pi) - np.pi)
    assert_allclose(run["imu_q_xyzw"], np.tile([0, 0, -0.6, 0.8], (5, 1)))
    assert_allclose(run["odom_w"][:, 2], 0.1 * i)
    assert_array_equal(run["lidar_on"], i % 4 // 2 == 1)
    assert run.metadata["frames"] == 9
    assert run.metadata["recording_end"] == "whole"
    assert run.metadata["start_s"] == 1.7e9
    assert features(run, "full").shape == (5, 20)
    assert np.isfinite(features(run, "full")).all()


@pytest.mark.parametrize(
    ("end", "told", "rows"),
    [
        ("]", "whole", 3),
        ("]\n\n", "whole", 3),
        ("", "without its bracket", 3),
        ("  \n", "without its bracket", 3),
        ('{"timestamp": 17', "within frame 6", 3),
        ('{"timestamp": 1700000001.0, "nn_mag', "within frame 6", 3),
        ('{"timestamp": 1700000001.0, "lidar": tr', "within frame 6", 3),
        ("{", "within frame 6", 3),
        (json.dumps(frame(5))[:-1], "within frame 6", 3),
        (json.dumps(frame(6)) + "]", "whole", 4),
    ],
)
def test_a_node_that_was_killed_leaves_all_whole_frames(tmp_path, end, told, rows):
    run = read_release(recorded(tmp_path, text([frame(i) for i in range(5)], end)))
    assert run.rows == rows
    assert run.metadata["recording_end"] == told


def test_what_was_not_heard_of_yet_is_nan(tmp_path):
    early = frame(
        0, pose_data=[], imu_data=None, odom=[[], []], battery_data=[None, None], map_magnetic_magnitude=0.0
    )
    run = read_release(recorded(tmp_path, text([early, frame(2)])))
    for name in ("mocap_p", "yaw", "imu_q_xyzw", "odom_v", "battery_v", "b_map_nt"):
        assert np.isnan(run[name][0]).all(), name
        assert np.isfinite(run[name][1]).all(), name


def test_of_two_readings_at_one_time_the_later_counts(tmp_path):
    run = read_release(recorded(tmp_path, text([frame(0), frame(0, nn_magnetic_magnitude=5.0), frame(2)])))
    assert_array_equal(run["b_measured_nt"], [5.0, 41_002.5])


BAD = [
    ("", "is empty"),
    ("{}", "a recording of the release begins with '\\['"),
    ("[]", "0 frames, and none carries a reading"),
    (text([frame(1), frame(3)]), "2 frames, and none carries a reading .nn_magnetic_magnitude is 0"),
    (text([frame(0), frame(2, pose_data=[1, 2])]), r"frame 2 \(at character \d+\): pose_data must be 3"),
    (text([frame(0, odom=[1, 2, 3])]), r"frame 1 .*odom must be 6 numbers here, got \[1, 2, 3\]"),
    (text([frame(0, lidar=2)]), "frame 1 .*lidar must be 0 or 1, got 2"),
    (text([frame(0, battery_data=["15", 1])]), 'battery_data must be a finite number, got "15"'),
    (text([frame(0, timestamp=None)]), r"timestamp must be a time \[s\], got null"),
    (text([frame(0, timestamp=1e400)]), "timestamp must be a finite number, got Infinity"),
    (text([{k.replace("odom", "odm"): v for k, v in frame(0).items()}]), "no 'odom' .* mean 'odm'"),
    (text([frame(4), frame(2)]), "frame 2 .*its clock goes back from 1700000000.4 to 1700000000.2 s"),
    (text([frame(0)], '7, {"a": 1}]'), "frame 2 .*a frame begins with '{', this with '7'"),
    (text([frame(0)], '{"timestamp" 1}, {}]'), r"frame 2 \(at character \d+\): not JSON: Expecting ':'"),
    (text([frame(0)]) + text([frame(2)]), "goes on after the end of its list.* two recordings"),
    ("[" * 100_000, "a frame begins with"),
    ('[{"a":' + "[" * 100_000, "frame 1 .*not JSON"),
]


@pytest.mark.parametrize(("content", "said"), BAD, ids=range(len(BAD)))
def test_what_is_no_recording_is_refused_with_its_frame(tmp_path, content, said):
    with pytest.raises(InputError, match=said) as refused:
        read_run(recorded(tmp_path, content))
    assert "sine_3.json" in str(refused.value)
    assert len(str(refused.value)) < 500 + len(str(tmp_path))


def test_bytes_that_are_no_text_and_writing_one_are_refused(tmp_path):
    (tmp_path / "a.json").write_bytes(b"[\n\xff\xfe\x00")
    with pytest.raises(InputError, match="not a text file"):
        read_run(tmp_path / "a.json")
    run = read_run(recorded(tmp_path, text([frame(0)])))
    with pytest.raises(InputError, match="a released package is read, not written"):
        write_run(run, tmp_path / "b.json")
    assert not (tmp_path / "b.json").exists()
