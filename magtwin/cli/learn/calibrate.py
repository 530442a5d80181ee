"""`magtwin calibrate`: a mixed model for one session, from a short labelled drive."""

from pathlib import Path

from magtwin.cli.app import app
from magtwin.cli.options import Flag, Force
from magtwin.cli.terminal import Done, check_output, step


@app.command
def calibrate(
    weights: Path,
    run: Path,
    *,
    map: Path,  # noqa: A002
    out: Path,
    duration_s: float | None = None,
    pose_sd_m: float = 0.0,
    pose_from_map: Flag = False,
    force: Force = False,
) -> Done:
    """Calibrate a mixed model by a labelled drive at the start of a session.

    Drive for a minute in curves to all sides, with poses of another source than the map. The new weights
    predict in that session, until the robot is switched off; their metadata name the drive and the model.

    Parameters
    ----------
    weights
        Weights of a mixed model, .safetensors (`magtwin train --model mixed`).
    run
        The drive, of any kind that `magtwin dataset build` reads.
    map
        Map that the weights were trained on: a layer or stage, or a folder of survey CSVs.
    out
        Weights to write, .safetensors.
    duration_s
        Length of the part to use, from the start [s]. Default: all.
    pose_sd_m
        Standard deviation of the drive's positions, each axis [m].
    pose_from_map
        The poses were estimated on the map: warn.
    """
    from magtwin.tasks.learning import calibrate as calibrate_files

    check_output(out, (".safetensors",), "a network", force=force)
    step("Calibrating")
    calibrated = calibrate_files(
        weights,
        run,
        anomaly_map=map,
        duration_s=duration_s,
        pose_sd_m=pose_sd_m,
        pose_from_map=pose_from_map,
        out=out,
        force=force,
    )
    return Done(calibrated.report(str(out)), out)
