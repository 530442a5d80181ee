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
INTRODUCTION = """\
# magtwin's USD schemas

This page lists every attribute that magtwin adds to a stage. Use it to read a magtwin scene in another
program, or to author one without magtwin. It describes version {version} of the schemas.

The schemas are codeless applied API schemas on plain `Xform` prims. A program that does not have them still
places every prim, and reads and keeps every value. This works because magtwin authors every attribute, even
one that equals the fallback; only empty values are left out. An attribute that a layer leaves out has its
fallback, in magtwin as in any program that has the schemas. The tables leave out a fallback that is an empty
text, list or file; `none` is no value.

* **Names** are `magtwin:<noun>:<field>` in camel case and end in the unit of the value: `rateHz`,
  `hardIronNt`, `yawZeroRad`. Units that multiply follow each other, `Per` comes before each that divides, and
  N m and A m2 count as one: nT/m is `NtPerM`, nT s/m is `NtSPerM`, nT/(N m) is `NtPerNm`. A ratio, a count, a
  text and a file have no unit.
* **Every attribute is uniform.** What a run changes is not part of the schemas: poses are time samples of
  transforms, and readings are attributes of the run's own layer ([logs.md](logs.md)).
* **Every attribute has a display name with its unit, a display group and a text**, for usdview and Kit.

`make schema` generates this page from [schema.usda](../magtwin/usd/schema/schema.usda).

## The schemas in other programs

`import magtwin.usd` registers the schemas with USD. magtwin reads and writes them also where a stage was
opened before; bare pxr knows them only if the import comes first, as USD reads schemas once. Other programs
find them by `PXR_PLUGINPATH_NAME`, which USD reads when a program starts. It names a folder with
`plugInfo.json` and `generatedSchema.usda`: `magtwin schema` prints the one of this installation, and
`magtwin schema --out DIR` makes a copy for another machine. `magtwin export` puts a copy in the folder
`plugin/magtwin` of each export.

OpenUSD's usdview:

```
PXR_PLUGINPATH_NAME=$(magtwin schema) usdview scenes/lab/lab.usda
```

Kit and Isaac Sim on Linux, in the program's own folder (these two lines were not run in Kit):

```
PXR_PLUGINPATH_NAME=$(magtwin schema) ./kit/kit apps/omni.app.editor.kit   # your app's .kit file
PXR_PLUGINPATH_NAME=$(magtwin schema) ./isaac-sim.sh
```

In a Kit extension instead, on startup and before a stage is opened:

```python
from pxr import Plug

Plug.Registry().RegisterPlugins("/path/to/the/folder")
```

Python with usd-core and without magtwin (`pip install usd-core`):

```
export PXR_PLUGINPATH_NAME=/path/to/the/folder
python -c "
from pxr import Usd
drive = Usd.SchemaRegistry().FindAppliedAPIPrimDefinition('MagtwinDifferentialDriveAPI')
name = 'magtwin:drive:wheelRadiusM'
print(drive.GetAttributeFallbackValue(name), drive.GetPropertyMetadata(name, 'displayName'))"
```

This prints `0.03575 Wheel radius [m]`. On Windows, set the variable with `set` or `$env:` first.

## Versions

The schemas have a version of two numbers, apart from magtwin's. The first number changes with names and
meanings, the second with new attributes. `schemaVersion` in `plugInfo.json` is that of the library. Each
layer that magtwin writes has it in its `customLayerData`, as `magtwinSchemaVersion`.

| layer | what magtwin does |
|---|---|
| of this version, or of none: an edit in another program | reads it |
| with a name that the schemas lack: a typing error, or an older name | ignores it, and warns once |
| of a later second number | reads it, ignores attributes that it does not know, and warns once |
| of a later first number | refuses it |
"""


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
    parts = [INTRODUCTION.format(version=VERSION)]
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
