"""From URDF to USD: `magtwin robot` against the command of urdf-usd-converter, in one run.

    python benchmarks/urdf.py [URDF ...] [--package NAME=DIR ...]

urdf-usd-converter needs usd-exchange, which brings a `pxr` of its own, so it gets an environment of its own,
build/urdf-usd-converter, made at the first run. Each conversion is a fresh process, the tools take turns, and
processor time counts, so that other programs disturb little; medians. What each wrote of the
first robot is read with plain OpenUSD.
"""

import argparse
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
REAL = ROOT.parent / "shared" / "data" / "turtlebot4" / "turtlebot4.urdf"
PEER = ROOT / "build" / "urdf-usd-converter"
PEER_VERSION = "0.3.4"
REPEATS = 5

COMMANDS = {
    "magtwin": (sys.executable, "-m", "magtwin", "robot", "{urdf}", "--out", "{out}"),
    "urdf-usd-converter": (str(PEER / "bin" / "urdf_usd_converter"), "{urdf}", "{out}"),
}


def install_peer() -> None:
    """Make the peer's environment, once."""
    if not (PEER / "bin" / "python").exists():
        subprocess.run([sys.executable, "-m", "venv", PEER], check=True)
        wanted = f"urdf-usd-converter=={PEER_VERSION}"
        subprocess.run([PEER / "bin" / "python", "-m", "pip", "install", "-q", wanted], check=True)


def measure(tool: str, urdf: Path, out: Path, packages: list[str]) -> tuple[float, float]:
    """Processor time [s] and peak memory [MB] of one conversion in a fresh process."""
    shutil.rmtree(out, ignore_errors=True)
    command = [word.format(urdf=urdf, out=out) for word in COMMANDS[tool]]
    command += [word for package in packages for word in ("--package", package)]
    # byte code of the modules is kept, as in an installed package; pip compiled that of the peer
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
    with tempfile.TemporaryFile() as log:
        process = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, env=environment)
        _, status, usage = os.wait4(process.pid, 0)
        if status:
            log.seek(0)
            sys.exit(f"{tool} could not convert {urdf}: {log.read().decode()[-500:]}")
    return usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1000


def _on_a_body(stage, relationship) -> bool:
    """Whether a joint's end is a rigid body, rather than the world."""
    from pxr import UsdPhysics

    targets = relationship.GetTargets()
    return bool(targets) and stage.GetPrimAtPath(targets[0]).HasAPI(UsdPhysics.RigidBodyAPI)


def features(out: Path) -> dict[str, str]:
    """What a written robot has, read with plain OpenUSD."""
    from pxr import Usd, UsdGeom, UsdPhysics, UsdShade

    root = next(iter(sorted(p for p in out.glob("*.usda") if p.name != "edits.usda")))
    stage = Usd.Stage.Open(str(root))
    prims = list(Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies()))
    bodies = [p for p in prims if p.HasAPI(UsdPhysics.RigidBodyAPI)]
    joints = [UsdPhysics.Joint(p) for p in prims if p.IsA(UsdPhysics.Joint)]
    to_world = [
        j for j in joints if not all(_on_a_body(stage, r) for r in (j.GetBody0Rel(), j.GetBody1Rel()))
    ]
    moving = [j for j in joints if not j.GetPrim().IsA(UsdPhysics.FixedJoint)]
    drives = [j for j in moving if UsdPhysics.DriveAPI.GetAll(j.GetPrim())]
    grips = [p for p in prims if p.IsA(UsdShade.Material) and p.HasAPI(UsdPhysics.MaterialAPI)]
    gprims = [p for p in prims if UsdGeom.Gprim(p) and UsdGeom.Imageable(p).ComputePurpose() != "guide"]
    lidar = [p for p in gprims if "rplidar" in str(p.GetPath())]
    box = UsdGeom.BBoxCache(Usd.TimeCode.Default(), ["default", "render"])
    size = box.ComputeWorldBound(stage.GetPseudoRoot()).ComputeAlignedRange().GetSize()
    mass = sum(UsdPhysics.MassAPI(p).GetMassAttr().Get() or 0 for p in bodies)
    return {
        "files, kB": f"{sum(f.stat().st_size for f in out.rglob('*') if f.is_file()) / 1000:,.0f}",
        "rigid bodies": str(len(bodies)),
        "joints, of them moving": f"{len(joints)}, {len(moving)}",
        "bolted to the world": "yes" if to_world else "no",
        "moving joints with a drive": f"{len(drives)} of {len(moving)}",
        "physics materials (friction)": str(len(grips)),
        "sensor prims": str(
            sum("Sensor" in p.GetTypeName() or p.GetTypeName() == "OmniLidar" for p in prims)
        ),
        "shapes shown": str(len(gprims)),
        "of them the LiDAR's": str(len(lidar)),
        "size, m": " x ".join(f"{s:.3f}" for s in size),
        "mass, kg": f"{mass:.3f}",
    }


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser()
    parser.add_argument("urdfs", nargs="*", type=Path, default=[REAL])
    parser.add_argument("--package", action="append", default=[])
    given = parser.parse_args()
    for urdf in given.urdfs:
        if not urdf.exists():
            sys.exit(f"{urdf}: no such URDF; name one, such as that of `magtwin fetch turtlebot4`")
    install_peer()
    scratch = Path(tempfile.mkdtemp())
    names = list(COMMANDS)
    print(f"{REPEATS} conversions each; medians of processor time, s, and greatest peak memory, MB")
    print(f"{'':24}" + "".join(f"{name:>22}" for name in names) + f"{'ratio':>8}")
    for urdf in given.urdfs:
        costs: dict[str, list[tuple[float, float]]] = {name: [] for name in names}
        for _ in range(REPEATS):
            for name in names:
                costs[name].append(measure(name, urdf.resolve(), scratch / name / urdf.stem, given.package))
        times = [statistics.median(time for time, _ in costs[name]) for name in names]
        peaks = [max(peak for _, peak in costs[name]) for name in names]
        cells = "".join(f"{t:15.2f}{m:7.0f}" for t, m in zip(times, peaks, strict=True))
        print(f"{urdf.stem[:24]:24}{cells}{times[0] / times[1]:8.2f}", flush=True)
    rows = {name: features(scratch / name / given.urdfs[0].stem) for name in names}
    shutil.rmtree(scratch)
    print(f"\n{'':30}{names[0]:>28}{names[1]:>28}")
    for key in rows[names[0]]:
        print(f"{key:30}{rows[names[0]][key]:>28}{rows[names[1]][key]:>28}")


if __name__ == "__main__":
    main()
