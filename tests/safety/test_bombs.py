"""Bombs: tiny files that would become large, or would not end, are refused before they are decoded."""

import importlib
import io
import os
import pickle
import resource
import sqlite3
import struct
import zipfile
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from one_triangle import glb

from magtwin.errors import InputError
from magtwin.export import usdz as usdz_format
from magtwin.files import budget
from magtwin.files.file import read_text
from magtwin.files.settings import read_toml
from magtwin.io.bags.bag import Bag
from magtwin.io.formats import read_run
from magtwin.learn.compensation.tolles_lawson import TollesLawson
from magtwin.urdf.meshes.mesh import read_mesh
from magtwin.urdf.source.settings import read_settings
from magtwin.urdf.source.source import read_source
from magtwin.usd import trial
from magtwin.usd.layers import open_stage

MOST = 300_000_000
"""Memory that a refusal may take [bytes]."""

ROOM = 8_000_000_000
"""Addresses that it may take: libraries that are loaded meanwhile reserve more than they use [bytes]."""

SPARE = 50_000_000
"""What a file of these tests may become, beside 4 times its size [bytes]."""


def npz(path, shape, data=0):
    """An npz of one array `t`, whose header claims a shape."""
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, {"descr": "<f8", "fortran_order": False, "shape": shape})
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("t.npy", head.getvalue() + bytes(data))


def parquet(path):
    """40 columns of 500,000 equal numbers: 160 MB."""
    one = pa.array(np.zeros(100_000))
    table = pa.table({f"c{i}": one for i in range(40)})
    with pq.ParquetWriter(path, table.schema, compression="zstd", use_dictionary=True) as writer:
        for _ in range(5):
            writer.write_table(table)


def laughs(count):
    """A stage in which each prim holds the one before twice."""
    text = '#usda 1.0\ndef "a0" {\ndef "x" {}\n}\n'
    for i in range(1, count):
        halves = "".join(f'def "{n}" (\nprepend references = </a{i - 1}>\n) {{}}\n' for n in "xy")
        text += f'def "a{i}" {{\n{halves}}}\n'
    return text


def commas(path):
    """14 MB of empty cells: 112 MB of numbers."""
    path.write_bytes(b"t" + b"".join(b",c%d" % i for i in range(999)) + b"\n" + (b"," * 999 + b"\n") * 14_000)


def mcap(path):
    """100 blank images of 1 MB in chunks that zstd makes tiny."""
    from mcap.writer import CompressionType, Writer

    with open(path, "wb") as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start("ros2")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data\n")
        channel = writer.register_channel("/a", "cdr", schema)
        for k in range(100):
            writer.add_message(channel, k, bytes(1_000_000), k)
        writer.finish()


def db3(path, more="", *, data="data BLOB", topics=1, message=b""):
    """A bag in sqlite3 with the statements `more`."""
    with closing(sqlite3.connect(path)) as database:
        columns = "id INTEGER, name TEXT, type TEXT, serialization_format TEXT, offered_qos_profiles TEXT"
        database.execute(f"CREATE TABLE topics ({columns})")
        database.execute(f"CREATE TABLE messages (id INTEGER, topic_id INTEGER, timestamp INTEGER, {data})")
        row = (1, "/a", "std_msgs/msg/String", "cdr", "")
        database.executemany("INSERT INTO topics VALUES (?, ?, ?, ?, ?)", [row] * topics)
        names = "id, topic_id, timestamp" + (", data" if data == "data BLOB" else "")
        values = (1, 1, 1, message)[: names.count(",") + 1]
        database.execute(f"INSERT INTO messages ({names}) VALUES ({', '.join('?' * len(values))})", values)
        database.executescript(more)
        database.commit()


ENDLESS = "WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c) SELECT x AS id FROM c"
VIRTUAL = (
    "PRAGMA writable_schema = ON; INSERT INTO sqlite_master "
    "VALUES ('table', 'metadata', 'metadata', 0, 'CREATE  VIRTUAL TABLE metadata USING dbstat');"
)
COMPUTED = "data BLOB GENERATED ALWAYS AS (zeroblob(900000000)) VIRTUAL"


def bag(path, mode, custom="{}"):
    """A folder of a bag whose file, or whose message, is 100 MB of zeros in zstd."""
    packed = pa.Codec("zstd").compress(bytes(100_000_000), asbytes=True)
    path.mkdir()
    if mode == "FILE":
        (path / "a.db3.zstd").write_bytes(packed)
    else:
        db3(path / "a.db3", message=packed)
    (path / "metadata.yaml").write_text(
        "rosbag2_bagfile_information:\n"
        f"  compression_mode: {mode}\n  compression_format: zstd\n  custom_data: {custom}\n"
        f"  relative_file_paths: [a.db3{'.zstd' if mode == 'FILE' else ''}]\n"
    )


ALIASES = (
    "{" + "a0: &a0 [x,x], " + ", ".join(f"a{i}: &a{i} [*a{i - 1},*a{i - 1}]" for i in range(1, 40)) + "}"
)
MERGES = "{a0: &a0 {x: 1}, " + ", ".join(
    f"a{i}: &a{i} {{<<: [{', '.join([f'*a{i - 1}'] * 9)}]}}" for i in range(1, 9)
) + "}"  # fmt: skip


def call(name):
    """A reader of magtwin by "module:function", imported when it is called."""

    def read(path):
        module, _, function = name.partition(":")
        return getattr(importlib.import_module(f"magtwin.{module}"), function)(path)

    return read


read_weights = call("learn.models.predictor:load_predictor")


def read_onnx(path):
    pytest.importorskip("onnx")
    return call("learn.inference.onnx:report_onnx")(path)


def unpack(path):
    (path.parent / "new").mkdir()
    return usdz_format.unpack(path, path.parent / "new")


def read_yaml(path):
    return list(read_settings(path))


def read_model(path):
    return TollesLawson.load(path)


def read_messages(path):
    with Bag(path) as bag:
        return bag.messages(["/a"])


def rrd(path):
    """A recording with a chunk that states 1 TB."""
    message = b"\x10\x02\x18" + b"\x80\x80\x80\x80\x80\x20" + b"\x20\x01\x2a\x00"
    path.write_bytes(b"RRF2\x00)\x00\x00\x01\x02\x00\x00" + struct.pack("<QQ", 2, len(message)) + message)


def collada(path, count):
    """A scene in which each node holds the one before twice."""
    nodes = '<node id="n0"/>' + "".join(
        f'<node id="n{i}"><instance_node url="#n{i - 1}"/><instance_node url="#n{i - 1}"/></node>'
        for i in range(1, count)
    )
    scene = f'<library_visual_scenes><visual_scene id="s"><node><instance_node url="#n{count - 1}"/></node>'
    path.write_text(
        f"<COLLADA><library_nodes>{nodes}</library_nodes>{scene}</visual_scene></library_visual_scenes>"
        '<scene><instance_visual_scene url="#s"/></scene></COLLADA>'
    )


def safetensors(path, header):
    path.write_bytes(struct.pack("<Q", len(header)) + header + bytes(8))


def shared(path):
    """1000 tensors that share 2 MB as stored: 4 GB of float32."""
    import torch

    one = torch.zeros(1_000_000, dtype=torch.float16)
    layers = {f"{i}.weight": one.view(1000, 1000) for i in range(1000)}
    torch.save({"model_state_dict": layers, "scaler_X": 0, "scaler_y": 0}, path)


class Hex:
    """A text that doubles with each call of `codecs.encode`."""

    def __init__(self, count):
        self.count = count

    def __reduce__(self):
        import _codecs

        return _codecs.encode, (b"A" * 1000 if not self.count else Hex(self.count - 1), "hex")


def doubling(path):
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a/data.pkl", pickle.dumps(Hex(30), protocol=2))
        archive.writestr("a/version", "3\n")
        archive.writestr("a/byteorder", "little")


def usdz(path):
    with zipfile.ZipFile(path, "w") as archive:
        for i in range(101):
            archive.writestr(f"{i}.usda", "")


BOMBS = {
    "dotted.toml": (lambda p: p.write_text("a" + ".a" * 20_000 + " = 1"), read_toml, "deeper than 16 levels"),
    "nested.toml": (lambda p: p.write_text("a = " + "[" * 9000 + "]" * 9000), read_toml, "deeper than 16"),
    "zeros.npz": (lambda p: npz(p, (10_000_000,), 80_000_000), read_run, "that decode to 80.0 MB"),
    "claims.npz": (lambda p: npz(p, (1 << 40,)), read_run, "its header claims shape"),
    "equal.parquet": (parquet, read_run, "that decode to 160.0 MB"),
    "commas.csv": (commas, read_run, "that decode to 112.0 MB"),
    "columns.csv": (lambda p: p.write_text("t" + ",a" * 20_000 + "\n"), read_run, "over 10,000 columns"),
    "facts.csv": (lambda p: p.write_text("# facts " + "[" * 99_999 + "\nt\n0\n"), read_run, "metadata"),
    "column.csv": (lambda p: p.write_text("# column t " + "[" * 99_999 + "\nt\n0\n"), read_run, "not JSON"),
    "images.mcap": (mcap, read_messages, "that decode to"),
    "endless.db3": (lambda p: db3(p, f"CREATE VIEW metadata AS {ENDLESS}"), read_run, "metadata is computed"),
    "computed.db3": (lambda p: db3(p, data=COMPUTED), read_messages, "messages is computed"),
    "virtual.db3": (lambda p: db3(p, VIRTUAL), read_run, "metadata is computed"),
    "topics.db3": (lambda p: db3(p, topics=10_001), read_run, "it has over 10,000 topics"),
    "file": (lambda p: bag(p, "FILE"), read_messages, "that decode to"),
    "message": (lambda p: bag(p, "MESSAGE"), read_messages, "that decode to"),
    "merges": (lambda p: bag(p, "MESSAGE", MERGES), read_messages, "a table of over 10000 entries"),
    "stated.rrd": (rrd, read_run, "that decode to 1,099.5 GB"),
    "merges.yaml": (lambda p: p.write_text(MERGES), read_yaml, "a table of over 10000 entries"),
    "nested.json": (lambda p: p.write_text("[" * 99_999), read_model, "nested.json"),
    "deep.urdf": (lambda p: p.write_text("<a>" * 9000 + "</a>" * 9000), read_source, "deeper than 200"),
    "wide.urdf": (lambda p: p.write_text("<a " + 'b="1" ' * 200_000 + "/>"), read_source, "a million"),
    "deep.dae": (lambda p: p.write_text("<COLLADA>" * 9000), read_mesh, "deeper than 200 elements"),
    "twice.dae": (lambda p: collada(p, 40), read_mesh, "shows over 500 nodes"),
    "words.obj": (lambda p: p.write_text("f " + "10 " * 1_200_000 + "\n"), read_mesh, "that decode to"),
    "words.stl": (
        lambda p: p.write_text("solid\n" + "vertex 0 0 0\n" * 300_000 + "endsolid\n"),
        read_mesh,
        "that decode to",
    ),
    "solids.stl": (lambda p: p.write_text("solid\nendsolid\n" * 20_000), read_mesh, "solids"),
    "count.ply": (
        lambda p: p.write_text("ply\nformat ascii 1.0\nelement vertex 999999999\nend_header\n"),
        read_mesh,
        "claims",
    ),
    "claims.stl": (lambda p: p.write_bytes(bytes(80) + b"\xff" * 4_000_000), read_mesh, "or cut short"),
    "stride.gltf": (lambda p: glb(p, {"count": 2_000_000_000}, byteStride=0), read_mesh, "that decode"),
    "length.safetensors": (
        lambda p: p.write_bytes(struct.pack("<Q", 1 << 60) + b"{}"),
        read_weights,
        "damaged safetensors",
    ),
    "shape.safetensors": (
        lambda p: safetensors(p, b'{"a":{"dtype":"F64","shape":[99999999999],"data_offsets":[0,8]}}'),
        read_weights,
        "damaged safetensors",
    ),
    "nested.safetensors": (
        lambda p: safetensors(p, b'{"__metadata__":{"magtwin":"' + b"[" * 99_999 + b'"},'
                              b'"a":{"dtype":"F64","shape":[1],"data_offsets":[0,8]}}'),
        read_weights,
        "its metadata is not JSON",
    ),
    "nodes.onnx": (
        lambda p: p.write_bytes(b"\x3a\x80\x89\x7a" + b"\x0a\x00" * 1_000_000),
        read_onnx,
        "no network of magtwin's",
    ),
    "entries.onnx": (lambda p: p.write_bytes(b"\x72\x00" * 20_000), read_onnx, "over 10,000 entries"),
    "shared.pth": (shared, read_weights, "that decode to"),
    "doubling.pth": (doubling, read_weights, "asks for the encoding 'hex'"),
    "entries.usdz": (usdz, unpack, "over 100 files"),
    "deep.usda": (lambda p: p.write_text("#usda 1.0\n" + 'def "a" {' * 9000), open_stage, "deeper than 128"),
    "laughs.usda": (lambda p: p.write_text(laughs(30)), open_stage, "references multiply each other"),
}  # fmt: skip


@contextmanager
def no_more_than(room):
    """Limit the address space, so that a test that fails does not take the memory of the machine."""
    size = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (size + room, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


@pytest.fixture
def small(monkeypatch):
    """Small limits, so that bombs are quick to make."""
    monkeypatch.setattr(budget, "SPARE", SPARE)
    monkeypatch.setitem(budget.BUDGETS, "USD", budget.Budget(seconds=600.0))
    monkeypatch.setattr(trial, "PROCESSOR_S", 2.0)
    monkeypatch.setitem(budget.BUDGETS, "mesh", budget.Budget(count=500))
    monkeypatch.setitem(budget.BUDGETS, "package", budget.Budget(count=100))


@pytest.mark.parametrize("name", BOMBS)
def test_a_bomb_is_refused_before_it_takes_memory(name, tmp_path, small):
    write, read, message = BOMBS[name]
    write(tmp_path / name)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    with no_more_than(ROOM), pytest.raises(InputError, match=message) as refusal:
        read(tmp_path / name)
    assert "\n" not in str(refusal.value)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 - before < MOST


def test_aliases_in_the_description_of_a_bag_do_not_multiply(tmp_path):
    import yaml

    from magtwin.files.settings import yaml_loader
    from magtwin.io.bags.db3 import custom_data

    about = yaml.load(f"{{custom_data: {ALIASES[:-1]}, note: 3}}}}", yaml_loader())
    assert custom_data(about) == {"note": "3"}


def hole(path, size):
    """A file that takes no room on the disk."""
    with open(path, "wb") as file:
        os.truncate(file.fileno(), size)


def picture(path, side):
    from PIL import Image

    Image.new("1", (side, side)).save(path)


@pytest.mark.parametrize(
    ("write", "reason"),
    [
        (lambda p: hole(p, 600_000_000), "600.0 MB are too large for image"),
        (lambda p: picture(p, 3000), "that decode to 99.0 MB"),
        (lambda p: picture(p, 12_000), "12000 x 12000 pixels are too many"),
        (lambda p: p.write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n"), "cannot identify"),
    ],
    ids=["a hole", "bytes", "pixels", "a program that another would run"],
)
def test_an_image_that_would_become_too_large_is_left_out_with_its_reason(write, reason, tmp_path, small):
    write(tmp_path / "a.png")
    (tmp_path / "a.mtl").write_text("newmtl m\nmap_Kd a.png\n")
    corners = "".join(f"v {x} {y} 0\nvt {x} {y}\n" for x, y in ((0, 0), (1, 0), (0, 1)))
    (tmp_path / "a.obj").write_text(f"mtllib a.mtl\n{corners}usemtl m\nf 1/1 2/2 3/3\n")
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    mesh = read_mesh(tmp_path / "a.obj")
    assert any(reason in text and lost for text, lost in mesh.notes), mesh.notes
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 - before < MOST


LARGE = {
    "TOML": ("a.toml", read_toml),
    "JSON": ("a.json", read_model),
    "YAML": ("a.yaml", read_yaml),
    "XML": ("a.urdf", read_source),
    "npz": ("a.npz", read_run),
    "Parquet": ("a.parquet", read_run),
    "CSV": ("a.csv", read_run),
    "text": ("a.md", lambda path: read_text(path, "model card", "text")),
    "readings": ("a.csv", call("tables.table:read_table")),
    "recording": ("a.json", call("io.release:read_release")),
    "rrd": ("a.rrd", read_run),
    "bag": ("a.mcap", read_run),
    "mesh": ("a.stl", read_mesh),
    "OBJ": ("a.obj", read_mesh),
    "weights": ("a.safetensors", read_weights),
    "checkpoint": ("a.pth", read_weights),
    "ONNX": ("a.onnx", read_onnx),
    "USD text": ("a.usda", open_stage),
    "USD": ("a.usdc", open_stage),
    "package": ("a.usdz", unpack),
}
"""A reader of each format."""


@pytest.mark.parametrize("kind", LARGE)
def test_a_file_above_the_limit_of_its_format_is_refused_unread(kind, tmp_path, monkeypatch):
    name, read = LARGE[kind]
    with open(tmp_path / name, "wb") as file:  # a hole, which takes no room on the disk
        file.write(b"PAR1")
        file.seek(3_000_000_000 - 4)
        file.write(b"PAR1")
    limits = budget.BUDGETS[kind]
    monkeypatch.setitem(budget.BUDGETS, "mesh", budget.Budget())  # of which an OBJ is one
    monkeypatch.setitem(budget.BUDGETS, kind, budget.Budget(file=min(limits.file, 2_000_000_000)))
    with no_more_than(ROOM), pytest.raises(InputError, match=f"3.0 GB are too large for {kind} "):
        read(tmp_path / name)


def test_every_format_of_the_table_has_a_reader_that_asks_for_it():
    assert LARGE.keys() | {"image", "URDF"} == budget.BUDGETS.keys()
