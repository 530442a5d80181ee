"""A program may open a stage with bare pxr before it imports magtwin; USD then does not know our schemas."""

import hashlib
import subprocess
import sys
from pathlib import Path

import pytest

OURS = "import magtwin.usd\n"
"""USD knows the schemas before it is used."""

BARE = "from pxr import Usd\nUsd.Stage.CreateInMemory().DefinePrim('/World', 'Xform')\n"
"""USD is used without the schemas, as in a script for Kit or Isaac Sim."""

USERS = """
import sys
from pathlib import Path

from pxr import Sdf, Usd, UsdGeom

import magtwin as mt
from magtwin.twin.maps import survey_scene
from magtwin.spec.plant import PlantSpec
from magtwin.spec.sensors import MocapSpec
from magtwin.usd import sensors
from magtwin.usd.info import info_of_stage
from magtwin.usd.schema import prims_with
from magtwin.usd.schema.versions import unknown_properties

mt.new_scene("room.toml")
toml = Path("room.toml")
toml.write_text(toml.read_text().replace("readings = 135", "readings = 1").replace("0.25 ", "0.5 "))
stage = mt.author_scene(toml, "room")
print(mt.open_twin(stage).scene)
run = mt.simulate(stage, "figure8", duration_s=2)
run.save("run.csv")
run.save("run.usdc")
print(info_of_stage(stage))

latest = mt.load_map("room/map/room.map.usdc")
mt.save_map(latest, "one.usdc")
print(mt.load_map("one.usdc"))
survey_scene(stage, "room/again.usdc", adopt=True, headings_rad=[0.0], readings=1, spacing_m=0.5)
print(mt.open_twin(stage).scene.map_sha256)

bare = Usd.Stage.CreateNew("bare.usda")
robot = UsdGeom.Xform.Define(bare, "/robot").GetPrim()
sensors.define_on_root(robot, "plant", PlantSpec(motor_abs_nt_nm=(1.0, 2.0, 3.0)))
sensors.define_on_root(robot, "mocap", MocapSpec())
sensors.define_footprint(robot, 0.2)
bare.Save()
print(*(sensors.read_on_root(robot, noun) for noun in ("plant", "mocap")), repr(sensors.read_path(robot)))
older = Path("bare.usda").read_text().replace("motorAbsNtPerNm", "motorAbsNtNm")
Path("older.usda").write_text(older)
print(unknown_properties(Sdf.Layer.FindOrOpen("older.usda")))

# As an editor leaves it that does not know the schemas: without any value that is the fallback.
gone = []
lean = Sdf.Layer.OpenAsAnonymous("room/robots/turtlebot4/turtlebot4.usda")
def look(path):
    if path.IsPropertyPath() and path.name.startswith(("magtwin:imu:", "magtwin:battery:", "magtwin:lidar:")):
        gone.append(lean.GetPropertyAtPath(path))
lean.Traverse(Sdf.Path.absoluteRootPath, look)
for spec in gone:
    spec.owner.RemoveProperty(spec)
lean.Export("room/robots/turtlebot4/lean.usda")
print(len(gone) > 20)
stripped = Usd.Stage.Open("room/robots/turtlebot4/lean.usda")
robot = stripped.GetDefaultPrim()
for noun in ("imu", "lidar", "battery"):
    print([getattr(sensors, f"read_{noun}")(prim) for prim in prims_with(robot, noun)])

for out in ("export", "export.glb", "export.usdc"):
    mt.export_scene(stage, out)
print([(finding.rule, finding.text) for check in mt.validate(stage).checks for finding in check.findings])
mt.from_urdf(sys.argv[1], "cart")
print(bool(Usd.SchemaRegistry().FindAppliedAPIPrimDefinition("MagtwinLabAPI")), file=sys.stderr)
"""


def files_of(folder: Path) -> dict[str, str]:
    """SHA-256 of every file below a folder."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def done(first: str, folder: Path) -> tuple[dict[str, str], str, str]:
    """The files and texts of every use of the schemas, and whether USD knew them, in a process of its own."""
    urdf = Path(__file__).resolve().parents[1] / "data" / "robots" / "cart.urdf"
    work = folder / "work"  # one name for both, as outputs may have it in their metadata
    work.mkdir()
    command = [sys.executable, "-c", first + USERS, str(urdf)]
    result = subprocess.run(command, cwd=work, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    work.rename(kept := folder / hashlib.sha256(first.encode()).hexdigest())
    return files_of(kept), result.stdout, result.stderr.splitlines()[-1]


@pytest.mark.slow
def test_every_use_of_the_schemas_gives_the_same_bytes_whether_usd_knows_them_or_not(tmp_path):
    files, texts, known = done(OURS, tmp_path)
    bare_files, bare_texts, bare_known = done(BARE, tmp_path)
    assert (known, bare_known) == ("True", "False")
    assert bare_files == files
    assert bare_texts == texts


def test_a_stage_may_be_opened_between_the_import_of_magtwin_and_its_use():
    use = "run = mt.simulate('lab', 'figure8', duration_s=2)\nprint(len(run['t']) > 200)"
    command = [sys.executable, "-c", f"import magtwin as mt\n{BARE}{use}"]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == "True\n"
