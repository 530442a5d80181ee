"""The Earth's field as a prim: where the lab stands and when, and the field that follows from it."""

import dataclasses

from pxr import Sdf, Usd, UsdGeom

from magtwin.errors import InputError
from magtwin.field.sources.earth import earth_field_nt
from magtwin.spec.base import ZERO3
from magtwin.spec.magnetics import EarthFieldSpec
from magtwin.usd.attributes import read_figures, write_figures
from magtwin.usd.schema import apply_api, attribute_name, place

DERIVED_FROM = attribute_name("earth", "derived_from")
DIGITS = 1
"""Digits after the point to which a derived field is kept [nT], as those of the coefficients."""

AGREES_NT = 1.0
"""Difference that a field which is given may have from the model's and not be called measured [nT]."""


def define_earth(stage: Usd.Stage, path: str | Sdf.Path, spec: EarthFieldSpec) -> Usd.Prim:
    """Author the Earth's field as an Xform of its own; returns its prim."""
    prim = write_figures(apply_api(UsdGeom.Xform.Define(stage, path).GetPrim(), "earth"), "earth", spec)
    prim.GetAttribute(DERIVED_FROM).Set("" if spec.measured else _inputs(spec))
    return prim


def read_earth(prim: Usd.Prim) -> EarthFieldSpec:
    """The spec of an authored Earth's field, computed anew where the prim's place, day or north were changed.

    Raises:
        InputError: It is none, or a figure is out of range.
    """
    spec = read_figures(EarthFieldSpec, prim, "earth")
    if spec.measured or prim.GetAttribute(DERIVED_FROM).Get() == _inputs(spec):
        return spec
    try:
        return derived(spec)
    except InputError as error:
        raise InputError(f"{place(prim)}: {error}") from error


def derived(spec: EarthFieldSpec) -> EarthFieldSpec:
    """The spec with the IGRF's field of its place, day and north, to 0.1 nT.

    Raises:
        InputError: The model does not reach there.
    """
    x, y, z = earth_field_nt(
        spec.latitude_deg, spec.longitude_deg, spec.height_m, spec.date, north_deg=spec.north_deg
    )
    b = (round(x, DIGITS) + 0.0, round(y, DIGITS) + 0.0, round(z, DIGITS) + 0.0)
    return dataclasses.replace(spec, b_world_nt=b, measured=False)


def checked(spec: EarthFieldSpec) -> EarthFieldSpec:
    """The spec with its field derived where it gives none, and held against the model's where it does.

    Raises:
        InputError: The field that it gives is not the model's, and is not said to be measured.
    """
    if spec.measured:
        return spec
    model = derived(spec)
    if spec.b_world_nt == ZERO3:
        return model
    if max(abs(a - b) for a, b in zip(spec.b_world_nt, model.b_world_nt, strict=True)) > AGREES_NT:
        raise InputError(
            f"b_world_nt {list(spec.b_world_nt)} is not the IGRF-14's field of that place, day and north, "
            f"{list(model.b_world_nt)}; leave it out, or say measured = true"
        )
    return spec


def _inputs(spec: EarthFieldSpec) -> str:
    """What the field follows from, as `derivedFrom` says it."""
    numbers = (spec.latitude_deg, spec.longitude_deg, spec.height_m, spec.date, spec.north_deg)
    return " ".join(str(number) for number in numbers)
