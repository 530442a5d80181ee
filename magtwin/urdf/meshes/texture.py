"""Texture: images of a robot, copied beside its asset."""

import hashlib
import io
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from magtwin.errors import InputError
from magtwin.files.budget import BUDGETS, check_decoded
from magtwin.files.file import read_bytes
from magtwin.urdf.meshes.reading import Images, Reading

TEXTURES = "textures"
"""Folder of the copies beside an asset's layers."""

READ = ("BMP", "DDS", "GIF", "JPEG", "JPEG2000", "PCX", "PNG", "PPM", "SGI", "TGA", "TIFF", "WEBP")
"""Formats that are read, by Pillow's names. Of others, EPS would start a program."""

BYTES = 11
"""Bytes that a pixel takes: as decoded, as RGBA, and as RGB."""

PIXELS, BY_BYTE = 1 << 28, 16
"""Most pixels of all images of a robot, and more of them for each byte of their files."""

KEPT = {"JPEG": ".jpg", "PNG": ".png"}
"""Formats that every USD viewer reads, by Pillow's names; others are converted to PNG."""


@dataclass(frozen=True)
class Image:
    """An image with the bytes of its file."""

    name: str
    """File name with the suffix of its format."""

    data: bytes

    mean: tuple[float, float, float]
    """Mean colour (sRGB), 0 to 1, for viewers without textures."""

    has_alpha: bool = False

    @property
    def shows_normals(self) -> bool:
        """Whether it is a map of normals, by its mean: (0.5, 0.5, 1) is up; maps of height are grey."""
        r, g, b = self.mean
        return b > 0.7 and abs(r - 0.5) < 0.2 and abs(g - 0.5) < 0.2


def read_image(name: str, reading: Reading, folder: Path | None = None) -> Image | None:
    """The image that a mesh file references; None with a note if it cannot be read.

    Args:
        name: Relative path in the file; may be percent-encoded or a `file:` URI.
        reading: The mesh file.
        folder: Folder to which the name is relative. Default: that of the mesh file.
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
        data = read_bytes(path, "image", "image")
    except (OSError, ValueError) as error:  # the name is too long, or contains a null byte
        reading.lose(f"texture {name!r} cannot be read and is left out ({error})")
        return None
    return image_of(data, path.name, reading)


@contextmanager
def opened_image(data: bytes) -> Iterator[Any]:
    """Pillow's image of the bytes of a file, whose pixels are not decoded yet.

    Raises:
        InputError: It is of no format in `READ`, damaged, or would take too much memory.
    """
    from PIL import Image as Pillow

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Pillow.DecompressionBombWarning)
        try:
            picture = Pillow.open(io.BytesIO(data), formats=READ)
        except (OSError, SyntaxError, ValueError, Pillow.DecompressionBombError) as error:
            raise InputError(str(error).partition(" <")[0]) from error  # without the object's address
    with picture:
        width, height = picture.size
        if width * height > BUDGETS["image"].count:
            raise InputError(f"{width} x {height} pixels are too many")
        check_decoded("the image", len(data), BYTES * width * height)
        yield picture


def image_of(data: bytes, name: str, reading: Reading) -> Image | None:
    """An image from the bytes of its file; formats not in KEPT are converted to PNG with a note.

    Args:
        data: Bytes of the file.
        name: Name for notes and for the copy.
        reading: The mesh file.
    """
    stem = re.sub(r"[^A-Za-z0-9_-]", "_", Path(name).stem) or "texture"
    key = hashlib.sha256(data).digest()
    if key not in reading.images.decoded:
        try:
            reading.images.decoded[key] = _decoded(data, reading.images)
        except (OSError, SyntaxError, ValueError) as error:
            reading.images.decoded[key] = str(error)
    image = reading.images.decoded[key]
    if isinstance(image, str):
        reading.lose(f"texture {name!r} is not a readable image and is left out ({image})")
        return None
    kind, made = image
    if kind not in KEPT:
        reading.note(f"texture {name!r} is {kind}, which not every USD viewer reads; written as PNG")
    return replace(made, name=stem + KEPT.get(kind, ".png"))


def _decoded(data: bytes, images: Images) -> tuple[str, Image]:
    """Format of an image by Pillow's name, and the image without its name."""
    from PIL import Image as Pillow

    with opened_image(data) as picture:
        images.size += len(data)
        images.pixels += picture.width * picture.height
        if images.pixels > PIXELS + BY_BYTE * images.size:
            raise InputError(f"the images to here have {images.pixels:,} pixels, which are too many")
        kind = picture.format or ""
        alpha = "A" in picture.getbands() or "transparency" in picture.info
        rgba = picture.convert("RGBA")
    r, g, b = (c / 255 for c in rgba.convert("RGB").resize((1, 1), Pillow.Resampling.BOX).tobytes())
    if kind not in KEPT:
        buffer = io.BytesIO()
        rgba.save(buffer, "PNG")
        data = buffer.getvalue()
    return kind, Image("", data, (r, g, b), alpha)


class Textures:
    """The distinct images of a robot, with unique names."""

    def __init__(self, folder: str) -> None:
        """Create an empty set.

        Args:
            folder: Asset path of the folder for the copies, relative to the robot's layer.
        """
        self.folder = folder
        self._names: dict[bytes, str] = {}
        self._taken: dict[str, int] = {}  # names in small letters, and the last number tried after each

    def __len__(self) -> int:
        return len(self._names)

    def add(self, image: Image) -> str:
        """Asset path of an image's copy."""
        if image.data not in self._names:
            stem, _, suffix = image.name.rpartition(".")
            first = image.name.lower()  # some file systems ignore case
            name, number = image.name, self._taken.get(first, 1)
            while name.lower() in self._taken:
                number += 1
                name = f"{stem}_{number}.{suffix}"
            self._taken[name.lower()], self._taken[first] = 1, number
            self._names[image.data] = name
        return f"{self.folder}/{self._names[image.data]}"

    def export(self, folder: Path) -> None:
        """Write the copies to a new folder."""
        folder.mkdir(parents=True)
        for data, name in self._names.items():
            (folder / name).write_bytes(data)
