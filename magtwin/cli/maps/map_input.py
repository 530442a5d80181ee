"""What `magtwin map` commands take: sources of readings, options of methods, headings, the Earth's field."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from magtwin.cli.terminal import step
from magtwin.errors import InputError
from magtwin.io.surveys.columns import Columns


def is_survey_folder(source: Path, columns: Columns) -> bool:
    """Whether a source is a folder of one CSV a heading, whose columns need no names."""
    from magtwin.io.surveys.readings import is_pattern

    if (source / "metadata.yaml").is_file() or is_pattern(source) or any(source.glob("*.parquet")):
        return False
    named = replace(columns, unit=None, scale=None) != Columns()
    return (source.is_dir() or not source.exists()) and not named


def read_sources(
    sources: tuple[Path, ...],
    columns: Columns,
    about: dict[str, Any],
    keep_latched: bool,
    pose_topic: str | None,
    field_topic: str | None,
) -> Any:
    """The readings of the sources, and the report of what was found latched, stuck or outlying in them."""
    from magtwin.field.survey.readings import TAKEN
    from magtwin.field.survey.stuck import mask_latched
    from magtwin.io.surveys.readings import read_readings

    step("Reading the survey")
    readings = read_readings(
        *sources, columns=columns, pose_topic=pose_topic, field_topic=field_topic, **{**about, "name": None}
    )  # refusals name the survey, not the file to be written
    masked, found = mask_latched(readings)
    taken = [part for part in readings.source.split("; ") if part.startswith(TAKEN)]
    if taken:
        found = replace(
            found, metadata={**found.metadata, "taken": [part.removeprefix(TAKEN) for part in taken]}
        )
    if not (keep_latched or masked.good.any()):
        raise InputError(
            f"{sources[0]}: all {len(readings)} readings are those of a sensor that was stuck; "
            "survey again, or give --keep-latched to take them as they are"
        )
    return (readings if keep_latched else masked), found


LEAST_READINGS = 8
"""Good readings of a drive that a map needs at least."""

USUAL_SPAN_M = 300.0
"""Extent of a survey above which the summary asks for the unit of its positions [m]."""

USUAL_READINGS = 100
"""Good readings of a drive below which the summary says that a map of them tells little."""


def worth_a_map(readings: Any, found: Any, source: Path) -> Any:
    """The report with what makes a map of these readings doubtful; refused where they are too few."""
    import numpy as np

    from magtwin.field.fit.harmonic.problem import ONE_HEADING

    count, yaw, notes = int(readings.good.sum()), readings.yaw[readings.good], list[str]()
    if readings.grid is None and count < LEAST_READINGS:
        raise InputError(
            f"{source}: {count} of {len(readings)} readings are good; a map needs {LEAST_READINGS} at least, "
            "and some hundred to be of use"
        )
    if readings.grid is None and count < USUAL_READINGS:
        notes.append(f"only {count} good readings: the map holds next to them alone")
    if (span := float(np.ptp(readings.p_xy, axis=0).max())) > USUAL_SPAN_M:
        notes.append(f"the readings span {span:,.0f} m: are their positions in metres?")
    way = np.exp(1j * yaw).mean()
    if np.abs(way) >= ONE_HEADING:
        notes.append(
            f"one heading only, {np.degrees(np.angle(way)):.0f} deg: nothing tells the robot's own field "
            "from the room's, and a simulated robot adds its whole platform field; survey in all headings"
        )
    return replace(found, metadata={**found.metadata, "doubts": notes}) if notes else found


def method_options(methods: list[str], kernel: str | None, earth: str | None) -> dict[str, dict[str, Any]]:
    """Options of methods, by name; refused where none of them takes what was given."""
    options: dict[str, dict[str, Any]] = {}
    for flag, value, method in (("--kernel", kernel, "gp"), ("--earth", earth, "harmonic")):
        if value is not None and method not in methods:
            raise InputError(f"{flag} is for --method {method} alone; leave it out of a {methods[0]} fit")
    if kernel is not None:
        options["gp"] = {"kernel": kernel}
    if earth is not None:
        options["harmonic"] = {"earth_nt": earth_nt(earth)}
    return options


def earth_nt(text: str) -> tuple[float, float, float]:
    """The Earth's field in world axes [nT], of a scene, of a place and a day, or as it stands."""
    words = [word.strip() for word in text.split(",")]
    forms = "a scene; latitude,longitude,height,date; or x,y,z in nT"
    if len(words) in (3, 4) and not Path(text).exists():
        from magtwin.field.sources.earth import earth_field_nt
        from magtwin.field.survey.readings import checked_earth_nt
        from magtwin.field.units import GREATEST_MEAN_NT, LEAST_MEAN_NT

        try:
            x, y, z = (float(word) for word in words[:3])
        except ValueError as error:
            raise InputError(f"--earth is {forms}; got {text!r}") from error
        if len(words) == 4:
            return earth_field_nt(x, y, z, words[3])
        size = sum(c * c for c in checked_earth_nt((x, y, z))) ** 0.5
        if not LEAST_MEAN_NT <= size <= GREATEST_MEAN_NT:
            raise InputError(
                f"--earth {text} is a field of {size:.6g} nT, and the Earth's is some 22,000 to 67,000; give "
                "it in nT, or its place with the day, latitude,longitude,height,date"
            )
        return x, y, z
    from magtwin.author.scene import read_scene

    if not Path(text).is_file():
        raise InputError(f"--earth is {forms}; there is no file {text!r}")
    known = read_scene(text, check_network=False).earth
    if known is None:
        raise InputError(f"--earth {text}: this scene does not know the Earth's field; give it as {forms}")
    return known.b_world_nt


def headings_rad(text: str) -> list[float]:
    """Headings as 0,90,180,270 [deg] in radians, each once, ascending."""
    from math import radians

    try:
        degrees = sorted({float(word) % 360 for word in text.split(",")})
    except ValueError:
        degrees = []
    if not degrees or any(h != h for h in degrees):
        raise InputError(f"headings are degrees with commas between, such as 0,90,180,270; got {text!r}")
    return [radians(h) for h in degrees]
