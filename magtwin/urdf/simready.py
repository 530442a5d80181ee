"""SimReady: metadata of an asset for NVIDIA's SimReady Foundation (SR.001, SR.004)."""

import re
from collections.abc import Mapping
from contextlib import suppress

from pxr import Gf, Usd, UsdPhysics

from magtwin.errors import InputError, hint
from magtwin.urdf.description.description import Description
from magtwin.urdf.report import ConversionReport
from magtwin.urdf.source.markup import read_markup
from magtwin.urdf.source.package import MANIFEST

KEY = "SimReady_Metadata"
"""Entry of the root layer's customLayerData."""

OUTSIDE = ("asset_name", "asset_type", "source_file", "usd_date_generated")
"""Entries that an older rule (SR.001) also requires at the top level."""

UNKNOWN = "not stated"
"""Default of entries that neither the user nor the package gives."""

ROBOT_QCODE = "Q11012"
"""Wikidata's item for robots."""

GIVEN = ("author", "asset_license", "asset_name", "asset_type", "category", "qcode", "usd_date_generated")
"""Entries that a user may give."""


def check_metadata(given: Mapping[str, str]) -> None:
    """Refuse invalid entries.

    Raises:
        InputError: A name is unknown, a text is empty, or qcode is not an item of Wikidata.
    """
    for name, text in given.items():
        if name not in GIVEN:
            raise InputError(f"metadata {name!r} is unknown; {hint(name, GIVEN)}")
        if not text.strip():
            raise InputError(f"metadata {name!r} is empty; leave it out or give a text")
    code = given.get("qcode", ROBOT_QCODE)
    if not re.fullmatch("Q[0-9]+", code):
        raise InputError(f"metadata 'qcode' must be an item of Wikidata, such as {ROBOT_QCODE}, got {code!r}")


def metadata(
    stage: Usd.Stage, description: Description, report: ConversionReport, given: Mapping[str, str]
) -> dict[str, object]:
    """Entries of an asset's customLayerData: those given, then those of its package, then defaults.

    Args:
        stage: The authored stage.
        description: The description; the `package.xml` of its package names author and licence.
        report: Size and mass.
        given: The user's entries by name, see GIVEN.
    """
    low, high = report.box_out or ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    bodies = sum(prim.HasAPI(UsdPhysics.RigidBodyAPI) for prim in stage.Traverse())
    entries = {
        "asset_name": report.robot,
        "asset_type": "robot",
        "category": "robot",
        "qcode": ROBOT_QCODE,
        **_package(description),
        "usd_date_generated": UNKNOWN,
        **given,
        "source_file": report.source,
        "rigid_body_count": int(bodies),
        "asset_extents": Gf.Vec3d(*(round(b - a, 6) for a, b in zip(low, high, strict=True))),
        "mass": round(report.mass_out_kg, 6),
    }
    return {KEY: entries, **{name: entries[name] for name in OUTSIDE}}


def _package(description: Description) -> dict[str, str]:
    """Author and licence in the manifest of the description's package."""
    texts: dict[str, list[str]] = {"author": [], "maintainer": [], "license": []}
    with suppress(InputError):
        root = read_markup(description.source.packages.home / MANIFEST, "package manifest").root
        texts = {tag: [" ".join((e.text or "").split()) for e in root.findall(tag)] for tag in texts}
    author = next(filter(None, (*texts["author"], *texts["maintainer"])), UNKNOWN)
    return {"author": author, "asset_license": ", ".join(filter(None, texts["license"])) or UNKNOWN}
