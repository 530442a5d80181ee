"""Conversion of runs between formats, and the scene that a run is shown in."""

import os
import warnings
from pathlib import Path
from typing import Any, Literal

from magtwin.errors import InputError, MismatchWarning
from magtwin.files.file import existing
from magtwin.files.outputs import check_free
from magtwin.io.formats import format_to_write, read_run, write_run
from magtwin.run.run import Run
from magtwin.twin import Twin, lab_and_map, led_by, open_twin, scene_of


def convert_run(
    source: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    scene: str | Path | None = None,
    out_unit: Literal["T", "nT"] | None = None,
    usd_fps: float | None = None,
    force: bool = False,
    **reading: Any,
) -> Run:
    """Convert a run, or the parts of one that did not end, to the format of the output's name.

    A name without a suffix is the folder of a rosbag2. The `scene` is the stage for formats that show it, by
    default that of the metadata; `out_unit` the unit of the field in a bag, by default T; `usd_fps` frames
    per second in USD, by default 30, and 0 for one per reading; `reading` options of
    `magtwin.io.formats.read_run`. An option that does not fit the formats is refused.
    """
    source, out = existing(source, "run"), Path(out)
    if out.resolve() == source.resolve():
        raise InputError(f"{out}: is the run itself; name another file")
    if out.resolve() in source.resolve().parents:
        raise InputError(f"{out}: holds the run, which would be removed with it; give another name")
    check_free(out, force=force)
    given = {"units": out_unit, "fps": usd_fps}
    options: dict[str, Any] = {name: value or None for name, value in given.items() if value is not None}
    takes = format_to_write(out).takes
    if scene is not None and not takes & {"twin", "scene_file"}:
        raise InputError(f"{out}: a table shows no scene; drop `scene`", parameter="scene")
    run = read_run(source, **reading)
    shown = "planned" in takes or "scene_file" in takes
    lacks = "shown without a scene" if shown else "written without /tf_static and the robot's description"
    twin = twin_to_show(run, source, scene, lacks=lacks) if takes & {"twin", "scene_file"} else None
    write_run(run, out, twin, force=force, **options)
    return run


def twin_to_show(
    run: Run, file: Path, scene: str | Path | None = None, *, lacks: str = "shown without a scene"
) -> Twin | None:
    """The scene to show a run in. Warns, and returns None, if the run's own scene cannot be opened.

    The folder of its `file` is searched for the scene. `scene` is used in place of that of the metadata, and
    must open unless it is `file`, as for a run that plays over a scene. The warning says what is lacking in
    `lacks`.
    """
    try:
        stage = scene_of(run, scene, near=file)
        twin = open_twin(stage, magnetometer="map-only", **lab_and_map(run.metadata, file))  # no network
        if "robot" in run.metadata:
            twin = led_by(twin, str(run.metadata["robot"]))
    except InputError as error:
        if scene not in (None, file):
            raise
        warnings.warn(f"{lacks}: {error}", MismatchWarning, stacklevel=2)
        return None
    then = run.metadata.get("scene_sha256")
    if then is not None and then != twin.metadata.get("scene_sha256") and scene != file:
        text = f"{twin.scene_file} has changed since the run; it is shown as it is now"
        warnings.warn(text, MismatchWarning, stacklevel=2)
    return twin
