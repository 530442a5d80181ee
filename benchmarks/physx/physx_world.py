"""A stage in NVIDIA's PhysX on the CPU, stepped through a pipe; needs neither magtwin nor pxr.

    python physx_world.py

In: a line of JSON, `{"stage", "base", "joints": [left, right, ...], "sides": [0, 1, ...], "senses":
[1, -1, ...], "start": [x, y, yaw] or null, "step_s"}`. Paths name prims. A side is 0 (left) or 1 (right);
default: 0 and 1. A sense is -1 for a wheel that rolls backward as its joint's angle grows; default: 1.
Then a line per answer: a list with the rates of both sides [rad/s], a pair per physics step, or `[x, y, yaw]`
to place the robot there at rest, or `{"joint": target [rad]}` to steer. Out: a line after the robot has
settled and one after each line in: x, y, yaw, v, w, the angles of the first two wheels, height of the base
[m], and z of its up axis.

PhysX reads attributes only of schemas that are registered first: those of the packages physx-usd-schemas and
newton-usd-schemas.
"""

import json
import math
import os
import sys
from importlib import metadata
from typing import Any

import numpy as np
import ovphysx
import ovstage
from ovphysx.types import GlobalConfigKey, SimObjectType

SETTLE_S = 2.0
"""Time for which the robot settles before it is driven [s]: it tilts onto its casters for about one."""

SCHEMAS = ("PhysxSchema", "OmniUsdPhysicsDeformableSchema")
"""Folders of physx-usd-schemas; PhysX refuses to start without both."""

LINK, JOINT, ROBOT = (
    SimObjectType.ARTICULATION_LINK,
    SimObjectType.ARTICULATION_JOINT,
    SimObjectType.ARTICULATION,
)

BASE = ("position", "orientation", "linearVelocity", "angularVelocity")


def open_stage(file: str) -> tuple[Any, Any]:
    """PhysX on the CPU with a stage, and the stage, which must be kept as long."""
    ovphysx.PhysX.set_cpu_mode(True)
    ovphysx.api.set_global_config(GlobalConfigKey.NUM_THREADS, 0)  # one thread steps one robot fastest
    physx = ovphysx.PhysX()
    package = metadata.distribution("physx-usd-schemas")
    folders = [str(package.locate_file(f"physx_usd_schemas/{name}/resources")) for name in SCHEMAS]
    ovstage.population.register_usd_schemas([*folders, str(ovphysx.newton_schema_root())])
    stage = ovstage.Stage("world")
    ovstage.population.open_usd(stage, file, ordinal=1, domains=ovstage.PopulationDomain.ALL)
    stage.advance_write_floor(ordinal=1).wait()
    physx.wait_task(physx.attach_ovstage(stage, read_ordinal=1))
    return physx, stage


def read(physx: Any, kind: SimObjectType, path: str, name: str) -> list[float]:
    """An attribute of a prim."""
    with physx.read_sync(kind, [name], pattern=path) as result:
        (group,) = result.groups
        return np.asarray(group.tensors[0].numpy(), float).ravel().tolist()


def write(physx: Any, kind: SimObjectType, path: str, name: str, values: list[float]) -> None:
    """Set an attribute of a prim."""
    with physx.write_sync(kind, name, pattern=path) as session:
        (group,) = session.groups
        group.tensors[0].numpy()[...] = np.reshape(values, group.tensors[0].numpy().shape)
        session.commit_sync(group)


class World:
    """A stage with one robot that is driven."""

    def __init__(self, job: dict[str, Any]) -> None:
        """Load it and let the robot settle at its start."""
        self.physx, self._stage = open_stage(job["stage"])
        self._step_s, self._base, self._joints = job["step_s"], job["base"], job["joints"]
        self._sides = job.get("sides", (0, 1))
        self._senses = job.get("senses", [1] * len(self._joints))
        self._rates = [math.nan, math.nan]
        self._raw, self._angles = [0.0, 0.0], [0.0, 0.0]
        for kind, path in ((LINK, self._base), *((JOINT, joint) for joint in self._joints)):
            if not self.physx.query(kind, pattern=path, metadata=True).wait().metadata.total_prim_count:
                raise ValueError(f"PhysX has no articulation with {path}")
        self.place(*(job["start"] or self.seen()[:3]))

    def place(self, x: float, y: float, yaw: float) -> None:
        """Put the robot at a pose of its base at its present height, at rest, and let it settle."""
        at_x, at_y, at_yaw = self.seen()[:3]
        turn = yaw - at_yaw
        c, s = math.cos(turn), math.sin(turn)
        p, q = (self._read(ROBOT, self._base, name) for name in ("rootPosition", "rootOrientation"))
        away = p[0] - at_x, p[1] - at_y  # the root need not be the base
        p = [x + c * away[0] - s * away[1], y + s * away[0] + c * away[1], p[2]]
        half_c, half_s, (i, j, k, w) = math.cos(turn / 2), math.sin(turn / 2), q
        q = [
            half_c * i - half_s * j,
            half_c * j + half_s * i,
            half_c * k + half_s * w,
            half_c * w - half_s * k,
        ]
        self._write(ROBOT, self._base, "rootPosition", p)
        self._write(ROBOT, self._base, "rootOrientation", q)
        for name in ("rootLinearVelocity", "rootAngularVelocity"):
            self._write(ROBOT, self._base, name, [0.0, 0.0, 0.0])
        for joint in self._joints:
            self._write(JOINT, joint, "jointVelocity", [0.0])
        self.step([[0.0, 0.0]] * round(SETTLE_S / self._step_s))

    def step(self, rates: list[list[float]]) -> None:
        """Physics steps, each with its wheel rates [rad/s]."""
        for pair in rates:
            for joint, side, sense in zip(self._joints, self._sides, self._senses, strict=True):
                if pair[side] != self._rates[side]:
                    self._write(JOINT, joint, "jointVelocityTarget", [math.degrees(sense * pair[side])])
            self._rates = list(pair)
            self.physx.step_sync(self._step_s)

    def seen(self) -> list[float]:
        """x, y, yaw, v, w, wheel angles, height, and how upright it is.

        PhysX wraps angles at two turns, so a wheel must turn by less than that between two answers.
        """
        p, (i, j, k, w), v, turning = (self._read(LINK, self._base, name) for name in BASE)
        yaw = math.atan2(2 * (w * k + i * j), 1 - 2 * (j * j + k * k))
        ahead = v[0] * math.cos(yaw) + v[1] * math.sin(yaw)
        both = self._joints[:2]
        raw = [
            sense * math.radians(self._read(JOINT, joint, "jointPosition")[0])
            for joint, sense in zip(both, self._senses, strict=False)
        ]
        turned = [(a - b + math.tau) % (2 * math.tau) - math.tau for a, b in zip(raw, self._raw, strict=True)]
        self._raw, self._angles = raw, [a + b for a, b in zip(self._angles, turned, strict=True)]
        return [*p[:2], yaw, ahead, turning[2], *self._angles, p[2], 1 - 2 * (i * i + j * j)]

    def _read(self, kind: SimObjectType, path: str, name: str) -> list[float]:
        """An attribute of a prim."""
        values = read(self.physx, kind, path, name)
        if not all(map(math.isfinite, values)):
            raise ValueError(f"{path} is lost: its {name} is {values}")
        return values

    def _write(self, kind: SimObjectType, path: str, name: str, values: list[float]) -> None:
        """Set an attribute of a prim."""
        write(self.physx, kind, path, name, values)


def main() -> None:
    """Serve one stage."""
    out = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # what the libraries print goes to stderr
    world = World(json.loads(sys.stdin.readline()))
    out.write(json.dumps(world.seen()) + "\n")
    for line in sys.stdin:
        asked = json.loads(line)
        if isinstance(asked, dict):
            for joint, angle in asked.items():
                write(world.physx, JOINT, joint, "jointPositionTarget", [math.degrees(angle)])
        elif asked and isinstance(asked[0], list):
            world.step(asked)
        else:
            world.place(*asked)
        out.write(json.dumps(world.seen()) + "\n")
    out.flush()
    os._exit(0)  # taking PhysX down can crash


if __name__ == "__main__":
    main()
