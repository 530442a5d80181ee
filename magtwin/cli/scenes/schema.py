"""`magtwin schema`."""

from pathlib import Path

from magtwin.cli.app import app
from magtwin.cli.options import Force
from magtwin.cli.terminal import Done, named


@app.command
def schema(*, out: Path | None = None, toml: Path | None = None, force: Force = False) -> Done:
    """Print the folder of magtwin's USD schemas, for PXR_PLUGINPATH_NAME; or copy it for another machine.

    usdview, Kit and any other program of OpenUSD then show the attributes with names, groups, units and
    fallbacks: see docs/schema.md. With --toml, write the JSON schemas of TOML files for editors instead.

    Parameters
    ----------
    out
        Folder to make, with plugInfo.json, generatedSchema.usda and schema.usda.
    toml
        Folder for the JSON schemas of scenes, sources, robots, suites and trainings. A TOML with the first
        line `#:schema ./scene.schema.json` is completed and checked by editors that know TOML schemas.
    """
    if toml is not None:
        from magtwin.files.settings import copy_schemas

        written = copy_schemas(toml)
        return Done(wrote=toml, data={"folder": str(toml), "files": [file.name for file in written]})
    from magtwin.usd.schema import FOLDER, publish
    from magtwin.usd.schema.versions import TEXT

    if out is None:
        return Done(text=str(FOLDER), data={"version": TEXT, "folder": str(FOLDER)})
    out = named(out, force=force)
    publish(out, force=force)
    return Done(wrote=out, data={"version": TEXT, "folder": str(out)})
