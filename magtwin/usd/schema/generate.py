"""Generate files from schema.usda: `python magtwin/usd/schema/generate.py`, or `make schema`.

generatedSchema.usda and plugInfo.json are for USD, docs/schema.md is for people. It is a script, so that it
works while the generated files are broken.
"""

import json
import shutil
import subprocess
import sys
import tempfile
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any

HERE = Path(__file__).resolve().parent
GENERATED = ("generatedSchema.usda", "plugInfo.json")
REFERENCE = HERE.parents[2] / "docs" / "schema.md"


def _names() -> ModuleType:
    """The module names.py, without its package, which needs the generated files."""
    spec = spec_from_file_location("names", HERE / "names.py")
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


NAMES = _names()
VERSION = ".".join(map(str, NAMES.VERSION))


def generate(folder: Path) -> None:
    """Write the generated files of the schema library to `folder`, with USD's own generator.

    USD leaves placeholders for paths in plugInfo.json; here the library is beside that file. Of a text USD
    keeps the first sentence; here all of it. The version is in plugInfo.json.
    """
    from pxr import Sdf

    spec = find_spec("pxr.Usd")
    assert spec is not None
    assert spec.origin is not None
    generator = Path(spec.origin).with_name("usdGenSchema.py")
    with tempfile.TemporaryDirectory() as scratch:
        shutil.copy(HERE / "schema.usda", scratch)
        layer = Sdf.Layer.FindOrOpen(str(Path(scratch) / "schema.usda"))
        for item in (item for schema in layer.rootPrims for item in (schema, *schema.properties)):
            if item.documentation:
                item.customData["userDocBrief"] = " ".join(item.documentation.split())
        layer.Save()
        subprocess.run(
            [sys.executable, str(generator), "schema.usda", "."], cwd=scratch, check=True, capture_output=True
        )
        written = (Path(scratch) / "plugInfo.json").read_text(encoding="utf-8")
        plug_info = json.loads("\n".join(line for line in written.splitlines() if not line.startswith("#")))
        for plugin in plug_info["Plugins"]:
            plugin |= {"LibraryPath": "", "ResourcePath": ".", "Root": "."}
            plugin["Info"]["schemaVersion"] = VERSION
        (folder / "plugInfo.json").write_text(json.dumps(plug_info, indent=4) + "\n", encoding="utf-8")
        shutil.copyfile(Path(scratch) / "generatedSchema.usda", folder / "generatedSchema.usda")


def reference() -> str:
    """The page docs/schema.md: every attribute with type, fallback and meaning."""
    from pxr import Sdf

    layer = Sdf.Layer.FindOrOpen(str(HERE / "schema.usda"))
    parts = [(HERE / "introduction.txt").read_text(encoding="utf-8").format(version=VERSION)]
    for schema in layer.rootPrims:
        if schema.specifier != Sdf.SpecifierClass:
            continue
        lines = [line.strip() for line in schema.documentation.strip().splitlines()]
        parts.append(f"\n## {schema.name}\n\n" + "\n".join(lines) + "\n")
        parts.append("\n| property | type | fallback | meaning |\n|---|---|---|---|\n")
        for item in schema.properties:
            attribute = isinstance(item, Sdf.AttributeSpec)
            kind = str(item.typeName) if attribute else "rel"
            fallback = f"`{_fallback(item)}`" if attribute and _fallback(item) else ""
            parts.append(f"| `{item.name}` | {kind} | {fallback} | {item.documentation} |\n")
    return "".join(parts)


def _fallback(attribute: Any) -> str:
    """An attribute's fallback as text; "" if it is empty."""
    value = attribute.default
    if value is None:
        return "none"
    if isinstance(value, float):
        return f"{value:g}"
    text = str(value)
    return "" if text in ("[]", "@@") else " ".join(text.split())


if __name__ == "__main__":
    generate(HERE)
    if REFERENCE.parent.is_dir():
        REFERENCE.write_text(reference(), encoding="utf-8")
