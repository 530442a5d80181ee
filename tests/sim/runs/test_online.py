"""Online: a robot that is commanded as it goes on reads what `simulate` gives for the same commands."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from magtwin.errors import InputError
from magtwin.run.run import Run
from magtwin.sim.motion.sampling import held
from magtwin.sim.runs.online import STANDS_S, Online
from magtwin.sim.runs.simulate import simulate, streams
from magtwin.sim.sensors.lidar import scans_of
from magtwin.sim.sensors.magnetometer import sense_magnetometer
from magtwin.sim.sensors.model_error import ModelError
from magtwin.sim.sensors.noise import gauss_markov
from magtwin.sim.sensors.online_sensors import Held, Magnetometer, Markov
from magtwin.sim.session import draw_session
from magtwin.spec.sensors import MagnetometerSpec
from magtwin.twin import Twin, open_twin

SEED = 3
DURATION_S = 8.0
ERROR = ModelError(60.0, 2.0, offset=0.7)


@pytest.fixture(scope="module", params=["physical", "surveyed", "neural"])
def twin(request: pytest.FixtureRequest, lab_scene: Path) -> Twin:
    surveyed = request.param == "surveyed"  # only a map, without Earth and sources
    twin = open_twin(lab_scene, magnetometer="physical" if surveyed else request.param)
    if surveyed:
        twin = replace(twin, scene=replace(twin.scene, earth=None, sources=(), furniture=()))
    robot = twin.scene.robot  # on a day of its own: markers that are off, wheels and IMU with their errors
    robot = replace(draw_session(robot, np.random.default_rng(9)), magnetometer=robot.magnetometer)
    robot = replace(robot, mocap=replace(robot.mocap, offset_m=(0.02, -0.01), dropout_every_s=2.0))
    return replace(twin, scene=replace(twin.scene, robot=robot))


def online_of(twin: Twin) -> Online:
    net = twin.magnetometer

    def network(run: Run) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        assert net is not None
        (read,) = net.read([run])
        return read.disturbance_nt, read.sd_nt, read.outside

    return Online(
        twin.scene,
        anomaly_map=twin.field,
        rng=np.random.default_rng(SEED),
        obstacles=twin.obstacles,
        network=network if net else None,
        model_error=ERROR,
        lidar="on",
    )


def test_commands_that_come_one_by_one_give_the_columns_of_a_run_of_them(twin: Twin) -> None:
    robot = online_of(twin)
    blocks, scans = [], []
    for k in range(round(DURATION_S / robot.step_s)):
        quiet = k % 7 or 200 < k < 260  # for a second nothing is commanded: the robot stops by its timeout
        blocks.append(robot.step(None if quiet else (0.25 + 0.05 * np.sin(0.01 * k), 0.6 * np.sin(0.02 * k))))
        scans.append(robot.scans())
    online = Run.concat(blocks)

    def disturbance_nt(run: Run) -> tuple[np.ndarray, np.ndarray]:
        assert twin.magnetometer is not None
        (read,) = twin.magnetometer.read([run])
        return read.disturbance_nt, read.sd_nt

    run = simulate(
        twin.scene,
        robot.commands,
        anomaly_map=twin.field,
        rng=np.random.default_rng(SEED),
        obstacles=twin.obstacles,
        duration_s=DURATION_S,
        lidar="on",
        disturbance_nt=disturbance_nt if twin.magnetometer else None,
        model_error=ERROR,
    )
    assert np.ptp(run["p_world_base"][:, 0]) > 0.3
    assert (run["v_base"][:, 0] == 0).sum() > 50
    assert np.ptp(run["b_model_error_nt"]) > 10 if twin.magnetometer else not run["b_model_error_nt"].any()
    step = twin.scene.robot.magnetometer.resolution_nt
    for name in run.keys() - {"b_sd_nt", "flag_out_of_distribution"}:  # of a network only its caller knows
        # Sums in another order may bring a reading to the next multiple of the resolution.
        rounded = ("b_model_error_nt", "b_measured_nt", "b_noise_nt", "b_vector_measured_nt")
        atol = (2.01 if name == "b_measured_nt" else 1.01) * step if name in rounded else 1e-10
        np.testing.assert_allclose(online[name], run[name], rtol=1e-12, atol=atol, err_msg=name)
    seen = scans_of(run, twin.scene.robot, twin.obstacles, streams(np.random.default_rng(SEED))["lidar"])
    np.testing.assert_array_equal(np.concatenate([s.t for s in scans]), seen.t)
    np.testing.assert_allclose(np.concatenate([s.arrival for s in scans]), seen.arrival, rtol=1e-12)
    ranges = np.concatenate([s.ranges_m for s in scans])
    assert np.mean(np.abs(ranges - seen.ranges_m)[np.isfinite(ranges)] < 1e-4) > 0.99  # but at edges


def test_a_robot_stands_until_its_battery_has_told_of_rest(twin: Twin) -> None:
    robot = online_of(twin)
    blocks = [robot.step((0.3, 0.0)) for _ in range(5)]
    run = Run.concat(blocks)
    assert not run["v_base"][run["t"] < STANDS_S].any()
    assert run["v_base"][-1, 0] > 0


def test_a_command_that_is_not_finite_is_refused(twin: Twin) -> None:
    robot = online_of(twin)
    for _ in range(4):
        robot.step()
    with pytest.raises(InputError, match="not finite"):
        robot.step((np.nan, 0.0))


def test_samples_arrive_step_by_step_as_at_once() -> None:
    t = np.arange(500) / 135
    stamps, latest = held(t, 62, latency_s=0.012, jitter_s=0.01, rng=np.random.default_rng(1))
    sensor, seen = Held(62, 0.012, 0.01, np.random.default_rng(1)), []
    for until in np.arange(1, 200) * 0.02:
        due = sensor.due(until)
        sensor.add(due, {"stamp": due})
        seen.append(sensor.at(t[(t >= until - 0.02 - 1e-9) & (t < until - 1e-9)])["stamp"])
    np.testing.assert_array_equal(np.concatenate(seen)[: len(t)], stamps[latest])


def test_a_process_goes_on_where_it_was() -> None:
    white = np.random.default_rng(2).standard_normal((100, 2))
    process = Markov(0.3, 50.0)
    parts = [process.next(white[a:b]) for a, b in ((0, 1), (1, 40), (40, 40), (40, 100))]
    np.testing.assert_allclose(np.concatenate(parts), gauss_markov(white, 0.3, 50.0), atol=1e-14)


def test_a_magnetometer_with_every_fault_reads_the_same_in_blocks() -> None:
    spec = MagnetometerSpec(
        noise_density_nt=0.02,
        flicker_corner_hz=0.5,
        resolution_nt=0.0,
        bandwidth_hz=20.0,
        clock_offset_s=0.011,
        heading_error_nt=3.0,
        dead_zone_axis=0.3,
        stuck_nt=35650.0,
        stuck_std_nt=50.0,
        dropout_share=0.05,
        vector_noise_density_nt=0.03,
    )
    count, rate = 400, 135.0
    angle = np.linspace(0, 9, count)
    vector = 5e4 * np.column_stack([np.sin(angle), np.zeros(count), np.cos(angle)])
    total = 5e4 + 300 * np.sin(3 * angle)
    total[50:60] = np.nan
    steep = (np.arange(count) // 30) % 5 == 3
    whole = sense_magnetometer(spec, total, vector, np.random.default_rng(4), rate_hz=rate, steep=steep)
    sensor = Magnetometer(spec, rate, np.random.default_rng(4))
    parts: dict[str, list[np.ndarray]] = {name: [] for name in whole}
    for a in range(0, count, 3):
        rows = slice(a, min(a + 3, count))
        axes, lost = sensor.axes(vector[rows], steep[rows])
        dropped = sensor.dropped(len(axes))
        axes[dropped] = np.nan
        read = sensor.read(total[rows], vector[rows], lost)
        read["b_measured_nt"][dropped] = np.nan
        read["b_noise_nt"][dropped] = np.nan
        for name, values in (read | {"b_vector_measured_nt": axes}).items():
            parts[name].append(values)
    assert whole["flag_lost_lock"].any()
    assert np.isnan(whole["b_measured_nt"]).sum() > 10
    for name, values in whole.items():
        np.testing.assert_allclose(np.concatenate(parts[name]), values, rtol=1e-12, atol=1e-9, err_msg=name)
