"""Make generatedSchema.usda and plugInfo.json from schema.usda: `python magtwin/usd/schema/generate.py`.

Run as a script, so that it works while the generated files are broken. Needs jinja2.
"""

import json
import shutil
import subprocess
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path

HERE = Path(__file__).resolve().parent
GENERATED = ("generatedSchema.usda", "plugInfo.json")


def generate(folder: Path) -> None:
    """Write the generated files of the schema library to `folder`, with USD's own generator.

    USD leaves placeholders for paths in plugInfo.json; here the library lies where that file lies.
    """
    spec = find_spec("pxr.Usd")
    assert spec is not None
    assert spec.origin is not None
    generator = Path(spec.origin).with_name("usdGenSchema.py")
    with tempfile.TemporaryDirectory() as scratch:
        shutil.copy(HERE / "schema.usda", scratch)
        subprocess.run(
            [sys.executable, str(generator), "schema.usda", "."], cwd=scratch, check=True, capture_output=True
        )
        written = (Path(scratch) / "plugInfo.json").read_text(encoding="utf-8")
        plug_info = json.loads("\n".join(line for line in written.splitlines() if not line.startswith("#")))
        for plugin in plug_info["Plugins"]:
            plugin |= {"LibraryPath": "", "ResourcePath": ".", "Root": "."}
        (folder / "plugInfo.json").write_text(json.dumps(plug_info, indent=4) + "\n", encoding="utf-8")
        shutil.copyfile(Path(scratch) / "generatedSchema.usda", folder / "generatedSchema.usda")


if __name__ == "__main__":
    generate(HERE)
