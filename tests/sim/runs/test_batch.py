"""sweep: the bits of simulate, whatever the block and the order; sessions; refusals."""

import dataclasses

import numpy as np
import pytest
from test_network import a_net

from magtwin import simulate, sweep
from magtwin.errors import InputError
from magtwin.run.run import COLUMNS, Run
from magtwin.sim.motion.commands import Commands
from magtwin.twin import Twin, open_twin

PATHS = ("figure8", "sine", "continuous_cycle", "figure8", "sine", "figure8", "curvilinear")
SEEDS = (3, 1, 4, 1, 5, 9, 2)
SPEEDS = (0.2, 0.25, 0.15, 0.2, 0.3, 0.1, 0.2)
SHORT = {"duration_s": 1.5, "rate_hz": 135.0}


@pytest.fixture(scope="module")
def neural(lab_scene, tmp_path_factory) -> Twin:
    """The lab with a small network of random weights, as bits do not depend on what it has learnt."""
    file = tmp_path_factory.mktemp("net") / "small.safetensors"
    error = {"residual_offset_sd_nt": 60.0, "residual_time_s": 2.0}
    a_net("full", (48, 48), residual_sd_nt=100.0, metadata=error).save(file)
    return open_twin(lab_scene, network=file)


@pytest.fixture(scope="module")
def physical(lab_scene) -> Twin:
    return open_twin(lab_scene, magnetometer="physical")


@pytest.fixture(scope="module")
def alone(neural) -> list[Run]:
    return [
        simulate(neural, path, seed=seed, speed=speed, **SHORT)
        for path, seed, speed in zip(PATHS, SEEDS, SPEEDS, strict=True)
    ]


def assert_same(a: Run, b: Run) -> None:
    assert list(a) == list(b)
    assert dict(a.metadata) == dict(b.metadata)
    for name in a:
        assert a[name].tobytes() == b[name].tobytes(), name


@pytest.mark.parametrize("block", [1, 2, 3, 7, 100])
def test_runs_are_those_of_simulate_to_the_last_bit_whatever_the_block(neural, alone, block):
    runs = sweep(neural, PATHS, SEEDS, speeds=SPEEDS, block=block, **SHORT)
    assert len(runs) == len(alone)
    for run, own in zip(runs, alone, strict=True):
        assert_same(run, own)


@pytest.fixture(scope="module")
def others(neural) -> list[Commands | Run | str]:
    """What can be driven beside paths."""
    script = Commands("script", np.array([[0.0, 0.2, 0.3], [0.4, 0.1, -0.5], [0.8, 0.0, 0.0]]))
    return [script, "random", simulate(neural, "sine", seed=8, **SHORT), "random"]


@pytest.mark.parametrize("block", [1, 3, 8])
def test_scripts_drivers_and_recorded_runs_are_those_of_simulate_too(neural, others, block):
    ways = [*others[:2], "figure8", *others[2:]]
    runs = sweep(neural, ways, range(5), block=block, **SHORT)
    for k, run in enumerate(runs):
        assert_same(run, simulate(neural, ways[k], seed=k, **SHORT))
    assert len({run["p_world_base"].tobytes() for run in runs}) == 5


def test_what_cannot_be_driven_is_refused_with_its_number_before_anything_is(neural, others):
    broken = Commands("broken", np.array([[0.0, np.nan, 0.0]]))
    with pytest.raises(InputError, match=r"^run 1 of 2, counted from 0: .*finite"):
        sweep(neural, [others[0], broken], [0, 0], **SHORT)
    walled = dataclasses.replace(neural, scene=dataclasses.replace(neural.scene, start=(2.95, 0.0, 0.0)))
    for way in ("random", others[0]):
        with pytest.raises(InputError, match=r"^run 1 of 2, counted from 0: the robot would begin in"):
            sweep(walled, ["figure8", way], [0, 0], **SHORT)
    with pytest.raises(InputError, match="randum"):
        sweep(neural, "randum", [0], **SHORT)


def test_whole_paths_end_when_each_robot_stands(physical, tmp_path):
    files = []
    for k, end in enumerate((0.2, 0.4)):
        files.append(str(tmp_path / f"line{k}.csv"))
        (tmp_path / f"line{k}.csv").write_text(f"-2.0,-1.2\n{-2.0 + end},-1.2\n")
    runs = list(sweep(physical, files, [0, 1]))
    for run, file, seed in zip(runs, files, (0, 1), strict=True):
        assert_same(run, simulate(physical, file, seed=seed))
    assert runs[0].duration_s < runs[1].duration_s


@pytest.mark.parametrize(
    "wanted",
    [
        ["b_total_nt", "yaw", "odom_v"],
        ["b_measured_nt"],
        ["b_vector_measured_nt", "flag_bump"],
        ["b_sd_nt", "battery_a"],
        ["flag_out_of_distribution", "mocap_p"],
        [],
    ],
    ids=lambda wanted: "+".join(wanted) or "t",
)
def test_columns_that_are_kept_are_those_named_and_t_in_the_tables_order(neural, alone, wanted):
    runs = sweep(neural, PATHS, SEEDS, speeds=SPEEDS, columns=wanted, **SHORT)
    for run, own in zip(runs, alone, strict=True):
        assert list(run) == [name for name in COLUMNS if name in {"t", *wanted}]
        for name in run:
            assert run[name].tobytes() == own[name].tobytes()


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"seeds": []}, "no runs are asked for"),
        ({"seeds": [0, 1.5]}, "seed must be a whole number"),
        ({"seeds": [0, -1]}, "seed must be a whole number"),
        ({"seeds": [0, True]}, "seed must be a whole number"),
        ({"seeds": [0, "1"]}, "seed must be a whole number"),
        ({"speeds": [0.1, 0.2, 0.3]}, "speeds must be one value or one for each of 2 runs, got 3"),
        ({"robots": []}, "robots must be one value or one for each of 2 runs, got 0"),
        ({"paths": ["figure8", "figure9"]}, "figure8"),
        ({"speeds": [0.2, 0.0]}, "run 1 of 2"),
        ({"speeds": [0.2, float("nan")]}, "run 1 of 2"),
        ({"columns": ["yaww"]}, "did you mean 'yaw'"),
        ({"block": 0}, "block must be a whole number"),
        ({"duration_s": -1.0}, "duration_s"),
        ({"rate_hz": 0.0}, "rate_hz"),
        ({"controller": "folower"}, "did you mean 'follower'"),
        ({"controller": object()}, "must be a name"),
        ({"network": "none"}, "to open_twin"),
    ],
)
def test_bad_input_is_refused_before_anything_is_driven(physical, change, text):
    options = {"paths": "figure8", "seeds": [0, 1], **SHORT, **change}
    paths, seeds = options.pop("paths"), options.pop("seeds")
    with pytest.raises(InputError, match=text):
        sweep(physical, paths, seeds, **options)
