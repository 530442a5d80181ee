"""Draw the pictures of docs/export.md: one export in Blender, in Hydra Storm, on the web, and by magtwin.

    python docs/looks.py

Needs a Python with bpy in MAGTWIN_BLENDER (`make pictures` makes one), npm and chromium.
"""

import functools
import http.server
import os
import shutil
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

import numpy as np
from PIL import Image

from magtwin.export.package import export_scene
from magtwin.figures.pictures import Camera, picture_of_stage
from magtwin.files.file import shipped

HERE = Path(__file__).resolve().parent
IN_BLENDER = HERE.parent / "tests" / "in_blender.py"
SIZE = (640, 400)
CAMERA = Camera(
    azimuth_deg=-64.0, elevation_deg=47.0, distance_m=10.0, target=(0.0, 0.2, 0.2), view_angle_deg=36.0
)
THREE = "three@0.180.0"
MOST_BYTES = 150_000
BACKGROUND = "#e8ebf0"

PAGE = """<!doctype html><body style="margin:0"><script type="importmap">
{"imports": {"three": "./node_modules/three/build/three.module.js"}}</script><script type="module">
import * as THREE from "three";
import { GLTFLoader } from "./node_modules/three/examples/jsm/loaders/GLTFLoader.js";
const [width, height] = [WIDTH, HEIGHT];
const renderer = new THREE.WebGLRenderer({ antialias: true });
renderer.setSize(width, height);
document.body.append(renderer.domElement);
const world = new THREE.Scene();
world.background = new THREE.Color("BACKGROUND");
world.add(new THREE.HemisphereLight(0xffffff, 0x99958c, 2.0));
const sun = new THREE.DirectionalLight(0xffffff, 1.5);
sun.position.set(-2, 6, 3);
world.add(sun);
const camera = new THREE.PerspectiveCamera(ANGLE, width / height, 0.1, 100);
camera.position.set(EYE);
camera.lookAt(TARGET);
new GLTFLoader().load("lab.glb", ({ scene }) => {
  world.add(scene);
  renderer.render(world, camera);
  document.title = "drawn";
});
</script>"""


def main() -> None:
    """Write docs/look_*.png."""
    if not os.environ.get("MAGTWIN_BLENDER"):
        sys.exit("MAGTWIN_BLENDER names no Python with bpy; run make pictures")
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        lab = shipped("scenes", "lab", "lab.usda")
        stage = export_scene(lab, work / "lab", trusted=True).root
        export_scene(lab, work / "lab.glb", trusted=True)
        picture_of_stage(stage, work / "magtwin.png", size=SIZE, camera=CAMERA, legend=False)
        in_blender(stage, work / "blender.png", "CYCLES")
        in_blender(stage, work / "storm.png", "HYDRA_STORM")
        on_the_web(work)
        for look in ("magtwin", "blender", "storm", "web"):
            keep(work / f"{look}.png", HERE / f"look_{look}.png")


def eye() -> np.ndarray:
    """Position of the camera in world [m], shape (3,)."""
    return np.array(CAMERA.target) + CAMERA.distance_m * CAMERA.axes()[2]


def in_blender(stage: Path, out: Path, engine: str) -> None:
    """Render with Blender; Storm is the renderer of usdview."""
    at, to = (",".join(f"{v:.6f}" for v in point) for point in (eye(), CAMERA.target))
    command = [os.environ["MAGTWIN_BLENDER"], IN_BLENDER, "render", stage, out, engine, at, to]
    subprocess.run([*command, str(CAMERA.view_angle_deg)], check=True, stdout=subprocess.DEVNULL)


def on_the_web(work: Path) -> None:
    """Photograph the .glb in Chromium, drawn by three.js."""
    subprocess.run(["npm", "install", "--no-audit", "--no-fund", "--silent", THREE], cwd=work, check=True)
    values = {"BACKGROUND": BACKGROUND, "WIDTH": SIZE[0], "HEIGHT": SIZE[1], "ANGLE": CAMERA.view_angle_deg}
    for name, (x, y, z) in (("EYE", eye()), ("TARGET", CAMERA.target)):
        values[name] = f"{x:.6f}, {z:.6f}, {-y:.6f}"  # glTF has Y up
    page = PAGE
    for name, value in values.items():
        page = page.replace(name, str(value))
    (work / "page.html").write_text(page)
    serve = functools.partial(Quiet, directory=work)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), serve) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        subprocess.run(
            [
                shutil.which("chromium") or "chromium-browser",
                *("--headless", "--no-sandbox", "--hide-scrollbars", "--use-angle=swiftshader"),
                *("--enable-unsafe-swiftshader", "--virtual-time-budget=20000"),
                f"--window-size={SIZE[0]},{SIZE[1]}",
                f"--screenshot={work / 'web.png'}",
                f"http://127.0.0.1:{server.server_port}/page.html",
            ],
            check=True,
            stderr=subprocess.DEVNULL,
        )
        server.shutdown()


class Quiet(http.server.SimpleHTTPRequestHandler):
    """A handler without a log."""

    def log_message(self, *_: object) -> None:
        """Write nothing."""


def keep(picture: Path, out: Path) -> None:
    """Write a picture with a palette of 256 colours, which keeps it small."""
    seen = Image.open(picture).convert("RGBA")
    whole = Image.alpha_composite(Image.new("RGBA", seen.size, BACKGROUND), seen).convert("RGB")
    whole.quantize(256).save(out, optimize=True)
    if out.stat().st_size > MOST_BYTES:
        sys.exit(f"{out}: larger than {MOST_BYTES} bytes; make it smaller")


if __name__ == "__main__":
    main()
