"""Build the lab's stage, `scenes/lab/lab.usda`, from `scenes/lab.toml`: `python scenes/build.py`.

The stage names its map, robot and weights where they lie in this project; `magtwin scene lab --out DIR`
makes one that stands alone.
"""

from pathlib import Path

from magtwin.author.scene import author_scene
from magtwin.twin import scene_from_toml

HERE = Path(__file__).resolve().parent


def build(folder: Path, *, force: bool = False) -> Path:
    """Write the stage to a folder; returns its root layer."""
    return author_scene(scene_from_toml(HERE / "lab.toml"), folder, by_reference=True, force=force)


if __name__ == "__main__":
    build(HERE / "lab", force=True)
