"""A glTF file that tests of limits share."""

import json


def glb(path, accessor, **more):
    """A glTF of one triangle mesh whose positions are `accessor`."""
    view = {"buffer": 0, "byteLength": 36} | more
    uri = "data:application/octet-stream;base64," + "A" * 48
    table = {
        "asset": {"version": "2.0"},
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "type": "VEC3"} | accessor],
        "bufferViews": [view],
        "buffers": [{"byteLength": 36, "uri": uri}],
    }
    path.write_text(json.dumps(table))
