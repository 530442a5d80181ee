"""Follow five journeys through the package, and compare the files that each enters with ARCHITECTURE.md.

    python .ci/walks.py           compare; exit status 1 if a list is not true, or a walk is too long
    python .ci/walks.py --write   write the lists into ARCHITECTURE.md

A file counts if one of its functions runs. Code that runs when a module is loaded does not count.
"""

import re
import sys
import tempfile
import threading
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "magtwin"
PAGE = ROOT / "ARCHITECTURE.md"

FILES = {
    "scene_to_recording": 134,
    "survey_to_map": 60,
    "recordings_to_network": 62,
    "localizer_to_row": 105,
    "urdf_to_usd": 60,
}
"""Most files of each walk."""

OPTIMIZED = 1
"""Flag of the code of functions, which bodies of modules and classes lack (`inspect.CO_OPTIMIZED`)."""


def scene_to_recording(folder: Path) -> Iterator[None]:
    """TOML to .rrd."""
    import magtwin as mt

    yield
    stage = mt.author_scene(ROOT / "scenes/lab.toml", folder / "lab")
    mt.simulate(stage, "figure8", duration_s=5).save(folder / "run.rrd")


def survey_to_map(folder: Path) -> Iterator[None]:
    """Survey to map."""
    import numpy as np

    import magtwin as mt

    x, y = (side.ravel() for side in np.meshgrid(np.arange(0, 3, 0.25), np.arange(0, 2, 0.25)))
    rows = np.column_stack([x, y, 0 * x, 48_000 + 900 * np.sin(x) * np.cos(2 * y)])
    np.savetxt(folder / "walk.csv", rows, delimiter=",", header="x,y,heading,field_nt", comments="")
    yield
    mt.save_map(mt.fit_map(mt.read_survey(folder / "walk.csv"), "gp"), folder / "map.usdc")


def recordings_to_network(folder: Path) -> Iterator[None]:
    """Recordings to network."""
    import magtwin as mt

    twin = mt.open_twin(ROOT / "scenes/lab/lab.usda", magnetometer="physical")
    runs = [folder / f"{number}.parquet" for number in range(4)]
    for number, run in enumerate(runs):
        robot = mt.in_session(twin, session=number, seed=0)
        mt.simulate(robot, "figure8", duration_s=20, seed=number).save(run)
    yield
    lab = ROOT / "maps/lab/lab.usdc"
    data = mt.build_dataset(runs, out=folder / "set", anomaly_map=lab, jobs=1)
    mt.train(data, out=folder / "net.safetensors", model="linear")
    mt.evaluate(folder / "net.safetensors", data, anomaly_map=lab)


def localizer_to_row(folder: Path) -> Iterator[None]:
    """Localizer to row."""
    from magtwin.bench.row import run_chunk
    from magtwin.bench.suite import load_suite

    yield
    suite = load_suite("standard").limited(scenarios=["tracking"], localizers=["ekf"], runs=1)
    run_chunk(suite, suite.chunks()[0])  # as a worker does


def urdf_to_usd(folder: Path) -> Iterator[None]:
    """URDF to USD."""
    import magtwin as mt

    yield
    mt.from_urdf(ROOT / "robots/turtlebot4/turtlebot4.urdf", folder / "robot")


WALKS = (scene_to_recording, survey_to_map, recordings_to_network, localizer_to_row, urdf_to_usd)


def entered(walk: Callable[[Path], Iterator[None]]) -> set[str]:
    """Files of the package in which a function runs on a walk, from where it yields to its end."""
    seen: set[str] = set()

    def note(frame: FrameType, event: str, _: Any) -> None:
        if event == "call" and frame.f_code.co_flags & OPTIMIZED:
            seen.add(frame.f_code.co_filename)

    with tempfile.TemporaryDirectory() as folder:
        steps = walk(Path(folder))
        next(steps)
        threading.setprofile(note)
        sys.setprofile(note)
        try:
            next(steps, None)
        finally:
            sys.setprofile(None)
            threading.setprofile(None)
    return {str(Path(name).relative_to(PACKAGE)) for name in seen if Path(name).is_relative_to(PACKAGE)}


def as_text(walk: Callable[[Path], Iterator[None]], files: set[str]) -> str:
    """The files of a walk by room, as lines of Markdown."""
    rooms: dict[str, list[str]] = {}
    for name in sorted(files):
        room, _, file = name.rpartition("/")
        rooms.setdefault(room, []).append(file.removesuffix(".py"))
    lines = [f"- {f'`{room}/`' if room else 'top'}: {', '.join(names)}" for room, names in rooms.items()]
    return "\n".join([f"**{walk.__doc__}** {len(files)} files.", "", *lines, ""])


def main() -> int:
    """Compare the walks with the page, or write them into it."""
    warnings.simplefilter("ignore")
    found = {walk: entered(walk) for walk in WALKS}
    text = "\n".join(as_text(walk, files) for walk, files in found.items())
    page = PAGE.read_text(encoding="utf-8")
    new = re.sub(r"(?s)(?<=<!-- walks -->\n).*(?=<!-- end of walks -->)", lambda _: f"\n{text}\n", page)
    if "--write" in sys.argv[1:]:
        PAGE.write_text(new, encoding="utf-8")
    elif new != page:
        print("The walks in ARCHITECTURE.md are not true: python .ci/walks.py --write", file=sys.stderr)
        return 1
    for walk, files in found.items():
        print(f"{len(files):4} of {FILES[walk.__name__]:4}  {walk.__doc__}")
    return int(any(len(files) > FILES[walk.__name__] for walk, files in found.items()))


if __name__ == "__main__":
    sys.exit(main())
