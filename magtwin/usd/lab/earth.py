"""The Earth's field as a prim: place and date of the lab, and the field computed from them."""

import dataclasses

from pxr import Sdf, Usd, UsdGeom

from magtwin.errors import InputError, about
from magtwin.field.sources.earth import earth_field_nt
from magtwin.spec.base import ZERO3
from magtwin.spec.magnetics import EarthFieldSpec
from magtwin.usd.attributes import read_spec, write_spec
from magtwin.usd.schema import apply_api, attribute_name, author, place, value_of

DERIVED_FROM = attribute_name("earth", "derived_from")
DIGITS = 1
"""Decimal places of a computed field [nT], as those of the model's coefficients."""

AGREES_NT = 1.0
"""Largest difference from the model of a field that is not marked as measured [nT]."""


def define_earth(stage: Usd.Stage, path: str | Sdf.Path, spec: EarthFieldSpec) -> Usd.Prim:
    """Author the Earth's field as an Xform; returns its prim."""
    prim = write_spec(apply_api(UsdGeom.Xform.Define(stage, path).GetPrim(), "earth"), "earth", spec)
    author(prim.GetAttribute(DERIVED_FROM), "" if spec.measured else _inputs(spec))
    return prim


def read_earth(prim: Usd.Prim) -> EarthFieldSpec:
    """The spec of an authored Earth's field, computed again if its place, date or north was changed.

    Raises:
        InputError: The prim is no Earth's field, or a value is out of range.
    """
    spec = read_spec(EarthFieldSpec, prim, "earth")
    if spec.measured or value_of(prim.GetAttribute(DERIVED_FROM)) == _inputs(spec):
        return spec
    with about(f"{place(prim)}:"):
        return derived(spec)


def derived(spec: EarthFieldSpec) -> EarthFieldSpec:
    """The spec with the field of the IGRF at its place, date and north, rounded to 0.1 nT.

    Raises:
        InputError: Place or date is outside the model.
    """
    x, y, z = earth_field_nt(
        spec.latitude_deg, spec.longitude_deg, spec.height_m, spec.date, north_deg=spec.north_deg
    )
    b = (round(x, DIGITS) + 0.0, round(y, DIGITS) + 0.0, round(z, DIGITS) + 0.0)
    return dataclasses.replace(spec, b_world_nt=b, measured=False)


def checked(spec: EarthFieldSpec) -> EarthFieldSpec:
    """The spec with a field: computed if it has none, otherwise compared with the model.

    Raises:
        InputError: The field differs from the model and is not marked as measured.
    """
    if spec.measured:
        return spec
    model = derived(spec)
    if spec.b_world_nt == ZERO3:
        return model
    if max(abs(a - b) for a, b in zip(spec.b_world_nt, model.b_world_nt, strict=True)) > AGREES_NT:
        raise InputError(
            f"b_world_nt {list(spec.b_world_nt)} is not the IGRF-14's field of that place, date and north, "
            f"{list(model.b_world_nt)}; leave it out, or set measured = true"
        )
    return spec


def _inputs(spec: EarthFieldSpec) -> str:
    """The inputs of the computed field, as the attribute `derivedFrom` has them."""
    numbers = (spec.latitude_deg, spec.longitude_deg, spec.height_m, spec.date, spec.north_deg)
    return " ".join(str(number) for number in numbers)
