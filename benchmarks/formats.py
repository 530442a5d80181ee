"""One run of ten minutes in every format; playback's time samples against USD's own way of setting them.

81,000 readings of every column are written in each format and read back. Time samples, a position and a
turn a step, are authored by magtwin's way, on the layer, and by `UsdGeom.XformOp.Set` on a stage, as USD's
tutorials do, in seconds of the processor; what saving takes is the same for both. All in turn in one
process after one warm-up; figures are medians, ratios are taken repetition by repetition.

    python benchmarks/formats.py [repetitions]
"""

import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, Vt

import magtwin
from magtwin.author.scene import author_scene
from magtwin.files.file import shipped
from magtwin.io.formats import read_run, write_run
from magtwin.twin import open_twin, scene_from_toml, simulate
from magtwin.usd.animation import sample

DURATION_S = 600.0
NAMES = ("run.parquet", "run.npz", "run.csv", "run.rrd", "run.mcap", "run.usdc")
WANTED_S, WANTED_RATIO = 5.0, 5.0


def seconds(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def by_xform_op(run: magtwin.Run, file: Path) -> Usd.Stage:
    """A sample of position and turn a step, as USD's tutorials author them."""
    stage = Usd.Stage.CreateNew(str(file))
    xform = UsdGeom.Xform.Define(stage, "/World/robot")
    translate, orient = xform.AddTranslateOp(), xform.AddOrientOp(UsdGeom.XformOp.PrecisionDouble)
    for t, p, (x, y, z, w) in zip(run["t"], run["p_world_base"], run["q_world_base_xyzw"], strict=True):
        translate.Set(Gf.Vec3d(*map(float, p)), float(t))
        orient.Set(Gf.Quatd(float(w), float(x), float(y), float(z)), float(t))
    return stage


def by_layer(run: magtwin.Run, file: Path) -> Sdf.Layer:
    """The same samples on the layer."""
    layer = Sdf.Layer.CreateNew(str(file))
    prim = Sdf.CreatePrimInLayer(layer, "/World/robot")
    translate = Sdf.AttributeSpec(prim, "xformOp:translate", Sdf.ValueTypeNames.Double3)
    orient = Sdf.AttributeSpec(prim, "xformOp:orient", Sdf.ValueTypeNames.Quatd)
    codes = run["t"].tolist()
    sample(layer, translate.path, codes, Vt.Vec3dArray.FromNumpy(run["p_world_base"]))
    sample(layer, orient.path, codes, Vt.QuatdArray.FromNumpy(run["q_world_base_xyzw"]))
    return layer


def size_mb(path: Path) -> float:
    files = path.iterdir() if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files) / 1e6


def main(repetitions: int = 5) -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        scene = author_scene(scene_from_toml(shipped("scenes", "lab.toml")), folder / "lab")
        twin = open_twin(scene, magnetometer="physical")
        run = simulate(twin, "figure8", duration_s=DURATION_S)
        rounds = []
        for repetition in range(repetitions + 1):
            took = {}
            for file in NAMES:
                spent = time.process_time()
                took[file] = seconds(lambda file=file: write_run(run, folder / file, twin, force=True))
                took[f"cpu {file}"] = time.process_time() - spent
                took[f"read {file}"] = seconds(lambda file=file: read_run(folder / file))
            took["cpu all"] = sum(took[f"cpu {file}"] for file in NAMES)
            took["all"] = sum(took[file] for file in NAMES)
            peer, ours = folder / f"peer{repetition}.usdc", folder / f"ours{repetition}.usdc"
            authored: list[Any] = []
            for key, author, to in (("XformOp.Set", by_xform_op, peer), ("on the layer", by_layer, ours)):
                spent = time.process_time()  # of one thread: other work on the machine is not counted
                authored.append(author(run, to))
                took[key] = time.process_time() - spent
            took["saving"] = seconds(authored[1].Save)
            rounds.append(took)
        sizes = {file: size_mb(folder / file) for file in NAMES}
    median = {key: statistics.median(took[key] for took in rounds[1:]) for key in rounds[0]}
    print(f"{run.rows:,} rows, {len(run)} columns, {repetitions} repetitions; medians")
    print(f"{'':16s}{'write':>9s}{'(CPU)':>9s}{'read':>9s}")
    for file in NAMES:
        figures = (median[key] for key in (file, f"cpu {file}", f"read {file}"))
        print(f"{file:16s}" + "".join(f"{figure:7.3f} s" for figure in figures) + f"{sizes[file]:8.1f} MB")
    print(f"{'all':16s}{median['all']:7.3f} s{median['cpu all']:7.3f} s  wanted: under {WANTED_S:g} s")
    ratios = np.array([took["XformOp.Set"] / took["on the layer"] for took in rounds[1:]])
    print(f"\n{2 * run.rows:,} time samples, CPU")
    for key in ("XformOp.Set", "on the layer", "saving"):
        print(f"{key:16s}{median[key]:7.3f} s")
    spread = f"from {ratios.min():.1f} to {ratios.max():.1f}"
    print(f"ratio {np.median(ratios):.1f} ({spread}); wanted: over {WANTED_RATIO:g}")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
