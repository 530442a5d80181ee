"""`magtwin bench`, its report, and comparisons."""

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import App, Parameter

from magtwin.cli.app import app
from magtwin.cli.options import Dask, Flag, Force, Jobs, Names, Shard, Whole, pairs
from magtwin.cli.terminal import Done, announce, progress

Results = Annotated[Path, Parameter(required=True)]

bench_app = App(
    name="bench", help="Benchmark localizers on simulated and recorded drives, and report the results."
)
app.command(bench_app)


@bench_app.default
def bench(
    suite: str,
    *,
    out: Path,
    only: Names = None,
    localizer: Names = None,
    runs: Whole | None = None,
    seeds: Literal["public", "held-out"] = "public",
    data: Annotated[list[str] | None, Parameter(consume_multiple=True)] = None,
    jobs: Jobs = None,
    shard: Shard = None,
    dask: Dask = None,
    no_tracks: Flag = False,
    force: Force = False,
) -> Done:
    """Benchmark localizers: run those of a suite on its scenarios, and write one row per run.

    Runs that are in the output folder already are skipped, so that the same command continues an interrupted
    benchmark, and shards can share a folder. The rows depend on neither jobs nor shards nor the machine.

    Parameters
    ----------
    suite
        TOML file of the suite, or the name of one that ships with magtwin: standard, aprilab, magnetic-data,
        ship.
    out
        Folder of results.
    only
        Scenarios to run. Default: all.
    localizer
        Localizers to run: names of the suite, of magtwin, or MODULE:CLASS. Default: all of the suite.
    runs
        Most runs of each scenario. Default: as many as the suite has.
    seeds
        held-out: other seeds than the public ones, for a final measurement.
    data
        Folders of data, as NAME=FOLDER.
    no_tracks
        Keep no errors over time.
    """
    from magtwin.bench.leaderboard import standings
    from magtwin.bench.runner import benchmark
    from magtwin.parallel import parse_shard

    announce(f"Benchmarking {suite}")
    with progress("Running", "runs") as advance:
        made = benchmark(
            suite,
            out,
            scenarios=only or (),
            localizers=localizer or (),
            runs=runs,
            seeds=seeds,
            data=pairs("data", data, "NAME=FOLDER"),
            jobs=jobs,
            shard=None if shard is None else parse_shard(shard),
            dask=dask,
            tracks=not no_tracks,
            force=force,
            progress=advance,
        )
    return Done(made.report(standings(made.rows, made.times)), out)


@bench_app.command
def report(*folders: Results, out: Path | None = None, force: Force = False) -> Done:
    """Write a page about results: leaderboard, distributions, errors over time and over the floor.

    The folder gets bench.html, which needs no other file, bench.md with its pictures, and bench.json.

    Parameters
    ----------
    folders
        Folders of results of one suite, as of shards on several machines.
    out
        Folder to make. Default: report, in the first folder.
    """
    from magtwin.bench.report import report_results

    announce("Reading the results")
    made = folders[0] / "report" if out is None else out
    report_results(folders, made, force=force)
    return Done(wrote=made)


@bench_app.command
def compare(a: Path, b: Path, *, out: Path | None = None, force: Force = False) -> Done:
    """Compare two results of one suite, run by run: paired differences with intervals and p-values.

    Parameters
    ----------
    a
        Folder of results.
    b
        Folder of other results with the same scenarios and seeds, as of another version of a localizer.
    out
        Page to write: .html, .md or .json. Default: only print.
    """
    from magtwin.bench.report import compare_results

    return Done(compare_results(a, b, out, force=force), wrote=out or ())
