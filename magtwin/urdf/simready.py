"""SimReady: what an asset says of itself, as NVIDIA's SimReady Foundation wants it (SR.001, SR.004)."""

import os
import re
from collections.abc import Mapping
from datetime import UTC, datetime

from pxr import Gf, Usd, UsdPhysics

from magtwin.errors import InputError, hint
from magtwin.urdf.description.description import Description
from magtwin.urdf.report import ConversionReport
from magtwin.urdf.source.markup import read_markup
from magtwin.urdf.source.package import MANIFEST

KEY = "SimReady_Metadata"
"""Entry of the root layer's customLayerData."""

OUTSIDE = ("asset_name", "asset_type", "source_file", "usd_date_generated")
"""Entries that an older rule (SR.001) wants beside that one too."""

UNKNOWN = "not stated"
"""What stands where neither the user nor the description says anything."""

ROBOT_QCODE = "Q11012"
"""Wikidata's item for robots."""

GIVEN = ("author", "asset_license", "asset_name", "asset_type", "category", "qcode", "usd_date_generated")
"""Entries that a user may give."""


def check_metadata(given: Mapping[str, str]) -> None:
    """Refuse entries that are none.

    Raises:
        InputError: A name is unknown, a text is empty, or qcode is no item of Wikidata.
    """
    for name, text in given.items():
        if name not in GIVEN:
            raise InputError(f"metadata {name!r} is unknown; {hint(name, GIVEN)}")
        if not text.strip():
            raise InputError(f"metadata {name!r} is empty; leave it out or say something")
    code = given.get("qcode", ROBOT_QCODE)
    if not re.fullmatch("Q[0-9]+", code):
        raise InputError(f"metadata 'qcode' must be Wikidata's, such as {ROBOT_QCODE}, got {code!r}")


def metadata(
    stage: Usd.Stage, description: Description, report: ConversionReport, given: Mapping[str, str]
) -> dict[str, object]:
    """Entries of an asset's customLayerData: those given, then those of its package, then what is known.

    The day is that of SOURCE_DATE_EPOCH, as reproducible builds set it, and no other, so that one
    description makes the same bytes on every day.

    Args:
        stage: What was authored.
        description: Its folder's `package.xml` names author and licence.
        report: Size and mass.
        given: By name, see GIVEN.
    """
    author, licence = _package(description)
    low, high = report.box_out or ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    bodies = sum(prim.HasAPI(UsdPhysics.RigidBodyAPI) for prim in stage.Traverse())
    entries = {
        "asset_name": report.robot,
        "asset_type": "robot",
        "category": "robot",
        "qcode": ROBOT_QCODE,
        "author": author,
        "asset_license": licence,
        "usd_date_generated": _day(),
        **given,
        "source_file": report.source,
        "rigid_body_count": int(bodies),
        "asset_extents": Gf.Vec3d(*(round(b - a, 6) for a, b in zip(low, high, strict=True))),
        "mass": round(report.mass_out_kg, 6),
    }
    return {KEY: entries, **{name: entries[name] for name in OUTSIDE}}


def _package(description: Description) -> tuple[str, str]:
    """Author and licence in the manifest of the package that holds the description."""
    manifest = description.source.packages.home / MANIFEST
    if not manifest.is_file():
        return UNKNOWN, UNKNOWN
    try:
        root = read_markup(manifest, "package manifest").root
    except InputError:
        return UNKNOWN, UNKNOWN
    names = [" ".join((e.text or "").split()) for tag in ("author", "maintainer") for e in root.findall(tag)]
    licences = [" ".join((e.text or "").split()) for e in root.findall("license")]
    return next(filter(None, names), UNKNOWN), ", ".join(filter(None, licences)) or UNKNOWN


def _day() -> str:
    """The day that SOURCE_DATE_EPOCH gives, YYYY-MM-DD."""
    try:
        seconds = int(os.environ.get("SOURCE_DATE_EPOCH", ""))
        return datetime.fromtimestamp(seconds, UTC).date().isoformat()
    except (ValueError, OverflowError, OSError):
        return UNKNOWN
