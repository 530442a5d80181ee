"""Seeds: the smallest file of each format, written by magtwin or in its place, and how each is read.

A seed is a folder. One file of it is damaged, the others stay as they are.
"""

import contextlib
import importlib
import io
import json
import shutil
import sys
import types
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

TEXTS = Path(__file__).with_name("texts")
"""Files of text that seeds begin from."""

NAMES = ("x.xacro", "cart.urdf", "controllers.yaml", "robot.toml", "room.toml", "suite.toml", "stage.usda")
XACRO, URDF, CONTROLLERS, ROBOT, SCENE, SUITE, STAGE, OBJ = (
    (TEXTS / name).read_text(encoding="utf-8") for name in (*NAMES, "m.obj")
)
MTL = "newmtl red\nKd 1 0 0\nd 0.5\nmap_Kd t.png\n"


def call(name: str, /, *arguments: Any, **options: Any) -> Any:
    """Call "module:function" of magtwin."""
    module, _, function = name.partition(":")
    return getattr(importlib.import_module(f"magtwin.{module}"), function)(*arguments, **options)


def _run(rows: int = 8) -> Any:
    from magtwin.run.run import Column, Run

    t, level = np.arange(rows) * 0.1, np.tile([0.0, 0.0, 0.0, 1.0], (rows, 1))
    columns = {
        "t": t,
        "b_total_nt": 5e4 + t,
        "b_measured_nt": 5e4 + 10 * t,
        "p_world_base": np.column_stack([t, t / 2, 0 * t]),
        "q_world_base_xyzw": level,
        "yaw": 0 * t,
        "lidar_on": t > 0.3,
        "battery_v": 15 + t,
        "battery_a": t,
        "battery_fraction": 1 - t,
        "mocap_p": np.column_stack([t, t / 2, 0 * t]),
        "mocap_q_xyzw": level,
        "imu_q_xyzw": level,
        **{name: np.column_stack([t, t, 0 * t]) for name in ("odom_v", "odom_w", "imu_w", "imu_a")},
        "volts": t.astype(np.float32),
    }
    return Run(columns, {"scene": "lab", "seed": 1}, {"volts": Column("V", "", "a voltage")})


def _map(name: str = "hills") -> Any:
    from magtwin.field.maps.map import AnomalyMap

    values = 41e3 + 1.0 * np.arange(48).reshape(4, 3, 4) ** 2
    return AnomalyMap(
        values_nt=values,
        origin_m=(-1.5, -1.0),
        cell_m=(1.0, 1.0),
        headings_rad=np.radians([0.0, 90.0, 180.0, 270.0]),
        variance_nt2=np.full(values.shape, 4.0),
        name=name,
    )


def _saved_run(file: Path) -> None:
    _run().save(file)


def _db3(file: Path) -> None:
    sys.path.append(str(Path(__file__).resolve().parents[1]))
    from recordings import as_db3

    whole = file.with_name("whole.mcap")
    _saved_run(whole)
    as_db3(whole, file)
    whole.unlink()


def _plain_bag(file: Path) -> None:
    """A bag without compression and checksums, whose messages a change reaches."""
    from mcap.reader import make_reader
    from mcap.writer import CompressionType, Writer

    whole = file.with_name("whole.mcap")
    _saved_run(whole)
    with whole.open("rb") as source, file.open("wb") as out:
        reader = make_reader(source)
        writer = Writer(out, compression=CompressionType.NONE, enable_crcs=False, use_statistics=False)
        writer.start(reader.get_header().profile)
        summary = reader.get_summary()
        schemas = {
            number: writer.register_schema(schema.name, schema.encoding, schema.data)
            for number, schema in sorted(summary.schemas.items())
        }
        channels = {
            number: writer.register_channel(
                channel.topic, channel.message_encoding, schemas[channel.schema_id], channel.metadata
            )
            for number, channel in sorted(summary.channels.items())
        }
        for about in reader.iter_metadata():
            writer.add_metadata(about.name, about.metadata)
        for _, channel, message in reader.iter_messages():
            writer.add_message(
                channels[channel.id], message.log_time, message.data, message.publish_time, message.sequence
            )
        writer.finish()
    whole.unlink()


def _bag_folder(file: Path) -> None:
    _run().save(file.parent.parent / "bag")
    for path in (file.parent.parent / "bag").iterdir():
        shutil.move(path, file.parent / path.name)
    (file.parent.parent / "bag").rmdir()


def _stage(file: Path) -> None:
    from pxr import Sdf

    layer = Sdf.Layer.CreateAnonymous(".usda")
    layer.ImportFromString(STAGE)
    layer.Export(str(file))
    _picture(file.with_name("t.png"))


def _package(file: Path) -> None:
    _stage(file.with_name("s.usda"))
    call("export.usdz:pack", file.with_name("s.usda"), file)
    file.with_name("s.usda").unlink()


def _map_layer(file: Path) -> None:
    if file.suffix == ".usda":
        from pxr import Sdf

        call("usd.maps.layer:save_map", _map(), file.with_suffix(".usdc"))
        Sdf.Layer.FindOrOpen(str(file.with_suffix(".usdc"))).Export(str(file))
        file.with_suffix(".usdc").unlink()
    else:
        call("usd.maps.layer:save_map", _map(), file)


def _robot(file: Path) -> None:
    _urdf(file.with_name("cart.urdf"))
    file.with_name("robot.toml").write_text(ROBOT)
    options = call("urdf.options:Options", single_file=True)
    call(
        "author.robot:build_robot",
        file.with_name("cart.urdf"),
        file.with_name("robot.toml"),
        file,
        options=options,
    )
    file.with_name("robot.toml").unlink()


def _urdf(file: Path) -> None:
    file.write_text(URDF)
    _mesh(file.with_name("m.stl"))
    file.with_name("c.yaml").write_text(CONTROLLERS)


def _scene_toml(file: Path) -> None:
    _robot(file.with_name("cart.usda"))
    _map_layer(file.with_name("map.usdc"))
    file.write_text(SCENE)


def _scene(file: Path) -> None:
    """The folder of a scene; `file` is one of its layers."""
    workshop = file.parent / "workshop"
    workshop.mkdir()
    _scene_toml(workshop / "room.toml")
    made = call("author.scene_file:scene_from_toml", workshop / "room.toml", workshop=workshop)
    call("author.scene:author_scene", made, file.parent / "room")
    for path in (file.parent / "room").iterdir():
        shutil.move(path, file.parent / path.name)
    shutil.rmtree(workshop)
    (file.parent / "room").rmdir()


def _mesh(file: Path) -> None:
    import trimesh

    if file.stem == "triangle":
        shape = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], process=False)
    else:
        shape = trimesh.creation.box()
    shape.visual.vertex_colors = [200, 10, 10, 255]
    if file.suffix == ".gltf":
        for name, data in shape.export(file_type="gltf").items():
            (file if name.endswith(".gltf") else file.with_name(name)).write_bytes(data)
    else:
        kind = {"ascii": "stl_ascii"}.get(file.stem, file.suffix[1:])
        data = shape.export(file_type=kind)
        file.write_bytes(data.encode() if isinstance(data, str) else data)


def _textured(file: Path) -> None:
    """A mesh with its material and texture; `file` is one of them."""
    (file.parent / "m.obj").write_text(OBJ)
    texture = f"t{file.suffix}" if file.stem == "t" else "t.png"
    (file.parent / "m.mtl").write_text(MTL.replace("t.png", texture))
    _picture(file.parent / texture)


def _picture(file: Path) -> None:
    from PIL import Image

    Image.new("RGB", (5, 4), (200, 10, 10)).save(file)


def _readings(file: Path) -> None:
    call(
        "field.survey.saved:save_readings",
        call("io.surveys.readings:readings_of_run", _run(), name="drive"),
        file,
    )


def _table(file: Path) -> None:
    rows = "".join(f"{x},{y},{h},{50000 + x}\n" for x in range(3) for y in range(3) for h in (0, 1.5))
    file.write_text(f"x,y,theta,b\n{rows}")


def _survey(file: Path) -> None:
    folder = file.parent / "survey"
    call("field.survey.nodes:write_survey", _map(), folder)
    for path in folder.iterdir():
        shutil.move(path, file.parent / path.name)
    folder.rmdir()


def _recording(file: Path) -> None:
    from magtwin.io.release import _SIZES

    frame: dict[str, Any] = {key: 1.0 if size == 1 else [0.5] * size for key, size in _SIZES.items()}
    frame |= {"nn_magnetic_magnitude": 45000.0, "timestamp": 1.5}
    file.write_text(json.dumps([frame, frame | {"timestamp": 1.6}]))


def _checkpoint(file: Path) -> None:
    import torch

    home = "sklearn.preprocessing._data"
    kind = type("StandardScaler", (), {"__module__": home})
    modules = {name: types.ModuleType(name) for name in ("sklearn", "sklearn.preprocessing", home)}
    modules[home].StandardScaler = kind

    def scaler(mean: Any, scale: Any) -> Any:
        made = kind()
        made.mean_, made.scale_, made.n_samples_seen_ = (
            np.array(mean, float),
            np.array(scale, float),
            np.int64(7),
        )
        return made

    torch.manual_seed(0)
    state = {
        "a.weight": torch.randn(4, 20),
        "a.bias": torch.randn(4),
        "b.weight": torch.randn(1, 4),
        "b.bias": torch.randn(1),
    }
    held = {
        "model_state_dict": state,
        "scaler_X": scaler(np.arange(20), np.ones(20)),
        "scaler_y": scaler([3.0], [5.0]),
    }
    with mock.patch.dict(sys.modules, modules):
        torch.save(held, file)


def _network(file: Path) -> None:
    from magtwin.files.file import shipped

    if file.stem == "net":  # a small perceptron
        _checkpoint(file.with_suffix(".pth"))
        call("learn.models.network:convert", file.with_suffix(".pth"), file)
        file.with_suffix(".pth").unlink()
    else:
        shutil.copyfile(shipped("weights", "turtlebot4_hybrid.safetensors"), file)


def _onnx(file: Path) -> None:
    _network(file.with_name("net.safetensors"))
    call("learn.inference.onnx:export_onnx", file.with_name("net.safetensors"), file)
    file.with_name("net.safetensors").unlink()


def _tolles_lawson(file: Path) -> None:
    from magtwin.learn.compensation.tolles_lawson import TollesLawson

    TollesLawson(("permanent",), (1.0, 2.0, 3.0), (0.1, 0.9), 0.0, 1.5).save(file)


def _dataset(file: Path) -> None:
    """A data set; `file` is its manifest."""
    root = file.parent
    call("learn.data.dataset:build_dataset", {"a": _run(40)}, _map(), root / "set")
    for path in (root / "set").iterdir():
        shutil.move(path, root / path.name)
    (root / "set").rmdir()


def _magnetic_data(file: Path) -> None:
    rows = range(12)
    (file.parent / "1-time.csv").write_text("".join(f"{0.1 * i}\n" for i in rows))
    (file.parent / "1-loc.csv").write_text("".join(f"{0.1 * i},0\n" for i in rows))
    (file.parent / "1-mag.csv").write_text("".join(f"20,{i},-40\n" for i in rows))


def _matlab(file: Path) -> None:
    from scipy.io import savemat

    n = 6
    q = np.tile([[1.0], [0], [0], [0]], n)
    held = {"p": np.arange(3 * n).reshape(3, n) * 0.1, "q": q, "p_0": np.zeros((3, 1)), "q_0": q[:, :1]}
    savemat(file, {**held, "T": 0.1, "y_mag": np.ones((3, n))})


def text(content: str) -> Callable[[Path], object]:
    """A writer of a text."""
    return lambda file: file.write_text(content)


# Readers: as a command reads the file.


def _read_run(file: Path) -> None:
    run = call("io.formats:read_run", file)
    json.dumps(str(run.report("x")))
    call("io.info:info_of", file)


def _read_survey_bag(file: Path) -> None:
    call("io.surveys.readings:read_readings", file, field_topic="/robot/qtfm/magnitude")


def _read_recorded(file: Path) -> None:
    """As a robot's own recording."""
    call("io.formats:read_run", file, topics={"/robot/qtfm/magnitude": "/robot/qtfm/magnitude"})


def _read_stage(file: Path) -> None:
    call("usd.info:info_of_stage", file)
    for name in ("usd.geometry:read_shapes", "usd.geometry:read_links", "usd.lab.obstacles:read_obstacles"):
        _refusable(name, file)
    _refusable("export.glb:write_glb", file, file.with_suffix(".out.glb"))


def _refusable(name: str, *arguments: Any, **options: Any) -> Any:
    """A call whose refusal does not end the reading; a refusal of several lines does."""
    from magtwin.errors import InputError

    try:
        return call(name, *arguments, **options)
    except InputError as error:
        if "\n" in str(error):
            raise


def _read_package(file: Path) -> None:
    call("usd.info:info_of_stage", file)
    folder = file.parent / "unpacked"
    folder.mkdir()
    call("export.usdz:unpack", file, folder)


def _read_map(file: Path) -> None:
    field = call("usd.maps.layer:load_map", file)
    str(field.report())
    field.lookup(np.zeros((1, 2)), np.zeros(1))


def _read_robot(file: Path) -> None:
    call("usd.robot:load_robot", file)
    _refusable("urdf.write:write_urdf", file, file.with_name("out.urdf"))
    call("usd.robot:read_notes", file)


def _read_scene(file: Path) -> None:
    root = file.with_name("room.usda")
    call("usd.scene:open_scene", root)
    _refusable("usd.info:info_of_stage", root)
    call("usd.lab.obstacles:read_obstacles", root)
    _refusable("twin:open_twin", root)


def _read_xacro(file: Path) -> None:
    call("urdf.source.source:read_source", file.with_name("x.xacro"))


def _read_urdf(file: Path) -> None:
    call("urdf.convert:convert_with_report", file, file.with_name("out.usda"))


def _read_controllers(file: Path) -> None:
    options = call("urdf.options:Options", controllers=file, profile="diff-drive")
    call(
        "urdf.convert:convert_with_report",
        file.with_name("x.urdf"),
        file.with_name("out.usda"),
        options=options,
    )


def _read_scene_toml(file: Path) -> None:
    call("author.scene_file:scene_from_toml", file, workshop=file.parent)


def _read_dataset(file: Path) -> None:
    made = call("learn.data.dataset:open_dataset", file.parent)
    str(made.report())
    made.check()
    for _ in made.runs():
        pass
    made.rows(("odom_v_x",)) if "odom_v" in made.columns else None


def _read_tolles_lawson(file: Path) -> None:
    from magtwin.learn.compensation.tolles_lawson import TollesLawson

    TollesLawson.load(file).report("x")


def _reads(*names: str, folder: bool = False, **options: Any) -> Callable[[Path], None]:
    def read(file: Path) -> None:
        for name in names:
            made = call(name, file.parent if folder else file, **options)
            for _ in made if isinstance(made, types.GeneratorType) else ():
                pass
            if hasattr(made, "report"):
                with contextlib.suppress(TypeError):  # some need a title
                    str(made.report())

    return read


@dataclass(frozen=True)
class Format:
    """A format that is fuzzed."""

    file: str
    """The file that is damaged, in the seed's folder."""

    write: Callable[[Path], object]
    """Writes it, and the files beside it."""

    read: Callable[[Path], object]
    """Reads it, as a command does."""

    slow: bool = field(default=False, kw_only=True)
    """Whether a read takes a process or more than 50 ms; such formats get fewer inputs."""


_MESH = _reads("urdf.meshes.mesh:read_mesh")
_OBJ: Callable[[Path], object] = lambda file: call("urdf.meshes.mesh:read_mesh", file.with_name("m.obj"))  # noqa: E731
_NETWORK = _reads("learn.models.predictor:load_predictor", "io.info:info_of")
_READINGS = _reads("io.surveys.readings:read_readings")

FORMATS: Mapping[str, Format] = {
    **{kind: Format(f"x.{kind}", _saved_run, _read_run) for kind in ("npz", "parquet", "csv", "mcap")},
    "db3": Format("x.db3", _db3, _read_run),
    "rrd": Format("x.rrd", _saved_run, _read_run, slow=True),
    "bag": Format("plain.mcap", _plain_bag, _read_run),
    "bag-folder": Format("metadata.yaml", _bag_folder, lambda file: _read_run(file.parent)),
    "bag-survey": Format("plain.mcap", _plain_bag, _read_survey_bag),
    "recorded": Format("plain.mcap", _plain_bag, _read_recorded),
    "animation": Format("x.usda", _saved_run, _read_run),
    "release": Format("x.json", _recording, _reads("io.release:read_release")),
    "usda": Format("x.usda", _stage, _read_stage),
    "usdc": Format("x.usdc", _stage, _read_stage),
    "usdz": Format("x.usdz", _package, _read_package),
    "map": Format("x.usdc", _map_layer, _read_map),
    "map-text": Format("x.usda", _map_layer, _read_map),
    "robot": Format("cart.usda", _robot, _read_robot, slow=True),
    "scene": Format("room.usda", _scene, _read_scene, slow=True),
    "scene-magnetics": Format("magnetics.usda", _scene, _read_scene, slow=True),
    "ply": Format("x.ply", _mesh, _MESH),
    "stl": Format("x.stl", _mesh, _MESH),
    "stl-text": Format("ascii.stl", _mesh, _MESH),
    "glb": Format("x.glb", _mesh, _MESH),
    "gltf": Format("triangle.gltf", _mesh, _MESH),
    "dae": Format("triangle.dae", _mesh, _MESH),
    "obj": Format("m.obj", _textured, _OBJ),
    "mtl": Format("m.mtl", _textured, _OBJ),
    **{
        kind: Format(f"t.{kind}", _textured, _OBJ)
        for kind in ("png", "jpg", "bmp", "tga", "tiff", "gif", "webp")
    },
    "urdf": Format("x.urdf", _urdf, _read_urdf, slow=True),
    "xacro": Format(
        "x.xacro",
        lambda file: (text(XACRO)(file), text("a: 1\nb: !degrees 3\n")(file.with_name("s.yaml"))),
        _read_xacro,
    ),
    "xacro-yaml": Format(
        "s.yaml",
        lambda file: (text("a: 1\nb: [!degrees 3]\n")(file), text(XACRO)(file.with_name("x.xacro"))),
        _read_xacro,
    ),
    "controllers": Format(
        "c.yaml", lambda file: _urdf(file.with_name("x.urdf")), _read_controllers, slow=True
    ),
    "robot-toml": Format("robot.toml", text(ROBOT), _reads("author.robot:read_settings")),
    "scene-toml": Format("room.toml", _scene_toml, _read_scene_toml, slow=True),
    "suite": Format("suite.toml", text(SUITE), _reads("bench.suite:load_suite")),
    "survey": Format("0_map.csv", _survey, _reads("field.survey.nodes:read_survey", folder=True)),
    "table": Format("x.csv", _table, _READINGS),
    "readings": Format("x.parquet", _readings, _READINGS),
    "path": Format("x.csv", text("x,y\n0,0\n1,0\n1,1\n"), _reads("path.points:read_path_csv")),
    "commands": Format(
        "x.csv", text("t,v,w\n0,0.1,0\n1,0.2,0.1\n"), _reads("sim.motion.commands:read_commands")
    ),
    "safetensors": Format("net.safetensors", _network, _NETWORK),
    "hybrid": Format("hybrid.safetensors", _network, _NETWORK),
    "pth": Format("x.pth", _checkpoint, _NETWORK),
    "onnx": Format("x.onnx", _onnx, _reads("learn.inference.onnx:report_onnx")),
    "tolles-lawson": Format("x.json", _tolles_lawson, _read_tolles_lawson),
    "dataset": Format("dataset.json", _dataset, _read_dataset),
    "magnetic-data": Format(
        "1-loc.csv", _magnetic_data, _reads("bench.magnetic_data:read_recording", folder=True, number=1)
    ),
    "matlab": Format(
        "Aligned_SquareLoop_1.mat", _matlab, _reads("bench.magslam:ship_case", folder=True, loop=1, seed=1)
    ),
}
"""Formats by name: every kind of file that a command, a stage or a robot's description may name."""


@dataclass(frozen=True)
class Seed:
    """A whole file of a format, and the files beside it."""

    data: bytes
    beside: Mapping[str, bytes]


def seed(kind: str, folder: Path) -> Seed:
    """The seed of a format, written into an empty folder."""
    chosen = FORMATS[kind]
    file = folder / chosen.file
    file.parent.mkdir(parents=True, exist_ok=True)
    chosen.write(file)
    files = {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}
    return Seed(files.pop(chosen.file), files)


def read(kind: str, data: bytes, beside: Mapping[str, bytes], folder: Path) -> None:
    """Read a file of a format as a user would, in a folder that is made."""
    for name, content in {**beside, FORMATS[kind].file: data}.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    FORMATS[kind].read(folder / FORMATS[kind].file)


def members(data: bytes, sound: bool) -> tuple[list[bytes], Callable[[int, bytes], bytes]] | None:
    """Parts of a container that a change of its bytes would not reach, and how to replace one.

    Members of zips, the JSON of safetensors and GLB, and columns and metadata of Parquet files if `sound`;
    checksums and lengths are then right.
    """
    if data.startswith(b"PAR1"):
        return _columns(data) if sound else None
    if data[:4] == b"PK\x03\x04":
        try:
            with zipfile.ZipFile(io.BytesIO(data)) as archive:
                parts = [(info, archive.read(info)) for info in archive.infolist()]
        except Exception:
            return None

        def packed(at: int, part: bytes) -> bytes:
            out = io.BytesIO()
            with zipfile.ZipFile(out, "w") as archive:
                for i, (info, old) in enumerate(parts):
                    copy = zipfile.ZipInfo(info.filename, info.date_time)
                    copy.extra, copy.compress_type = info.extra, info.compress_type
                    archive.writestr(copy, part if i == at else old)
            return out.getvalue()

        return [part for _, part in parts], packed
    glb = data[:4] == b"glTF"
    start, width = (20, 4) if glb else (8, 8)
    size = int.from_bytes(data[start - width - 4 * glb : start - 4 * glb], "little")
    if data[start : start + 1] != b"{" or not 0 < size <= len(data) - start:
        return None

    def joined(at: int, part: bytes) -> bytes:
        part += b" " * (-len(part) % 4)
        rest = data[start + size :]
        if glb:
            total = start + len(part) + len(rest)
            return (
                data[:8]
                + total.to_bytes(4, "little")
                + len(part).to_bytes(4, "little")
                + data[16:20]
                + part
                + rest
            )
        return len(part).to_bytes(8, "little") + part + rest

    return [data[start : start + size]], joined


def _columns(data: bytes) -> tuple[list[bytes], Callable[[int, bytes], bytes]]:
    """The values of the columns of numbers of a Parquet file, its texts, and its metadata."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pq.read_table(io.BytesIO(data), use_threads=False)
    about = sorted((table.schema.metadata or {}).items())
    whole = [column.combine_chunks() for column in table.columns]
    rows = [isinstance(column, pa.FixedSizeListArray) for column in whole]
    flat = [column.flatten() if listed else column for column, listed in zip(whole, rows, strict=True)]
    numbers = [i for i, column in enumerate(flat) if pa.types.is_primitive(column.type)]
    places = [(i, k) for i in numbers for k, part in enumerate(flat[i].buffers()) if part and len(flat[i])]
    parts = [flat[i].buffers()[k].to_pybytes() for i, k in places]
    texts = [i for i, column in enumerate(whole) if pa.types.is_string(column.type)]
    words = [json.dumps(whole[i].to_pylist()).encode() for i in texts]

    def packed(at: int, part: bytes) -> bytes:
        columns, metadata = list(whole), dict(about)
        if at < len(parts):
            i, k = places[at]
            size, buffers = len(parts[at]), flat[i].buffers()
            buffers[k] = pa.py_buffer(part[:size].ljust(size, b"\0"))
            columns[i] = pa.Array.from_buffers(flat[i].type, len(flat[i]), buffers)
            if rows[i]:
                columns[i] = pa.FixedSizeListArray.from_arrays(columns[i], type=whole[i].type)
        elif at < len(parts) + len(texts):
            i = texts[at - len(parts)]
            columns[i] = pa.array(json.loads(part), whole[i].type)
        else:
            metadata[about[at - len(parts) - len(texts)][0]] = part
        out = io.BytesIO()
        pq.write_table(pa.Table.from_arrays(columns, schema=table.schema.with_metadata(metadata)), out)
        return out.getvalue()

    return [*parts, *words, *(value for _, value in about)], packed
