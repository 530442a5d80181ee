"""UNTESTED. A magnetometer in Isaac Sim: a robot drives a figure of eight and reads map + network.

    ./python.sh -m pip install onnxruntime
    ./python.sh isaac_magnetometer.py STAGE.usda NETWORK.onnx READINGS.csv

Written from the sources of Isaac Sim 6.0.1 and never run there, as it needs an RTX card; the loop is that of
newton_magnetometer.py, which is tested. STAGE is a scene of magtwin's, NETWORK what `magtwin network export
WEIGHTS.safetensors --out NETWORK.onnx` wrote. Signals are the physics' own, without noise or delay, and the
battery stays full.
"""

import json
import math
import sys
from pathlib import Path

from isaacsim import SimulationApp

app = SimulationApp({"headless": True})

import isaacsim.core.experimental.utils.stage as stage_utils  # noqa: E402 - these are there once it runs
import numpy as np  # noqa: E402
import omni.timeline  # noqa: E402
import onnxruntime  # noqa: E402
from isaacsim.core.experimental.prims import Articulation, RigidPrim  # noqa: E402
from isaacsim.core.simulation_manager import SimulationManager  # noqa: E402

DT, STEPS, SPEED, ACCELERATION = 0.02, 4, 0.2, 0.9  # s between readings, physics steps in it, m/s, m/s2
opened, stage = stage_utils.open_stage(str(Path(sys.argv[1]).resolve()))
if not opened:
    sys.exit(f"{sys.argv[1]}: Isaac Sim cannot open it")
network = onnxruntime.InferenceSession(sys.argv[2])
inputs = json.loads(network.get_modelmeta().custom_metadata_map["features"])


def figures(noun):
    """The prim that has magtwin's figures of a noun, and the figures by name."""
    key = f"magtwin:{noun}:"
    prim = next(p for p in stage.Traverse() if any(n.startswith(key) for n in p.GetPropertyNames()))
    return prim, {a.GetName().removeprefix(key): a.Get() for a in prim.GetAttributes()}


robot, drive = figures("drive")
grid, battery, lidar = (figures(noun)[1] for noun in ("anomalyMap", "battery", "lidar"))
values = np.where(grid["valid"], grid["values"], np.nan).reshape(grid["shape"])
values = np.append(values, values[:1], axis=0)  # once round: the last heading is the first
headings = np.radians([*grid["headings"], grid["headings"][0] + 360])


def field_map(x, y, yaw):
    """The map at a pose [nT]: linear in x, in y, and between two headings on the circle."""
    yaw = (yaw - headings[0]) % (2 * math.pi) + headings[0]
    k = min(np.searchsorted(headings, yaw, "right"), len(headings) - 1) - 1
    h = (yaw - headings[k]) / (headings[k + 1] - headings[k])
    column, row = (np.array([x, y]) - grid["origin"]) / grid["cellSize"]
    if not (0 <= column <= values.shape[2] - 1 and 0 <= row <= values.shape[1] - 1):
        return math.nan
    i, j = min(int(column), values.shape[2] - 2), min(int(row), values.shape[1] - 2)
    cell = (1 - h) * values[k, j : j + 2, i : i + 2] + h * values[k + 1, j : j + 2, i : i + 2]
    return float(np.array([1 - row + j, row - j]) @ cell @ np.array([1 - column + i, column - i]))


def signals(t, pose, q, twist, acceleration, command):
    """What a network may read, by the names that magtwin has for it; the battery is full."""
    (x, y, yaw), (v, w), full = pose, twist, battery["voltageFullV"]
    on = float(lidar["onS"] > 0 and (t + lidar["phaseS"]) % (lidar["onS"] + lidar["offS"]) >= lidar["offS"])
    watts = battery["loadW"] + on * battery["lidarW"] + battery["dragN"] * abs(v) / battery["motorEfficiency"]
    known = dict.fromkeys(("odom_v_y", "odom_v_z", "odom_w_x", "odom_w_y", "imu_w_x", "imu_w_y"), 0.0)
    known |= {"yaw_deg": math.degrees(yaw) % 360, "odom_v_x": v, "odom_w_z": w, "imu_w_z": w}
    known |= {"imu_a_x": acceleration, "imu_a_y": v * w, "imu_a_z": 0.0, "lidar_on": on, "turning": abs(w)}
    known |= {f"imu_q_{part}": math.copysign(1, q[3]) * q[n] for n, part in enumerate("xyzw")}
    volts = full - battery["resistanceOhm"] * watts / full
    known |= {"battery_fraction": 1.0, "battery_v": volts, "battery_a": watts / volts}
    known |= {"lag_v": command[0] - v, "lag_w": command[1] - w}
    c, s = math.cos(yaw), math.sin(yaw)
    for name in ("odom_v_x", "odom_w_z", "turning", "lag_v", "lag_w", "lidar_on", "battery_a"):
        known |= {f"{name}_yaw_sin": known[name] * s, f"{name}_yaw_cos": known[name] * c}
    known |= {"yaw_sin": s, "yaw_cos": c, "yaw_sin_2": math.sin(2 * yaw), "yaw_cos_2": math.cos(2 * yaw)}
    for name, a, b in (("forward", c, s), ("left", -s, c)):
        ends = [field_map(x + step * a, y + step * b, yaw) for step in (-0.001, 0.001)]
        slope = (ends[1] - ends[0]) / 0.002
        known |= {f"map_gradient_{name}": slope, f"speed_map_gradient_{name}": slope * v}
    return known


if graphs := stage.GetPrimAtPath("/World/Graphs"):
    graphs.SetActive(False)  # the wheels are driven from here, not by ROS 2
joints = [robot.GetRelationship(f"magtwin:drive:{side}WheelJoint").GetTargets() for side in ("left", "right")]
SimulationManager.setup_simulation(dt=DT / STEPS, device="cpu")
articulation = Articulation(str(robot.GetPath()))
links = robot.GetRelationship("isaac:physics:robotLinks").GetTargets()  # the base comes first
base = RigidPrim(str(links[0]))
omni.timeline.get_timeline_interface().play()
app.update()
wheels = [articulation.get_dof_indices(path.name).list()[0] for (path,) in joints]

u = np.linspace(0, 2 * np.pi, 4001)
path = np.column_stack([2.4 * np.sin(u), 1.2 * np.sin(2 * u)])
way = np.append(0, np.cumsum(np.hypot(*np.diff(path, axis=0).T)))  # travelled to each point of the path [m]
course = np.unwrap(np.arctan2(2.4 * np.cos(2 * u), 2.4 * np.cos(u)))
guide = *path.T, course, np.gradient(course, way)  # x, y, heading and curvature there
half = course[0] / 2
place, turn = (*path[0], 0.0), (math.cos(half), 0.0, 0.0, math.sin(half))
articulation.set_world_poses(positions=place, orientations=turn)

readings, rates, command = [], np.zeros(2), (0.0, 0.0)
travelled = wanted = last_v = 0.0
while travelled < way[-1]:
    place, turn = (part.numpy()[0].tolist() for part in base.get_world_poses())
    speed, spin = (part.numpy()[0].tolist() for part in base.get_velocities())  # in world axes
    t, (x, y, _), q, (vx, vy, _), w = len(readings) * DT, place, [*turn[1:], turn[0]], speed, spin[2]
    yaw = math.atan2(2 * (q[3] * q[2] + q[0] * q[1]), 1 - 2 * (q[1] ** 2 + q[2] ** 2))
    v = vx * math.cos(yaw) + vy * math.sin(yaw)
    known = signals(t, (x, y, yaw), q, (v, w), (v - last_v) / DT, command)
    if lacking := sorted(set(inputs) - set(known)):
        sys.exit(f"{sys.argv[2]} reads {', '.join(lacking)}, which this script does not know")
    last_v, features = v, np.array([[known[name] for name in inputs]])
    disturbance, sd = (out.item() for out in network.run(["disturbance_nt", "sd_nt"], {"features": features}))
    b_map = field_map(x, y, yaw)
    readings.append((t, x, y, yaw, *command, b_map, disturbance, sd, b_map + disturbance))

    wanted = min(SPEED, wanted + ACCELERATION * DT)
    travelled += wanted * DT
    px, py, heading, bend = (np.interp(travelled, way, along) for along in guide)
    ahead = math.cos(yaw) * (px - x) + math.sin(yaw) * (py - y)
    aside = math.cos(yaw) * (py - y) - math.sin(yaw) * (px - x)
    forward = wanted * math.cos(heading - yaw) + 2 * ahead  # Kanayama and others (1990)
    command = forward, wanted * (bend + 8 * aside + 4 * math.sin(heading - yaw))
    apart = command[1] * drive["wheelSeparationM"] / 2
    asked = np.array([forward - apart, forward + apart]) / drive["wheelRadiusM"]
    rates += (1 - math.exp(-DT / max(drive["motorLagS"], 1e-9))) * (asked - rates)
    articulation.set_dof_velocity_targets(rates, dof_indices=wheels)
    SimulationManager.step(steps=STEPS)

names = "t,x,y,yaw,v_cmd,w_cmd,b_map_nt,b_disturbance_nt,b_sd_nt,b_total_nt"
np.savetxt(sys.argv[3], readings, "%.6f", ",", header=names, comments="")
print(f"{len(readings)} readings in {t:.1f} s of driving are in {sys.argv[3]}")
app.close()
