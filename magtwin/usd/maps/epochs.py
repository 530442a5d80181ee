"""Epochs of a map: the variant set `epoch` of its prim, with one variant for each date."""

import datetime
import itertools
import warnings
from collections.abc import Collection, Iterator
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
    root, mask = prim.GetStage().GetRootLayer(), Usd.StagePopulationMask([prim.GetPath()])
    for date, session in itertools.chain(_variants(prim), _time_samples(prim)):
        if not dates or date in dates:
            stage = Usd.Stage.OpenMasked(root, session, mask)  # held in a name: a prim does not keep it
            yield date, stage.GetPrimAtPath(prim.GetPath())


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


def _session_of(prim: Usd.Prim) -> tuple[Sdf.Layer, Sdf.PrimSpec]:
    """A copy of the session layer of a prim's stage, and its opinion on the prim."""
    session = Sdf.Layer.CreateAnonymous()
    session.TransferContent(prim.GetStage().GetSessionLayer())
    return session, Sdf.CreatePrimInLayer(session, prim.GetPath())


def _variants(prim: Usd.Prim) -> Iterator[tuple[str, Sdf.Layer]]:
    """Date of each epoch, and the session layer that selects it."""
    for date in epochs_of(prim):
        session, over = _session_of(prim)
        over.variantSelections[EPOCH] = date
        yield date, session


def _samples(prim: Usd.Prim) -> tuple[Sdf.Layer, Sdf.Path, list[float]] | None:
    """Layer, prim and time codes of an older map's epochs, read there: layer offsets would round them."""
    for spec in prim.GetAttribute(attribute_name("anomalyMap", "values")).GetPropertyStack():
        if times := spec.layer.ListTimeSamplesForPath(spec.path):
            return spec.layer, spec.path.GetPrimPath(), list(times)
    return None


def _time_samples(prim: Usd.Prim) -> Iterator[tuple[str, Sdf.Layer]]:
    """Date of each time code of an older map, in days since 2000-01-01, and a session layer of its values."""
    if epochs_of(prim) or not (found := _samples(prim)):
        return
    layer, path, times = found
    for time in times:
        session, over = _session_of(prim)
        for name, spec in layer.GetPrimAtPath(path).attributes.items():
            if layer.GetNumTimeSamplesForPath(spec.path):
                value = layer.QueryTimeSample(spec.path, time)
                own = Sdf.AttributeSpec(over, name, spec.typeName, spec.variability)
                own.default = Sdf.ValueBlock() if value is None else value
        try:
            date = ORIGIN + datetime.timedelta(days=time)
        except (OverflowError, ValueError) as error:
            raise InputError(
                f"{place(prim)}: its time code {time:g} is no day since {ORIGIN:%Y-%m-%d}; correct it"
            ) from error
        yield date.isoformat(), session
