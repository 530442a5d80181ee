"""Epochs of a map: the variant set `epoch` of its prim, with one variant for each date."""

import datetime
import warnings
from collections.abc import Callable, Collection, Iterator
from contextlib import AbstractContextManager

from pxr import Sdf, Usd

from magtwin.errors import InputError, find
from magtwin.field.days import ORIGIN
from magtwin.usd.schema import attribute_name, place

EPOCH = "epoch"
"""Name of the variant set. Its variants are dates, YYYY-MM-DD, so their order is that of time."""


def epochs_of(prim: Usd.Prim) -> tuple[str, ...]:
    """Dates of a map's epochs, the earliest first; empty if the map has none."""
    sets = prim.GetVariantSets()
    return tuple(sorted(sets.GetVariantSet(EPOCH).GetVariantNames())) if sets.HasVariantSet(EPOCH) else ()


def selected_epoch(prim: Usd.Prim) -> str:
    """Date of the epoch that the stage shows; "" if the map has no epochs.

    Raises:
        InputError: The map has epochs, and none of them is selected; names the prim.
    """
    dates = epochs_of(prim)
    if not dates:
        return ""
    date = str(prim.GetVariantSets().GetVariantSet(EPOCH).GetVariantSelection())
    if date not in dates:
        got = f"the epoch {date!r} is selected, which it does not have" if date else "no epoch is selected"
        raise InputError(f"{place(prim)}: {got}; select one of {', '.join(dates)}")
    return date


def select_epoch(prim: Usd.Prim, date: str) -> None:
    """Show an epoch of a map, in the stage's session layer.

    Raises:
        InputError: The map has no epoch of that date; the text names its epochs.
    """
    dates = epochs_of(prim)
    if not dates:
        raise InputError(f"{place(prim)}: the map has no epochs; leave out `epoch`", parameter="epoch")
    try:
        find("epoch of the map", date, dict.fromkeys(dates))
    except InputError as error:
        raise InputError(f"{place(prim)}: {error}", parameter="epoch") from error
    stage = prim.GetStage()
    with Usd.EditContext(stage, stage.GetSessionLayer()):
        prim.GetVariantSets().SetSelection(EPOCH, date)


def define_epoch(prim: Usd.Prim, date: str) -> AbstractContextManager[None]:
    """Add an epoch to a map and select it; edits in the context are of this epoch."""
    variants = prim.GetVariantSets().AddVariantSet(EPOCH)
    variants.AddVariant(date)
    variants.SetVariantSelection(date)
    return variants.GetVariantEditContext()


def each_epoch(prim: Usd.Prim, dates: Collection[str] = ()) -> Iterator[tuple[str, Usd.Prim]]:
    """A map's prim at each of its epochs, on a stage of its own; arrays are read when they are asked for.

    Args:
        prim: The prim. Its own stage stays as it is.
        dates: Epochs to visit. Default: all, the earliest first.

    Yields:
        Date and prim. The prim is valid until the next step.
    """
    names = epochs_of(prim)
    for date in names:
        if not dates or date in dates:
            yield from _overlaid(prim, date, lambda over, d=date: over.variantSelections.update({EPOCH: d}))
    if not names:
        yield from _time_samples(prim)


def warn_of_time_codes(prim: Usd.Prim) -> bool:
    """Whether a map keeps its epochs as time codes, as older versions wrote them; warns if so."""
    old = bool(_samples(prim))
    if old:
        text = (
            f"{place(prim)}: keeps its epochs as time codes, which collide with those of a run; convert the "
            "map's file: magtwin map epochs OLD.usdc --out NEW.usdc"
        )
        warnings.warn(text, stacklevel=2)
    return old


def _overlaid(
    prim: Usd.Prim, date: str, edit: Callable[[Sdf.PrimSpec], object]
) -> Iterator[tuple[str, Usd.Prim]]:
    """The prim on a stage of its own, with an edit in the session layer."""
    stage = prim.GetStage()
    session = Sdf.Layer.CreateAnonymous()
    session.TransferContent(stage.GetSessionLayer())
    edit(Sdf.CreatePrimInLayer(session, prim.GetPath()))
    mask = Usd.StagePopulationMask([prim.GetPath()])
    own = Usd.Stage.OpenMasked(stage.GetRootLayer(), session, mask)
    yield date, own.GetPrimAtPath(prim.GetPath())


def _samples(prim: Usd.Prim) -> tuple[Sdf.Layer, Sdf.Path, list[float]] | None:
    """Layer, prim and time codes of an older map's epochs, read there: layer offsets would round them."""
    for spec in prim.GetAttribute(attribute_name("anomalyMap", "values")).GetPropertyStack():
        if times := spec.layer.ListTimeSamplesForPath(spec.path):
            return spec.layer, spec.path.GetPrimPath(), list(times)
    return None


def _time_samples(prim: Usd.Prim) -> Iterator[tuple[str, Usd.Prim]]:
    """The prim at each time code of an older map, which are days since 2000-01-01."""
    if not (found := _samples(prim)):
        return
    layer, path, times = found

    def edit(over: Sdf.PrimSpec, time: float) -> None:
        for name, spec in layer.GetPrimAtPath(path).attributes.items():
            if layer.GetNumTimeSamplesForPath(spec.path):
                value = layer.QueryTimeSample(spec.path, time)
                own = Sdf.AttributeSpec(over, name, spec.typeName, spec.variability)
                own.default = Sdf.ValueBlock() if value is None else value

    for time in times:
        date = (ORIGIN + datetime.timedelta(days=time)).isoformat()
        yield from _overlaid(prim, date, lambda over, t=time: edit(over, t))
