"""Rules for what goes to Isaac Sim that its own rules, see `isaac_sim`, and OpenUSD leave out.

They follow its pages "Asset Structure" and "Robot Schema".
"""

import math
from collections.abc import Iterator

from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics

from magtwin.export.validation.rule import Subject, Wrong, rule
from magtwin.export.validation.rules import applied
from magtwin.usd.sensors import IMU_TYPE, LIDAR_API, LIDAR_TYPE

ROBOT_API, LINK_API, JOINT_API = "IsaacRobotAPI", "IsaacLinkAPI", "IsaacJointAPI"
LINKS, JOINTS = "isaac:physics:robotLinks", "isaac:physics:robotJoints"

LEAST_SCAN_HZ = 0.466
"""Least turns a second whose period a 32-bit number of nanoseconds holds (SimReady LI.003)."""

CORE = "omni:sensor:Core:"
EMITTER_STATE, ROI = f"{CORE}emitterState:", "isRoiState"


def robots(subject: Subject) -> list[Usd.Prim]:
    """Prims that Isaac Sim takes for robots."""
    return [prim for prim in subject.prims if ROBOT_API in applied(prim)]


@rule("isaac", "keep one root, and author the type with magtwin robot")
def robot_schema(subject: Subject) -> Iterator[Wrong]:
    """Every robot has no second articulation root, and has a robot type."""
    for robot in robots(subject):
        where = str(robot.GetPath())
        roots = [prim for prim in Usd.PrimRange(robot) if prim.HasAPI(UsdPhysics.ArticulationRootAPI)]
        if len(roots) > 1:
            yield Wrong(f"has {len(roots)} articulation roots, Isaac Sim wants one", where)
        if not robot.GetAttribute("isaac:robotType").Get():
            yield Wrong("does not say isaac:robotType", where, severity="warning")


@rule("isaac", "list them with magtwin robot, or in Isaac Sim's robot schema panel")
def robot_lists(subject: Subject) -> Iterator[Wrong]:
    """Every robot lists all its bodies and all its joints, each once, and no missing prim."""
    for robot in robots(subject):
        prims, where = list(Usd.PrimRange(robot)), str(robot.GetPath())
        bodies = {prim.GetPath() for prim in prims if prim.HasAPI(UsdPhysics.RigidBodyAPI)}
        joints = {prim.GetPath() for prim in prims if prim.IsA(UsdPhysics.Joint)}
        for name, wanted, api in ((LINKS, bodies, LINK_API), (JOINTS, joints, JOINT_API)):
            relationship = robot.GetRelationship(name)
            listed = list(relationship.GetTargets()) if relationship else []
            lost, odd = sorted(wanted - set(listed)), [path for path in listed if path not in wanted]
            if lost:
                yield Wrong(f"{name} lacks {_few(lost)}", where)
            if odd:
                yield Wrong(f"{name} lists {_few(odd)}, which is no such thing of its own", where)
            if len(set(listed)) < len(listed):
                yield Wrong(f"{name} lists something twice", where)
            bare = sorted(p for p in wanted if api not in applied(subject.stage.GetPrimAtPath(p)))
            if bare:
                yield Wrong(f"{_few(bare)} lack {api}", where)


@rule("isaac", "give it a finite force; with zero gains the joint stays free")
def joint_drives(subject: Subject) -> Iterator[Wrong]:
    """Every drive of a joint has a finite maximum force above 0."""
    for prim in subject.prims:
        for api in applied(prim):
            if api.startswith("PhysicsDriveAPI:"):
                force = UsdPhysics.DriveAPI(prim, api.partition(":")[2]).GetMaxForceAttr().Get()
                if not 0 < force < math.inf:
                    yield Wrong(f"has a drive of force {force:g}", str(prim.GetPath()))


@rule("isaac", "use convexHull or convexDecomposition; a moving body cannot collide as triangles")
def collider_shapes(subject: Subject) -> Iterator[Wrong]:
    """No rigid body collides as a triangle mesh."""
    for body in subject.prims:
        if not body.HasAPI(UsdPhysics.RigidBodyAPI):
            continue
        for prim in Usd.PrimRange(body, Usd.TraverseInstanceProxies()):
            if not prim.HasAPI(UsdPhysics.CollisionAPI) or not prim.IsA(UsdGeom.Mesh):
                continue
            mesh = UsdPhysics.MeshCollisionAPI(prim)
            kind = mesh.GetApproximationAttr().Get() if prim.HasAPI(UsdPhysics.MeshCollisionAPI) else "none"
            if kind == UsdPhysics.Tokens.none:
                yield Wrong("is a triangle mesh that moves", str(prim.GetPath()))


@rule("isaac", "magtwin robot and magtwin export author these")
def sensor_mounts(subject: Subject) -> Iterator[Wrong]:
    """Every sensor of Isaac Sim is on a rigid body and has the attributes that it needs."""
    for prim in subject.prims:
        kind, where = prim.GetTypeName(), str(prim.GetPath())
        if kind not in (IMU_TYPE, LIDAR_TYPE):
            continue
        above = map(subject.stage.GetPrimAtPath, prim.GetPath().GetAncestorsRange())
        if not any(end and end.HasAPI(UsdPhysics.RigidBodyAPI) for end in above):
            yield Wrong("rides on no rigid body", where)
        if kind == IMU_TYPE:
            period = prim.GetAttribute("sensorPeriod").Get()
            if period is None or period < 0:
                yield Wrong(f"has a sensorPeriod of {period}", where)
            continue
        if LIDAR_API not in applied(prim):
            yield Wrong(f"has not {LIDAR_API}", where)
            continue
        turns = prim.GetAttribute(f"{CORE}scanRateBaseHz").Get()
        near, far = (prim.GetAttribute(f"{CORE}{end}RangeM").Get() for end in ("near", "far"))
        if turns is None or turns < LEAST_SCAN_HZ:
            yield Wrong(f"turns at {turns} Hz", where)
        if near is None or far is None or not 0 <= near < far:
            yield Wrong(f"ranges from {near} to {far} m", where)
        emitters = prim.GetAttribute(f"{CORE}numberOfEmitters").Get()
        if emitters is None:
            yield Wrong("does not say its numberOfEmitters (SimReady LI.002)", where)
            continue
        for attribute in prim.GetAttributes():
            name = attribute.GetName()
            if name.startswith(EMITTER_STATE) and not name.endswith(ROI):
                values = attribute.Get()
                if values is not None and len(values) not in (0, emitters):
                    yield Wrong(f"has {emitters} emitters and {len(values)} of {name}", where)


@rule("isaac", "add a PhysicsScene: magtwin scene authors one with the lab")
def physics_scene(subject: Subject) -> Iterator[Wrong]:
    """A stage with robots in a lab has one physics scene, with gravity pointing down."""
    if not (subject.having("lab") and robots(subject)):
        return
    scenes = [prim for prim in subject.prims if prim.IsA(UsdPhysics.Scene)]
    if len(scenes) != 1:
        yield Wrong(f"has {len(scenes)} physics scenes")
    for prim in scenes:
        direction = Gf.Vec3d(UsdPhysics.Scene(prim).GetGravityDirectionAttr().Get() or (0, 0, 0))
        if direction.GetLength() and not Gf.IsClose(direction.GetNormalized(), Gf.Vec3d(0, 0, -1), 1e-6):
            yield Wrong(f"pulls along {tuple(direction)}", str(prim.GetPath()))


def _few(paths: list[Sdf.Path]) -> str:
    names = [f"<{path}>" for path in paths[:3]]
    return ", ".join(names) + (f" and {len(paths) - 3} more" if len(paths) > 3 else "")
