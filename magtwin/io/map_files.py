"""Files of maps: a layer, a stage, a folder of survey CSVs, or the name of a shipped scene."""

import os
from pathlib import Path

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.files.file import existing
from magtwin.files.kinds import expected, scene_file, shipped_or

Source = str | os.PathLike[str]


def open_map(file: Source) -> AnomalyMap:
    """The map of a layer or stage, or of a folder of survey CSVs, as from `map_file`."""
    from magtwin.field.survey.nodes import read_survey
    from magtwin.usd.maps.layer import load_map

    file = map_file(file)
    if not file.is_dir():
        return load_map(file)
    return read_survey(expected(file, "map"))[0]


def map_file(source: Source) -> Path:
    """The file of a map: a layer or stage, a folder of CSVs or of a scene, or that of a shipped scene."""
    path = Path(source)
    if os.path.exists(path):  # noqa: PTH110 - False of a name that is too long, which is refused below
        return shipped_or(path)
    if path.suffix or (len(path.parts) > 1 and not path.exists()):
        return existing(path, "map")
    try:
        return scene_file(path)
    except InputError as error:
        text = f"{source}: no map layer, stage, folder of CSVs or shipped scene: {error}"
        raise InputError(text) from error
