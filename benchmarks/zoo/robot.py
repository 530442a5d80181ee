"""One robot of the zoo: convert, validate, compare with yourdfpy; writes its row and the jobs of engines.

    python robot.py < JOBS

A server of jobs, see `serving.py`. `zoo.py` writes them.
"""

import json
import re
import sys
import time
from collections import Counter
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from serving import serve

LIMIT_GB = 8
"""Most memory of a robot [GB]."""

SEED = 0
"""Of the joint values for forward kinematics."""


def convert(job: dict, row: dict):
    """Convert with the defaults of `magtwin robot`; an arm's base is fixed."""
    from magtwin.author.from_urdf import from_urdf

    packages = {name: Path(folder) for name, folder in job["packages"].items()}
    start = time.process_time()
    made = from_urdf(
        job["urdf"],
        job["out"],
        packages=packages,
        arguments=job["arguments"],
        fix_base=job["fix_base"],
        force=True,
        proof=True,
        **job["options"],
    )
    report = made.report
    row |= {
        "convert_cpu_s": round(time.process_time() - start, 2),
        "links": len(report.links),
        "joints": len(report.joints),
        "notes": list(report.notes),
        "losses": list(report.losses),
        "repairs": {line.kind: line.count for line in report.repairs},
        "meshes_absent": sum(line.count for line in report.repairs if line.kind == "mesh-missing"),
        "boxes": boxes(report),
        "mass_kg": report.mass_out_kg,
        "fates": dict(Counter(line.fate for line in report.proof)),
    }
    return made


def boxes(report) -> list[str]:
    """Links with a placeholder for a collision mesh that is absent."""
    texts = [entry.text for line in report.repairs for entry in line.entries]
    found = [re.match(r"link '(.*?)': collision mesh .* a box of", text) for text in texts]
    return sorted({match[1] for match in found if match})


def check(asset: Path, row: dict) -> None:
    """Validate with OpenUSD's, NVIDIA's and Isaac Sim's rules."""
    from magtwin.export.validation.validate import validate

    row["errors"] = {}
    for each in validate(asset, ("core", "nvidia", "isaac")).checks:
        name = each.validator.split()[0]
        texts = [f"{f.rule}: {f.text} {f.where}".strip() for f in each.findings if f.severity == "error"]
        if each.not_run:
            row.setdefault("not_run", {})[name] = each.not_run
        row["errors"].setdefault(name, []).extend(texts)


def in_metres(mesh: Path) -> bool:
    """Whether the unit of a mesh is the metre; yourdfpy ignores another one of COLLADA."""
    head = mesh.read_text(errors="replace")[:10000] if mesh.suffix.lower() == ".dae" else ""
    unit = re.search(r"""<unit\b[^>]*\bmeter\s*=\s*["']([^"']+)""", head)
    return unit is None or float(unit[1]) == 1


class Peer:
    """The same description, read by yourdfpy from the expanded text."""

    def __init__(self, job: dict, work: Path) -> None:
        import yourdfpy

        from magtwin.urdf.source.source import read_source

        packages = {name: Path(folder) for name, folder in job["packages"].items()}
        self.source = read_source(
            job["urdf"],
            packages=packages,
            arguments=job["arguments"],
            skip_missing_includes=job["options"].get("skip_missing_includes", False),
        )
        text = work / "peer.urdf"
        ElementTree.ElementTree(self.source.xml).write(text)
        self.absent = self.scaled = 0

        def find(fname: str) -> str:
            try:
                file = self.source.find_file(fname, "mesh")
            except ValueError:
                self.absent += 1
                return fname
            self.scaled += not in_metres(file)
            return str(file)

        self.model = yourdfpy.URDF.load(str(text), filename_handler=find, build_collision_scene_graph=False)
        self.joints = {joint.name: joint for joint in self.model.robot.joints}
        self.rest = {
            j.name: j.limit.lower
            for j in self.joints.values()
            if j.limit and j.limit.lower is not None and j.limit.lower == j.limit.upper
        }
        self.update({})

    def update(self, values: dict) -> None:
        names = self.model.actuated_joint_names
        self.model.update_cfg([values.get(name, self.rest.get(name, 0.0)) for name in names])

    def drawn(self, rng: np.random.Generator, moving: set[str]) -> dict:
        """Random values of the joints that move on the stage too."""
        values = {}
        for name in self.model.actuated_joint_names:
            joint = self.joints[name]
            if name not in moving or joint.type not in ("continuous", "revolute", "prismatic"):
                continue
            low, high = -1.0, 1.0
            if joint.type != "continuous" and joint.limit and joint.limit.upper is not None:
                low, high = max(low, joint.limit.lower or 0.0), min(high, joint.limit.upper)
            values[name] = float(rng.uniform(min(low, high), high))
        return values

    def everything(self, values: dict) -> dict:
        """Values of all joints, those that mimic included; URDF gives a fixed joint no mimic."""
        every = dict(values)
        for joint in self.joints.values():
            if joint.mimic is not None and joint.type != "fixed" and joint.mimic.joint in values:
                every[joint.name] = joint.mimic.multiplier * values[joint.mimic.joint] + joint.mimic.offset
        return every

    def places(self) -> dict:
        base = self.model.base_link
        return {name: self.model.get_transform(name, base) for name in self.model.link_map}

    def mass(self) -> float:
        links = self.model.robot.links
        return float(sum(link.inertial.mass or 0.0 for link in links if link.inertial is not None))


def compare(asset: Path, report, peer: Peer, row: dict) -> None:
    """Hold links, mass and the box of all visuals against yourdfpy's."""
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(asset))
    cache, wanted, away = UsdGeom.XformCache(), peer.places(), []
    paths = {line.name: line.prim for line in report.links if line.prim}
    root = np.array(cache.GetLocalToWorldTransform(stage.GetDefaultPrim())).T
    for name, path in paths.items():
        T = np.linalg.inv(root) @ np.array(cache.GetLocalToWorldTransform(stage.GetPrimAtPath(path))).T
        if name in wanted:
            away.append(np.abs(T - wanted[name]).max())
    row["link_error_m"] = float(max(away, default=0.0))
    row["links_compared"] = len(away)
    row["urdf_mass_kg"] = peer.mass()
    bounds = peer.model.scene.bounds if len(peer.model.scene.geometry) else None
    row["meshes_scaled"] = peer.scaled
    if bounds is not None and report.box_out is not None and not (peer.absent or peer.scaled):
        size = np.linalg.norm(bounds[1] - bounds[0])
        row["box_error"] = float(np.abs(np.array(report.box_out) - bounds).max() / size)


def fk_job(report, peer: Peer | None) -> dict:
    """Joint values by prim, and where bodies must be, for the engine's own forward kinematics."""
    if peer is None:
        return {}
    moving = {line.name for line in report.joints if line.type_out not in ("", "PhysicsFixedJoint")}
    values = peer.drawn(np.random.default_rng(SEED), moving)
    peer.update(values)
    joints = {line.name: line.prim for line in report.joints if line.prim}
    bodies = {line.name: line.prim for line in report.links if line.became == "body"}
    base = next(iter(bodies))
    T_base = np.linalg.inv(peer.model.get_transform(base, peer.model.base_link))
    return {
        "joints": {joints[name]: v for name, v in peer.everything(values).items() if name in joints},
        "base": bodies[base],
        "bodies": {
            path: (T_base @ peer.model.get_transform(name, peer.model.base_link))[:3, 3].tolist()
            for name, path in bodies.items()
        },
    }


def drives_job(asset: Path, report, floats: bool) -> dict:
    """Room, bodies and driven joints of a stage, for an engine that reads none of them itself."""
    from pxr import Usd, UsdGeom, UsdPhysics

    sys.path.insert(0, str(Path(__file__).parents[1] / "physx"))
    from physx_drive import room_text

    from magtwin.usd.geometry import read_triangles

    stage = Usd.Stage.Open(str(asset))
    guides = read_triangles(stage, purposes=(UsdGeom.Tokens.guide,), wanted=lambda *_: True)
    enabled = [
        corners
        for path, corners in guides.items()
        if UsdPhysics.CollisionAPI(stage.GetPrimAtPath(path)).GetCollisionEnabledAttr().Get() is not False
    ]
    drives = []
    for line in report.joints:
        prim = stage.GetPrimAtPath(line.prim) if line.prim else None
        for axis, schema in (("angular", UsdPhysics.RevoluteJoint), ("linear", UsdPhysics.PrismaticJoint)):
            if not prim or not prim.IsA(schema) or not prim.HasAPI(UsdPhysics.DriveAPI, axis):
                continue
            drive, joint = UsdPhysics.DriveAPI(prim, axis), schema(prim)
            stiffness, damping = drive.GetStiffnessAttr().Get(), drive.GetDampingAttr().Get()
            if stiffness or damping:
                drives.append(
                    {
                        "path": line.prim,
                        "slides": axis == "linear",
                        "stiffness": stiffness,
                        "target": drive.GetTargetPositionAttr().Get() or 0.0,
                        "lower": joint.GetLowerLimitAttr().Get(),
                        "upper": joint.GetUpperLimitAttr().Get(),
                    }
                )
    bodies = [line.prim for line in report.links if line.became == "body"]
    lowest = min((float(c.reshape(-1, 3)[:, 2].min()) for c in enabled), default=0.0)
    room = asset.parent.parent / "physx_room.usda"
    room.write_text(room_text(asset, lowest if floats else None, scene=True))
    return {"room": str(room), "bodies": bodies, "base": bodies[0], "drives": drives}


def main(job_file: str) -> None:
    """Do a job; a step that fails is a line of the row, and the other steps follow."""
    job = json.loads(Path(job_file).read_text())
    work = Path(job["out"]).parent
    row: dict = {"steps_failed": {}}

    def step(name: str, call):
        try:
            return call()
        except Exception as error:  # of a foreign library, on a foreign file
            row["steps_failed"][name] = f"{type(error).__name__}: {error}".splitlines()[0][:400]
            return None

    made = step("convert", lambda: convert(job, row))
    if made is not None:
        peer = step("yourdfpy", lambda: Peer(job, work))
        if peer is not None:
            step("compare", lambda: compare(made.asset, made.report, peer, row))
        step("validate", lambda: check(made.asset, row))
        poses = step("poses", lambda: fk_job(made.report, peer)) or {}
        floats = not job["fix_base"]
        seen = step("drives", lambda: drives_job(made.asset, made.report, floats)) or {}
        trial = {"stage": str(made.asset), "poses": poses, "floats": floats, **seen}
        for name in job["engines"]:
            text = json.dumps({**trial, "answer": str(work / f"{name}.json")})
            (work / f"{name}_job.json").write_text(text)
    Path(job["answer"]).write_text(json.dumps(row, indent=1))


if __name__ == "__main__":
    import yourdfpy  # noqa: F401 - here, so that no job imports it again

    import magtwin.author.from_urdf  # noqa: F401

    serve(main, LIMIT_GB)
