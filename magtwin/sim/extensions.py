"""What users can add to a simulation without a fork: sensors, interference, controllers and engines.

Each kind has a protocol, a registry, and a decorator that registers an entry under a name:

| Kind | Protocol | Decorator | Use |
|---|---|---|---|
| sensor | `Sensor` | `@sensor("sonar")` | `simulate(..., sensors=["sonar"])` |
| interference | `Interference` | `@interference("pump")` | `simulate(..., interference=["pump"])` |
| controller | `motion.controllers.Controller` | `@controller("mine")` | `simulate(..., controller="mine")` |
| engine | `motion.engine.Engine` | `@engine("mine")` | `simulate(..., engine="mine")` |

Functions and objects can be given in place of names. Installed packages register entries by entry points of
the groups `magtwin.sensors`, `magtwin.interference`, `magtwin.controllers` and `magtwin.engines`.

    @sensor("speedometer")
    class Speedometer:
        columns = {"speed_m_s": Column("m/s", "base_link", "measured forward speed")}

        def __init__(self, scene, rng):
            self.rng = rng

        def sense(self, motion, t, until_s=None):
            return {"speed_m_s": motion.at(t).v + 0.01 * self.rng.standard_normal(len(t))}

    @interference("pump")
    def pump_nt(columns, robot, rng):
        hum = 30.0 * np.sin(2 * np.pi * 0.8 * columns["t"])
        return np.column_stack([hum, 0 * hum, 0 * hum])
"""

from collections.abc import Callable, Iterable, Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.extend import Registry
from magtwin.run.run import COLUMNS, Column
from magtwin.sim.motion.controllers import CUSTOM_CONTROLLERS
from magtwin.sim.motion.engine import ENGINES
from magtwin.sim.motion.sampling import Moving
from magtwin.spec.robot import RobotSpec
from magtwin.spec.scene import Scene

Array = NDArray[np.float64]


class Sensor(Protocol):
    """A sensor of one robot in one run, with its state."""

    @property
    def columns(self) -> Mapping[str, Column]:
        """Unit, frame and meaning of each column that it adds; names that magtwin does not use."""

    def sense(self, motion: Moving, t: Array, until_s: float | None = None) -> Mapping[str, NDArray[Any]]:
        """Its columns at the next readings.

        Times never go back from call to call. To be reproducible however a run is cut into calls, draw random
        numbers reading by reading in the order of time; `magtwin.sim.sensors.clock.SampledSensor` does so for
        a sensor with its own rate.

        Args:
            motion: What the robot did, known until `until_s`.
            t: Times of the readings [s], shape (N,).
            until_s: End of the time that is known [s]. Default: just past the last reading.

        Returns:
            Arrays of shape (N,) or (N, width) by column.
        """


SensorFactory = Callable[[Scene, np.random.Generator], Sensor]
"""From a scene, its robot first, and a source of noise to a sensor at the start of a run."""

Interference = Callable[[Mapping[str, NDArray[Any]], RobotSpec, np.random.Generator], Array]
"""A field that is added at the magnetometer, beside the lab's and the robot's own.

From columns of readings (t, true pose and speed, wheels, odometry, IMU, battery, lidar_on), the robot and a
source of noise to the field in base_link axes [nT], shape (N, 3). A live robot calls it with a few readings
at a time, in the order of time."""

SENSORS: Registry[SensorFactory] = Registry("sensor", "sensors")
INTERFERENCE: Registry[Interference] = Registry("interference term", "interference")

sensor = SENSORS.register
interference = INTERFERENCE.register
controller = CUSTOM_CONTROLLERS.register
"""Registers a `magtwin.sim.motion.controllers.ControllerFactory`, such as a controller's class."""
engine = ENGINES.register
"""Registers a `magtwin.sim.motion.engine.Engine`."""


def start_sensors(
    sensors: Iterable[str | SensorFactory], scene: Scene, rng: np.random.Generator
) -> list[Sensor]:
    """Custom sensors at the start of a run, each with its own generator."""
    chosen = [SENSORS[one] if isinstance(one, str) else one for one in sensors]
    started = [make(scene, own) for make, own in zip(chosen, rng.spawn(len(chosen)), strict=True)]
    taken = set(COLUMNS)
    for made in started:
        if again := sorted(taken & set(made.columns)):
            raise InputError(f"sensors add the column {again[0]!r}, which exists already; use another name")
        taken |= set(made.columns)
    return started
