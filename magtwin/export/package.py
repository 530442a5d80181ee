"""Export a stage with all that it needs: as a folder, a .usdz, a layer or a .glb."""

import json
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from shlex import quote
from tempfile import TemporaryDirectory
from typing import Literal

from jinja2 import Environment
from pxr import Sdf, UsdGeom, UsdUtils

from magtwin.errors import InputError, find
from magtwin.export.contents import THUMBNAIL, bring_together, copied, kind_of, weights_metadata
from magtwin.export.flatten import flatten
from magtwin.export.glb import write_glb
from magtwin.export.isaac import GRAPHS, author_graph
from magtwin.export.structure import structure
from magtwin.export.usdz import pack, unpack
from magtwin.export.validation.inspection import inspect
from magtwin.files.file import existing, sha256
from magtwin.files.folders import allow
from magtwin.files.outputs import check_free, output, transaction
from magtwin.report.report import Figure, Report
from magtwin.report.summary import in_markdown, printable
from magtwin.run.run import Run
from magtwin.urdf.simready import UNKNOWN
from magtwin.usd.animation import write_animation
from magtwin.usd.layers import SUFFIXES, open_stage, stage_sha256
from magtwin.usd.maps.layer import read_map
from magtwin.usd.placement import labs_on
from magtwin.usd.scene import read_scene
from magtwin.usd.schema import FOLDER as SCHEMA
from magtwin.usd.schema import attribute_name, place, prims_with, value_of
from magtwin.usd.trial import check_named
from magtwin.usd.units import check_units
from magtwin.version import __version__

Profile = Literal["omniverse", "isaac", "newton", "viewer"]
PROFILES: dict[str, str] = {
    "omniverse": "the stage with its layers, variants and instances",
    "isaac": "as omniverse, with Isaac Sim's asset structure 3.0 and a ROS 2 Action Graph for each robot",
    "newton": "as omniverse, with an example that steps Newton and evaluates the network",
    "viewer": "one layer for simple viewers, without variants and instances",
}
"""Contents of each profile."""

KINDS = {"": "folder", ".usdz": "package", ".usd": "layer", ".usdc": "layer", ".glb": "web"}
"""Kind of export by the suffix of the output."""

NETWORK, NETWORK_SHA256 = (attribute_name("magnetometer", name) for name in ("network", "network_sha256"))
PLUGIN = Path("plugin", "magtwin")
GENERATED = ("plugInfo.json", "generatedSchema.usda")
"""Files of the schema plugin."""

LEFT_OUT = ("weights", "paths")
"""Kinds of files that only an export as a folder holds."""

README = "README.md"

SCRIPTS = Path(__file__).resolve().parent / "scripts"
"""Examples that need no magtwin; those whose names begin with the profile are exported with `SHARED`."""

SHARED = SCRIPTS / "magnetometer.py"


@dataclass(frozen=True)
class Exported:
    """The result of an export."""

    files: tuple[Path, ...]
    """The output, then the folder beside it, if any."""

    root: Path
    """File to open: a layer, a package or a .glb."""

    profile: str
    licences: dict[str, str]
    """Licence by file name in the export."""

    notes: tuple[str, ...] = ()
    """Warnings."""

    def report(self) -> Report:
        """The files with their sizes, profile, licences and notes."""
        figures = [Figure("profile", self.profile), Figure("opens with", str(self.root))]
        for file in self.files:
            inside = [f for f in file.rglob("*") if f.is_file()] if file.is_dir() else [file]
            size = sum(f.stat().st_size for f in inside) / 1e6
            note = f"{len(inside)} files" if file.is_dir() else ""
            figures.append(Figure(str(file), size, "MB", note=note))
        metadata = {"licences": self.licences, "notes": list(self.notes)}
        return Report(str(self.files[0]), tuple(figures), {k: v for k, v in metadata.items() if v})


def export_scene(
    scene_file: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    profile: Profile | None = None,
    animation: Run | None = None,
    to_onnx: Callable[[Path, Path], object] | None = None,
    thumbnail: Callable[[Path, Path], object] | None = None,
    trusted: bool = False,
    force: bool = False,
    progress: Callable[[str], object] = lambda step: None,
) -> Exported:
    """Write a stage with everything that it needs, so that it can be moved anywhere.

    Args:
        scene_file: Root layer of a scene or of any other stage, or a .usdz.
        out: What to make: a folder (no suffix), a package .usdz, one layer .usd or .usdc, or a .glb. Beside
            a package lies a folder `<name>_magtwin` with the schema plugin, README.md and the network.
        profile: A key of `PROFILES`. Default: omniverse for folders and packages, else viewer.
        animation: A run that plays over the stage; in a folder it is a separate layer, `<name>_run.usdc`.
        to_onnx: Function f(weights file, output file) that writes the network as ONNX. If it raises
            InputError, the report of the export has a note.
        thumbnail: Function f(root layer, output file) that draws a PNG of 256 x 256 pixels. If it raises
            InputError, the report of the export has a note.
        trusted: Whether the stage is trusted. If not, another process reads all of it first, in a second.
        force: Whether to replace existing files.
        progress: Function that is called with the name of each step.

    Raises:
        InputError: The stage cannot be opened, refers to files that do not exist, does not match its
            checksums, or is not in metres with Z up; or `out` exists, or cannot hold the stage. Nothing is
            written.
    """
    scene_file, out = Path(scene_file), Path(out)
    if (kind := KINDS.get(out.suffix.lower())) is None:
        raise InputError(f"{out}: an export is a folder (no suffix), or ends in .usdz, .usd, .usdc or .glb")
    name: str = profile or ("omniverse" if kind in ("folder", "package") else "viewer")
    find("profile", name, PROFILES)
    if kind in ("layer", "web") and name != "viewer":
        raise InputError(
            f"{out}: {out.suffix} is for viewers; give a folder or a .usdz for `profile='{name}'`",
            parameter="profile",
        )
    beside = out.with_name(f"{out.stem}_magtwin") if kind == "package" and name != "viewer" else None
    if existing(scene_file, "stage").is_dir():
        inner = scene_file / f"{scene_file.resolve().name}.usda"
        raise InputError(
            f"{scene_file}: a folder; give a USD file in it{f', such as {inner}' if inner.is_file() else ''}"
        )
    for target in filter(None, (out, beside)):
        check_free(target, force=force)
        if target.resolve() in (scene_file.resolve(), *scene_file.resolve().parents):
            raise InputError(f"{target}: is or contains the exported stage; give another output")
    with TemporaryDirectory() as scratch, _renamed(Path(scratch, "stage"), scene_file), ExitStack() as own:
        work = _Work(Path(scratch, "stage"), scene_file, name, progress)
        work.gather(trusted=trusted)
        own.enter_context(allow(scratch))  # flattened layers name files beside them; work.folder moves
        work.check()
        if to_onnx is not None and name != "viewer":
            work.onnx_of(to_onnx)
        if name == "isaac":
            work.for_isaac()
        work.write_origin()
        if animation is not None:
            work.animate(animation)
        with transaction(), ExitStack() as outputs:
            aside = outputs.enter_context(output(out, force=force))
            folder = None if beside is None else outputs.enter_context(output(beside, force=force))
            progress(f"Writing the {kind}")
            if kind == "folder":
                work.whole(aside, thumbnail)
            elif kind == "package":
                work.package(aside, folder)
            elif kind == "layer":
                work.layer(aside)
            else:
                write_glb(work.run or work.root, aside)
        shown = work.run or work.root
    root = out / shown.name if kind == "folder" else out
    return Exported((out, *([beside] if beside else [])), root, name, work.licences, tuple(work.notes))


@contextmanager
def _renamed(copy: Path, scene_file: Path) -> Iterator[None]:
    """Make errors about the working copy name the original stage."""
    try:
        yield
    except InputError as error:
        there = scene_file if scene_file.suffix.lower() == ".usdz" else scene_file.parent
        text = str(error)
        for folder in (copy.with_name("package"), copy):
            for path in (folder.resolve(), folder):
                text = text.replace(f"{path}{os.sep}", f"{there}{os.sep}")
        raise InputError(text) from error


class _Work:
    """A working copy of a stage, prepared step by step."""

    def __init__(
        self, folder: Path, scene_file: Path, profile: str, progress: Callable[[str], object]
    ) -> None:
        self.folder, self.source, self.profile, self.progress = folder, scene_file, profile, progress
        self.notes: list[str] = []
        self.licences: dict[str, str] = {}
        self.run: Path | None = None
        self.plays = False
        self.onnx: list[Path] = []
        self.scripts = sorted(SCRIPTS.glob(f"{profile}_*.py"))
        self.checksum = ""

    def gather(self, *, trusted: bool) -> None:
        """Copy the stage and all that it names into the folder."""
        self.progress("Gathering files")
        self.folder.mkdir()
        if self.source.suffix.lower() == ".usdz":
            package = self.folder.with_name("package")
            package.mkdir()
            root = unpack(self.source, package)
            if not trusted:
                inspect(root, ())
            self.checksum = sha256(self.source)
            self.root = bring_together(root, self.folder, within=package)
        else:
            if not trusted:
                inspect(self.source, ())
            self.root = bring_together(self.source, self.folder)
            self.checksum = stage_sha256(self.source)
        stage = open_stage(self.root)
        check_units(stage)
        if len(labs := dict.fromkeys(lab.path for lab in labs_on(stage))) > 1:
            raise InputError(
                f"{self.source}: has the labs {', '.join(labs)}; export the stage of each by itself"
            )
        metres, up = UsdGeom.GetStageMetersPerUnit(stage), UsdGeom.GetStageUpAxis(stage)
        if UsdGeom.LinearUnitsAre(metres, UsdGeom.LinearUnits.meters) and up == UsdGeom.Tokens.z:
            return
        authored = stage.HasAuthoredMetadata("metersPerUnit") and stage.HasAuthoredMetadata("upAxis")
        raise InputError(
            f"{self.source}: has {metres:g} m a unit and {up} up{'' if authored else ', the defaults of USD'}"
            "; an export is in metres with Z up: convert the stage first, in Blender or Omniverse"
        )

    def check(self) -> None:
        """Check the scene, and map and networks against their checksums; collect licences."""
        self.progress("Checking map and network")
        stage = open_stage(self.root)
        world = stage.GetPseudoRoot()
        self.map = ""
        for prim in prims_with(world, "anomalyMap"):
            read_map(prim)
            self.map = self.map or str(prim.GetPath())
            licence = value_of(prim.GetAttribute(attribute_name("anomalyMap", "licence")))
            values = prim.GetAttribute(attribute_name("anomalyMap", "values")).GetPropertyStack()[0].layer
            self.licences[self._relative(Path(values.realPath))] = licence or UNKNOWN
        magnetometers = prims_with(world, "magnetometer")
        self.magnetometer = str(magnetometers[0].GetPath()) if magnetometers else ""
        self.networks: list[Path] = []
        for prim in magnetometers:
            named = prim.GetAttribute(NETWORK).Get()
            if not named or not named.path:
                continue
            file = check_named(self.root, Path(named.resolvedPath), place(prim))
            checksum, actual = prim.GetAttribute(NETWORK_SHA256).Get(), sha256(file)
            if checksum and checksum.lower() != actual:
                raise InputError(
                    f"{place(prim)}: its network {named.path} has SHA-256 {actual}, the stage was made with "
                    f"{checksum}; put that network back, or make the scene anew"
                )
            if file not in self.networks:
                self.networks.append(file)
                self.licences[self._relative(file)] = licence_of(file) or UNKNOWN
        for layer in stage.GetUsedLayers():
            metadata = layer.customLayerData.get("SimReady_Metadata", {})
            licence = metadata.get("asset_license") if isinstance(metadata, dict) else None
            if layer.realPath and isinstance(licence, str) and licence:
                self.licences[self._relative(Path(layer.realPath))] = licence
        self.licences = dict(sorted(self.licences.items()))
        is_scene = all(prims_with(world, noun) for noun in ("lab", "robot", "magnetometer"))
        self.scene = read_scene(self.root) if is_scene else None

    def _relative(self, file: Path) -> str:
        return file.resolve().relative_to(self.folder.resolve()).as_posix()

    def onnx_of(self, write: Callable[[Path, Path], object]) -> None:
        """Write networks as ONNX beside their weights."""
        for weights in self.networks:
            out = weights.with_suffix(".onnx")
            try:
                if not out.exists():  # a package may contain it
                    self.progress(f"Writing {weights.stem} as ONNX")
                    write(weights, out)
                self.onnx.append(out)
            except InputError as error:
                self.notes.append(f"{self._relative(weights)} has no ONNX beside it: {error}")

    def for_isaac(self) -> None:
        """Give robots Isaac Sim's asset structure, and the scene its Action Graphs."""
        if self.scene is None:
            raise InputError(
                f"{self.source}: has no lab, robot and magnetometer, which profile isaac needs; use "
                "`profile='omniverse'`"
            )
        self.progress("Authoring for Isaac Sim")
        for asset in {placed.robot.asset for placed in self.scene.robots}:
            structure(asset)
        stage = open_stage(self.root)
        author_graph(stage, self.scene)
        stage.GetRootLayer().Save()

    def write_origin(self) -> None:
        """Write source, version and licences to the metadata of the root layer."""
        layer = Sdf.Layer.FindOrOpen(str(self.root))
        origin = {
            "version": __version__,
            "profile": self.profile,
            "source": self.source.name,
            "sourceSha256": self.checksum,
            "licences": self.licences,
        }
        metadata = dict(layer.customLayerData)
        metadata["creator"] = metadata.get("creator", "magtwin")
        own = metadata.get("magtwin")
        metadata["magtwin"] = {**(own if isinstance(own, dict) else {}), "export": origin}
        layer.customLayerData = metadata
        layer.Save()

    def animate(self, run: Run) -> None:
        """Write a run over the stage."""
        self.progress("Writing the run")
        self.run, self.plays = self.root.with_name(f"{self.root.stem}_run.usdc"), True
        write_animation(run, self.run, self.root)
        layer, below = Sdf.Layer.FindOrOpen(str(self.run)), Sdf.Layer.FindOrOpen(str(self.root))
        theirs = dict(below.customLayerData)
        kept = {name: theirs[name] for name in ("magtwin", "renderSettings") if name in theirs}
        layer.customLayerData = {**dict(layer.customLayerData), **kept}  # a root layer has its own
        layer.Save()

    def flat(self) -> None:
        """Replace the stage by one layer and the files that it names."""
        self.progress("Flattening the stage")
        flat = self.folder.with_name("flat") / f"{self.source.stem}.usdc"
        flat.parent.mkdir()
        flatten(self.run or self.root, flat)
        self.folder = self.folder.with_name("viewer")
        self.folder.mkdir()
        self.root, self.run = bring_together(flat, self.folder), None

    def leave_out(self) -> None:
        """Remove networks and paths, and empty their names: neither a package nor a layer may hold them."""
        files = [file for file in self.folder.rglob("*") if file.is_file()]
        for file in files:
            if file.suffix.lower() in SUFFIXES:
                layer = Sdf.Layer.FindOrOpen(str(file))
                UsdUtils.ModifyAssetPaths(layer, lambda name: "" if kind_of(name) in LEFT_OUT else name)
                if layer.dirty:
                    layer.Save()
            elif kind_of(file) in LEFT_OUT:
                file.unlink()

    def layer(self, out: Path) -> None:
        """Write one layer."""
        self.leave_out()
        self.flat()
        for file in self.folder.rglob("*"):
            if file.is_file() and file != self.root:
                raise InputError(
                    f"{self.source}: {self._relative(file)} cannot be part of a layer; "
                    "give a folder or a .usdz"
                )
        if out.suffix.lower() == ".usd":
            self.root = self.root.rename(self.root.with_suffix(".usd"))
        shutil.move(self.root, out)

    def package(self, out: Path, beside: Path | None) -> None:
        """Write a package, and the folder beside it."""
        if beside is not None:
            beside.mkdir()
            for file in [*self.networks, *self.onnx]:
                copied(file, beside / "weights" / file.name)
            self._write_readme(beside, out.name, packed=True)
        self.leave_out()
        if self.profile == "viewer":
            self.flat()
        pack(self.run or self.root, out)

    def whole(self, out: Path, thumbnail: Callable[[Path, Path], object] | None) -> None:
        """Write a folder."""
        if self.profile == "viewer":
            self.flat()
        self._write_readme(self.folder, self.root.name, packed=False)
        shutil.move(self.folder, out)
        if thumbnail is not None:
            self.progress("Drawing its thumbnail")
            picture = out / THUMBNAIL / f"{self.root.name}.png"
            picture.parent.mkdir(parents=True, exist_ok=True)
            picture.unlink(missing_ok=True)  # an old one
            try:
                thumbnail(out / self.root.name, picture)
            except InputError as error:  # nothing to draw, or no renderer
                self.notes.append(f"no thumbnail was drawn: {str(error).replace(f'{out}{os.sep}', '')}")
                if not any(picture.parent.iterdir()):
                    shutil.rmtree(picture.parents[1])

    def _write_readme(self, folder: Path, root: str, *, packed: bool) -> None:
        """Write the README page and the schema plugin to a folder."""
        viewer = self.profile == "viewer"
        run = root if packed or self.run is None else self.run.name  # file that plays the run
        if not viewer:
            for name in GENERATED:
                copied(SCHEMA / name, folder / PLUGIN / name)
        text = Path(__file__).with_name("readme.md.jinja").read_text(encoding="utf-8")
        pages = Environment(trim_blocks=True, finalize=lambda value: printable(value).replace("`", "'"))
        pages.filters["marked"] = in_markdown
        template = pages.from_string(text)
        page = template.render(
            name=self.source.stem,
            version=__version__,
            root=root,
            run=run if self.plays else "",
            flat=viewer,
            plugin=not viewer,
            map=self.map,
            magnetometer=self.magnetometer if self.networks else "",
            packed=packed,
            graphs=str(GRAPHS) if self.profile == "isaac" else "",
            source=self.source.name,
            checksum=self.checksum,
            licences=self.licences,
            scripts=[script.name for script in self.scripts],
            stage=quote(f"../{root}" if packed else root),
            onnx=quote(self._relative(self.onnx[0]) if self.onnx else "NETWORK.onnx"),
            notes=self.notes,
        )
        (folder / README).write_text(page, encoding="utf-8")
        for script in (*self.scripts, SHARED) if self.scripts else ():
            copied(script, folder / script.name)


def licence_of(network: Path) -> str:
    """The licence in the metadata of a network's weights; "" if there is none."""
    try:
        return str(json.loads(weights_metadata(network)["magtwin"])["facts"].get("licence", ""))
    except (ValueError, KeyError, TypeError, AttributeError):
        return ""
