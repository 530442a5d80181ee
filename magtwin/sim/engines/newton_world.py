"""A stage in Newton's MuJoCo solver, stepped through a pipe.

    python -m magtwin.sim.engines.newton_world

Newton needs its USD schemas registered before USD is first used, so `newton.py` starts this as another
process. In: a line of JSON, `{"stage", "robot", "joints": [left, right, ...], "sides": [0, 1, ...], "base",
"start": [x, y, yaw], "step_s", "scrub"}`, then a line per control step with the rates of both sides
[rad/s], a pair per physics step. Out: a line after the robot has settled and one after each control step:
x, y, yaw, v, w, both wheels' angles, height of the base [m], and the z component of its up axis. Newton reads
the stage, its contacts and drives. Then the MuJoCo model of its solver is stepped in C, because a step
through Newton's arrays takes a millisecond.
"""

import json
import math
import os
import sys
from typing import Any

import mujoco
import newton
import newton_usd_schemas  # noqa: F401 - registers them

SETTLE_S = 0.5
"""Time for which the robot settles before it is driven [s]."""

STIFF_STEPS = 4.0
"""Time constant of a contact in steps (MuJoCo's solref); assumed. With MuJoCo's default of 0.02 s a robot of
4 kg sinks by 0.34 mm into a hard floor, and its wheels roll as if they were 0.5 % smaller."""

EDGE_M = 0.0005
"""Half of the width of a wheel that does not scrub [m]."""


class World:
    """A stage with one robot that is driven."""

    def __init__(self, job: dict[str, Any]) -> None:
        """Build it and let the robot settle at its start."""
        builder = newton.ModelBuilder(up_axis=newton.Axis.Z)
        newton.solvers.SolverMuJoCo.register_custom_attributes(builder)
        builder.add_usd(job["stage"], load_visual_shapes=False, load_static_visual_shapes=False)
        model = builder.finalize(device="cpu")
        for name in job["joints"]:
            joint = _only(list(model.joint_label), job["robot"], name)
            if not model.joint_armature.numpy()[model.joint_qd_start.numpy()[joint]] > 0:
                raise ValueError(
                    f"{name} has no newton:armature, so that its drive throws the robot; set it to 0.002"
                )
        # Kept, since it owns the model and the data.
        self._solver = newton.solvers.SolverMuJoCo(model, use_mujoco_cpu=True, cone="elliptic")
        self._model, self._data = self._solver.mj_model, self._solver.mj_data
        self._model.opt.timestep = job["step_s"]
        self._model.geom_gap[:] = 0.0  # Newton's default of 0.1 m doubles the contacts, without effect
        # Newton asks MuJoCo for one contact point per pair. That of a cylinder jumps from edge to edge of its
        # tread, so that the distance between the wheels would jump too.
        self._model.geom_solref[:] = STIFF_STEPS * job["step_s"], 1.0
        self._model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_MULTICCD)
        bodies = [self._model.body(i).name for i in range(self._model.nbody)]
        base = _only(bodies, job["robot"], job["base"])
        root = self._model.body_rootid[base]
        joints = [self._model.joint(i).name for i in range(self._model.njnt)]
        self._base, self._sides = base, job["sides"]
        self._wheels = [_only(joints, job["robot"], joint) for joint in job["joints"]]
        if not job["scrub"]:
            self._narrow()
        driven = self._model.actuator_trnid[:, 0].tolist()
        self._ctrl = [driven.index(joint) for joint in self._wheels]
        free = self._model.body_jntadr[root]
        if self._model.jnt_type[free] != mujoco.mjtJoint.mjJNT_FREE:
            raise ValueError(f"{job['robot']} is bolted to the stage")
        self._q = self._model.jnt_qposadr[free]
        self._qd = self._model.jnt_dofadr[free]
        x, y, yaw = job["start"]
        self._data.qpos[self._q + 3 : self._q + 7] = math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)
        for _ in range(2):  # settle, put the robot back, and settle again
            self._data.qpos[self._q : self._q + 2] = x, y
            mujoco.mj_forward(self._model, self._data)
            for _ in range(round(SETTLE_S / 2 / job["step_s"])):
                mujoco.mj_step(self._model, self._data)
        mujoco.mj_forward(self._model, self._data)
        left = self._data.xmat[base].reshape(3, 3)[:, 1]  # a joint whose axis points right turns backward
        self._senses = [math.copysign(1.0, left @ self._data.xaxis[joint]) for joint in self._wheels]
        self._zero = self._angles()

    def _narrow(self) -> None:
        """Let the wheels roll on the middle of their treads, since the edges of a wide one slip on curves."""
        turned = [self._model.jnt_bodyid[joint] for joint in self._wheels]
        for i, body in enumerate(self._model.geom_bodyid.tolist()):
            if body in turned and self._model.geom_type[i] == mujoco.mjtGeom.mjGEOM_CYLINDER:
                self._model.geom_size[i, 1] = min(EDGE_M, self._model.geom_size[i, 1])

    def step(self, rates: list[list[float]]) -> None:
        """Physics steps, each with its wheel rates [rad/s]."""
        for pair in rates:
            self._data.ctrl[self._ctrl] = [
                pair[side] * sense for side, sense in zip(self._sides, self._senses, strict=True)
            ]
            mujoco.mj_step(self._model, self._data)

    def seen(self) -> list[float]:
        """x, y, yaw, v, w, wheel angles, height, and how upright it is."""
        mujoco.mj_kinematics(self._model, self._data)
        x, y, z = self._data.xpos[self._base].tolist()
        turn = self._data.xmat[self._base].reshape(3, 3)
        yaw = math.atan2(turn[1, 0], turn[0, 0])
        vx, vy, _, wx, wy, wz = self._data.qvel[self._qd : self._qd + 6].tolist()
        w = turn[2, 0] * wx + turn[2, 1] * wy + turn[2, 2] * wz  # MuJoCo gives it in the body's axes
        v = vx * math.cos(yaw) + vy * math.sin(yaw)
        left, right = (
            (a - b) * sense
            for a, b, sense in zip(self._angles()[:2], self._zero[:2], self._senses[:2], strict=True)
        )
        return [x, y, yaw, v, float(w), left, right, z, float(turn[2, 2])]

    def _angles(self) -> list[float]:
        return [float(self._data.qpos[self._model.jnt_qposadr[joint]]) for joint in self._wheels]


def _only(labels: list[str], robot: str, name: str) -> int:
    """Index of the label of a robot's link or joint; MuJoCo's labels have _ in place of /."""
    plain = [label.replace("/", "_") for label in labels]
    ends = [i for i, label in enumerate(plain) if label.endswith(f"_{name}")]
    ends = [i for i in ends if f"_{robot}_" in plain[i]] if len(ends) > 1 else ends
    if len(ends) > 1:  # left_wheel_joint ends with wheel_joint too
        ends = [i for i in ends if labels[i].endswith(f"/{name}")] or ends[:1]
    if not ends:
        raise ValueError(f"no {name} of {robot} in {', '.join(labels)}")
    return ends[0]


def main() -> None:
    """Serve one stage."""
    out = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # what the libraries print goes to stderr
    world = World(json.loads(sys.stdin.readline()))
    out.write(json.dumps(world.seen()) + "\n")
    for line in sys.stdin:
        world.step(json.loads(line))
        out.write(json.dumps(world.seen()) + "\n")


if __name__ == "__main__":
    main()
