"""`magtwin model compensate`: remove the platform's field from a run, by Tolles and Lawson's model."""

from pathlib import Path
from typing import Any, Literal

from cyclopts import App

from magtwin.cli.learn.model import model_app
from magtwin.cli.options import Flag, Force
from magtwin.cli.terminal import Done, named, step
from magtwin.files.kinds import expected

compensate_app = App(name="compensate", help="Remove the platform's field from a run (Tolles-Lawson).")
model_app.command(compensate_app)


@compensate_app.command
def fit(
    run: Path,
    *,
    out: Path,
    terms: str = "permanent,induced6,eddy9",
    band_hz: tuple[float, float] = (0.1, 0.9),
    no_band: Flag = False,
    penalty: float | None = None,
    preset: Literal["magtwin", "magnav"] = "magtwin",
    current: Flag = False,
    force: Force = False,
) -> Done:
    """Fit the model to a calibration run that turns through all headings in a uniform or well mapped field.

    A map that the same robot surveyed in several headings contains the platform's field already, so little is
    left to fit. Survey without the platform, or calibrate outdoors.

    Parameters
    ----------
    run
        Run or log with field vectors, of any kind that `magtwin info` reads. Without a map its field is taken
        as uniform.
    out
        Model to write, a .json file.
    terms
        Terms separated by commas: permanent; induced3, induced5 or induced6; eddy3, eddy8 or eddy9; bias,
        which needs --no-band.
    band_hz
        Pass band of the manoeuvres [Hz].
    no_band
        Fit all frequencies.
    penalty
        Penalty of the regression. Default: by cross-validation, or 0 with --preset magnav.
    preset
        Conventions of the regressors, the filter and the penalty: magtwin's own, or those of MagNav.jl.
    current
        Fit the field of the battery's current too, with its delay.
    """
    from magtwin.files.outputs import output
    from magtwin.io.formats import read_run
    from magtwin.learn.compensation.tolles_lawson import fit_run

    out = named(out, (".json",), "a Tolles-Lawson model", force=force)
    names = tuple(name.strip() for name in f"{terms}{',current' * current}".split(",") if name.strip())
    step("Fitting the model")
    how: Any = {"band_hz": None if no_band else band_hz, "ridge": penalty, "preset": preset}
    model = fit_run(read_run(run), terms=names, **how)
    with output(out, force=force) as aside:
        model.save(aside)
    return Done(model.report(f"Tolles-Lawson model of {run}"), out)


@compensate_app.command
def apply(run: Path, model: Path, *, out: Path, force: Force = False) -> Done:
    """Remove the part of a run's b_measured_nt that a fitted model explains.

    Parameters
    ----------
    run
        Run or log with field vectors, of any kind that `magtwin info` reads.
    model
        Model that `magtwin model compensate fit` wrote (.json).
    out
        Compensated run to write, a .parquet file.
    """
    from magtwin.io.formats import read_run
    from magtwin.io.tables import write_parquet
    from magtwin.learn.compensation.tolles_lawson import TollesLawson, compensate_run

    out = named(out, (".parquet",), "a run", force=force)
    compensated, report = compensate_run(
        read_run(run), TollesLawson.load(expected(model, "Tolles-Lawson model"))
    )
    write_parquet(compensated, out, force=force)
    return Done(report, out, next=(("magtwin", "report", out),))


@compensate_app.command
def export(model: Path, *, out: Path, force: Force = False) -> Done:
    """Write a model's offsets and current terms as parameters of an autopilot.

    Parameters
    ----------
    model
        Model that `magtwin model compensate fit` wrote (.json).
    out
        File to write: .params of PX4 (CAL_MAG0_*), or .parm of ArduPilot (COMPASS_OFS_*, COMPASS_MOT_*).
    """
    from magtwin.files.outputs import output
    from magtwin.learn.compensation.tolles_lawson import TollesLawson

    out = named(out, (".params", ".parm"), "parameters", force=force)
    made = TollesLawson.load(expected(model, "Tolles-Lawson model"))
    px4 = out.suffix == ".params"
    lines = [
        f"1\t1\t{name}\t{value:.8g}\t{6 if isinstance(value, int) else 9}" if px4 else f"{name},{value:.8g}"
        for name, value in made.parameters("px4" if px4 else "ardupilot").items()
    ]
    with output(out, force=force) as aside:
        aside.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return Done(wrote=out, text=f"{len(lines)} parameters", data={"parameters": len(lines)})
