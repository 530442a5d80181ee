"""`magtwin map info`, `diff`, `upward`, `export` and `occupancy`: commands on what exists."""

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from magtwin.cli.maps.map import LAYERS, PICTURES, MapFile, map_app
from magtwin.cli.options import Force, Scene
from magtwin.cli.terminal import Done, named, step


@map_app.command(name="info")
def map_info(file: MapFile) -> Done:
    """Print a map's metadata: field, uncertainty, method, sources, licence, frame, height and date."""
    from magtwin.field.maps.statistics import map_metadata
    from magtwin.io.map_files import open_map

    return Done(map_metadata(open_map(file)), whole=True)


@map_app.command(name="diff")
def map_diff(before: Path, after: Path, *, out: Path | None = None, force: Force = False) -> Done:
    """Report what changed from one survey to another: where, how much, and how significant it is.

    Parameters
    ----------
    before
        The earlier map: a layer or stage, a folder of survey CSVs, or a shipped scene's name: lab.
    after
        The later map.
    out
        Picture to write (.png or .svg).
    """
    from magtwin.field.maps.difference import difference
    from magtwin.io.map_files import open_map

    out = out and named(out, PICTURES, "a picture", force=force)
    step("Comparing the maps")
    change = difference(open_map(before), open_map(after))
    if out is not None:
        from magtwin.figures.canvas import save
        from magtwin.figures.maps import draw_difference

        save(draw_difference(change), out, force=force)
    report = change.report()
    regions = [asdict(region) for region in change.regions]
    whole = replace(report, metadata={**report.metadata, "regions": regions})
    draw = ("magtwin", "plot", before, after, "--out", "difference.png")
    return Done(report, out or (), data=json.loads(whole.to_json()), next=() if out else (draw,))


@map_app.command(name="upward")
def map_upward(
    file: MapFile,
    *,
    height_m: Annotated[float, Parameter(help="Height of the sensor above the floor in the new map [m].")],
    out: Path,
    force: Force = False,
) -> Done:
    """Continue a map to another height: exactly by its harmonic field, else upward by its grid's spectrum.

    Parameters
    ----------
    out
        Map layer to write (.usdc).
    """
    from magtwin.field.maps.continuation import at_height
    from magtwin.field.maps.statistics import map_metadata
    from magtwin.io.map_files import open_map
    from magtwin.usd.maps.layer import save_map

    out = named(out, LAYERS, "a map layer", force=force)
    step(f"Continuing the field to {height_m:g} m")
    field = at_height(open_map(file), height_m)
    save_map(field, out, force=force)
    return Done(map_metadata(field), out, rest=f"magtwin info {out}", next=(("magtwin", "plot", out),))


@map_app.command(name="export")
def map_export(file: MapFile, *, out: Path, force: Force = False) -> Done:
    """Write a map as CSVs, one per heading, that `magtwin map import` reads back.

    Comment lines above the rows keep the map's method, frame, height, date, licence and statistics. The rows
    of a survey come back unchanged.

    Parameters
    ----------
    out
        Folder to make: 0_map.csv, 90_map.csv, ..., rows of x [m], y [m], heading [rad], field [nT].
    """
    from magtwin.field.survey.nodes import write_survey
    from magtwin.io.map_files import open_map

    out = named(out, force=force)
    files = write_survey(open_map(file), out, force=force)
    again = ("magtwin", "map", "import", out, "--out", f"{out.name}.usdc")
    return Done(wrote=tuple(files), next=(again,))


@map_app.command(name="occupancy")
def map_occupancy(
    scene: Scene, *, out: Path, resolution_m: float | None = None, force: Force = False
) -> Done:
    """Write walls, furniture and floor of a scene as an occupancy grid, for nav2's map_server.

    Occupied is where a simulated robot stops. The floor is free, and what is beyond it is unknown.

    Parameters
    ----------
    out
        File to write (.yaml). The picture (.pgm) is written beside it.
    resolution_m
        Side of a cell [m]. Default: 0.05, or more where that gives over a million cells.
    """
    from magtwin.path.occupancy import occupancy_of
    from magtwin.twin import open_twin, room_of

    out = named(out, (".yaml",), "a map of map_server", beside=(".pgm",), force=force)
    step("Opening the scene")
    grid = occupancy_of(room_of(open_twin(scene, magnetometer="map-only")), resolution_m=resolution_m)
    wrote = grid.save(out, force=force)
    rows, columns = grid.cells.shape
    data = {"columns": columns, "rows": rows}
    data |= {"resolution_m": grid.resolution_m, "origin_m": list(grid.origin_m)}
    return Done(lines=str(grid).splitlines(), data=data, wrote=wrote)
