"""Magnetised things of a scene as bodies, with what the Earth's field induces in them."""

from dataclasses import replace

import numpy as np

from magtwin.errors import InputError
from magtwin.field.sources.bodies import Body, induced_magnetization
from magtwin.spec.magnetics import SourceSpec


def body_of(source: SourceSpec, b_world_nt: tuple[float, float, float] | None = None) -> Body:
    """The magnetised body of a source that is no point, induced magnetization included.

    The Earth's field is in world axes [nT], None if it is not known; a source with a susceptibility needs it.
    """
    body = Body(
        shape=source.shape,
        size_m=np.array(source.size_m),
        p_world=np.array(source.p_world),
        q_world_xyzw=np.array(source.q_world_xyzw),
        magnetization=np.array(source.magnetization),
        vertices=np.array(source.vertices_m) if source.vertices_m else None,
        faces=np.array(source.faces) if source.faces else None,
    )
    if not source.susceptibility:
        return body
    if b_world_nt is None:
        raise InputError(
            f"source {source.name!r} has susceptibility {source.susceptibility:g}, but the Earth's field, "
            "which magnetises it, is not known; give the scene an [earth] table"
        )
    induced = induced_magnetization(body, source.susceptibility, b_world_nt)
    return replace(body, magnetization=body.magnetization + induced)
