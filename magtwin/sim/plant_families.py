"""Families of plants: named worlds that a seed draws, and a plant as it is in one session."""

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError, find
from magtwin.files.settings import from_table
from magtwin.spec.base import ZERO3
from magtwin.spec.plant import PlantSpec
from magtwin.spec.robot import RobotSpec

Array = NDArray[np.float64]

SESSION_STD = 0.1
"""Relative spread between sessions, like `current_std` of the TurtleBot 4."""

SPREADS = (
    *("start_field_std_nt", "warm_up_age_mean_s", "session_std", "hard_iron_std_nt"),
    *("current_direction_std", "marker_offset_std_m", "mocap_latency_std_s"),
)
"""Figures of a plant that say how sessions differ."""

MOST_DIGITS = 18
"""Most digits of a seed in a text."""

Entropy = tuple[int, ...]

EARTH_NT = 45e3
"""Typical size of the Earth's field [nT]."""


def draw_plant(name: str, seed: int = 0, *, which: int = 0) -> PlantSpec:
    """A plant of a family, with freshly drawn constants.

    The constants are those of a robot in all sessions; `draw_session_plant` adds what differs between
    sessions. "all" has exactly the constants that each family has with the same seed.

    Args:
        name: A name of `PLANTS`.
        seed: Seed of the constants.
        which: Index of the robot in its scene.

    Raises:
        InputError: There is no such family, or the seed is no whole number from 0 up.
    """
    family = find("plant", name, PLANTS)
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise InputError(f"seed of a plant must be a whole number from 0 up, got {seed!r}", parameter="plant")
    return family((int(seed), 4, which) if which else (int(seed), 4))


def _generator(entropy: Entropy, family: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence(entropy, spawn_key=(family,)))


def _hysteresis(entropy: Entropy) -> PlantSpec:
    """One piece of iron, mostly below the sensor: as a dipole it makes k (3 u u' - 1) of the field there."""
    rng = _generator(entropy, 0)
    thresholds = np.sort(np.array([800.0, 2500.0, 6000.0, 14000.0]) * np.exp(0.2 * rng.standard_normal(4)))
    weights = rng.dirichlet(np.full(4, 4.0))
    u = np.array([0.0, 0.0, -1.0]) + 0.35 * rng.standard_normal(3)
    u /= np.linalg.norm(u)
    matrix = rng.uniform(0.0035, 0.0075) * (3 * np.outer(u, u) - np.eye(3))
    return PlantSpec(
        hysteresis=_numbers(matrix),
        play_thresholds_nt=_numbers(thresholds),
        play_weights=_numbers(weights),
        start_field_std_nt=50e3,  # carried and tilted, past steel and magnets
    )


def _warm_up(entropy: Entropy) -> PlantSpec:
    rng = _generator(entropy, 1)
    tau = np.array([100.0, 400.0]) * np.exp(0.15 * rng.standard_normal(2))
    sign = rng.choice([-1.0, 1.0])
    soft = sign * rng.uniform(80, 240, 2) / EARTH_NT
    hard = np.concatenate([rng.uniform(80, 250) * _direction(rng) for _ in tau])
    return PlantSpec(
        warm_up_s=_numbers(tau),
        warm_up_nt=_numbers(hard),
        warm_up_soft_iron=_numbers(soft),
        warm_up_age_mean_s=30.0,
        session_std=SESSION_STD,
    )


def _nonlinear(entropy: Entropy) -> PlantSpec:
    rng = _generator(entropy, 2)
    return PlantSpec(
        motor_abs_nt_nm=_numbers(rng.uniform(1500, 4000) * _direction(rng)),
        motor_square_nt_nm2=_numbers(rng.uniform(10e3, 40e3) * _direction(rng)),
        lidar_speed_nt_s_m=_numbers(rng.uniform(600, 1800) * _direction(rng)),
        lidar_supply_nt_a=_numbers(rng.uniform(200, 700) * _direction(rng)),
        session_std=SESSION_STD,
    )


def _moving_part(entropy: Entropy) -> PlantSpec:
    rng = _generator(entropy, 3)
    apart = rng.uniform(0.15, 0.3)
    moment = rng.uniform(120, 400) * apart**3 / 100  # 1 A m2 makes 100 nT at 1 m, across its axis
    tilt, azimuth = rng.uniform(0, math.pi / 4), rng.uniform(0, 2 * math.pi)
    level = moment * math.cos(tilt)
    return PlantSpec(
        moving_moment=(
            level * math.cos(azimuth),
            level * math.sin(azimuth),
            moment * math.sin(tilt) * float(rng.choice([-1.0, 1.0])),
        ),
        p_magnetometer_moving=_numbers(apart * _direction(rng)),
        moving_arm_m=rng.uniform(0.0, 0.04),
        pan_range=rng.uniform(math.pi / 3, math.pi),
        pan_period_s=rng.uniform(20.0, 90.0),
        pan_dwell=rng.uniform(0.0, 0.6),
        session_std=SESSION_STD,
    )


def _drawn(entropy: Entropy) -> PlantSpec:
    hard, turn, offset, latency = np.exp(0.2 * _generator(entropy, 4).standard_normal(4)).tolist()
    return PlantSpec(
        hard_iron_std_nt=180.0 * hard,
        current_direction_std=0.2 * turn,
        marker_offset_std_m=0.015 * offset,
        mocap_latency_std_s=0.015 * latency,
    )


def _all(entropy: Entropy) -> PlantSpec:
    whole: dict[str, Any] = {}
    for family in (_hysteresis, _warm_up, _nonlinear, _moving_part, _drawn):
        plant = vars(family(entropy))
        whole |= {name: value for name, value in plant.items() if value != getattr(PlantSpec(), name)}
    return PlantSpec(**whole)


PLANTS: Mapping[str, Callable[[Entropy], PlantSpec]] = {
    "nominal": lambda entropy: PlantSpec(),
    "hysteresis": _hysteresis,
    "warm-up": _warm_up,
    "nonlinear": _nonlinear,
    "moving-part": _moving_part,
    "drawn": _drawn,
    "all": _all,
}
"""Families of plants: from the entropy of a seed to the constants of a robot."""


def draw_session_plant(robot: RobotSpec, rng: np.random.Generator) -> RobotSpec:
    """The robot with its plant as in one session.

    Returns:
        The robot with a plant whose spreads are 0, its permanent field, the directions of its current terms,
        and marker offset and latency of motion capture drawn too.
    """
    plant, platform, mocap = robot.plant, robot.platform, robot.mocap
    start = np.add(plant.start_field_nt, plant.start_field_std_nt * rng.standard_normal(3))
    age = plant.warm_up_age_s + plant.warm_up_age_mean_s * rng.exponential()
    factors = 1 + plant.session_std * rng.standard_normal(4)
    phase = rng.uniform()
    hard = plant.hard_iron_std_nt * rng.standard_normal(3)
    from scipy.spatial.transform import Rotation  # takes 0.3 s to import

    turns = Rotation.from_rotvec(plant.current_direction_std * rng.standard_normal((4, 3))).as_matrix()
    offset = np.add(mocap.offset_m, plant.marker_offset_std_m * rng.standard_normal(2))
    latency = max(0.0, mocap.latency_s + plant.mocap_latency_std_s * rng.standard_normal())
    scaled: dict[str, Any] = {
        name: _numbers(np.multiply(getattr(plant, name), factor))
        for name, factor in (
            *(("warm_up_nt", factors[0]), ("warm_up_soft_iron", factors[0])),
            *(("motor_abs_nt_nm", factors[1]), ("motor_square_nt_nm2", factors[1])),
            *(("lidar_speed_nt_s_m", factors[2]), ("lidar_supply_nt_a", factors[2])),
            ("moving_moment", factors[3]),
        )
    }
    if plant.moving_moment != ZERO3:
        scaled["pan_phase"] = float(phase)
    scaled |= {"start_field_nt": _numbers(start), "warm_up_age_s": float(age), **dict.fromkeys(SPREADS, 0.0)}
    plant = replace(plant, **scaled)
    left, right, lidar, battery = turns
    turned: dict[str, Any] = {
        name: _numbers(matrix @ getattr(platform, name))
        for name, matrix in (
            *(("left_motor_nt_nm", left), ("right_motor_nt_nm", right), ("battery_nt", battery)),
            *(("lidar_nt", lidar), ("lidar_cos_nt", lidar), ("lidar_sin_nt", lidar)),
        )
    }
    platform = replace(
        platform,
        **turned,
        hard_iron_nt=_numbers(platform.hard_iron_nt + hard),
        hard_iron_change_nt=_numbers(platform.hard_iron_change_nt + hard),
    )
    mocap = replace(mocap, offset_m=_numbers(offset), latency_s=float(latency))
    return replace(robot, plant=plant, platform=platform, mocap=mocap)


def plant_of(text: str, *, which: int = 0) -> PlantSpec:
    """The plant of a text "NAME" or "NAME:SEED", or of what `plant_text` gave; without a seed it is 0."""
    if text.startswith("{"):
        try:
            given = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise InputError(f"plant {text[:60]!r} is not JSON: {error}", parameter="plant") from error
        return from_table(PlantSpec, given, "plant")
    name, colon, seed = text.partition(":")
    if colon and not (seed.isascii() and seed.isdigit() and len(seed) <= MOST_DIGITS):
        seeds = f"SEED a whole number from 0 up with at most {MOST_DIGITS} digits"
        raise InputError(f"plant must be NAME or NAME:SEED, {seeds}; got {text[:60]!r}", parameter="plant")
    return draw_plant(name, int(seed or 0), which=which)


def plant_text(plant: PlantSpec) -> str:
    """The fields of a plant that are not default, as JSON; `plant_of` reads it."""
    default = vars(PlantSpec())
    return json.dumps({name: value for name, value in vars(plant).items() if value != default[name]})


def _direction(rng: np.random.Generator) -> Array:
    """A unit vector of any direction."""
    v = rng.standard_normal(3)
    return np.asarray(v / np.linalg.norm(v))


def _numbers(values: Any) -> Any:
    """An array as a flat tuple of floats, as specs have it."""
    return tuple(np.ravel(values).tolist())
