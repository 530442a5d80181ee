"""Piece: triangles of one material, as the readers of mesh files return them."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magtwin.urdf.meshes.texture import Image
from magtwin.usd.geometry import linear_from_srgb

Rgba = tuple[float, float, float, float]

GREY: Rgba = (0.5, 0.5, 0.5, 1.0)
"""Colour of a surface without a material (sRGB)."""


@dataclass(frozen=True)
class Map:
    """An image that gives an input of a surface: scale x texel + bias, for each channel."""

    image: Image

    channel: str = "rgb"
    """"rgb", or the one channel that is read: "r", "g", "b" or "a"."""

    scale: Rgba = (1.0, 1.0, 1.0, 1.0)

    bias: Rgba = (0.0, 0.0, 0.0, 0.0)

    colour: bool = False
    """Whether its texels are sRGB colours; else they are numbers."""

    wrap: tuple[str, str] = ("repeat", "repeat")
    """Outside 0 to 1, along s and t: "repeat", "mirror" or "clamp"."""


@dataclass(frozen=True)
class Paint:
    """The look of a surface: a material of a mesh file, or of the URDF."""

    name: str = ""
    """Its name in the file. Default: from the colour."""

    rgba: Rgba = (1.0, 1.0, 1.0, 1.0)
    """Colour (sRGB) and opacity, 0 to 1; with a texture, the factor that multiplies it."""

    image: Image | None = None
    """Colour texture."""

    roughness: float = 0.5
    """0 is a mirror, 1 is chalk."""

    metallic: float = 0.0
    """0 is an insulator, 1 is metal."""

    see_through: bool = False
    """Whether the texture's opacity is used."""

    cutoff: float = 0.0
    """Opacity threshold between invisible and opaque; 0 blends."""

    emissive: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Light that it gives off, linear."""

    specular: tuple[float, float, float] | None = None
    """Reflectance at normal incidence, linear; it replaces `metallic`. None: from `metallic` and `ior`."""

    ior: float | None = None
    """Index of refraction. None: 1.5."""

    maps: tuple[tuple[str, Map], ...] = ()
    """Textures of other inputs than the colour, by the input of UsdPreviewSurface."""

    wrap: tuple[str, str] = ("repeat", "repeat")
    """The colour texture outside 0 to 1, as in `Map`."""

    double_sided: bool = False
    """Whether it is visible from behind."""

    by_vertex: bool = False
    """Whether the colours at the corners replace `rgba`."""

    @property
    def textured(self) -> bool:
        """Whether it needs texture coordinates."""
        return self.image is not None or bool(self.maps)

    @property
    def without_textures(self) -> "Paint":
        """The paint for a mesh without texture coordinates, with the mean colour of its texture."""
        r, g, b = (1.0, 1.0, 1.0) if self.image is None else self.image.mean
        mean = (self.rgba[0] * r, self.rgba[1] * g, self.rgba[2] * b, self.rgba[3])
        return replace(self, rgba=mean, image=None, maps=(), see_through=False)

    @property
    def display_colour(self) -> tuple[float, float, float]:
        """Linear colour for viewers without materials."""
        mean = (1.0, 1.0, 1.0) if self.image is None else self.image.mean
        r, g, b = (round(float(c), 5) for c in linear_from_srgb(self.rgba[:3]) * linear_from_srgb(mean))
        return (r, g, b)


def smoothness(exponent: float, highlight: tuple[float, float, float]) -> tuple[float, tuple]:
    """Roughness and reflectance of a Phong highlight.

    A microfacet lobe of width a has the shape of a highlight with the exponent n if a^2 = 2 / (n + 2)
    (Walter et al. 2007, doi:10.2312/EGWR/EGSR07/195-206), and `UsdPreviewSurface` takes the root of a. Its
    peak, F / 4 a^2, is as high as that of the highlight, k, if the reflectance F is 4 a^2 k.

    Args:
        exponent: Exponent n of the highlight, 0 or more.
        highlight: Its colour k, linear.

    Returns:
        Roughness, 0 to 1, and reflectance F at normal incidence, linear.
    """
    squared = 2 / (max(exponent, 0.0) + 2)
    r, g, b = (min(4 * squared * c, 1.0) for c in highlight)
    return squared**0.25, (r, g, b)


def normal_map(image: Image, strength: float = 1.0, wrap: tuple[str, str] = ("repeat", "repeat")) -> Map:
    """The map of a tangent-space normal map: texels from 0 to 1 become -1 to 1, x and y times `strength`."""
    s = strength
    return Map(image, scale=(2 * s, 2 * s, 2.0, 1.0), bias=(-s, -s, -1.0, 0.0), wrap=wrap)


def linear(rgb: tuple[float, ...]) -> tuple[float, float, float]:
    """Linear red, green, blue of an sRGB colour."""
    r, g, b = (float(c) for c in linear_from_srgb(rgb[:3]))
    return (r, g, b)


PLAIN = Paint(rgba=GREY)
"""The look of a surface without a material."""


@dataclass(frozen=True)
class Piece:
    """Triangles with one paint, from a reader. Missing values are None."""

    points: NDArray
    """Vertices [m], shape (V, 3)."""

    faces: NDArray
    """Corners of the triangles, counter-clockwise from outside, shape (F, 3)."""

    paint: Paint | None = None

    normals: NDArray | None = None
    """Normal at each corner of each face, shape (F, 3, 3)."""

    uvs: NDArray | None = None
    """Texture coordinates at each corner from the picture's lower left, shape (F, 3, 2)."""

    colours: NDArray | None = None
    """Linear red, green, blue at each corner, 0 to 1, shape (F, 3, 3)."""

    @property
    def nbytes(self) -> int:
        """Size of its arrays."""
        arrays = (self.points, self.faces, self.normals, self.uvs, self.colours)
        return sum(array.nbytes for array in arrays if array is not None)

    def moved(self, T: NDArray) -> "Piece":
        """The piece under an affine map T, shape (4, 4); faces stay outwards under a reflection.

        Normals transform by the inverse transpose of the linear part A, n' ~ A^-T n, times the sign of det A.
        """
        if np.array_equal(T, np.eye(4)):
            return self
        A = T[:3, :3]
        det = A[0] @ np.cross(A[1], A[2])
        if det == 0:
            raise ValueError("a node's transform flattens the mesh")
        points = self.points @ A.T + T[:3, 3]
        normals = None if self.normals is None else self.normals @ np.linalg.inv(A)
        made = replace(self, points=points, normals=normals)
        return made.flipped() if det < 0 else made

    def flipped(self) -> "Piece":
        """The piece with its faces wound the other way and the same normals."""
        normals, uvs, colours = (
            None if values is None else values[:, ::-1] for values in (self.normals, self.uvs, self.colours)
        )
        return replace(self, faces=self.faces[:, ::-1], normals=normals, uvs=uvs, colours=colours)
