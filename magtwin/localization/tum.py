"""TUM files: poses as lines `t x y z qx qy qz qw`, which evo and other programs read.

The format is that of the TUM RGB-D benchmark (Sturm et al. 2012, IROS): seconds, metres, quaternion of the
body in world, single spaces.
"""

import os
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from magtwin.errors import InputError
from magtwin.files.outputs import output
from magtwin.frames import quat_from_yaw
from magtwin.localization.problem import Array
from magtwin.run.run import Run

HEADER = "# t [s] x y z [m] qx qy qz qw, base_link in {frame}"


def save_tum(path: str | os.PathLike[str], t: ArrayLike, pose: ArrayLike, *, force: bool = False) -> Path:
    """Write planar poses as a TUM file; z is 0.

    Args:
        path: File to write.
        t: Times [s], shape (N,).
        pose: x, y [m] and yaw [rad] of base_link in world, shape (N, 3).
        force: Replace an existing file.

    Raises:
        InputError: The shapes differ, a value is not finite, or the file cannot be written.
    """
    planar = np.asarray(pose, float)
    if planar.ndim != 2 or planar.shape[1] != 3:
        raise InputError(f"pose of a TUM file must have shape (N, 3), got {planar.shape}")
    p = np.column_stack([planar[:, :2], np.zeros(len(planar))])
    path = Path(path)
    with output(path, force=force) as aside:
        aside.write_text(_text(t, p, quat_from_yaw(planar[:, 2]), "world"), encoding="utf-8")
    return path


def save_tum_folder(run: Run, folder: str | os.PathLike[str], *, force: bool = False) -> list[Path]:
    """Write the trajectories of a localized run as TUM files.

    Args:
        run: A run with the columns of `magtwin.localization.track.EST_COLUMNS`.
        folder: Folder to make: `estimate.tum`; `truth.tum` if the run has the true pose; `odometry.tum`,
            which is in the frame `odom`, if it has odometry.
        force: Replace an existing folder.

    Returns:
        The files.

    Raises:
        InputError: The run has no estimates, or the folder cannot be written.
    """
    if "est_p_world_base" not in run:
        raise InputError("the run has no column 'est_p_world_base'; run `magtwin localize` on it first")
    texts = {"estimate.tum": _text(run["t"], run["est_p_world_base"], quat_from_yaw(run["est_yaw"]), "world")}
    for name, p, q, frame in (
        ("truth.tum", "p_world_base", "q_world_base_xyzw", "world"),
        ("odometry.tum", "odom_p", "odom_q_xyzw", "odom"),
    ):
        if p in run and q in run:
            texts[name] = _text(run["t"], run[p], run[q], frame)
    folder = Path(folder)
    with output(folder, force=force) as aside:
        aside.mkdir()
        for name, text in texts.items():
            (aside / name).write_text(text, encoding="utf-8")
    return [folder / name for name in texts]


def _text(t: ArrayLike, p: Array, q_xyzw: Array, frame: str) -> str:
    t = np.asarray(t, float)
    if t.shape != (len(p),):
        raise InputError(f"t of a TUM file must have shape ({len(p)},), got {t.shape}")
    table = np.column_stack([t, p, q_xyzw])
    if not np.isfinite(table).all():
        row = int(np.argmin(np.isfinite(table).all(axis=1)))
        raise InputError(f"a TUM file holds finite poses only, got {table[row].tolist()} in row {row}")
    lines = [" ".join(f"{value:.9f}" for value in row) for row in table.tolist()]
    return "\n".join([HEADER.format(frame=frame), *lines]) + "\n"
