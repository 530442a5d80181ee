"""UNTESTED. A magnetometer in Isaac Sim: a robot drives a figure of eight and reads map + network.

    ./python.sh -m pip install onnxruntime
    ./python.sh isaac_magnetometer.py STAGE.usda NETWORK.onnx READINGS.csv

Written from the sources of Isaac Sim 6.0.1 and never run there, as it needs an RTX card; readings and control
are those of magnetometer.py beside it, which is tested. STAGE is a scene of magtwin's, NETWORK what `magtwin
network export WEIGHTS.safetensors --out NETWORK.onnx` wrote.
"""

import math
import sys
from pathlib import Path

from isaacsim import SimulationApp

app = SimulationApp({"headless": True})

import isaacsim.core.experimental.utils.stage as stage_utils  # noqa: E402 - these are there once it runs
import numpy as np  # noqa: E402
import omni.timeline  # noqa: E402
from isaacsim.core.experimental.prims import Articulation, RigidPrim  # noqa: E402
from isaacsim.core.simulation_manager import SimulationManager  # noqa: E402
from magnetometer import DT, STEPS, Lap  # noqa: E402

opened, stage = stage_utils.open_stage(str(Path(sys.argv[1]).resolve()))
if not opened:
    sys.exit(f"{sys.argv[1]}: Isaac Sim cannot open it")
lap = Lap(stage, sys.argv[2])
if graphs := stage.GetPrimAtPath("/World/Graphs"):
    graphs.SetActive(False)  # the wheels are driven from here, not by ROS 2
SimulationManager.setup_simulation(dt=DT / STEPS, device="cpu")
articulation, base = Articulation(str(lap.robot.GetPath())), RigidPrim(str(lap.base))
omni.timeline.get_timeline_interface().play()
app.update()
wheels = [articulation.get_dof_indices(path.name).list()[0] for path in lap.joints]
half = lap.start[2] / 2
place, turn = (*lap.start[:2], 0.0), (math.cos(half), 0.0, 0.0, math.sin(half))
articulation.set_world_poses(positions=place, orientations=turn)

rates = np.zeros(2)
while True:
    (x, y, _), turn = (part.numpy()[0].tolist() for part in base.get_world_poses())
    (vx, vy, _), spin = (part.numpy()[0].tolist() for part in base.get_velocities())  # in world axes
    asked = lap.step(x, y, [*turn[1:], turn[0]], vx, vy, spin[2])
    if asked is None:
        break
    rates = lap.lag(rates, asked)
    articulation.set_dof_velocity_targets(rates, dof_indices=wheels)
    SimulationManager.step(steps=STEPS)
lap.save(sys.argv[3])
app.close()
