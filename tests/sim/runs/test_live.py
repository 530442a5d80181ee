"""LiveRobot: a robot that is commanded as it goes on reads what `simulate` gives for the same commands."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from magtwin.run.run import Run
from magtwin.sim.runs.live import LiveRobot
from magtwin.sim.runs.multi_robot import simulate_robots
from magtwin.sim.runs.sensing import streams
from magtwin.sim.runs.simulate import Sensed, simulate
from magtwin.sim.sensors.lidar import scans_of
from magtwin.sim.sensors.model_error import ModelError
from magtwin.sim.session import draw_session
from magtwin.spec.scene import PlacedRobot
from magtwin.twin import Twin, open_twin
from magtwin.twin.simulation import stated

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


def live_of(twin: Twin) -> LiveRobot:
    net = twin.magnetometer

    def finish(sensed: Sensed) -> Run:
        if net is None:
            return sensed.read()
        (read,) = net.read([sensed.run])
        run = sensed.read((read.disturbance_nt, read.sd_nt), ERROR)
        return stated(twin, run, read)

    return LiveRobot(
        twin.scene,
        anomaly_map=twin.field,
        rng=np.random.default_rng(SEED),
        obstacles=twin.obstacles,
        network=net is not None,
        finish=finish,
        lidar="on",
    )


def test_commands_that_come_one_by_one_give_the_columns_of_a_run_of_them(twin: Twin) -> None:
    robot = live_of(twin)
    blocks, scans = [], []
    for k in range(round(DURATION_S / robot.step_s)):
        quiet = k % 7 or 200 < k < 260  # for a second nothing is commanded: the robot stops by its timeout
        blocks.append(robot.step(None if quiet else (0.25 + 0.05 * np.sin(0.01 * k), 0.6 * np.sin(0.02 * k))))
        scans.append(robot.scans())
    live = Run.concat(blocks)

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
        network=twin.magnetometer is not None,
        finish=lambda sensed: sensed.predicted(disturbance_nt, ERROR) if twin.magnetometer else sensed.read(),
    )
    assert np.ptp(run["p_world_base"][:, 0]) > 0.3
    assert (run["v_base"][:, 0] == 0).sum() > 50
    assert np.ptp(run["b_model_error_nt"]) > 10 if twin.magnetometer else not run["b_model_error_nt"].any()
    step = twin.scene.robot.magnetometer.resolution_nt
    for name in run.keys() - {"b_sd_nt", "flag_out_of_distribution"}:  # of a network only its caller knows
        # Sums in another order may bring a reading to the next multiple of the resolution.
        rounded = ("b_model_error_nt", "b_measured_nt", "b_noise_nt", "b_vector_measured_nt")
        atol = (2.01 if name == "b_measured_nt" else 1.01) * step if name in rounded else 1e-10
        np.testing.assert_allclose(live[name], run[name], rtol=1e-12, atol=atol, err_msg=name)
    seen = scans_of(run, twin.scene.robot, twin.obstacles, streams(np.random.default_rng(SEED))["lidar"])
    np.testing.assert_array_equal(np.concatenate([s.t for s in scans]), seen.t)
    np.testing.assert_allclose(np.concatenate([s.arrival for s in scans]), seen.arrival, rtol=1e-12)
    ranges = np.concatenate([s.ranges_m for s in scans])
    assert np.mean(np.abs(ranges - seen.ranges_m)[np.isfinite(ranges)] < 1e-4) > 0.99  # but at edges


def test_robots_beside_each_other_read_what_simulate_robots_gives(lab_scene: Path) -> None:
    twin = open_twin(lab_scene, magnetometer="physical")
    bob = PlacedRobot(robot=replace(twin.scene.robot, name="bob"), start=(0.1, 0.75, 2.0))
    scene = replace(
        twin.scene, robot=replace(twin.scene.robot, name="ann"), start=(0.0, 0.0, 0.3), others=(bob,)
    )
    names = ("ann", "bob")
    rngs = {name: np.random.default_rng(k) for k, name in enumerate(names)}
    robots = {
        name: LiveRobot(
            scene.led_by(name), anomaly_map=twin.field, rng=np.random.default_rng(k), obstacles=twin.obstacles
        )
        for k, name in enumerate(names)
    }
    for name, robot in robots.items():
        robot.beside(other for key, other in robots.items() if key != name)
    blocks: dict[str, list[Run]] = {name: [] for name in names}
    for k in range(200):
        robots["ann"].drive((0.25, 0.4))
        robots["bob"].drive((0.2, -0.5) if k % 5 == 0 else None)
        for name, robot in robots.items():
            blocks[name].append(robot.read())
    runs = simulate_robots(
        scene,
        {name: robot.commands for name, robot in robots.items()},
        anomaly_map=twin.field,
        rngs=rngs,
        meet="flag",
        duration_s=4.0,
        obstacles=twin.obstacles,
    )
    for name in names:
        live, run = Run.concat(blocks[name]), runs[name]
        alone = simulate(
            scene.led_by(name),
            robots[name].commands,
            anomaly_map=twin.field,
            rng=np.random.default_rng(names.index(name)),
            obstacles=twin.obstacles,
            duration_s=4.0,
        )
        assert np.ptp(run["b_truth_nt"] - alone["b_truth_nt"]) > 20  # they feel each other
        for column in run.keys() & live.keys():
            # The rate of the other's field is differenced to one side at the end of a live step.
            atol = 0.05 if column.startswith("b_") else 1e-9
            np.testing.assert_allclose(live[column], run[column], rtol=1e-9, atol=atol, err_msg=column)
