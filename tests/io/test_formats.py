"""One run through every format that holds it, and the commands that read and write them all."""

import json

import numpy as np
import pytest
from recordings import as_db3
from refusing import refused
from test_run import assert_same, every_column
from test_tables import few_bytes

from magtwin.cli import main
from magtwin.errors import InputError
from magtwin.io.formats import FORMATS, Format, read_run, write_run
from magtwin.io.tables import ParquetParts
from magtwin.run.run import Column, Run
from magtwin.twin import Twin, open_twin, simulate

EXACT = ("run.parquet", "run.csv", "run.npz", "run.rrd", "run.usd", "run.usda", "run.usdc")
BAGS = ("run.mcap", "bag")
READ = (*EXACT, *BAGS, "run.db3")
"""Formats that are read; .db3 is written by rosbags."""

WITHIN = {
    "battery_v": {"rtol": 1e-7},
    "battery_a": {"rtol": 1e-7},
    "battery_fraction": {"rtol": 1e-7},
    "b_vector_measured_nt": {"rtol": 1e-15},
}
"""What a bag's messages are coarser in: the battery's are float32, the vector is published in tesla."""


@pytest.fixture(scope="module")
def twin(lab_scene) -> Twin:
    return open_twin(lab_scene, magnetometer="physical")


@pytest.fixture(scope="module")
def run(twin) -> Run:
    """Four seconds along the figure of eight, with every column, true metadata, and flags that change."""
    run = simulate(twin, "figure8", seed=11, duration_s=4.0)
    flag = np.zeros(run.rows, bool)
    flag[200:203] = True
    return run.with_columns(flag_bump=flag).with_metadata(title="größe", big=2**60, quick=True)


@pytest.fixture(scope="module")
def written(run, twin, tmp_path_factory):
    """A folder with the run in every format."""
    folder = tmp_path_factory.mktemp("formats")
    for name in (*EXACT, *BAGS):
        write_run(run, folder / name, twin)
    as_db3(folder / "run.mcap", folder / "run.db3")
    return folder


def assert_carried(run, again):
    assert list(again) == list(run)
    assert dict(again.metadata) == dict(run.metadata)
    assert {key: type(value) for key, value in again.metadata.items()} == {
        key: type(value) for key, value in run.metadata.items()
    }


@pytest.mark.parametrize("name", EXACT)
def test_a_run_comes_back_to_the_last_bit_with_its_metadata(name, run, written):
    again = read_run(written / name)
    assert_carried(run, again)
    assert_same(run, again)


@pytest.mark.parametrize("name", [*EXACT, *BAGS])
def test_columns_of_a_users_own_keep_unit_frame_parts_and_rule(name, tmp_path):
    run = Run({"t": np.arange(5.0), "head_k": np.full(5, 290.0), "coil": np.arange(15.0).reshape(5, 3)})
    run = run.with_columns(p_world_base=np.zeros((5, 3)), q_world_base_xyzw=np.tile([0, 0, 0, 1.0], (5, 1)))
    run = run.with_columns(valve=np.arange(5) > 2, est_q_xyzw=np.tile([0, 0, 0, 1.0], (5, 1)))
    coil = Column("A", "magnetometer", "currents", 3, ("a", "b", "c"))
    run = run.with_specs(head_k=Column("K", "", "temperature", interpolation="hold"), coil=coil)
    write_run(run, tmp_path / name)
    again = read_run(tmp_path / name)
    assert_same(run, again)
    assert {key: again.spec(key) for key in again} == {key: run.spec(key) for key in run}


@pytest.mark.parametrize("name", [*BAGS, "run.db3"])
def test_a_run_comes_back_from_a_bag_as_its_messages_carry_it(name, run, written):
    again = read_run(written / name)
    assert_carried(run, again)
    for column, values in run.items():
        if column in WITHIN:
            np.testing.assert_allclose(again[column], values, **WITHIN[column], err_msg=column)
        else:
            assert again[column].tobytes() == values.tobytes(), column


def test_folders_are_read_by_what_is_in_them(run, written, tmp_path):
    parts = ParquetParts(tmp_path / "run.parquet")
    parts.append(run)
    assert_same(read_run(parts.folder), run)
    (tmp_path / "out").mkdir()
    write_run(run, tmp_path / "out" / "run.parquet")
    (tmp_path / "out" / "run.png").touch()
    assert_same(read_run(tmp_path / "out"), run)
    assert len(read_run(written / "bag")) == len(run)
    (tmp_path / "none").mkdir()
    with pytest.raises(InputError, match="a folder without a run; name a file"):
        read_run(tmp_path / "none")


@pytest.mark.filterwarnings("ignore:.*cut short:magtwin.errors.RepairWarning")
@pytest.mark.parametrize("name", [f"run{suffix}" for suffix, kind in FORMATS.items() if kind.write])
def test_every_format_refuses_a_file_cut_short_or_of_another_kind(name, written, tmp_path):
    whole = (written / name).read_bytes()
    cut = () if name == "run.mcap" else (whole[: len(whole) // 3],)  # which is read as far as it goes
    for content in (b"", b"nothing of the kind\n" * 40, *cut):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError) as refused:
            read_run(tmp_path / name)
        assert name in str(refused.value)
        assert "\n" not in str(refused.value)


@pytest.mark.parametrize("name", [*EXACT, *BAGS])
def test_every_format_refuses_a_run_whose_time_goes_backwards(name, tmp_path):
    back = every_column().take(slice(None, None, -1))
    with pytest.raises(InputError, match=r"t must ascend|backwards"):
        write_run(back, tmp_path / name)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", [*EXACT, *BAGS])
def test_a_full_disk_is_refused_by_every_format_and_what_was_there_stays(name, run, twin, written, tmp_path):
    write_run(run.take(slice(0, 20)), tmp_path / name)
    before = read_run(tmp_path / name)
    whole = written / name
    room = max(file.stat().st_size for file in (whole.iterdir() if whole.is_dir() else [whole])) // 2
    with few_bytes(room), pytest.raises(InputError, match=r"cannot be written|full|too large"):
        write_run(run, tmp_path / name, twin, force=True)
    assert_same(read_run(tmp_path / name), before)
    assert [p.name for p in tmp_path.iterdir()] == [name]


def test_convert_writes_any_format_from_any_other(run, written, tmp_path, capsys):
    chain = ["run.rrd", "bag", "run.usdc", "run.npz", "run.mcap", "run.csv", "run.parquet"]
    source = written / "run.parquet"
    for name in chain:
        main(["convert", str(source), str(tmp_path / name)])
        source = tmp_path / name
    assert f"Wrote {source}: {run.rows} rows, {len(run)} columns" in capsys.readouterr().out
    assert_carried(run, read_run(source))


def test_convert_takes_frames_a_second_units_and_the_scene(run, written, lab_scene, tmp_path, capsys):
    from pxr import Usd

    main(["convert", str(written / "run.csv"), str(tmp_path / "a.usdc"), "--usd-fps", "10"])
    stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    assert stage.GetTimeCodesPerSecond() == 10
    assert stage.GetPrimAtPath("/World/turtlebot4/base_link").IsValid()  # its scene is below it
    main(["convert", str(written / "run.csv"), str(tmp_path / "b.usdc"), "--usd-fps", "0"])
    assert Usd.Stage.Open(str(tmp_path / "b.usdc")).GetTimeCodesPerSecond() == pytest.approx(135)
    main(["convert", str(written / "run.csv"), str(tmp_path / "c.mcap"), "--out-unit", "nT"])
    assert np.array_equal(read_run(tmp_path / "c.mcap")["b_measured_nt"], run["b_measured_nt"])
    stray = run.with_metadata(scene_file="gone.usda")
    write_run(stray, tmp_path / "stray.parquet")
    main(["convert", str(tmp_path / "stray.parquet"), str(tmp_path / "d.usdc")])
    assert "without a scene: gone.usda: the scene of the run is missing" in capsys.readouterr().err
    main(["convert", str(tmp_path / "stray.parquet"), str(tmp_path / "e.usdc"), "--scene", str(lab_scene)])
    assert Usd.Stage.Open(str(tmp_path / "e.usdc")).GetPrimAtPath("/World/turtlebot4/base_link").IsValid()


@pytest.mark.parametrize(
    ("source", "out", "options", "message"),
    [
        ("run.parquet", "new.xyz", [], "unknown format of a run; known: .csv"),
        ("run.parquet", "new.csv", ["--out-unit", "nT"], "CSV has no option 'units'; drop it"),
        ("run.parquet", "new.csv", ["--scene", "x.usda"], "a table shows no scene; drop --scene"),
        ("run.parquet", "new.rrd", ["--scene", "x.usda"], "x.usda: no such scene"),
        ("run.parquet", "new.mcap", ["--usd-fps", "5"], "rosbag2 has no option 'fps'"),
        ("run.parquet", "new.db3", [], "rosbag2 in SQLite is read, not written; give .mcap"),
        ("run.parquet", "new.usd", ["--usd-fps", "-5"], "fps must be above 0"),
        ("run.parquet", "run.parquet", ["--force"], "is read by this command and would be replaced"),
        ("runn.csv", "new.parquet", [], "runn.csv: no such run; did you mean 'run.csv'?"),
    ],
)
def test_what_convert_cannot_do_is_refused_in_one_line(source, out, options, message, written, capsys):
    before = sorted(p.name for p in written.iterdir())
    assert message in refused(capsys, "convert", written / source, written / out, *options)
    assert sorted(p.name for p in written.iterdir()) == before


@pytest.mark.parametrize("name", READ)
def test_info_of_every_format_tells_rows_columns_units_and_what_the_run_came_from(name, run, written, capsys):
    main(["info", str(written / name), "--json"])
    told = json.loads(capsys.readouterr().out)
    assert told["figures"]["readings"] == run.rows
    assert told["figures"]["columns"] == len(run)
    assert told["metadata"]["columns"]["b_total_nt"].startswith("nT  b_map_nt + b_disturbance_nt")
    for fact in ("seed", "scene_sha256", "map_sha256", "magtwin", "path"):
        assert told["metadata"][fact] == run.metadata[fact]


def test_a_conversion_without_its_scene_warns_of_what_the_format_lacks(run, tmp_path, monkeypatch, capsys):
    write_run(run.with_metadata(scene_file="gone/lab.usda"), tmp_path / "apart" / "run.parquet")
    monkeypatch.chdir(tmp_path)
    for name, lacks in (
        ("a.mcap", "written without /tf_static and the robot's description: "),
        ("a.rrd", "shown without a scene: "),
    ):
        main(["convert", "apart/run.parquet", name])
        assert f"warning: {lacks}" in capsys.readouterr().err
    main(["convert", "apart/run.parquet", "a.csv"])
    assert "warning" not in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["convert", "apart/run.parquet", "apart", "--force"])
    error = [line for line in capsys.readouterr().err.splitlines() if line.startswith("magtwin")]
    assert error == ["magtwin: apart: holds the run, which would be removed with it; give another name"]


def test_a_registered_format_is_read_and_written_by_its_suffix(tmp_path, monkeypatch):
    monkeypatch.setattr(FORMATS, "_loaded", dict(FORMATS._loaded))
    text = Format(
        name="text",
        read=lambda path: Run({"t": np.loadtxt(path, ndmin=1)}),
        write=lambda run, path, *, force: np.savetxt(path, run["t"]),
    )
    FORMATS.register(".txt")(text)
    write_run(Run({"t": [0.0, 1.0]}), tmp_path / "run.txt")
    assert read_run(tmp_path / "run.txt").rows == 2


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("p_world_base", 1e300, r"'p_world_base', row 1: 1e\+300 is beyond 1e\+30"),
        ("b_total_nt", -1e308, "'b_total_nt', row 1: -1e"),
        ("t", 1e12, "t must be seconds, from -9.2e"),
    ],
)
def test_numbers_that_no_run_can_hold_are_refused(name, value, message, tmp_path):
    run = every_column(3)
    values = run[name].copy()
    values[slice(1, 2) if name != "t" else slice(2, 3)] = value
    np.savez(tmp_path / "run.npz", **{**run.columns, name: values})
    with pytest.raises(InputError, match=message):
        read_run(tmp_path / "run.npz")
