"""Drive a stage in Newton's MuJoCo solver on the CPU, in a process of its own; writes what it saw as JSON.

    python newton_drive.py STAGE JOB.json

The process is its own because Newton's USD schemas must be registered before USD is first used.
JOB: {"rate_hz": steps a second, "settle_s": ..., "ground_friction": ..., "height_m": where it is let go,
"trials": [{"seconds": ..., "speeds": {joint: rad/s}}, ...]}. Each trial starts anew from rest.
"""

import json
import math
import sys
from pathlib import Path

import newton
import warp as wp
from pxr import Usd


def yaw(q):
    return math.atan2(2 * (q[6] * q[5] + q[3] * q[4]), 1 - 2 * (q[4] ** 2 + q[5] ** 2))


def build(stage, job):
    builder = newton.ModelBuilder(up_axis=newton.Axis.Z)
    newton.solvers.SolverMuJoCo.register_custom_attributes(builder)
    builder.add_usd(stage, xform=wp.transform((0.0, 0.0, job["height_m"]), wp.quat_identity()))
    if job.get("ground_friction") is not None:
        builder.add_ground_plane(cfg=newton.ModelBuilder.ShapeConfig(mu=job["ground_friction"]))
    return builder.finalize(device="cpu")


def drive(model, job, trial):
    """Twist that a base has gone through, and where its joints are at the end."""
    solver = newton.solvers.SolverMuJoCo(model)
    now, then, control = model.state(), model.state(), model.control()
    newton.eval_fk(model, model.joint_q, model.joint_qd, now)
    starts, coords = model.joint_qd_start.numpy(), model.joint_q_start.numpy()
    index = {label.split("/")[-1]: i for i, label in enumerate(model.joint_label)}
    at_rest = control.joint_target_qd.numpy().copy()
    asked = at_rest.copy()
    for joint, speed in trial["speeds"].items():
        asked[starts[index[joint]]] = speed
    if trial.get("positions"):
        targets = control.joint_target_q.numpy().copy()
        for joint, value in trial["positions"].items():
            targets[coords[index[joint]]] = value
        control.joint_target_q.assign(targets)

    def pose():
        return now.body_q.numpy()[0].astype(float).copy()

    turned = 0.0
    for seconds, target in ((job["settle_s"], at_rest), (trial["seconds"], asked)):
        control.joint_target_qd.assign(target)
        first = last = pose()
        turned = 0.0
        for _ in range(round(seconds * job["rate_hz"])):
            now.clear_forces()
            solver.step(now, then, control, None, 1 / job["rate_hz"])
            now, then = then, now
            q = pose()
            turned += (yaw(q) - yaw(last) + math.pi) % (2 * math.pi) - math.pi
            last = q
    newton.eval_ik(model, now, now.joint_q, now.joint_qd)
    values, rates = now.joint_q.numpy(), now.joint_qd.numpy()
    single = [name for name, i in index.items() if model.joint_type.numpy()[i] in (0, 1)]
    return {
        "forward_m": float(math.hypot(*(last - first)[:2])),
        "turned_rad": turned,
        "rise_m": float(last[2] - first[2]),
        "positions": {name: float(values[coords[index[name]]]) for name in single},
        "rates": {name: float(rates[starts[index[name]]]) for name in single},
    }


def main(stage_file, job_file):
    wp.config.quiet = True
    job = json.loads(Path(job_file).read_text())
    stage = Usd.Stage.Open(stage_file)
    model = build(stage, job)
    seen = {
        "mass_kg": float(model.body_mass.numpy().sum()),
        "bodies": model.body_count,
        "dofs": model.joint_dof_count,
        "trials": [drive(model, job, trial) for trial in job["trials"]],
    }
    sys.stdout.write(json.dumps(seen) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
