import contextlib
import dataclasses
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path as FilePath

import numpy as np
import pytest
import rerun as rr
import rerun_cli
from PIL import Image
from rerun.chunk import RrdReader
from waiting import PATIENCE_S, wait_until

from magtwin.cli import main
from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.frames import quat_from_rpy, quat_from_yaw, rotate
from magtwin.io.rerun import recording
from magtwin.io.rerun.file import read_run, read_runs, show_run, write_comparison, write_rrd
from magtwin.io.rerun.live import RrdWriter
from magtwin.io.rerun.series import DERIVED, STATES
from magtwin.io.rerun.viewer import live_viewer, screenshot, show
from magtwin.io.tables import write_parquet
from magtwin.path import figure8
from magtwin.run.run import COLUMNS, Run
from magtwin.spec.robot import RobotSpec
from magtwin.spec.scene import Scene
from magtwin.spec.sensors import MagnetometerSpec
from magtwin.twin import Twin, scan

HEADER = """#usda 1.0
(
    defaultPrim = "lab"
    metersPerUnit = 1
    upAxis = "Z"
)

def Xform "lab"
{
"""
BOX = """def Cube "{name}"
{{
    double size = 1
    color3f[] primvars:displayColor = [{colour}]
    double3 xformOp:scale = {size}
    double3 xformOp:translate = {place}
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]
}}
"""
LINK = """def Xform "{name}" (prepend apiSchemas = ["PhysicsRigidBodyAPI"])
{{
    double xformOp:rotateX = {roll}
    double3 xformOp:translate = {place}
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateX"]
    def Cylinder "visual"
    {{
        double radius = {radius}
        double height = {height}
        double3 xformOp:translate = (0, 0, {lift})
        uniform token[] xformOpOrder = ["xformOp:translate"]
        color3f[] primvars:displayColor = [{colour}]
    }}
}}
"""
JOINT = """def Physics{kind}Joint "{name}_joint"
{{
    rel physics:body0 = </lab/robot/base_link>
    rel physics:body1 = </lab/robot/{name}>
    uniform token physics:axis = "Z"
}}
"""


def a_stage() -> str:
    """A floor, two walls, and a robot of a base, two wheels, a post and a magnetometer."""
    boxes = [
        ("floor", (6, 3.5, 0.1), (0, 0, -0.05), (0.3, 0.3, 0.3)),
        ("wall_n", (6.1, 0.05, 0.3), (0, 1.775, 0.15), (0.5, 0.5, 0.45)),
        ("wall_e", (0.05, 3.5, 0.3), (3.025, 0, 0.15), (0.5, 0.5, 0.45)),
    ]
    links = [
        ("base_link", (0, 0, 0), 0, 0.164, 0.06, 0.05, (0.1, 0.1, 0.1)),
        ("left_wheel", (0, 0.1165, 0.04), -90, 0.03575, 0.015, 0, (0.02, 0.02, 0.02)),
        ("right_wheel", (0, -0.1165, 0.04), -90, 0.03575, 0.015, 0, (0.02, 0.02, 0.02)),
        ("plate", (0, 0, 0.3), 0, 0.137, 0.003, 0, (0.6, 0.6, 0.6)),
        ("magnetometer_link", (0, 0, 0.33), 0, 0.03, 0.04, 0, (0.7, 0.1, 0.1)),
    ]
    text = HEADER
    for name, size, place, colour in boxes:
        text += BOX.format(name=name, size=size, place=place, colour=colour)
    text += 'def Xform "robot"\n{\n'
    for name, place, roll, radius, height, lift, colour in links:
        text += LINK.format(
            name=name, place=place, roll=roll, radius=radius, height=height, lift=lift, colour=colour
        )
        if name != "base_link":
            text += JOINT.format(name=name, kind="Revolute" if "wheel" in name else "Fixed")
    return text + "}\n}\n"


def a_field() -> AnomalyMap:
    """A map of one hill and a slope, at two headings, with a hole."""
    x, y = np.meshgrid(np.linspace(-3, 3, 25), np.linspace(-1.75, 1.75, 15))
    hill = 41_000 + 5_000 * np.exp(-((x - 1) ** 2 + y**2)) - 900 * x
    values = np.stack([hill, hill + 400])
    valid = np.ones(values.shape, bool)
    valid[:, 2:4, 3:5] = False
    return AnomalyMap(
        values_nt=values, origin_m=(-3, -1.75), cell_m=(0.25, 0.25), headings_rad=[0, np.pi], valid=valid
    )


def a_run(field: AnomalyMap, *, rows: int = 2000, rate_hz: float = 135.0, vector: bool = True) -> Run:
    """A robot that drives a figure of eight over a map, with every column filled."""
    rng = np.random.default_rng(1)
    t = np.arange(rows) / rate_hz
    path = figure8()
    along = np.linspace(0, 1, len(path.p_xy))
    x, y = (np.interp(t / 65 % 1, along, path.p_xy[:, k]) for k in (0, 1))
    yaw = np.unwrap(np.arctan2(np.gradient(y), np.gradient(x)))
    v = np.hypot(np.gradient(x, t), np.gradient(y, t))
    zero, q = np.zeros(rows), quat_from_yaw(yaw)
    b_map = field.lookup(np.column_stack([x, y]), yaw)
    disturbance = 300 * np.sin(yaw) + rng.normal(0, 20, rows)
    w = np.gradient(yaw, t)
    columns = {
        "t": t,
        "p_world_base": np.column_stack([x, y, zero]),
        "q_world_base_xyzw": q,
        "yaw": (yaw + np.pi) % (2 * np.pi) - np.pi,
        "v_base": np.column_stack([v, zero, zero]),
        "w_base": np.column_stack([zero, zero, w]),
        "v_cmd": np.full(rows, 0.2),
        "w_cmd": w,
        "wheel_angle": np.cumsum(np.column_stack([v - 0.1 * w, v + 0.1 * w]), axis=0) / rate_hz / 0.03575,
        "odom_v": np.column_stack([v + rng.normal(0, 0.005, rows), zero, zero]),
        "imu_w": np.column_stack([zero, zero, w + rng.normal(0, 0.02, rows)]),
        "battery_v": 15.7 + rng.normal(0, 0.02, rows),
        "battery_fraction": 1 - t / 6000,
        "lidar_on": t % 60 > 40,
        "b_map_nt": b_map,
        "b_disturbance_nt": disturbance,
        "b_total_nt": b_map + disturbance,
        "b_measured_nt": b_map + disturbance + rng.normal(0, 5, rows),
        "b_vector_nt": np.tile([12e3, -9e3, -38e3] if vector else [np.nan] * 3, (rows, 1)),
        "b_truth_nt": np.full(rows, np.nan),
        "flag_outside_map": np.isnan(b_map),
    }
    for name, column in COLUMNS.items():
        shape = (rows,) if column.width == 1 else (rows, column.width)
        columns.setdefault(name, np.zeros(shape, bool if column.unit == "bool" else float))
    return Run(
        {name: columns[name] for name in COLUMNS},
        {"path": "figure8", "seed": 1, "map": "hill", "magtwin": "0"},
    )


def a_scene(layer: FilePath) -> Scene:
    robot = RobotSpec(
        name="robot",
        asset=layer,
        p_base_magnetometer=(0, 0, 0.33),
        magnetometer=MagnetometerSpec(link="magnetometer_link"),
    )
    return Scene(name="lab", map_layer=layer, robot=robot)


@pytest.fixture(scope="module")
def parts(tmp_path_factory):
    """A run, and what write_rrd needs beside it."""
    stage = tmp_path_factory.mktemp("stage") / "lab.usda"
    stage.write_text(a_stage())
    field = a_field()
    return a_run(field), {"twin": Twin(a_scene(stage), stage, field, None), "planned": figure8()}


@pytest.fixture(scope="module")
def written(parts, tmp_path_factory):
    run, rest = parts
    path = tmp_path_factory.mktemp("rrd") / "run.rrd"
    write_rrd(run, path, **rest)
    return path


def columns_of(rrd, entity):
    """Times [ns] and values by component of an entity, the values nested as Rerun nests them."""
    times, values = [], {}
    for chunk in RrdReader(rrd).stream().to_chunks():
        if chunk.entity_path == f"/{entity}":
            batch = chunk.to_record_batch()
            if "sim_time" in batch.schema.names:
                times += batch.column("sim_time").cast("int64").to_pylist()
            for name in batch.schema.names:
                if name not in ("sim_time", "rerun.controls.RowId"):
                    values.setdefault(name, []).extend(batch.column(name).to_pylist())
    return np.array(times), values


def test_every_column_is_a_component_under_its_own_name_at_full_rate(parts, written):
    run, _ = parts
    times, values = columns_of(written, "run")
    assert np.array_equal(times, np.rint(run["t"] * 1e9))  # Rerun's clock counts nanoseconds
    for name, column in COLUMNS.items():
        rows = [row[0] for row in values[name]]
        if column.parts:
            assert list(rows[0]) == list(column.parts)
            rows = [list(row.values()) for row in rows]
        assert np.array_equal(np.array(rows), run[name], equal_nan=column.unit != "bool"), name


def test_a_run_comes_back_to_the_bit_with_its_metadata_and_the_order_of_its_columns(parts, written):
    run, _ = parts
    back = read_run(written)
    assert list(back) == list(run)
    assert dict(back.metadata) == dict(run.metadata)
    for name in run:
        assert back[name].dtype == run[name].dtype
        assert back[name].tobytes() == np.ascontiguousarray(run[name]).tobytes(), name


def test_states_hold_from_each_change_of_a_flag_to_the_next(parts, written):
    run, _ = parts
    for column, state in STATES.items():
        times, values = columns_of(written, f"states/{state.name}")
        words = np.array([state[0] for state in values["StateChange:state"]])
        held = words[np.searchsorted(times, np.rint(run["t"] * 1e9), side="right") - 1]
        assert np.array_equal(held, np.where(run[column], state.up, state.down)), column


def test_the_robot_stands_where_the_run_has_it_at_fifty_hertz_or_less_to_the_last_row(parts, written):
    run, _ = parts
    times, values = columns_of(written, "world/robot")
    rows = np.searchsorted(run["t"], times / 1e9 - 1e-6)
    assert np.diff(times)[:-1].min() >= 1e9 / 50
    assert rows[-1] == run.rows - 1
    p = np.array(values["Transform3D:translation"])[:, 0]
    q = np.array(values["Transform3D:quaternion"])[:, 0]
    np.testing.assert_allclose(p, run["p_world_base"][rows], atol=1e-6)  # Rerun's poses are single precision
    np.testing.assert_allclose(q, run["q_world_base_xyzw"][rows], atol=1e-6)


def test_wheels_turn_about_their_axles_by_the_runs_angles(parts, written):
    run, _ = parts
    for side, name in enumerate(("left_wheel", "right_wheel")):
        times, values = columns_of(written, f"world/robot/{name}")
        q = np.array(values["Transform3D:quaternion"])[:, 0]
        rows = np.searchsorted(run["t"], times / 1e9 - 1e-6)
        axle, spoke = rotate(q, [0.0, 0, 1]), rotate(q, [1.0, 0, 0])
        np.testing.assert_allclose(axle, np.tile([0, 1, 0], (len(q), 1)), atol=1e-6)  # y points to the left
        angle = np.arctan2(-spoke[:, 2], spoke[:, 0])  # a wheel that rolls forward turns x downwards
        off = np.angle(np.exp(1j * (angle - run["wheel_angle"][rows, side])))
        np.testing.assert_allclose(off, 0, atol=1e-5)


def test_what_stands_still_and_each_link_is_one_mesh_of_the_stages_triangles(written):
    for entity, triangles in {
        "world/lab/lab/floor": 12,
        "world/robot/base_link": 128,
        "world/robot/plate": 128,
    }.items():
        _, values = columns_of(written, entity)
        assert len(values["Mesh3D:vertex_positions"][0]) == 3 * triangles, entity
    x, y, z = np.array(columns_of(written, "world/lab/lab/floor")[1]["Mesh3D:vertex_positions"][0]).T
    assert (np.ptp(x), np.ptp(y), z.max()) == pytest.approx((6, 3.5, 0), abs=1e-6)


def test_the_ribbon_of_readings_goes_where_the_sensor_was_and_the_plan_lies_on_the_floor(parts, written):
    run, rest = parts
    times, values = columns_of(written, "world/readings")
    strips = np.array(values["LineStrips3D:strips"])[:, 0]
    rows = np.searchsorted(run["t"], times / 1e9 - 1e-6)
    np.testing.assert_allclose(strips[:, 1], run["p_world_base"][rows] + [0, 0, 0.33], atol=1e-6)
    np.testing.assert_array_equal(strips[1:, 0], strips[:-1, 1])  # a ribbon without a gap
    _, plan = columns_of(written, "world/planned")
    strip = np.array(plan["LineStrips3D:strips"][0][0])
    np.testing.assert_allclose(strip[:, :2], rest["planned"].p_xy, atol=1e-6)


def test_the_floor_is_viridis_of_the_map_and_see_through_where_it_is_unknown(written):
    _, values = columns_of(written, "world/map")
    form = values["GridMap:format"][0][0]
    pixels = np.array(values["GridMap:data"][0][0], np.uint8).reshape(form["height"], form["width"], 4)
    assert not pixels[::-1][:, :][int(0.6 / 0.02), int(0.9 / 0.02), 3]  # the hole, from the lower left corner
    row, column = int((1.75 - 0) / 0.02), int((3 + 1) / 0.02)
    assert pixels[row, column].tolist()[3] == 255
    assert pixels[row, column, :3].sum() > pixels[row, -1, :3].sum()  # the hill is bright, the slope dark


def test_the_field_arrow_goes_through_the_sensor_and_is_there_only_where_the_vector_is_known(
    parts, written, tmp_path
):
    run, rest = parts
    _, values = columns_of(written, "world/robot/magnetometer/field")
    arrow, tail = (np.array(values[f"Arrows3D:{key}"][-1][0]) for key in ("vectors", "origins"))
    b = run["b_vector_nt"][0]
    np.testing.assert_allclose(arrow / np.linalg.norm(arrow), b / np.linalg.norm(b), atol=1e-6)
    np.testing.assert_allclose(tail, -arrow / 2, atol=1e-6)
    write_rrd(a_run(rest["twin"].field, rows=50, vector=False), tmp_path / "run.rrd", **rest)
    assert not columns_of(tmp_path / "run.rrd", "world/robot/magnetometer/field")[1]


@pytest.mark.parametrize("rows", [1, 10])
def test_a_run_of_a_few_rows_is_recorded_too(parts, rows, tmp_path):
    run, rest = parts
    few = Run({name: values[:rows] for name, values in run.items()}, {"note": "a | b"})
    write_rrd(few, tmp_path / "run.rrd", **rest)
    times, _ = columns_of(tmp_path / "run.rrd", "run")
    assert len(times) == rows
    assert r"| note | a \| b |" in columns_of(tmp_path / "run.rrd", "metadata")[1]["TextDocument:text"][0][0]


def test_the_metadata_are_properties_of_the_recording_and_a_page_in_it(parts, written):
    run, _ = parts
    batch = next(c for c in RrdReader(written).stream().to_chunks() if c.entity_path == "/__properties/run")
    told = {k: v[0][0] for k, v in batch.to_record_batch().to_pydict().items() if not k.startswith("rerun.")}
    assert told == dict(run.metadata)
    schema = RrdReader(written).store().schema().component_columns()
    assert {column.component for column in schema if column.entity_path == "/run"} >= set(COLUMNS)
    page = columns_of(written, "metadata")[1]["TextDocument:text"][0][0]
    assert all(f"| {key} | {value} |" in page for key, value in run.metadata.items())


def test_the_arrow_is_at_a_sensor_whose_link_has_no_shape_and_a_map_without_field_is_recorded(
    parts, tmp_path
):
    run, rest = parts
    turn = tuple(quat_from_rpy([0.1, 0.2, 0.3]).tolist())
    twin = rest["twin"]
    robot = dataclasses.replace(
        twin.scene.robot,
        p_base_magnetometer=(0.05, -0.02, 0.4),
        q_base_magnetometer_link_xyzw=turn,
        magnetometer=MagnetometerSpec(link="a_frame_without_mass_or_shape"),
    )
    field = dataclasses.replace(twin.field, valid=np.zeros(twin.field.values_nt.shape, bool))
    twin = dataclasses.replace(twin, scene=dataclasses.replace(twin.scene, robot=robot), field=field)
    nothing = np.full(run.rows, np.nan)
    run = run.with_columns(b_map_nt=nothing, b_total_nt=nothing, b_measured_nt=nothing)
    write_rrd(run, tmp_path / "run.rrd", **rest | {"twin": twin})
    _, values = columns_of(tmp_path / "run.rrd", "world/robot/magnetometer")
    np.testing.assert_allclose(values["Transform3D:translation"][0][0], [0.05, -0.02, 0.4], atol=1e-6)
    np.testing.assert_allclose(values["Transform3D:quaternion"][0][0], turn, atol=1e-6)
    assert np.isnan(read_run(tmp_path / "run.rrd")["b_total_nt"]).all()


def rerun(*arguments):
    """Rerun's own command line."""
    program = FilePath(rerun_cli.__file__).with_name("rerun")
    return subprocess.run([program, *map(str, arguments)], capture_output=True, text=True, check=False)


def test_two_recordings_of_one_run_are_the_same_recording(parts, tmp_path):
    run, rest = parts
    run = Run({name: np.nan_to_num(values) for name, values in run.items()}, run.metadata)  # nan != nan
    for name in ("a.rrd", "b.rrd"):
        write_rrd(run, tmp_path / name, **rest)
    a, b = (RrdReader(tmp_path / name).recordings()[0].recording_id for name in ("a.rrd", "b.rrd"))
    assert a == b
    assert rerun("rrd", "verify", tmp_path / "a.rrd").returncode == 0
    done = rerun("rrd", "compare", "--unordered", tmp_path / "a.rrd", tmp_path / "b.rrd")
    assert done.returncode == 0, done.stderr[:500]


def test_another_run_is_another_recording(parts, written, tmp_path):
    run, rest = parts
    write_rrd(run.with_metadata(seed=2), tmp_path / "seed.rrd", **rest)
    write_rrd(run.with_columns(yaw=run["yaw"] + 1e-9), tmp_path / "yaw.rrd", **rest)
    ids = [
        RrdReader(p).recordings()[0].recording_id
        for p in (written, tmp_path / "seed.rrd", tmp_path / "yaw.rrd")
    ]
    assert len(set(ids)) == 3


def test_runs_without_rows_or_times_existing_files_and_a_disabled_rerun_are_refused(
    parts, tmp_path, monkeypatch
):
    run, rest = parts
    path = tmp_path / "run.rrd"
    with pytest.raises(InputError, match=r"run\.rrd: the run has no rows"):
        write_rrd(Run({name: v[:0] for name, v in run.items()}), path, **rest)
    with pytest.raises(InputError, match=r"t of row 3 is not finite"):
        write_rrd(Run({"t": [0.0, 1.0, np.nan]}), path)
    assert not list(tmp_path.iterdir())
    path.write_text("kept")
    with pytest.raises(InputError, match=r"run\.rrd: exists already; give `force=True`"):
        write_rrd(run, path, **rest)
    for kind in (lambda out: write_rrd(run, out), RrdWriter):
        with pytest.raises(InputError, match="cannot be written"):
            kind(path / "run.rrd")
    with monkeypatch.context() as patch:
        patch.setenv("RERUN", "off")
        with pytest.raises(InputError, match="switched off by the environment variable RERUN; unset it"):
            write_rrd(run, path, **rest, force=True)
    assert path.read_text() == "kept"
    write_rrd(run, path, **rest, force=True)
    assert RrdReader(path).recordings()


def test_a_stage_that_is_missing_is_refused_and_nothing_is_left(parts, tmp_path):
    run, rest = parts
    strict = rr.strict_mode()
    with pytest.raises(InputError, match=r"none\.usda: no such USD file"):
        write_rrd(
            run,
            tmp_path / "run.rrd",
            **{**rest, "twin": dataclasses.replace(rest["twin"], scene_file=tmp_path / "none.usda")},
        )
    assert not list(tmp_path.iterdir())
    assert rr.strict_mode() == strict


def test_columns_of_other_kinds_come_back_too(tmp_path):
    run = Run(
        {
            "t": np.arange(5.0),
            "est_p": np.arange(10.0).reshape(5, 2) / 3,
            "a count, of /odd:name": np.arange(5, dtype=np.int16),
            "est_sd": np.linspace(0, 1, 5, dtype=np.float32),
            "flag_bump": np.array([1, 0, 1, 1, 0], bool),
        },
        {"seed": 2**80, "note": 'a | "b"\nc', "share": 0.1, "on": True},
    )
    write_rrd(run, tmp_path / "run.rrd")
    back = read_run(tmp_path / "run.rrd")
    assert list(back) == list(run)
    assert dict(back.metadata) == dict(run.metadata)
    assert {type(fact) for fact in back.metadata.values()} == {int, str, float, bool}
    for name in run:
        assert back[name].dtype == run[name].dtype
        assert np.array_equal(back[name], run[name])
    with pytest.raises(InputError, match="column 'word' cannot be recorded"):
        write_rrd(Run({"t": np.arange(2.0), "word": np.array(["a", "b"])}), tmp_path / "b.rrd")
    assert [path.name for path in tmp_path.iterdir()] == ["run.rrd"]


def test_plots_of_error_and_interval_follow_from_the_columns(parts, tmp_path):
    run, rest = parts
    rng = np.random.default_rng(3)
    run = run.with_columns(
        b_truth_nt=run["b_total_nt"] - rng.normal(0, 40, run.rows), b_sd_nt=np.full(run.rows, 41.0)
    )
    write_rrd(run, tmp_path / "run.rrd", **rest)
    _, values = columns_of(tmp_path / "run.rrd", "derived")
    assert set(values) == set(DERIVED)
    shown = {name: np.ravel(values[name]) for name in DERIVED}
    total, truth = run["b_total_nt"], run["b_truth_nt"]
    single = {"rtol": 1e-6, "atol": 0.01, "equal_nan": True}  # they are drawn in single precision
    np.testing.assert_allclose(shown["error_nt"], total - truth, **single)
    np.testing.assert_allclose(shown["measured_error_nt"], run["b_measured_nt"] - truth, **single)
    np.testing.assert_allclose(shown["interval_high_nt"] - shown["interval_low_nt"], 3.29 * 41, atol=0.02)
    known = np.isfinite(total)
    inside = np.abs(shown["error_nt"][known]) < shown["error_high_nt"][known]
    assert inside.mean() == pytest.approx(0.9, abs=0.03)
    assert set(read_run(tmp_path / "run.rrd")) == set(run)


def events_of(rrd):
    times, values = columns_of(rrd, "events")
    texts = [text[0] for text in values.get("TextLog:text", [])]
    return sorted(zip((times / 1e9).tolist(), texts, strict=True))


def test_events_tell_when_and_where_each_flag_began_and_ended(tmp_path):
    t = np.arange(0, 10, 0.01)
    flag = np.zeros(len(t), bool)
    flag[100:151], flag[160:201], flag[500:], lock = True, True, True, np.zeros(len(t), bool)
    p = np.column_stack([t, -t, 0 * t])
    lock[0] = True
    run = Run({"t": t, "p_world_base": p, "flag_bump": flag, "flag_lost_lock": lock})
    write_rrd(run, tmp_path / "run.rrd")
    assert events_of(tmp_path / "run.rrd") == [
        (0.0, "magnetometer has lock again at x, y = +0.00, -0.00 m, after 0.00 s"),
        (0.0, "magnetometer loses lock at x, y = +0.00, -0.00 m"),
        (1.0, "bump: touches an obstacle at x, y = +1.00, -1.00 m"),
        (
            2.0,
            "clear of the obstacle at x, y = +2.00, -2.00 m, after 1.00 s",
        ),  # 0.1 s apart are not two bumps
        (5.0, "bump: touches an obstacle at x, y = +5.00, -5.00 m"),  # and the last one does not end
    ]


@pytest.mark.parametrize("block", [1, 7, 333])
def test_events_and_states_are_the_same_however_the_run_is_cut_into_blocks(block, tmp_path):
    rng = np.random.default_rng(block)
    t = np.arange(600) / 20
    flags = {
        name: np.repeat(rng.random(60) < 0.4, 10) for name in ("flag_bump", "flag_pose_lost", "lidar_on")
    }
    run = Run({"t": t, "p_world_base": np.column_stack([t, t, t]), **flags})
    write_rrd(run, tmp_path / "whole.rrd")
    writer = RrdWriter(tmp_path / "blocks.rrd")
    for start in range(0, run.rows, block):
        writer.append(Run({name: values[start : start + block] for name, values in run.items()}))
    writer.close()
    assert events_of(tmp_path / "blocks.rrd") == events_of(tmp_path / "whole.rrd")
    for state in ("bump", "mocap", "LiDAR"):
        a, b = (columns_of(tmp_path / f"{name}.rrd", f"states/{state}") for name in ("blocks", "whole"))
        assert np.array_equal(a[0], b[0])
        assert a[1]["StateChange:state"] == b[1]["StateChange:state"]


def test_runs_that_are_compared_stand_on_one_timeline_with_their_offsets_and_come_back(parts, tmp_path):
    run, rest = parts
    other = Run({name: values[:500] for name, values in run.items()}, {"seed": 2})
    runs = {"the first": run, "b/2": other}
    write_comparison(runs, tmp_path / "two.rrd", rest["twin"], offsets_s={"b/2": 2.5})
    back = read_runs(tmp_path / "two.rrd")
    assert list(back) == list(runs)
    for name, one in runs.items():
        assert dict(back[name].metadata) == dict(one.metadata)
        assert all(back[name][key].tobytes() == np.ascontiguousarray(one[key]).tobytes() for key in one)
    for entity in ("run/b_2", "world/robot/b_2"):
        times, _ = columns_of(tmp_path / "two.rrd", entity)
        assert times[0] == 2.5e9
    assert rerun("rrd", "verify", tmp_path / "two.rrd").returncode == 0
    with pytest.raises(InputError, match=r"compares 2 runs \(the first, b/2\)"):
        read_run(tmp_path / "two.rrd")


def test_view_shows_several_runs(parts, tmp_path, monkeypatch):
    run, _ = parts
    for name in ("a.parquet", "b.parquet"):
        write_parquet(run, tmp_path / name)
    seen = tmp_path / "seen.rrd"
    monkeypatch.setattr("magtwin.io.rerun.viewer.show", lambda rrd, **_: shutil.copy(rrd, seen))
    files = [str(tmp_path / "a.parquet"), str(tmp_path / "b.parquet")]
    main(["view", *files])
    assert [columns_of(seen, f"run/{name}")[0][0] for name in "ab"] == [0, 0]


def test_runs_that_cannot_be_told_apart_and_offsets_of_none_are_refused(parts, tmp_path):
    run, _ = parts
    path = tmp_path / "two.rrd"
    for runs, offsets, said in (
        ({}, {}, "no runs to compare"),
        ({"a b": run, "a_b": run}, {}, "need names that differ"),
        ({"": run}, {}, "need names that differ"),
        ({"a": run}, {"b": 1.0}, "offset 1.0 s of 'b'"),
        ({"a": run}, {"a": np.inf}, "offset inf s of 'a'"),
    ):
        with pytest.raises(InputError, match=said):
            write_comparison(runs, path, offsets_s=offsets)
    assert not list(tmp_path.iterdir())


def test_a_recording_that_was_cut_short_or_is_none_is_refused_in_a_line(written, tmp_path):
    whole = written.read_bytes()
    changed = bytearray(whole)
    changed[len(whole) // 2 : len(whole) // 2 + 400] = bytes(400)
    rec = rr.RecordingStream("another", send_properties=False)
    rec.save(tmp_path / "foreign.rrd")
    rec.log("points", rr.Points3D([[0, 0, 0]]))
    rec.log("run", rr.TextDocument("not a table"), static=True)
    rec.flush()
    rec.disconnect()
    for name, content, said in (
        ("half.rrd", whole[: len(whole) // 2], "can be read|cut short"),
        ("no_end.rrd", whole[:-5000], "can be read|cut short"),
        ("changed.rrd", bytes(changed), "can be read"),
        ("text.rrd", b"t,b_total_nt\n0,1\n" * 99, "not a Rerun recording that can be read"),
        ("empty.rrd", b"", "not a Rerun recording that can be read"),
        ("foreign.rrd", None, "not one of a run"),
    ):
        if content is not None:
            (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match=said) as refused:
            read_run(tmp_path / name)
        assert str(refused.value).startswith(str(tmp_path / name))
        assert "\n" not in str(refused.value)


def test_bytes_that_were_changed_never_end_the_process(tmp_path):
    run = Run({"t": np.arange(50.0), "b_total_nt": np.arange(50.0)})
    write_rrd(run, tmp_path / "run.rrd")
    whole, rng = (tmp_path / "run.rrd").read_bytes(), np.random.default_rng(0)
    said = []
    for _ in range(12):
        changed = bytearray(whole)
        for at in rng.integers(0, len(whole), 4):
            changed[at] = rng.integers(0, 256)
        (tmp_path / "changed.rrd").write_bytes(changed)
        try:
            read_run(tmp_path / "changed.rrd")
        except InputError as error:
            said.append(str(error))
    assert len(said) >= 6
    assert not any("\n" in text for text in said)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="a limit on file sizes is of POSIX")
def test_a_full_disk_is_said_in_a_line_and_earlier_files_stay(parts, tmp_path):
    from magtwin.io.tables import write_parquet

    run, _ = parts
    write_parquet(run, tmp_path / "run.parquet")
    (tmp_path / "run.rrd").write_text("mine")
    script = """
import resource, signal, sys
from magtwin.io.rerun.file import write_rrd
from magtwin.io.rerun import recording
from magtwin.io.rerun.live import RrdWriter
from magtwin.io.tables import read_parquet
from magtwin.errors import InputError

run = read_parquet("run.parquet")
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
for limit in (1000, 100_000, int(sys.argv[1])):
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
    try:
        write_rrd(run, "run.rrd", force=True)
    except InputError as error:
        print(error)
writer = RrdWriter("live.rrd")
try:
    for _ in range(3):
        writer.append(run)
except InputError as error:
    print(error)
"""
    write_rrd(run, tmp_path / "size.rrd")
    just = (tmp_path / "size.rrd").stat().st_size - 1000  # so that only its end does not fit
    command = [sys.executable, "-c", script, str(just)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    lines = done.stdout.splitlines()
    assert len(lines) == 4
    assert all(
        line.startswith(("run.rrd: cannot be written", "live.rrd: cannot be written")) for line in lines
    )
    assert (tmp_path / "run.rrd").read_text() == "mine"
    assert {path.name for path in tmp_path.iterdir()} == {
        "run.parquet",
        "run.rrd",
        "size.rrd",
        "live.partial.rrd",
    }


@pytest.mark.skipif(not hasattr(os, "fork"), reason="a limit on file sizes is of POSIX")
def test_a_disk_that_fills_while_rerun_writes_ends_in_a_line(parts, tmp_path):
    from magtwin.io.tables import write_parquet

    write_parquet(parts[0], tmp_path / "run.parquet")
    script = """
import resource, signal
from magtwin.io.rerun import recording
from magtwin.io.rerun.file import write_rrd
from magtwin.io.tables import read_parquet
from magtwin.errors import InputError

run = read_parquet("run.parquet")
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
recording.check_room = lambda *_: None  # as if there had been room then
for limit in (0, 100, 3000, 5000, 7000, 20_000, 40_000):
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
    try:
        write_rrd(run, "run.rrd")
    except InputError as error:
        print(error)
"""
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    lines = done.stdout.splitlines()
    assert len(lines) == 7
    assert all(line.startswith("run.rrd: cannot be written (") for line in lines)
    assert {path.name for path in tmp_path.iterdir()} == {"run.parquet"}


@pytest.mark.parametrize("rows", [20, 540])
@pytest.mark.parametrize("shown", [False, True])
def test_the_room_asked_of_a_disk_is_enough_and_no_multiple_of_it(rows, shown, parts, tmp_path, monkeypatch):
    run, rest = parts
    asked = []
    monkeypatch.setattr(recording, "check_room", lambda file, size, final: asked.append(size))
    run = run.take(slice(rows))
    scans = scan(rest["twin"], run.with_columns(lidar_on=np.ones(run.rows, bool)))
    write_rrd(run, tmp_path / "run.rrd", **({**rest, "scans": scans} if shown else {}))
    (size,) = asked
    assert size / 4 < (tmp_path / "run.rrd").stat().st_size < size


@pytest.fixture
def no_display(monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        monkeypatch.delenv(name, raising=False)
    if sys.platform != "linux":
        pytest.skip("only on Linux a display can be taken away")


@pytest.mark.usefixtures("no_display")
def test_without_a_display_the_error_names_the_run_or_the_browser(parts, written, tmp_path):
    source = tmp_path / "run.parquet"
    with pytest.raises(InputError, match="the Rerun viewer opened no window: ") as refused:
        show_run(parts[0], file=source)
    text = str(refused.value)
    assert text.startswith(f"{source}: ")
    assert text.endswith("; without a display view the .rrd of this run, which a browser shows too")
    with pytest.raises(InputError, match=r"opened no window: .*DISPLAY.*; .*rerun --web-viewer --bind 127"):
        show(written)


def test_a_run_from_any_file_is_shown_as_series_and_one_without_plotted_columns_is_refused(
    parts, tmp_path, monkeypatch
):
    run, _ = parts
    seen = tmp_path / "seen.rrd"
    monkeypatch.setattr("magtwin.io.rerun.file.show", lambda rrd, **_: shutil.copy(rrd, seen))
    show_run(run, file="run.parquet")
    assert np.array_equal(read_run(seen)["b_disturbance_nt"], run["b_disturbance_nt"])
    bare = Run({"t": np.arange(3.0), "est_bias_nt": np.zeros(3)})
    with pytest.raises(InputError, match=r"run\.parquet: holds none of the columns that are plotted, such"):
        show_run(bare, file="run.parquet")


@pytest.fixture
def drawable():
    """Skips where nothing can be drawn."""
    try:
        with live_viewer(headless=True):
            pass
    except InputError as error:
        if "cannot draw here" not in str(error):
            raise
        pytest.skip(str(error))


@pytest.mark.usefixtures("drawable")
def test_the_viewer_draws_every_view_without_a_complaint(written, tmp_path):
    assert screenshot(written, tmp_path / "run.png", time_s=9.0, size=(800, 500)) == []
    content = (tmp_path / "run.png").read_bytes()
    assert content[:4] == b"\x89PNG"
    assert [int.from_bytes(content[k : k + 4]) for k in (16, 20)] == [800, 500]


def test_what_is_no_recording_is_refused_before_a_viewer_starts(written, tmp_path, monkeypatch):
    monkeypatch.setattr("magtwin.io.rerun.viewer.live_viewer", lambda **options: pytest.fail("was started"))
    fake, out = tmp_path / "fake.rrd", tmp_path / "run.png"
    fake.write_text("t,b\n0,1\n")
    with pytest.raises(InputError, match=r"fake\.rrd: not a Rerun recording"):
        screenshot(fake, out)
    with pytest.raises(InputError, match=r"a folder; name the \.rrd file in it"):
        screenshot(tmp_path, out)
    with pytest.raises(InputError, match=r"must lie in 200\.\.8000 pixels each way, got 20 x 500"):
        screenshot(written, out, size=(20, 500))
    assert not out.exists()


@pytest.mark.usefixtures("drawable")
def test_the_picture_command_draws_a_recording_and_refuses_a_time_beyond_it(written, tmp_path, capsys):
    out = tmp_path / "run.png"
    with pytest.raises(SystemExit):
        main(["picture", str(written), "--out", str(out), "--time-s", "9999"])
    assert re.search(r"the recording goes from 0 to [\d.]+ s; there is no 9999 s", capsys.readouterr().err)
    assert not out.exists()
    main(["picture", str(written), "--out", str(out), "--time-s", "5", "--size", "640x400"])
    with Image.open(out) as image:
        assert image.size == (640, 400)
        assert np.std(np.asarray(image.convert("L"))) > 20


@pytest.mark.usefixtures("drawable")
def test_a_picture_that_is_interrupted_leaves_no_viewer_and_no_file(written, tmp_path):
    if not FilePath("/proc").is_dir():
        pytest.skip("processes are read from /proc, which is not there")

    def viewers(parent):
        found = []
        for stat in FilePath("/proc").glob("[0-9]*/stat"):
            with contextlib.suppress(OSError):
                words = stat.read_text().rpartition(")")[2].split()
                if int(words[1]) == parent and b"--headless" in (stat.parent / "cmdline").read_bytes():
                    found.append(stat.parent)
        return found

    command = [sys.executable, "-m", "magtwin", "picture", str(written), "--out", str(tmp_path / "run.png")]
    (temporary := tmp_path / "temporary").mkdir()
    environment = {**os.environ, "TMPDIR": str(temporary)}
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL, env=environment)
    try:
        found = wait_until(lambda: viewers(process.pid))
        assert len(found) == 1
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE_S) == 130
    finally:
        process.kill()
        process.wait()
    assert not found[0].exists()
    assert [path.name for path in tmp_path.iterdir() if "run.png" in path.name] == []
    assert list(temporary.iterdir()) == []


@pytest.mark.usefixtures("drawable")
def test_the_viewer_listens_on_this_machine_only_and_ends_with_its_block():
    tables = [path for path in map(FilePath, ("/proc/net/tcp", "/proc/net/tcp6")) if path.exists()]
    if not tables:
        pytest.skip("listening sockets are read from /proc, which is not there")

    def listening(port):
        rows = [line.split() for table in tables for line in table.read_text().splitlines()]
        return [row[1] for row in rows if row[1].endswith(f":{port:04X}") and row[3] == "0A"]

    with live_viewer(headless=True) as (_, client):
        port = int(client.url.rsplit(":", 1)[1].split("/")[0])
        assert listening(port) == [f"0100007F:{port:04X}"]
    assert listening(port) == []


def test_a_machine_without_graphics_is_refused_with_what_to_install(written, tmp_path, monkeypatch):
    for name in ("VK_DRIVER_FILES", "VK_ICD_FILENAMES", "__EGL_VENDOR_LIBRARY_FILENAMES"):
        monkeypatch.setenv(name, str(tmp_path / "none"))
    monkeypatch.setenv("WGPU_BACKEND", "vulkan")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))  # where the viewer keeps its files too
    with pytest.raises(
        InputError, match=r"cannot draw here: .*; .*apt install mesa-vulkan-drivers libvulkan1"
    ):
        screenshot(written, tmp_path / "run.png")
    assert not list(tmp_path.iterdir())


def test_metadata_in_the_viewer_are_text_and_no_markdown():
    page = recording.metadata_page({"scene": "![x](http://a.example/t.png) <b> \u202e\x1b a\\|b\n| c"})
    (text,) = page.text.as_arrow_array().to_pylist()
    cell = text.splitlines()[2]
    assert cell == r"| scene | \!\[x\](http://a.example/t.png) \<b\> \\u202e\\x1b a\\\|b \| c |"
