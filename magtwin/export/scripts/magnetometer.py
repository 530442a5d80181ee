"""What the scripts for Isaac Sim and Newton share: readings of map + network, and a lap of a figure of eight.

Needs onnxruntime, numpy and the stage of an engine, and nothing of magtwin. Signals are the physics' own,
without noise or delay, and the battery stays full.
"""

import json
import math
import sys

import numpy as np
import onnxruntime
from pxr import Gf, UsdGeom

DT, STEPS, SPEED, ACCELERATION = 0.02, 4, 0.2, 0.9  # s between readings, physics steps in it, m/s, m/s2


class Lap:
    """A robot that drives the figure of eight, and its magnetometer."""

    def __init__(self, stage, network):
        """Read a scene of magtwin's, and the file that `magtwin model export W.safetensors` wrote."""
        self.stage, self.file = stage, network
        self.network = onnxruntime.InferenceSession(network)
        self.inputs = json.loads(self.network.get_modelmeta().custom_metadata_map["features"])
        self.robot, self.drive = self.figures("drive")
        self.grid, self.battery, self.lidar = (self.figures(n)[1] for n in ("anomalyMap", "battery", "lidar"))
        values = np.where(self.grid["valid"], self.grid["valuesNt"], np.nan).reshape(self.grid["shape"])
        self.values = np.append(values, values[:1], axis=0)  # once round: the last heading is the first
        self.headings = np.radians([*self.grid["headingsDeg"], self.grid["headingsDeg"][0] + 360])
        names = [f"magtwin:drive:{side}WheelJoint" for side in ("left", "right")]
        self.joints = [self.robot.GetRelationship(name).GetTargets()[0] for name in names]
        self.base = self.robot.GetRelationship("isaac:physics:robotLinks").GetTargets()[0]  # it comes first
        self.senses = np.array([self.sense(stage.GetPrimAtPath(joint)) for joint in self.joints])
        u = np.linspace(0, 2 * np.pi, 4001)
        path = np.column_stack([2.4 * np.sin(u), 1.2 * np.sin(2 * u)])
        self.way = np.append(
            0, np.cumsum(np.hypot(*np.diff(path, axis=0).T))
        )  # to each point of the path [m]
        course = np.unwrap(np.arctan2(2.4 * np.cos(2 * u), 2.4 * np.cos(u)))
        self.guide = *path.T, course, np.gradient(course, self.way)  # x, y, heading and curvature there
        self.start = *path[0], course[0]
        self.readings, self.command = [], (0.0, 0.0)
        self.travelled = self.wanted = self.last_v = 0.0

    def figures(self, noun):
        """The prim that has magtwin's figures of a noun, and the figures by name."""
        key = f"magtwin:{noun}:"
        prim = next(p for p in self.stage.Traverse() if any(n.startswith(key) for n in p.GetPropertyNames()))
        return prim, {a.GetName().removeprefix(key): a.Get() for a in prim.GetAttributes()}

    def sense(self, joint):
        """-1 if a wheel rolls backward as its joint's angle grows, since its axis points right; else 1."""
        axis = Gf.Vec3d(*(float(letter == joint.GetAttribute("physics:axis").Get()) for letter in "XYZ"))
        axis = Gf.Rotation(joint.GetAttribute("physics:localRot1").Get()).TransformDir(axis)
        wheel = self.stage.GetPrimAtPath(joint.GetRelationship("physics:body1").GetTargets()[0])
        base = self.stage.GetPrimAtPath(self.base)
        to_base, _ = UsdGeom.XformCache().ComputeRelativeTransform(wheel, base)
        return -1.0 if to_base.TransformDir(axis)[1] < 0 else 1.0

    def field_map(self, x, y, yaw):
        """The map at a pose [nT]: linear in x, in y, and between two headings on the circle."""
        values, headings = self.values, self.headings
        yaw = (yaw - headings[0]) % (2 * math.pi) + headings[0]
        k = min(np.searchsorted(headings, yaw, "right"), len(headings) - 1) - 1
        h = (yaw - headings[k]) / (headings[k + 1] - headings[k])
        column, row = (np.array([x, y]) - self.grid["originM"]) / self.grid["cellSizeM"]
        if not (0 <= column <= values.shape[2] - 1 and 0 <= row <= values.shape[1] - 1):
            return math.nan
        i, j = min(int(column), values.shape[2] - 2), min(int(row), values.shape[1] - 2)
        cell = (1 - h) * values[k, j : j + 2, i : i + 2] + h * values[k + 1, j : j + 2, i : i + 2]
        return float(np.array([1 - row + j, row - j]) @ cell @ np.array([1 - column + i, column - i]))

    def signals(self, t, pose, q, twist, acceleration):
        """What a network may read, by the names that magtwin has for it; the battery is full."""
        battery, lidar, command = self.battery, self.lidar, self.command
        (x, y, yaw), (v, w), full = pose, twist, battery["voltageFullV"]
        cycle = lidar["onS"] + lidar["offS"]
        on = float(lidar["onS"] > 0 and (t + lidar["phaseS"]) % cycle >= lidar["offS"])
        watts = battery["loadW"] + on * battery["lidarW"]
        watts += battery["dragN"] * abs(v) / battery["motorEfficiency"]
        known = dict.fromkeys(("odom_v_y", "odom_v_z", "odom_w_x", "odom_w_y", "imu_w_x", "imu_w_y"), 0.0)
        known |= {"yaw_deg": math.degrees(yaw) % 360, "odom_v_x": v, "odom_w_z": w, "imu_w_z": w}
        known |= {"imu_a_x": acceleration, "imu_a_y": v * w, "imu_a_z": 0.0, "lidar_on": on}
        known |= {f"imu_q_{part}": math.copysign(1, q[3]) * q[n] for n, part in enumerate("xyzw")}
        volts = full - battery["resistanceOhm"] * watts / full
        known |= {"battery_fraction": 1.0, "battery_v": volts, "battery_a": watts / volts}
        known |= {"lag_v": command[0] - v, "lag_w": command[1] - w, "turning": abs(w)}
        c, s = math.cos(yaw), math.sin(yaw)
        for name in ("odom_v_x", "odom_w_z", "turning", "lag_v", "lag_w", "lidar_on", "battery_a"):
            known |= {f"{name}_yaw_sin": known[name] * s, f"{name}_yaw_cos": known[name] * c}
        known |= {"yaw_sin": s, "yaw_cos": c, "yaw_sin_2": math.sin(2 * yaw), "yaw_cos_2": math.cos(2 * yaw)}
        for name, a, b in (("forward", c, s), ("left", -s, c)):
            ends = [self.field_map(x + step * a, y + step * b, yaw) for step in (-0.001, 0.001)]
            slope = (ends[1] - ends[0]) / 0.002
            known |= {f"map_gradient_{name}": slope, f"speed_map_gradient_{name}": slope * v}
        return known

    def step(self, x, y, q, vx, vy, w):
        """Take a reading at a pose (q is xyzw) with a velocity in world; returns rates of both joints.

        The rates are None at the end of the lap.
        """
        if self.travelled >= self.way[-1]:
            return None
        t, drive = len(self.readings) * DT, self.drive
        yaw = math.atan2(2 * (q[3] * q[2] + q[0] * q[1]), 1 - 2 * (q[1] ** 2 + q[2] ** 2))
        v = vx * math.cos(yaw) + vy * math.sin(yaw)
        known = self.signals(t, (x, y, yaw), q, (v, w), (v - self.last_v) / DT)
        if lacking := sorted(set(self.inputs) - set(known)):
            sys.exit(f"{self.file} reads {', '.join(lacking)}, which this script does not know")
        self.last_v, features = v, {"features": np.array([[known[name] for name in self.inputs]])}
        disturbance, sd = (out.item() for out in self.network.run(["disturbance_nt", "sd_nt"], features))
        b_map = self.field_map(x, y, yaw)
        self.readings.append((t, x, y, yaw, *self.command, b_map, disturbance, sd, b_map + disturbance))

        self.wanted = min(SPEED, self.wanted + ACCELERATION * DT)
        self.travelled += self.wanted * DT
        px, py, heading, bend = (np.interp(self.travelled, self.way, along) for along in self.guide)
        ahead = math.cos(yaw) * (px - x) + math.sin(yaw) * (py - y)
        aside = math.cos(yaw) * (py - y) - math.sin(yaw) * (px - x)
        forward = self.wanted * math.cos(heading - yaw) + 2 * ahead  # Kanayama and others (1990)
        self.command = forward, self.wanted * (bend + 8 * aside + 4 * math.sin(heading - yaw))
        apart = self.command[1] * drive["wheelSeparationM"] / 2
        return self.senses * np.array([forward - apart, forward + apart]) / drive["wheelRadiusM"]

    def lag(self, rates, asked):
        """Rates of the wheels after a step, by the lag of the motors."""
        return rates + (1 - math.exp(-DT / max(self.drive["motorLagS"], 1e-9))) * (asked - rates)

    def save(self, file):
        """Write the readings as CSV."""
        names = "t,x,y,yaw,v_cmd,w_cmd,b_map_nt,b_disturbance_nt,b_sd_nt,b_total_nt"
        np.savetxt(file, self.readings, "%.6f", ",", header=names, comments="")
        print(f"{len(self.readings)} readings in {self.readings[-1][0]:.1f} s of driving are in {file}")
