"""Cutaway: a picture in which nothing hides the floor's heat-map, the robot or its trail."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

VEIL = 0.3
"""Share of its colour that an object keeps where it stands before the heat-map, the robot or the trail."""


class Cutaway:
    """Takes pictures of a plotter; objects before the subject are drawn as a veil over it.

    Each picture is drawn twice: whole, and with the subject alone on a transparent ground. The second is laid
    over the first, so that walls, columns and cabinets stay solid wherever they hide nothing of the subject.
    A camera below the floor sees the floor from below, without a cutaway.
    """

    def __init__(self, plotter: Any, size: tuple[int, int], screens: Sequence[Any]) -> None:
        """Prepare the pictures.

        Args:
            plotter: What is drawn, a pyvista plotter whose window was rendered once.
            size: Width and height [pixel].
            screens: The actors that may hide the subject; all others are the subject.
        """
        self._plotter, self._size, self._screens = plotter, size, tuple(screens)
        window = plotter.render_window
        window.SetAlphaBitPlanes(1)
        self._whole, self._subject = _grabber(window, alpha=False), _grabber(window, alpha=True)

    def image(self, *, whole: bool = False) -> NDArray[np.uint8]:
        """The picture as the camera stands now, shape (height, width, 3).

        Args:
            whole: Whether to draw everything solid.
        """
        image = self._grabbed(self._whole)
        if whole or not self._screens:
            return image
        with self._alone():
            subject = self._grabbed(self._subject)
        laid = subject[..., :3].astype(np.uint32)  # multiplied by its alpha already: its ground is black
        alpha = subject[..., 3:].astype(np.uint32)
        share = round(256 * (1 - VEIL))
        mixed = (image * (256 - share * alpha // 255) + share * laid) >> 8
        return np.minimum(mixed, 255).astype(np.uint8)

    @contextmanager
    def _alone(self) -> Iterator[None]:
        """The subject alone, on a transparent ground, within the block."""
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

    def _grabbed(self, grab: Any) -> NDArray[np.uint8]:
        """The window rendered anew, as a copy, shape (height, width, 3 or 4)."""
        from vtkmodules.util.numpy_support import vtk_to_numpy

        self._plotter.render_window.Render()
        grab.Modified()
        grab.Update()
        seen = vtk_to_numpy(grab.GetOutput().GetPointData().GetScalars())
        return np.array(seen.reshape(self._size[1], self._size[0], -1)[::-1], np.uint8)


def _grabber(window: Any, *, alpha: bool) -> Any:
    """A filter that copies a window as it was last drawn; pyvista's own would draw it once more."""
    from vtkmodules.vtkRenderingCore import vtkWindowToImageFilter

    grab = vtkWindowToImageFilter()
    grab.SetInput(window)
    if alpha:
        grab.SetInputBufferTypeToRGBA()
    else:
        grab.SetInputBufferTypeToRGB()
    grab.ReadFrontBufferOff()
    grab.ShouldRerenderOff()
    return grab
