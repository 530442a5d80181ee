"""Let one converted robot settle in Newton, then drive it or move its first joint.

    python newton_trial.py < JOBS

A server of jobs, see `serving.py`. Newton's USD schemas must be registered before USD is first used, so this
is a process of its own. A job has `stage`, `answer`, and `poses`: positions of joints by prim [rad, m] and
the places of bodies that belong to them [m], both for forward kinematics. Each joint starts at the value
within its limits that is nearest to 0, and a floating robot with its lowest collider on a plane. The MuJoCo
solver on the CPU steps the model, with the settings of magtwin's own engine.
"""

import json
import math
from pathlib import Path
from typing import NamedTuple

import mujoco
import newton
import newton_usd_schemas  # noqa: F401 - registers them
import numpy as np
import warp as wp
from serving import serve

STEP_S = 0.002
SETTLE_S, WATCH_S, MOVE_S = 3.0, 1.0, 1.0
"""Time to settle, time in which creep is measured, and time of the motion [s]."""

STIFF_STEPS = 4.0
"""As in magtwin.sim.engines.newton_world."""

SPEED_M_S, TURN_RAD, SLIDE_M = 0.1, 0.2, 0.02
"""Speed of wheels, and steps of a rotary and of a sliding joint."""

SINGLE = newton.JointType.REVOLUTE, newton.JointType.PRISMATIC

FAR_M, GRAVITY = 100.0, 9.81

LIMIT_GB = 8
"""Most memory of a trial [GB]."""


class Wheel(NamedTuple):
    """A wheel that stands on the floor."""

    joint: int

    axle: np.ndarray
    """Unit axis of the joint on the floor, shape (2,)."""

    radius: float
    """Height of its centre [m]."""

    friction: float


def put_within_limits(builder: newton.ModelBuilder) -> None:
    """Move each joint to the nearest value within its limits, and those that follow another after it."""
    q_at, qd_at = builder.joint_q_start, builder.joint_qd_start
    for joint, kind in enumerate(builder.joint_type):
        if kind in SINGLE:
            low, high = (
                ends[qd_at[joint]] for ends in (builder.joint_limit_lower, builder.joint_limit_upper)
            )
            builder.joint_q[q_at[joint]] = min(max(builder.joint_q[q_at[joint]], low), high)
    for joint, leader in enumerate(builder.joint_mimic_joint):
        if leader is not None and leader >= 0:
            offset, ratio = builder.joint_mimic_coeffs[joint]
            builder.joint_q[q_at[joint]] = offset + ratio * builder.joint_q[q_at[leader]]


class Trial:
    """One robot in Newton."""

    def __init__(self, stage: str) -> None:
        builder = newton.ModelBuilder(up_axis=newton.Axis.Z)
        newton.solvers.SolverMuJoCo.register_custom_attributes(builder)
        builder.add_usd(stage, load_visual_shapes=False, load_static_visual_shapes=False)
        put_within_limits(builder)
        self.free = [i for i, kind in enumerate(builder.joint_type) if kind == newton.JointType.FREE]
        self.floats = 0 in self.free
        if self.floats:
            builder.add_ground_plane()
        self.model = model = builder.finalize(device="cpu")
        self.labels, self.bodies = list(model.joint_label), list(model.body_label)
        self.q_at, self.qd_at = model.joint_q_start.numpy(), model.joint_qd_start.numpy()
        self.solver = newton.solvers.SolverMuJoCo(model, use_mujoco_cpu=True, cone="elliptic")
        self.mj, self.data = self.solver.mj_model, self.solver.mj_data
        self.mj.opt.timestep = STEP_S
        self.mj.geom_gap[:] = 0.0
        self.mj.geom_solref[:] = STIFF_STEPS * STEP_S, 1.0
        self.mj.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_MULTICCD)
        if self.floats:
            self._put_on_the_floor()
        self.now, self.then, self.control = model.state(), model.state(), model.control()
        newton.eval_fk(model, model.joint_q, model.joint_qd, self.now)
        self.top_speed = 0.0
        self.up_at_start = self.up()

    def _put_on_the_floor(self) -> None:
        """Lower or raise the robot until its lowest collider touches the plane."""
        mj, data = self.mj, self.data
        q = self.model.joint_q.numpy()
        data.qpos[2] += FAR_M / 2
        mujoco.mj_forward(mj, data)
        planes = [i for i in range(mj.ngeom) if mj.geom_type[i] == mujoco.mjtGeom.mjGEOM_PLANE]
        gaps = [
            mujoco.mj_geomDistance(mj, data, planes[0], i, FAR_M, None)
            for i in range(mj.ngeom)
            if i not in planes and mj.geom_contype[i] | mj.geom_conaffinity[i]
        ]
        if gaps:
            q[2] += FAR_M / 2 - min(gaps)
            self.model.joint_q.assign(q)

    def fk_error(self, poses: dict) -> float | None:
        """Greatest distance of a body from where it should be, relative to the base [m]."""
        if not poses:
            return None
        q = self.model.joint_q.numpy().copy()
        for path, value in poses["joints"].items():
            if path in self.labels:
                q[self.q_at[self.labels.index(path)]] = value
        state = self.model.state()
        newton.eval_fk(self.model, wp.array(q, dtype=wp.float32, device="cpu"), self.model.joint_qd, state)
        T = state.body_q.numpy().astype(float)
        place = {name: T[i] for i, name in enumerate(self.bodies)}
        base = place.get(poses["base"])
        if base is None:
            return None
        x, y, z, w = base[3:7]
        R = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        )
        away = [
            np.linalg.norm(R.T @ (place[name][:3] - base[:3]) - np.array(wanted))
            for name, wanted in poses["bodies"].items()
            if name in place
        ]
        return float(max(away)) if away else None

    def run(self, seconds: float) -> bool:
        """Step; False if a value is not finite."""
        for i in range(round(seconds / STEP_S)):
            self.now.clear_forces()
            self.solver.step(self.now, self.then, self.control, None, STEP_S)
            self.now, self.then = self.then, self.now
            if i % 10 == 0:
                speeds = np.linalg.norm(self.now.body_qd.numpy()[:, :3], axis=1)
                if not np.isfinite(speeds).all():
                    return False
                self.top_speed = max(self.top_speed, float(speeds.max(initial=0.0)))
        return True

    def places(self) -> np.ndarray:
        return self.now.body_q.numpy().astype(float).copy()

    def positions(self) -> np.ndarray:
        q, qd = wp.zeros_like(self.model.joint_q), wp.zeros_like(self.model.joint_qd)
        newton.eval_ik(self.model, self.now, q, qd)
        return q.numpy().astype(float)

    def single(self) -> list[int]:
        """Joints with one degree of freedom."""
        return [i for i, kind in enumerate(self.model.joint_type.numpy().tolist()) if kind in SINGLE]

    def gains(self, joint: int) -> tuple[float, float]:
        at = self.qd_at[joint]
        return float(self.model.joint_target_ke.numpy()[at]), float(self.model.joint_target_kd.numpy()[at])

    def on_floor(self) -> dict[str, float]:
        """Bodies that touch the floor, by their name in MuJoCo, with the largest friction of a contact."""
        touching: dict[str, float] = {}
        plane = mujoco.mjtGeom.mjGEOM_PLANE
        for contact in self.data.contact[: self.data.ncon]:
            for a, b in ((contact.geom1, contact.geom2), (contact.geom2, contact.geom1)):
                if self.mj.geom_type[a] == plane:
                    name = self.mj.body(self.mj.geom_bodyid[b]).name
                    touching[name] = max(touching.get(name, 0.0), float(contact.friction[0]))
        return touching

    def wheels(self) -> list[Wheel]:
        """Joints with a velocity drive whose body stands on the floor."""
        wheels, touching = [], self.on_floor()
        child, place = self.model.joint_child.numpy(), self.places()
        for joint in self.single():
            ke, kd = self.gains(joint)
            body = int(child[joint])
            friction = touching.get(self.bodies[body].replace("/", "_"))
            if ke or not kd or friction is None:
                continue
            axis = self.data.xaxis[self.mj.joint(self.labels[joint].replace("/", "_")).id]
            if abs(axis[2]) < 0.3 and place[body][2] > 0.005:
                wheels.append(Wheel(joint, axis[:2] / np.linalg.norm(axis[:2]), place[body][2], friction))
        return wheels

    def ahead(self, wheels: list[Wheel]) -> np.ndarray:
        """The direction on the floor in which the wheels roll, shape (2,): across their axles.

        The x axis of the base, or for a base that is turned in its description, its y axis.
        """
        x, y, z, w = self.places()[0][3:7]
        v = np.array([1 - 2 * (y * y + z * z), 2 * (x * y + z * w)])
        v /= max(np.linalg.norm(v), 1e-9)
        along = np.mean([abs(wheel.axle @ v) for wheel in wheels])
        return np.array([-v[1], v[0]]) if along > math.cos(math.radians(30)) else v

    def up(self) -> np.ndarray:
        """The z axis of the base, shape (3,)."""
        x, y, z, w = self.now.body_q.numpy().astype(float)[0][3:7]
        return np.array([2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)])

    def tilt(self) -> float:
        """Angle between the z axis of the base now and at the start [deg]."""
        return math.degrees(math.acos(max(-1.0, min(1.0, float(self.up() @ self.up_at_start)))))

    def drive(self, wheels: list[Wheel]) -> dict:
        """Roll ahead; the distance as a share of what the wheels should turn.

        With a description's friction mu the floor moves the robot by at most mu g t^2 / 2. If that is less
        than half of the distance, the share is that of the wheels' own turn.
        """
        targets = self.control.joint_target_qd.numpy().copy()
        start, ahead, before = self.places()[0][:2], self.ahead(wheels), self.positions()
        left, distance = np.array([-ahead[1], ahead[0]]), SPEED_M_S * MOVE_S
        rates = {w.joint: float(np.sign(w.axle @ left)) / w.radius for w in wheels}
        for joint, rate in rates.items():
            targets[self.qd_at[joint]] = rate * SPEED_M_S
        self.control.joint_target_qd.assign(targets)
        what, friction = f"{len(wheels)} wheels", max(w.friction for w in wheels)
        if not self.run(MOVE_S):
            return {"what": what, "share": math.nan}
        if friction * GRAVITY * MOVE_S**2 / 2 < distance / 2:
            turned = self.positions() - before
            shares = [turned[self.q_at[joint]] / (rate * distance) for joint, rate in rates.items()]
            return {"what": f"{what} turn, on friction {friction:.2g}", "share": float(np.mean(shares))}
        return {"what": what, "share": float((self.places()[0][:2] - start) @ ahead) / distance}

    def move(self) -> dict | None:
        """Move the first joint that has a drive; the motion as a share of the step."""
        low, high = self.model.joint_limit_lower.numpy(), self.model.joint_limit_upper.numpy()
        before = self.positions()
        followers = {int(j) for j in getattr(self.model, "constraint_mimic_joint0", wp.zeros(0)).numpy()}
        for joint in self.single():
            ke, kd = self.gains(joint)
            if not (ke or kd) or joint in followers:
                continue
            q, at = self.q_at[joint], self.qd_at[joint]
            slides = self.model.joint_type.numpy()[joint] == newton.JointType.PRISMATIC
            step = SLIDE_M if slides else TURN_RAD
            if ke:
                targets = self.control.joint_target_q.numpy().copy()
                up = min(step, high[at] - before[q])
                down = min(step, before[q] - low[at])
                step = float(up if up >= down else -down)
                targets[q] += step
                self.control.joint_target_q.assign(targets)
            else:
                targets = self.control.joint_target_qd.numpy().copy()
                targets[at] = step / MOVE_S
                self.control.joint_target_qd.assign(targets)
            fine = self.run(MOVE_S)
            share = float((self.positions()[q] - before[q]) / step) if fine else math.nan
            return {"what": self.labels[joint].rpartition("/")[2], "share": share}
        return None


def main(job_file: str) -> None:
    job = json.loads(Path(job_file).read_text())
    trial = Trial(job["stage"])
    seen: dict = {
        "engine": f"Newton {newton.__version__}",
        "mass_kg": float(trial.model.body_mass.numpy().sum()),
        "masses_kg": dict(zip(trial.bodies, map(float, trial.model.body_mass.numpy()), strict=True)),
        "bodies": trial.model.body_count,
        "floats": trial.floats,
        "fk_error_m": trial.fk_error(job["poses"]),
    }
    start = trial.places()
    fine = trial.run(SETTLE_S)
    if fine:
        settled, tilt = trial.places(), trial.tilt()
        fine = trial.run(WATCH_S)
    if fine:
        after = trial.places()
        creep = np.linalg.norm(after[:, :3] - settled[:, :3], axis=1)
        moved = np.linalg.norm(after[:, :3] - start[:, :3], axis=1)
        seen |= {
            "creep_m": float(creep.max()),
            "creeps": trial.bodies[int(creep.argmax())],
            "base_moved_m": float(moved[0]),
            "base_sank_m": float(start[0, 2] - after[0, 2]),
            "base_creep_m": float(abs(after[0, 2] - settled[0, 2])),
            "moved_m": float(moved.max()),
            "moves": trial.bodies[int(moved.argmax())],
            "tilt_deg": trial.tilt(),
            "tilt_creep_deg": abs(trial.tilt() - tilt),
            "on_floor": sorted(trial.on_floor()),
        }
        wheels = trial.wheels() if trial.floats else []
        seen["motion"] = trial.drive(wheels) if wheels else trial.move()
        fine = bool(np.isfinite(trial.places()).all())
    seen |= {"finite": fine, "top_speed_m_s": trial.top_speed}
    Path(job["answer"]).write_text(json.dumps(seen))


if __name__ == "__main__":
    wp.config.quiet = True
    wp.init()
    serve(main, LIMIT_GB)
