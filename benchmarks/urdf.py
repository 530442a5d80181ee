"""TurtleBot 4 from URDF to USD: magtwin against urdf-usd-converter, in one run.

    python benchmarks/urdf.py [URDF]

urdf-usd-converter needs usd-exchange, which brings a `pxr` of its own, so it gets an environment of its own,
build/urdf-usd-converter, made at the first run. Cold is a fresh process for each conversion, warm is one
process that converts again and again; medians. What each wrote is read with plain OpenUSD.
"""

import json
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
REAL = ROOT.parent / "shared" / "data" / "turtlebot4" / "turtlebot4.urdf"
PEER = ROOT / "build" / "urdf-usd-converter"
PEER_VERSION = "0.3.4"
REPEATS = 7

WARM = """
import json, pathlib, shutil, sys, time
urdf, out, repeats = sys.argv[1], pathlib.Path(sys.argv[2]), int(sys.argv[3])
{imports}
times = []
for k in range(repeats + 1):
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir()
    start = time.perf_counter()
    {convert}
    times.append(time.perf_counter() - start)
print(json.dumps(times[1:]))
"""

TOOLS = {
    "magtwin": {
        "python": Path(sys.executable),
        "imports": "from magtwin.urdf import convert_urdf",
        "convert": "convert_urdf(urdf, out / 'robot.usda')",
    },
    "urdf-usd-converter": {
        "python": PEER / "bin" / "python",
        "imports": "import urdf_usd_converter\nconverter = urdf_usd_converter.Converter()",
        "convert": "converter.convert(urdf, str(out))",
    },
}


def install_peer() -> None:
    """Make the peer's environment, once."""
    if not (PEER / "bin" / "python").exists():
        subprocess.run([sys.executable, "-m", "venv", PEER], check=True)
        wanted = f"urdf-usd-converter=={PEER_VERSION}"
        subprocess.run([PEER / "bin" / "python", "-m", "pip", "install", "-q", wanted], check=True)


def measure(tool: dict, urdf: Path, out: Path) -> tuple[list[float], list[float]]:
    """Times of fresh processes, and of conversions in one process [s]."""
    script = WARM.format(**tool)
    command = [tool["python"], "-c", script, urdf, out]
    cold = []
    for _ in range(REPEATS):
        single = script.replace("range(repeats + 1)", "range(1)")
        start = time.perf_counter()
        subprocess.run([tool["python"], "-c", single, urdf, out, "0"], check=True, capture_output=True)
        cold.append(time.perf_counter() - start)
    result = subprocess.run([*command, str(REPEATS)], check=True, capture_output=True, text=True)
    return cold, json.loads(result.stdout.splitlines()[-1])


def _on_a_body(stage, relationship) -> bool:
    """Whether a joint's end is a rigid body, rather than the world."""
    from pxr import UsdPhysics

    targets = relationship.GetTargets()
    return bool(targets) and stage.GetPrimAtPath(targets[0]).HasAPI(UsdPhysics.RigidBodyAPI)


def features(out: Path) -> dict[str, str]:
    """What a written robot has, read with plain OpenUSD."""
    from pxr import Usd, UsdGeom, UsdPhysics, UsdShade

    root = next(iter(sorted(out.glob("*.usda"))))
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
    urdf = Path(sys.argv[1] if len(sys.argv) > 1 else REAL).resolve()
    if not urdf.exists():
        sys.exit(f"{urdf}: no such URDF; name one, such as that of `magtwin fetch turtlebot4`")
    install_peer()
    scratch = Path(tempfile.mkdtemp())
    rows: dict[str, dict[str, str]] = {}
    medians: dict[str, tuple[float, float]] = {}
    for name, tool in TOOLS.items():
        out = scratch / name
        cold, warm = measure(tool, urdf, out)
        medians[name] = statistics.median(cold), statistics.median(warm)
        rows[name] = {
            "cold, s": f"{medians[name][0]:.3f} ({min(cold):.3f} to {max(cold):.3f})",
            "warm, s": f"{medians[name][1]:.3f} ({min(warm):.3f} to {max(warm):.3f})",
            **features(out),
        }
    shutil.rmtree(scratch)
    print(f"{urdf.name}, {REPEATS} conversions each; medians (least to greatest)")
    names = list(TOOLS)
    print(f"{'':30}{names[0]:>28}{names[1]:>28}")
    for key in rows[names[0]]:
        print(f"{key:30}{rows[names[0]][key]:>28}{rows[names[1]][key]:>28}")
    ours, peers = medians[names[0]], medians[names[1]]
    print(f"ratio cold {ours[0] / peers[0]:.2f}, warm {ours[1] / peers[1]:.2f}; wanted: at most 0.50")


if __name__ == "__main__":
    main()
