"""A magnetometer in Newton: a robot drives a figure of eight through its lab and reads map + network.

    python newton_magnetometer.py STAGE.usda NETWORK.onnx READINGS.csv

STAGE is a scene of magtwin's, NETWORK what `magtwin model export WEIGHTS.safetensors --out NETWORK.onnx`
wrote. Needs magnetometer.py beside it, newton[sim], newton-usd-schemas, onnxruntime, numpy and usd-core, and
nothing of magtwin.
"""

import math
import sys

import newton
import newton_usd_schemas  # noqa: F401 - registers them, before USD is first used
from magnetometer import DT, STEPS, Lap
from pxr import Usd

stage = Usd.Stage.Open(sys.argv[1])
lap = Lap(stage, sys.argv[2])
builder = newton.ModelBuilder()
newton.solvers.SolverMuJoCo.register_custom_attributes(builder)
builder.add_usd(stage, load_visual_shapes=False, load_static_visual_shapes=False)
wheels = [builder.joint_qd_start[builder.joint_label.index(str(path))] for path in lap.joints]
base = builder.body_label.index(str(lap.base))
free = builder.joint_q_start[builder.joint_child.index(base)]  # of its joint: x, y, z, and a quaternion
model = builder.finalize(device="cpu")
solver = newton.solvers.SolverMuJoCo(model, use_mujoco_cpu=True)
now, then, control = model.state(), model.state(), model.control()

pose, half = model.joint_q.numpy(), lap.start[2] / 2
pose[free : free + 2], pose[free + 3 : free + 7] = lap.start[:2], (0, 0, math.sin(half), math.cos(half))
now.joint_q.assign(pose)
newton.eval_fk(model, now.joint_q, now.joint_qd, now)

rates = control.joint_target_qd.numpy()
while True:
    x, y, _, *q = now.body_q.numpy()[base].tolist()
    vx, vy, _, _, _, w = now.body_qd.numpy()[base].tolist()
    asked = lap.step(x, y, q, vx, vy, w)
    if asked is None:
        break
    rates[wheels] = lap.lag(rates[wheels], asked)
    control.joint_target_qd.assign(rates)
    for _ in range(STEPS):
        now.clear_forces()
        solver.step(now, then, control, None, DT / STEPS)
        now, then = then, now
lap.save(sys.argv[3])
