"""`magtwin bench`, its report, and comparisons."""

import shlex
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import App, Parameter

from magtwin.cli import options as opt
from magtwin.cli.app import app
from magtwin.cli.terminal import Done, continued_by_a_repeat, named, progress, step

ANEW = "Remove all results in the folder first, of all localizers."
Anew = Annotated[bool, Parameter(name="--force", negative="", help=ANEW)]
Results = Annotated[Path, Parameter(required=True)]

bench_app = App(name="bench")
app.command(bench_app)


@bench_app.default
def bench(
    suite: str,
    *,
    out: Path,
    only: opt.Names = None,
    localizer: opt.Names = None,
    runs: opt.Whole | None = None,
    seeds: Literal["public", "held-out"] = "public",
    salt: str = "",
    data: Annotated[list[str] | None, Parameter(consume_multiple=True)] = None,
    jobs: opt.Jobs = None,
    shard: opt.Shard = None,
    dask: opt.Dask = None,
    no_tracks: opt.Flag = False,
    force: Anew = False,
) -> Done:
    """Benchmark localizers on simulated and recorded drives, and report the results.

    The localizers of a suite run on its scenarios; the folder gets one row per run and localizer. Runs that
    the folder already has are skipped, so the same command continues an interrupted benchmark, and shards can
    share a folder. The number of processes, shards and machines does not change the rows. docs/bench.md
    describes scenarios and scores.

    Parameters
    ----------
    suite
        TOML file of the suite, or the name of one that ships with magtwin: standard, standard-1, slam,
        aprilab, magnetic-data, ship, 1d.
    out
        Folder of results to write or continue.
    only
        Scenarios to run. Default: all.
    localizer
        Localizers to run: names in the suite, methods of `magtwin localize`, or MODULE:CLASS. Default: all of
        the suite.
    runs
        Largest number of runs of each scenario. Default: all of the suite.
    seeds
        public, to choose settings; or held-out, other places and seeds for a final measurement.
    salt
        Salt of the held-out places and seeds, in hexadecimal digits, of a suite that has one.
    data
        Folders of the data that the suite needs, as NAME=FOLDER, such as ship=magslam/ship.
    jobs
        Number of processes. Default: one for each processor.
    no_tracks
        Do not write the errors over time, which the report draws.
    """
    from magtwin.bench.leaderboard import standings
    from magtwin.bench.runner import benchmark
    from magtwin.parallel import parse_shard

    what: Any = {"scenarios": only or (), "localizers": localizer or (), "runs": runs, "seeds": seeds}
    what["salt"] = salt
    with continued_by_a_repeat(), progress(f"Benchmarking {suite}", "runs") as advance:
        what |= {"data": opt.pairs("data", data, "NAME=FOLDER"), "tracks": not no_tracks, "force": force}
        how: Any = {"jobs": jobs, "dask": dask, "shard": None if shard is None else parse_shard(shard)}
        made = benchmark(suite, out, progress=advance, **what, **how)
    report = made.report(standings(made.rows, made.times, made.compensated))
    page = ("magtwin", "bench", "report", out)
    return Done(report, out, rest=shlex.join(map(str, page)), next=(page,))


@bench_app.command
def report(*folders: Results, out: Path | None = None, force: opt.Force = False) -> Done:
    """Write a report on results: leaderboard, distributions of errors, and errors over time.

    The report is a folder with bench.html, which is self-contained, bench.json, and the pictures.

    Parameters
    ----------
    folders
        Folders of results of one suite, such as those of shards on several machines.
    out
        Folder to make. Default: `report` in the first folder.
    """
    from magtwin.bench.report import report_results

    made = named(folders[0] / "report" if out is None else out, force=force)
    step("Reading the results")
    report_results(folders, made, force=force)
    return Done(wrote=(made / "bench.html", made / "bench.json"), text="open bench.html in a browser")


@bench_app.command
def compare(a: Path, b: Path) -> Done:
    """Compare two folders of results run by run: paired differences with intervals and p-values.

    Only localizers whose name is in both folders are compared.

    Parameters
    ----------
    a
        Folder of results.
    b
        Folder of results to subtract, with the same scenarios and seeds, such as those of another version of
        a localizer.
    """
    from magtwin.bench.report import compare_results

    return Done(compare_results(a, b))


@bench_app.command
def verify(
    receipt: Path,
    *,
    suite: str | None = None,
    runs: opt.Whole = 12,
    salt: str = "",
    data: Annotated[list[str] | None, Parameter(consume_multiple=True)] = None,
    jobs: opt.Jobs = None,
) -> Done:
    """Make a sample of the runs of results again, and compare their rows with those of the receipt.

    Ends with status 1 if a row differs.

    Parameters
    ----------
    receipt
        receipt.json in a folder of results, or the folder.
    suite
        The suite, if it has scenes, paths or weights of its own. Default: its copy in the folder.
    runs
        Number of runs in the sample.
    salt
        Salt of the held-out places and seeds, in hexadecimal digits, if the suite has one.
    data
        Folders of the data that the suite needs, as NAME=FOLDER, such as ship=magslam/ship.
    jobs
        Number of processes. Default: one for each processor.
    """
    from magtwin.bench.runner import verify as check

    step("Making the sample again")
    found = check(
        receipt, suite=suite, runs=runs, salt=salt, data=opt.pairs("data", data, "NAME=FOLDER"), jobs=jobs
    )
    different = next(figure.value for figure in found.figures if figure.name == "different")
    return Done(found, figures=[each.name for each in found.figures], status=int(bool(different)))
