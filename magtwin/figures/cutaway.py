"""Cutaway: pictures in which nothing hides the heat-map on the floor, the robot or its trail."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

VEIL = 0.3
"""Opacity of an object where it stands in front of the heat-map, the robot or the trail."""


class Cutaway:
    """Takes pictures of a plotter in which objects in front of the subject are a veil over it.

    Each picture is drawn twice: whole, and with the subject alone on a transparent ground. The second is laid
    over the first, so that walls, columns and cabinets stay solid where they hide nothing of the subject.
    A camera below the floor sees the floor from below, without a cutaway.
    """

    def __init__(self, plotter: Any, size: tuple[int, int], screens: Sequence[Any]) -> None:
        """Prepare the pictures.

        Args:
            plotter: A pyvista plotter whose window was rendered once.
            size: Width and height [pixel].
            screens: Actors that may hide the subject. All others are the subject.
        """
        self._plotter, self._size, self._screens = plotter, size, tuple(screens)
        window = plotter.render_window
        window.SetAlphaBitPlanes(1)
        self._whole, self._subject = _grabber(window, alpha=False), _grabber(window, alpha=True)

    def image(self, *, whole: bool = False) -> NDArray[np.uint8]:
        """The picture from the present camera, shape (height, width, 3).

        Args:
            whole: Whether to draw everything solid.
        """
        image = self._grab(self._whole)
        if whole or not self._screens:
            return image
        with self._subject_alone():
            subject = self._grab(self._subject)
        colour = subject[..., :3].astype(np.uint32)  # already multiplied by alpha, as its ground is black
        alpha = subject[..., 3:].astype(np.uint32)
        share = round(256 * (1 - VEIL))
        mixed = (image * (256 - share * alpha // 255) + share * colour) >> 8
        return np.minimum(mixed, 255).astype(np.uint8)

    @contextmanager
    def _subject_alone(self) -> Iterator[None]:
        renderer = self._plotter.renderer
        ground, shown = renderer.GetBackground(), [actor.visibility for actor in self._screens]
        try:
            for actor in self._screens:
                actor.visibility = False
            renderer.SetBackground(0.0, 0.0, 0.0)
            renderer.SetBackgroundAlpha(0.0)
            yield
        finally:
            renderer.SetBackground(*ground)
            renderer.SetBackgroundAlpha(1.0)
            for actor, visible in zip(self._screens, shown, strict=True):
                actor.visibility = visible

    def _grab(self, grabber: Any) -> NDArray[np.uint8]:
        """Render the window and copy it, shape (height, width, 3 or 4)."""
        from vtkmodules.util.numpy_support import vtk_to_numpy

        self._plotter.render_window.Render()
        grabber.Modified()
        grabber.Update()
        pixels = vtk_to_numpy(grabber.GetOutput().GetPointData().GetScalars())
        return np.array(pixels.reshape(self._size[1], self._size[0], -1)[::-1], np.uint8)


def _grabber(window: Any, *, alpha: bool) -> Any:
    """A filter that copies a window without rendering it again, as pyvista's own would."""
    from vtkmodules.vtkRenderingCore import vtkWindowToImageFilter

    grabber = vtkWindowToImageFilter()
    grabber.SetInput(window)
    if alpha:
        grabber.SetInputBufferTypeToRGBA()
    else:
        grabber.SetInputBufferTypeToRGB()
    grabber.ReadFrontBufferOff()
    grabber.ShouldRerenderOff()
    return grabber
