"""Replay: the motion of a recorded Run, on which other sensors can be read.

Rows of the kinematic engine, from the first on and at least one in each control step, give its exact motion.
For other rows speeds change evenly from row to row; quantities that depend on their change, above all the
motors' torque, are then only as good as the rate of the rows.
"""

from dataclasses import replace

import numpy as np

from magtwin.errors import InputError
from magtwin.frames import yaw_from_quat
from magtwin.run.run import Run
from magtwin.sim.engines.sampled import SampledMotion
from magtwin.sim.motion.drive import wheel_rates
from magtwin.sim.motion.follow import CONTROL_RATE_HZ
from magtwin.spec.drive import DriveSpec


def replayed(run: Run, drive: DriveSpec) -> SampledMotion:
    """The motion that a Run recorded, from its first row on.

    Returns:
        The motion, one mean interval longer than the rows, so that it gives as many readings.
    """
    lacking = [name for name in ("t", "p_world_base") if name not in run]
    if "yaw" not in run and "q_world_base_xyzw" not in run:
        lacking.append("yaw or q_world_base_xyzw")
    if lacking:
        raise InputError(f"a run to replay needs {', '.join(lacking)}, and has only {', '.join(run)}")
    if run.rows < 2:
        raise InputError(f"a run to replay needs at least two rows, got {run.rows}")
    t = run["t"]
    yaw = run["yaw"] if "yaw" in run else yaw_from_quat(run["q_world_base_xyzw"])
    pose = np.column_stack([run["p_world_base"][:, :2], yaw])
    for broken, what in (
        (~np.isfinite(t), "its time is not finite"),
        (np.diff(t, prepend=-np.inf) <= 0, "its time is not after that of the row before"),
        (~np.isfinite(pose).all(axis=1), "its pose is not finite"),
    ):
        rows = np.flatnonzero(broken)
        if len(rows):
            row = f"row {rows[0] + 1} of {run.rows} of the run to replay"
            raise InputError(f"{row}: {what} (t = {t[rows[0]]:g} s); leave such rows out")
    from_start = t[0] == 0
    t = t - t[0]
    pose[:, 2] = np.unwrap(pose[:, 2])
    if "v_base" in run and "w_base" in run:
        v, w = run["v_base"][:, 0], run["w_base"][:, 2]
    else:
        rate = np.gradient(pose, t, axis=0)
        v = rate[:, 0] * np.cos(pose[:, 2]) + rate[:, 1] * np.sin(pose[:, 2])
        w = rate[:, 2]
    if "wheel_angle" in run:
        wheels = run["wheel_angle"] - run["wheel_angle"][0]
    else:
        rates = wheel_rates(v, w, drive)
        turned = np.cumsum((rates[1:] + rates[:-1]) / 2 * np.diff(t)[:, None], axis=0)
        wheels = np.vstack([[0.0, 0.0], turned])
    unknown = np.full(len(t), np.nan)
    motion = SampledMotion(
        t=t,
        pose=pose,
        v=v,
        w=w,
        wheel_angle=wheels,
        v_cmd=run.get("v_cmd", unknown),
        w_cmd=run.get("w_cmd", unknown),
        bump=run["flag_bump"] if "flag_bump" in run else np.zeros(len(t), bool),
        duration_s=float(t[-1] * len(t) / (len(t) - 1)),
    )
    step_s = 1 / CONTROL_RATE_HZ
    return replace(motion, step_s=step_s) if from_start and motion.has_steps(step_s) else motion
