"""Gymnasium: the checker, seeds, vectors against single robots, signals, rewards, ends, refusals."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

gymnasium = pytest.importorskip("gymnasium", reason="needs the extra gym")
from gymnasium.utils.env_checker import check_env  # noqa: E402
from gymnasium.vector import SyncVectorEnv  # noqa: E402

import magtwin.gym  # noqa: E402
from magtwin.errors import InputError  # noqa: E402
from magtwin.run.run import COLUMNS  # noqa: E402

NAME = "magtwin/MagNav-v0"
AHEAD = np.array([0.2, 0.0], np.float32)


@pytest.fixture(scope="module")
def line(tmp_path_factory) -> str:
    file = tmp_path_factory.mktemp("path") / "line.csv"
    file.write_text("-2.0,-1.2\n0.0,-1.2\n")
    return str(file)


def vector(twin, count, **options):
    return gymnasium.make_vec(NAME, num_envs=count, scene=twin, **options)


def column(env, observations, name):
    """A signal of observations (..., F)."""
    signals = env.unwrapped.robots.signals if hasattr(env.unwrapped, "robots") else env.unwrapped.signals
    first = sum(COLUMNS[s].width for s in signals[: signals.index(name)])
    return observations[..., first : first + COLUMNS[name].width]


@pytest.mark.filterwarnings("ignore:.*symmetric and normalized space")  # ours is in m/s and rad/s
@pytest.mark.parametrize("session", ["drawn", "survey"])
def test_gymnasiums_checker_passes(twin, session):
    check_env(gymnasium.make(NAME, scene=twin, session=session).unwrapped)


def test_each_episode_is_a_session_of_its_own_unless_that_of_the_survey_is_wanted(twin):
    names = ("battery_fraction", "imu_q_xyzw", "b_total_nt")
    for session in ("drawn", "survey"):
        env = vector(twin, 2, signals=names, session=session)
        first, _ = env.reset(seed=4)
        again, _ = env.reset()
        charges = np.concatenate([column(env, o, "battery_fraction").ravel() for o in (first, again)])
        assert len(set(charges.tolist())) == (4 if session == "drawn" else 1)
        yaw = np.concatenate([column(env, o, "imu_q_xyzw")[:, 2:] for o in (first, again)])
        apart = np.abs(yaw - yaw[0]).max()
        assert apart > 0.02 if session == "drawn" else apart < 0.01
        field = np.concatenate([column(env, o, "b_total_nt").ravel() for o in (first, again)])
        assert np.ptp(field) > 50 if session == "drawn" else np.ptp(field) < 1


def test_vectors_agree_with_gymnasiums_own_through_the_ends_of_episodes(twin):
    options = {"scene": twin, "duration_s": 0.5, "random_start": True}
    ours = vector(twin, 2, duration_s=0.5, random_start=True)
    theirs = SyncVectorEnv([lambda: gymnasium.make(NAME, **options)] * 2)
    a, b = ours.reset(seed=3), theirs.reset(seed=3)
    assert_allclose(a[0], b[0], rtol=1e-6, atol=1e-6)
    draw = np.random.default_rng(1).uniform(-1, 1, (14, 2, 2)) * ours.single_action_space.high
    for actions in draw.astype(np.float32):
        a, b = ours.step(actions), theirs.step(actions)
        assert_allclose(a[0], b[0], rtol=1e-6, atol=1e-6)
        for x, y in zip(a[1:4], b[1:4], strict=True):
            assert_allclose(np.asarray(x, float), np.asarray(y, float), atol=1e-12)
        assert a[4].keys() == b[4].keys()
        for name in ("p_world_base", "yaw", "bump", "_bump"):
            assert_allclose(np.asarray(a[4][name], float), np.asarray(b[4][name], float), atol=1e-12)


def test_the_field_is_the_exact_one_of_a_run_at_the_same_pose(twin, line):
    """A robot at rest: nothing but its place, its own iron and its electronics make the field."""
    robot = twin.scene.robot
    still = replace(robot.platform, left_motor_nt_nm=(0.0, 0.0, 0.0), right_motor_nt_nm=(0.0, 0.0, 0.0))
    twin = replace(twin, scene=replace(twin.scene, robot=replace(robot, platform=still)))
    run = magtwin.simulate(
        twin, line, seed=0, session="survey", duration_s=0.1, rate_hz=135.0
    )  # its motors start at once
    env = gymnasium.make(NAME, scene=twin, path=line, signals=("b_total_nt", "b_map_nt"), session="survey")
    observation, _ = env.reset(seed=0)
    assert_allclose(observation[1], run["b_map_nt"][0], rtol=1e-6)
    assert_allclose(observation[0], run["b_total_nt"][0], atol=5.0)  # electronics


def test_a_bump_is_told_and_ends_the_episode_where_that_is_asked_for(twin, tmp_path):
    (tmp_path / "out.csv").write_text("2.0,0.0\n2.5,0.0\n")
    for end in (False, True):
        env = gymnasium.make(
            NAME, scene=twin, path=str(tmp_path / "out.csv"), end_on_bump=end, duration_s=20.0
        )
        env.reset(seed=0)
        for _ in range(100):
            _, _, ended, _, info = env.step(AHEAD)
            if info["bump"]:
                break
        assert info["bump"]
        assert ended is end


def test_a_reward_of_ones_own_is_asked_for_each_step(twin):
    seen = []

    def mine(step: magtwin.gym.Transition) -> np.ndarray:
        seen.append(step)
        return step.after["b_total_nt"] - step.before["b_total_nt"]

    env = vector(twin, 2, reward=mine)
    env.reset(seed=0)
    before = env.unwrapped.stepped.columns["b_total_nt"].copy()
    _, rewards, *_ = env.step(np.tile(AHEAD, (2, 1)))
    assert_array_equal(rewards, env.unwrapped.stepped.columns["b_total_nt"] - before)
    assert len(seen) == 1
    assert seen[0].action.shape == (2, 2)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"scene": None}, "needs a scene"),
        ({"network": "none"}, "to open_twin"),
        ({"signals": ("b_mesured_nt",)}, "did you mean 'b_measured_nt'"),
        ({"signals": ()}, "signals are empty"),
        ({"step_s": 0.03}, "multiple of the control step"),
        ({"step_s": 0.6}, "command_timeout_s"),
        ({"step_s": float("nan")}, "step_s"),
        ({"duration_s": 0.0}, "duration_s"),
        ({"path": "figure9"}, "figure8"),
        ({"reward": 1.0}, r"reward must be a function of a Transition, got 1\.0"),
        ({"render_mode": "human"}, "render_mode"),
    ],
)
def test_bad_options_are_refused(twin, options, text):
    with pytest.raises(InputError, match=text):
        magtwin.gym.MagNavEnv(**{"scene": twin, **options})
