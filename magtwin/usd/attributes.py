"""Specs as attributes of a prim, and poses as transforms.

Values are read back exactly as they were written. A value is authored even if it equals the schema's
fallback, since a reader may not have the schema; it is not authored again over a layer that has it.
"""

from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

from pxr import Gf, Sdf, Usd, UsdGeom, Vt

from magtwin.errors import InputError, about
from magtwin.frames import wxyz_from_xyzw, xyzw_from_wxyz
from magtwin.spec.base import Quat, Vec3
from magtwin.usd.layers import relative_asset
from magtwin.usd.schema import attribute_name, author, place, require_api, type_of, value_of
from magtwin.usd.trial import check_named

S = TypeVar("S")


def write_spec(prim: Usd.Prim, noun: str, spec: Any, *, skip: Any = ()) -> Usd.Prim:
    """Write each field of a spec, except those in `skip`, to its attribute.

    None, "" and () are not authored, unless a weaker layer has another value.
    """
    for field in fields(spec):
        if field.name in skip:
            continue
        attribute = prim.GetAttribute(attribute_name(noun, field.name))
        value = getattr(spec, field.name)
        missing = value not in (None, "", ()) and not attribute.HasAuthoredValue()
        if missing or _value(attribute) != (value.resolve() if isinstance(value, Path) else value):
            author(attribute, _usd_value(attribute, value))
    return prim


def read_spec(cls: type[S], prim: Usd.Prim, noun: str, **known: Any) -> S:
    """A spec from the attributes of `prim`; `known` gives the other fields.

    Raises:
        InputError: The prim lacks the schema, or a value is missing, of another type or out of range.
    """
    require_api(prim, noun)
    values = dict(known)
    for field in fields(cls):  # type: ignore[arg-type]
        if field.name not in known:
            values[field.name] = plain_value(prim.GetAttribute(attribute_name(noun, field.name)))
    with about(f"{place(prim)}:"):
        return cls(**values)


def read_axis(prim: Usd.Prim, name: str = "axis") -> str:
    """The axis X, Y or Z of a solid, or of a joint as `physics:axis`.

    Raises:
        InputError: It is something else.
    """
    axis = str(prim.GetAttribute(name).Get())
    if axis not in ("X", "Y", "Z"):
        raise InputError(f"{place(prim)}: {name} must be X, Y or Z, got {axis!r}")
    return axis


def read_number(prim: Usd.Prim, name: str) -> float:
    """A number, such as the radius of a solid.

    Raises:
        InputError: It is something else.
    """
    value = prim.GetAttribute(name).Get()
    if not isinstance(value, int | float):
        raise InputError(f"{place(prim)}: {name} must be a number; correct it")
    return value


def write_pose(prim: Usd.Prim, p: Vec3, q_xyzw: Quat | None = None) -> None:
    """Set the pose of an Xform in its parent: position [m] and optional orientation, in double precision.

    Other transform ops are removed from the order.
    """
    want = [("xformOp:translate", Sdf.ValueTypeNames.Double3, Gf.Vec3d(p))]
    if q_xyzw is not None:
        want.append(
            ("xformOp:orient", Sdf.ValueTypeNames.Quatd, Gf.Quatd(*map(float, wxyz_from_xyzw(q_xyzw))))
        )
    for name, kind, value in want:
        attribute = prim.GetAttribute(name) or prim.CreateAttribute(name, kind, custom=False)
        if attribute.GetTypeName() != kind:
            raise InputError(f"{place(prim)}: {name} is a {attribute.GetTypeName()}, magtwin writes {kind}")
        if attribute.Get() != value:
            attribute.Set(value)
    order = Vt.TokenArray([name for name, _, _ in want])
    if UsdGeom.Xformable(prim).GetXformOpOrderAttr().Get() != order:
        UsdGeom.Xformable(prim).GetXformOpOrderAttr().Set(order)


def read_pose(prim: Usd.Prim) -> tuple[Vec3, Quat]:
    """Position [m] and orientation (xyzw) of an Xform in its parent.

    A pose of `write_pose` is read back exactly. Another rigid transform is composed, and its quaternion is
    normalised if it is not in double precision.
    """
    xformable = UsdGeom.Xformable(prim)
    ops = {op.GetOpName(): op.Get() for op in xformable.GetOrderedXformOps()}
    if list(ops) in (["xformOp:translate"], ["xformOp:translate", "xformOp:orient"]):
        translate, orient = ops["xformOp:translate"], ops.get("xformOp:orient", Gf.Quatd(1))
        if not isinstance(orient, Gf.Quatd):
            orient = Gf.Quatd(orient).GetNormalized()
    else:
        local = xformable.GetLocalTransformation()
        translate, orient = local.ExtractTranslation(), local.RemoveScaleShear().ExtractRotationQuat()
    q = xyzw_from_wxyz((orient.GetReal(), *orient.GetImaginary()))
    return tuple(map(float, translate)), tuple(map(float, q))  # type: ignore[return-value]


def target(prim: Usd.Prim, relationship: str) -> Usd.Prim:
    """The one prim that a relationship of `prim` points to.

    Raises:
        InputError: It points to no prim of the stage, or to several.
    """
    found = prim.GetRelationship(relationship)
    paths = found.GetForwardedTargets() if found else []
    there = prim.GetStage().GetPrimAtPath(paths[0]) if len(paths) == 1 else None
    if not there or not there.IsDefined() or not there.IsActive():
        seen = ", ".join(map(str, paths)) or "none"
        raise InputError(f"{place(prim)}: {relationship} must point to one prim of the stage, found {seen}")
    return there


def targets(prim: Usd.Prim, relationship: str) -> list[Usd.Prim]:
    """The prims that a relationship of `prim` points to.

    Raises:
        InputError: One of them is not on the stage.
    """
    found = prim.GetRelationship(relationship)
    there = [prim.GetStage().GetPrimAtPath(path) for path in (found.GetForwardedTargets() if found else [])]
    if not all(there):
        raise InputError(f"{place(prim)}: {relationship} points to a prim that is not on the stage")
    return there


def check_prim_name(name: str, what: str) -> str:
    """`name` if a prim can have it.

    Raises:
        InputError: It has characters other than letters, digits and _, or starts with a digit.
    """
    if not Sdf.Path.IsValidIdentifier(name):
        way = "use letters, digits and _, not starting with a digit"
        raise InputError(f"{what} {name!r} cannot name a prim; {way}")
    return name


def _usd_value(attribute: Usd.Attribute, value: Any) -> Any:
    """A field's value as the attribute's type."""
    kind = type_of(attribute)
    if kind == Sdf.ValueTypeNames.Asset:
        layer = attribute.GetStage().GetEditTarget().GetLayer()
        return Sdf.AssetPath(relative_asset(layer, value) if value is not None else "")
    if kind == Sdf.ValueTypeNames.Matrix3d:
        return Gf.Matrix3d(*value)
    if kind.isArray:
        points = isinstance(kind.defaultValue, Vt.Vec2dArray)
        return kind.type.pythonClass([Gf.Vec2d(*each) for each in value] if points else value)
    return tuple(value) if isinstance(value, tuple) else value


def plain_value(attribute: Usd.Attribute) -> Any:
    """An attribute's value as plain Python: numbers, text, tuples, a Path (which need not exist) or None.

    Raises:
        InputError: The value is not of the type in the schema, or a file that the stage may not name.
    """
    value, root = _value(attribute), attribute.GetStage().GetRootLayer().realPath
    if isinstance(value, Path) and root and value.exists():
        check_named(Path(root), value, f"<{attribute.GetPath()}>")
    return value


def _value(attribute: Usd.Attribute) -> Any:
    """As `plain_value`, of a stage that is being written."""
    value, kind = value_of(attribute), type_of(attribute)
    if not isinstance(value, kind.type.pythonClass or type(kind.defaultValue)):
        text = f"{attribute.GetName()} must be a {kind}, got a {type(value).__name__}"
        raise InputError(f"{place(attribute.GetPrim())}: {text}")
    if isinstance(value, Sdf.AssetPath):  # the file need not exist
        if not value.path:
            return None
        layer = attribute.GetPropertyStack()[0].layer
        return Path(value.resolvedPath or Sdf.ComputeAssetPathRelativeToLayer(layer, value.path)).resolve()
    if isinstance(value, Gf.Matrix3d):
        return tuple(float(x) for row in value for x in row)
    if isinstance(value, Gf.Vec3d | Gf.Vec2d):
        return tuple(map(float, value))
    if isinstance(value, Vt.Vec2dArray):
        return tuple((float(x), float(y)) for x, y in value)
    return tuple(value) if isinstance(value, Vt.StringArray | Vt.DoubleArray) else value
