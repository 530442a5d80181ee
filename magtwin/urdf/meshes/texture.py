"""Texture: the pictures that a robot wears, copied beside its asset and named relative to it."""

import io
import re
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote

from magtwin.errors import InputError
from magtwin.urdf.meshes.reading import Reading

TEXTURES = "textures"
"""Folder of the copies beside the layers of an asset."""

KEPT = {"JPEG": ".jpg", "PNG": ".png"}
"""Formats that every USD viewer reads, by Pillow's names; others become PNG."""

MAX_PIXELS = 2**27
"""Largest picture that is opened."""


@dataclass(frozen=True)
class Image:
    """A picture as its file holds it."""

    name: str
    """Name of the file, with the suffix of what it holds."""

    data: bytes

    mean: tuple[float, float, float]
    """Mean colour (sRGB), 0 to 1: what a viewer without textures shows."""


def read_image(name: str, reading: Reading, folder: Path | None = None) -> Image | None:
    """The picture that a mesh file names; none, with a note, where there is none to be had.

    Args:
        name: As the file has it: a relative path, perhaps percent-encoded or a `file:` URI.
        reading: The mesh file.
        folder: Folder that the name is relative to; by default the mesh file's.
    """
    text = re.sub(r"^file:/+(?=[A-Za-z]:|/)|^file:(//)?", "", unquote(name.strip()).replace("\\", "/"))
    path = (folder or reading.path.parent) / text
    try:
        if not reading.may_read(path):
            reading.lose(f"texture {name!r} lies outside the robot's packages and is left out")
            return None
        if not path.is_file():
            reading.lose(f"texture {name!r} is missing and is left out; looked for {path}")
            return None
        data = path.read_bytes()
    except (OSError, ValueError) as error:  # a name that is too long, or holds a null byte
        reading.lose(f"texture {name!r} cannot be read and is left out ({error})")
        return None
    return image_of(data, path.name, reading)


def image_of(data: bytes, name: str, reading: Reading) -> Image | None:
    """A picture from its bytes; one of another format than KEPT becomes PNG, with a note.

    Args:
        data: The file's bytes.
        name: Its name, for notes and for the copy.
        reading: The mesh file that shows it.
    """
    from PIL import Image as Pillow

    stem = re.sub(r"[^A-Za-z0-9_-]", "_", Path(name).stem) or "texture"
    try:
        with Pillow.open(io.BytesIO(data)) as picture:
            kind, (width, height) = picture.format or "", picture.size
            if width * height > MAX_PIXELS:
                raise InputError(f"{width} x {height} pixels are too many")
            rgba = picture.convert("RGBA")
    except (OSError, InputError, SyntaxError, ValueError, Pillow.DecompressionBombError) as error:
        reason = str(error).partition(" <")[0]  # without the address of what could not be read
        reading.lose(f"texture {name!r} is no picture that can be read and is left out ({reason})")
        return None
    r, g, b = (c / 255 for c in rgba.convert("RGB").resize((1, 1), Pillow.Resampling.BOX).tobytes())
    if kind not in KEPT:
        reading.note(f"texture {name!r} is {kind}, which not every USD viewer reads; written as PNG")
        buffer = io.BytesIO()
        rgba.save(buffer, "PNG")
        data, kind = buffer.getvalue(), "PNG"
    return Image(stem + KEPT[kind], data, (r, g, b))


class Textures:
    """The pictures of one robot: each once, under a name of its own."""

    def __init__(self, folder: str) -> None:
        """Start without one.

        Args:
            folder: Asset path of the folder that the copies will lie in, as the robot's layer sees it.
        """
        self.folder = folder
        self._names: dict[bytes, str] = {}

    def __len__(self) -> int:
        return len(self._names)

    def add(self, image: Image) -> str:
        """Asset path of a picture's copy."""
        if image.data not in self._names:
            stem, _, suffix = image.name.rpartition(".")
            taken, name, number = {n.lower() for n in self._names.values()}, image.name, 1
            while name.lower() in taken:  # some file systems take A and a for one
                number += 1
                name = f"{stem}_{number}.{suffix}"
            self._names[image.data] = name
        return f"{self.folder}/{self._names[image.data]}"

    def export(self, folder: Path) -> None:
        """Write the copies into a folder that is made for them."""
        folder.mkdir(parents=True)
        for data, name in self._names.items():
            (folder / name).write_bytes(data)
