"""A Run as a USD layer of time samples over its scene, which any USD viewer plays.

Time code 0 is the run's first row. The prim `Run` also holds every column as one exact array at full rate.
Samples are authored on the layer itself, since a stage would recompose for each.
"""

import json
import os
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import repeat
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, Vt

from magtwin.errors import InputError, about, find
from magtwin.files.outputs import output
from magtwin.frames import quat_conjugate, quat_multiply, rotate
from magtwin.run import mapped
from magtwin.run.resample import grid
from magtwin.run.run import COLUMNS, Column, Run, check_clock
from magtwin.spec.base import Quat, Vec3
from magtwin.usd.attributes import read_pose, target, targets
from magtwin.usd.geometry import BASE_LINK, read_links
from magtwin.usd.layers import (
    SUFFIXES,
    WORLD,
    check_not_part,
    describe_stage,
    open_layer,
    open_stage,
    translates,
)
from magtwin.usd.placement import lab_on, labs_on, take_to_origin
from magtwin.usd.schema import attribute_name, only_prim_with, place, prims_with
from magtwin.usd.schema.versions import creator
from magtwin.usd.sensors import JOINT_FIELDS, WHEELS_FIELDS

FPS = 30.0
"""Default frame rate [Hz]."""

MOST_FPS = 10_000.0

RUN = "Run"
"""Name of the prim that holds the columns."""

POSES = (("p_world_base", "q_world_base_xyzw"), ("mocap_p", "mocap_q_xyzw"), ("odom_p", "odom_q_xyzw"))
"""Columns of the robot's pose, best first."""

READINGS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "magnetometer": (
            "b_map_nt",
            "b_disturbance_nt",
            "b_total_nt",
            "b_measured_nt",
            "b_vector_nt",
            "flag_outside_map",
            "flag_out_of_distribution",
            "flag_lost_lock",
        ),
        "battery": ("battery_v", "battery_fraction"),
        "lidar": ("lidar_on",),
        "robot": ("flag_bump", "flag_pose_lost"),
    }
)
"""Columns sampled on the prim of each sensor: `b_total_nt` as `magtwin:magnetometer:bTotalNt`."""

_BARE = WORLD.AppendChild("robot")
"""Robot of a run without a scene."""

_FACTS = "magtwinFacts"
_COLUMN = "magtwin:run:"
_TRANSLATE, _ORIENT = "xformOp:translate", "xformOp:orient"
_DTYPES = ("f8", "f4", "f2", "i4", "i8", "u1", "u4", "u8", "b1")
_NAMES = ("double", "float", "half", "int", "int64", "uchar", "uint", "uint64", "bool")
_KINDS = {d: Sdf.ValueTypeNames.Find(f"{name}[]") for d, name in zip(_DTYPES, _NAMES, strict=True)}
"""USD's arrays by numpy's dtypes."""


@dataclass(frozen=True)
class _Stand:
    """Prims of a robot in a scene."""

    world: Sdf.Path = WORLD
    robot: Sdf.Path = _BARE
    p_root_base: Vec3 = (0.0, 0.0, 0.0)
    """Origin of the base link in the robot's root [m]."""
    q_root_base_xyzw: Quat = (0.0, 0.0, 0.0, 1.0)
    wheels: tuple[tuple[int, Sdf.Path, Vec3, Quat, Vec3], ...] = ()
    """Driven wheels: side (0 for left, 1 for right), prim, position [m] and orientation in its parent, and
    axis in its own frame, about which it turns by a positive angle as it rolls forward."""
    sensors: Mapping[str, Sdf.Path] = field(
        default_factory=lambda: {"magnetometer": _BARE.AppendChild("magnetometer"), "robot": _BARE}
    )


@translates
def write_animation(
    run: Run,
    path: str | os.PathLike[str],
    scene_file: str | os.PathLike[str] | None = None,
    *,
    fps: float | None = FPS,
    force: bool = False,
) -> None:
    """Write a run as a layer of time samples over its scene.

    Poses and readings are resampled at `fps` with `Run.resample`; flags and the battery are sampled when they
    change. Bodies are moved by their transforms: for viewing, not for a physics engine. USD keeps the layer
    in memory until it is written: 0.4 GB for an hour at 135 Hz.

    Args:
        run: The run. The pose is `p_world_base`, or else motion capture or odometry. Among several robots of
            a scene, the metadata `robot` selects one; default: the first.
        path: The .usd, .usda or .usdc file to make; text is large.
        scene_file: The stage of the run, which becomes a sublayer. It may itself play another robot's run.
            Without a stage, Xforms called robot and magnetometer are authored.
        fps: Frame rate [Hz]; None samples every row.
        force: Whether to replace an existing file.

    Raises:
        InputError: The file exists and `force` was not given, cannot be written or is part of the scene; the
            run has no clock or no pose, or a column that USD cannot hold; or the scene has no robot.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: a USD file ends in {', '.join(SUFFIXES)}")
    if fps is not None and not 0 < fps <= MOST_FPS:
        raise InputError(f"fps must be above 0 and at most {MOST_FPS:g}, got {fps!r}")
    check_clock(run, "the run to write")
    t = run["t"]
    if not len(t):
        raise InputError("the run has no rows, there is nothing to play")
    rate = fps or (round(1 / float(np.median(np.diff(t[: mapped.LONG + 1]))), 6) if len(t) > 1 else 1.0)
    pose = _pose_columns(run)
    stand = _Stand()
    if scene_file is not None:
        stage = open_stage(scene_file)
        world = stage.GetDefaultPrim()
        if labs_on(stage):
            take_to_origin(stage, lab_on(stage, str(run.metadata.get("lab", ""))))
        check_not_part(stage, path)
        stand = _stand(stage, world, str(run.metadata.get("robot", "")))
    with output(path, force=force) as aside:
        layer = Sdf.Layer.CreateNew(str(aside))
        if layer is None:
            raise InputError(f"{path}: cannot be made as a USD layer")
        about = "A run of magtwin: poses of the robot and readings of its sensors over time"
        describe_stage(Usd.Stage.Open(layer), about)
        metadata = json.dumps(dict(run.metadata), ensure_ascii=False)
        layer.customLayerData = {**creator(), _FACTS: metadata}
        layer.defaultPrim = stand.world.name
        layer.startTimeCode, layer.endTimeCode = 0.0, float((t[-1] - t[0]) * rate)
        layer.timeCodesPerSecond = layer.framesPerSecond = float(rate)
        if scene_file is not None:
            # Relative to the final place of the layer.
            below = os.path.relpath(Path(scene_file).resolve(), path.resolve().parent)
            below = Path(below).as_posix()
            layer.subLayerPaths = [below if below.startswith("../") else f"./{below}"]
        else:
            for bare in (stand.world, stand.robot, stand.sensors["magnetometer"]):
                spec = Sdf.CreatePrimInLayer(layer, bare)
                spec.specifier, spec.typeName = Sdf.SpecifierDef, "Xform"
        readings = _sampled(run, stand)
        _declare(layer, stand, readings, wheels="wheel_angle" in run)
        try:
            _store(layer, stand.world.AppendChild(RUN), run)
            samples = _samples(stand, readings, pose, run, fps, rate)
            if not samples[stand.robot.AppendProperty(_TRANSLATE)][0]:
                raise InputError(
                    f"no pose {pose[0]!r} of the run is known at the time of a frame; raise `fps`"
                )
            for attribute, (codes, values) in samples.items():
                sample(layer, attribute, codes, values)
            layer.Save()
        except Tf.ErrorException as error:
            raise InputError(f"{path}: cannot be written; is the disk full?") from error


def read_animation(path: str | os.PathLike[str]) -> Run:
    """The exact run that `write_animation` wrote; its scene need not exist.

    Raises:
        InputError: The file is missing, not USD, truncated, or holds no run.
    """
    layer = open_layer(path)
    try:
        run = _read(layer, path)
    except InputError:
        raise
    except (Tf.ErrorException, ValueError, AttributeError, TypeError, RecursionError) as error:
        raise InputError(f"{path}: holds a damaged run; write it again") from error
    check_clock(run, str(path))
    return run


@translates
def is_animation(path: str | os.PathLike[str]) -> bool:
    """Whether a USD file holds a run.

    Raises:
        InputError: The file is missing or not USD.
    """
    layer = open_layer(path)
    return bool(layer.GetAttributeAtPath(_run_path(layer).AppendProperty(f"{_COLUMN}t")))


def _read(layer: Sdf.Layer, path: str | os.PathLike[str]) -> Run:
    """The run of a layer."""
    prim = layer.GetPrimAtPath(_run_path(layer))
    if not prim:
        raise InputError(
            f"{path}: plays no run: it has no prim {_run_path(layer)} that holds one; give a layer that "
            "`magtwin run --out F.usda` or `magtwin convert` wrote"
        )
    columns, specs = {}, {}
    known = sorted(prim.properties, key=lambda column: column.customData.get("number", np.inf))
    known = [attribute for attribute in known if attribute.name.startswith(_COLUMN)]
    for attribute in known:
        name = attribute.name.removeprefix(_COLUMN)
        columns[name] = _array(attribute, path)
        if name not in COLUMNS:
            said = {key: str(value) for key, value in attribute.customData.items()}
            parts = tuple(filter(None, said.get("parts", "").split(",")))
            rule: Any = said.get("interpolation", "linear")
            unit, frame = said.get("unit", ""), said.get("frame", "")
            specs[name] = Column(unit, frame, attribute.documentation, len(parts) or 1, parts, rule)
    metadata = json.loads(layer.customLayerData.get(_FACTS, "{}"))
    with about(f"{path}: holds a damaged run:"):
        return Run(columns, {k: v for k, v in metadata.items() if isinstance(v, str | int | float)}, specs)


def _run_path(layer: Sdf.Layer) -> Sdf.Path:
    world = WORLD
    if layer.defaultPrim and Sdf.Path.IsValidIdentifier(layer.defaultPrim):
        world = Sdf.Path.absoluteRootPath.AppendChild(layer.defaultPrim)
    return world.AppendChild(RUN)


def _pose_columns(run: Run) -> tuple[str, str]:
    for p, q in POSES:
        if p in run and q in run and any(np.isfinite(run[p][r]).all(1).any() for r in mapped.parts(run.rows)):
            return p, q
    known = "; ".join(" and ".join(pair) for pair in POSES)
    raise InputError(f"the run has no pose of the robot; it needs {known}")


def _stand(stage: Usd.Stage, default: Usd.Prim, name: str) -> _Stand:
    """The prims of a lab's robot, on a stage in the lab's axes; the first robot if `name` is ""."""
    root = stage.GetPseudoRoot()
    robots = {prim.GetName(): prim for prim in prims_with(root, "robot")}
    prim = find("robot", name, robots) if name else next(iter(robots.values()), None)
    if prim is None:
        prim = only_prim_with(root, "robot")  # refuses
    if not default:
        raise InputError(f"{place(prim)}: the stage has no default prim, which holds the run; set one")
    if prim.IsInstance() or prim.IsInstanceProxy():
        text = "the robot is an instance, whose wheels cannot turn; make it not instanceable"
        raise InputError(f"{place(prim)}: {text}")
    cache = UsdGeom.XformCache()
    if cache.GetParentToWorldTransform(prim) != Gf.Matrix4d(1):
        raise InputError(
            f"{place(prim)}: a prim above the robot, below the lab's root, is moved; the robot must stand in "
            "the lab's own axes"
        )
    base = next((body for body in Usd.PrimRange(prim) if body.GetName() == BASE_LINK), prim)
    to_root = cache.ComputeRelativeTransform(base, prim)[0].RemoveScaleShear()
    turn, offset = to_root.ExtractRotationQuat(), to_root.ExtractTranslation()
    sensors = {noun: prims[0].GetPath() for noun in READINGS if (prims := prims_with(prim, noun))}
    x, y, z = map(float, offset)
    return _Stand(
        world=default.GetPath(),
        robot=prim.GetPath(),
        p_root_base=(x, y, z),
        q_root_base_xyzw=(*map(float, turn.GetImaginary()), float(turn.GetReal())),  # type: ignore[arg-type]
        wheels=tuple(
            _wheel(side, joint, stage)
            for fields_ in (JOINT_FIELDS, WHEELS_FIELDS)
            for side, field_ in enumerate(fields_)
            for joint in targets(prim, attribute_name("drive", field_))
        ),
        sensors=sensors,
    )


def _wheel(side: int, joint: Usd.Prim, stage: Usd.Stage) -> tuple[int, Sdf.Path, Vec3, Quat, Vec3]:
    body = target(joint, "physics:body1")
    links = read_links(stage)  # by path where another body has the name
    link = links.get(str(body.GetPath()), links.get(body.GetName()))
    if link is None or link.rolling_axis is None:
        raise InputError(f"{place(joint)}: is no revolute joint between two bodies, as a wheel needs")
    return side, body.GetPath(), *read_pose(body), link.rolling_axis


def _sampled(run: Run, stand: _Stand) -> list[tuple[str, str]]:
    """Sensors and columns that are sampled on their prims: all but those that are never known."""
    return [
        (noun, name)
        for noun, names in READINGS.items()
        for name in names
        if name in run
        and noun in stand.sensors
        and not all(np.isnan(run[name][rows]).all() for rows in mapped.parts(run.rows))
    ]


def _declare(layer: Sdf.Layer, stand: _Stand, readings: list[tuple[str, str]], *, wheels: bool) -> None:
    """Author the sampled attributes without their samples."""
    kinds = Sdf.ValueTypeNames
    for path, p in ((stand.robot, None), *((w[1], Gf.Vec3d(w[2])) for w in stand.wheels if wheels)):
        prim = Sdf.CreatePrimInLayer(layer, path)
        translate = Sdf.AttributeSpec(prim, _TRANSLATE, kinds.Double3)
        orient = Sdf.AttributeSpec(prim, _ORIENT, kinds.Quatd)
        order = Sdf.AttributeSpec(prim, "xformOpOrder", kinds.TokenArray, Sdf.VariabilityUniform)
        order.default = Vt.TokenArray([translate.name, orient.name])
        if p is not None:
            translate.default = p
    for noun, name in readings:
        prim, spec = Sdf.CreatePrimInLayer(layer, stand.sensors[noun]), COLUMNS[name]
        kind = {"bool": kinds.Bool}.get(spec.unit, kinds.Double3 if spec.width == 3 else kinds.Double)
        attribute = Sdf.AttributeSpec(prim, attribute_name(noun, name), kind, declaresCustom=True)
        attribute.documentation = spec.doc
        attribute.customData = {key: v for key, v in (("unit", spec.unit), ("frame", spec.frame)) if v}


def _samples(
    stand: _Stand,
    readings: list[tuple[str, str]],
    pose: tuple[str, str],
    run: Run,
    fps: float | None,
    rate: float,
) -> dict[Sdf.Path, tuple[Sequence[float], Sequence[Any]]]:
    """Time codes and values: poses and readings at every frame, held values when they change."""
    row_codes = (run["t"] - run["t"][0]) * rate
    if fps is None:
        frames, at_frames = run, row_codes
    else:
        kept = [name for _, name in readings if COLUMNS[name].interpolation != "hold"]
        wanted = [name for name in dict.fromkeys((*pose, "wheel_angle", *kept)) if name in run]
        rules: Any = {pose[0]: "linear", pose[1]: "quaternion"}  # it moves between recorded poses
        at = grid(run["t"][0], run["t"][-1], fps)
        frames = run.select(*wanted).resample(at, interpolation=rules)
        at_frames = np.arange(len(at), dtype=float)
    codes = at_frames.tolist()
    p, q = (frames[name] for name in pose)
    known = np.isfinite(p).all(axis=1) & np.isfinite(q).all(axis=1)
    q = quat_multiply(q[known], quat_conjugate(stand.q_root_base_xyzw))
    p, moved = p[known] - rotate(q, stand.p_root_base), at_frames[known].tolist()
    samples: dict[Sdf.Path, tuple[Any, Any]] = {
        stand.robot.AppendProperty(_TRANSLATE): (moved, Vt.Vec3dArray.FromNumpy(np.ascontiguousarray(p))),
        stand.robot.AppendProperty(_ORIENT): (moved, Vt.QuatdArray.FromNumpy(np.ascontiguousarray(q))),
    }
    for side, path, _, q_rest, axis in stand.wheels if "wheel_angle" in frames else ():
        half = frames["wheel_angle"][:, side, None] / 2
        turn = quat_multiply(q_rest, np.hstack([np.sin(half) * axis, np.cos(half)]))
        turns = Vt.QuatdArray.FromNumpy(np.ascontiguousarray(turn))
        samples[path.AppendProperty(_ORIENT)] = codes, turns
    for noun, name in readings:
        path, spec = stand.sensors[noun].AppendProperty(attribute_name(noun, name)), COLUMNS[name]
        if spec.interpolation == "hold":
            rows = np.flatnonzero(np.append(True, run[name][1:] != run[name][:-1]))
            samples[path] = row_codes[rows].tolist(), run[name][rows].tolist()
        elif spec.width == 3:
            samples[path] = codes, Vt.Vec3dArray.FromNumpy(np.ascontiguousarray(frames[name]))
        else:
            samples[path] = codes, frames[name].tolist()
    return samples


def sample(layer: Sdf.Layer, path: Sdf.Path, codes: Iterable[float], values: Iterable[Any]) -> None:
    """Author samples of an attribute in one change block."""
    with Sdf.ChangeBlock():
        deque(map(layer.SetTimeSample, repeat(path), codes, values), maxlen=0)


def _store(layer: Sdf.Layer, path: Sdf.Path, run: Run) -> None:
    """Author every column of a run as an array."""
    prim = Sdf.CreatePrimInLayer(layer, path)
    prim.specifier, prim.typeName = Sdf.SpecifierDef, "Scope"
    prim.documentation = "Every column of the run; rows of vectors are flattened"
    for number, (name, values) in enumerate(run.items()):
        kind = _KINDS.get(values.dtype.str[1:])
        if kind is None or values.ndim > 2 or not Sdf.Path.IsValidIdentifier(name):
            raise InputError(
                f"column {name!r} cannot be written to USD: it needs numbers or flags, and a name of letters,"
                f" digits and _, got {values.dtype} of shape {values.shape}"
            )
        spec = run.spec(name)
        uniform = Sdf.VariabilityUniform
        attribute = Sdf.AttributeSpec(prim, f"{_COLUMN}{name}", kind, uniform, declaresCustom=True)
        attribute.documentation = spec.doc
        said: dict[str, Any] = {"unit": spec.unit, "frame": spec.frame, "parts": ",".join(spec.parts)}
        if name not in COLUMNS:
            said["interpolation"] = spec.interpolation
        said = {key: value for key, value in said.items() if value}
        attribute.customData = {**said, "number": number}  # text sorts attributes by name
        attribute.default = kind.type.pythonClass.FromNumpy(np.ascontiguousarray(values).reshape(-1))


def _array(attribute: Sdf.AttributeSpec, path: str | os.PathLike[str]) -> NDArray[Any]:
    """The values of a column."""
    dtype = next((dtype for dtype, kind in _KINDS.items() if kind == attribute.typeName), None)
    if dtype is None:
        raise InputError(f"{path}: <{attribute.path}> must be an array of numbers, got {attribute.typeName}")
    if attribute.default is None:
        raise InputError(f"{path}: <{attribute.path}> must be an array of numbers, but has no value")
    values = np.array(attribute.default, dtype)
    parts = str(attribute.customData.get("parts", ""))
    width = len(parts.split(","))
    if len(values) % width:
        raise InputError(f"{path}: <{attribute.path}> has {len(values)} numbers in rows of {width}")
    return values.reshape(-1, width) if parts else values
