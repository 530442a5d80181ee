"""The commands that write, on small inputs."""

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]

Work = Callable[[], None]


@dataclass(frozen=True)
class Command:
    """A command line, or a function for what only a running robot does."""

    name: str
    words: str
    """Arguments; IN is the folder of inputs."""
    needs: tuple[str, ...] = ()
    """Inputs, as `INPUTS` names them."""
    begins: str = ""
    """Input whose files lie in the working folder before, to be changed in place."""
    force: bool = True
    """Whether --force replaces older outputs."""
    keeps: bool = False
    """Whether finished parts of the work remain, and a repeat continues it."""

    def arguments(self, inputs: Path, *, force: bool) -> list[str]:
        """Arguments of `magtwin`."""
        words = [word.replace("IN/", f"{inputs}/") for word in self.words.split()]
        return [*words, "--force"] if force and self.force else words


def _magtwin(*words: object) -> None:
    """Run a command that makes an input."""
    from magtwin.cli import main

    main([*map(str, words), "--quiet"])


def _scene(folder: Path) -> None:
    text = (ROOT / "scenes" / "starter.toml").read_text(encoding="utf-8")
    text = text.replace("spacing_m = 0.25", "spacing_m = 1.0").replace("readings = 135", "readings = 2")
    (folder / "room.toml").write_text(text, encoding="utf-8")
    _magtwin("scene", folder / "room.toml", "--out", folder / "room")


def _run(folder: Path) -> None:
    _magtwin("run", "lab", "--duration-s", 3, "--seed", 3, "--out", folder / "run.parquet")


def _readings(folder: Path) -> None:
    survey = folder / "survey"
    survey.mkdir()
    for heading in (0, 90, 180, 270):
        rows = [
            f"{x / 2},{y / 2},{math.radians(heading)},{45e3 + 40 * x * x - 30 * y + heading}"
            for x in range(6)
            for y in range(5)
        ]
        (survey / f"{heading}_map.csv").write_text(
            "\n".join(["# x,y,theta,scalar_mag", *rows, ""]), encoding="utf-8"
        )
    _magtwin("map", "import", survey, "--height-m", 0.2, "--out", folder / "map.usdc")


def _dataset(folder: Path) -> None:
    words = ("--count", 5, "--sessions", 5, "--duration-s", 3, "--path", "sine", "--magnetometer", "physical")
    _magtwin("sweep", "lab", *words, "--out", folder / "days")
    files = sorted((folder / "days").glob("*.parquet"))
    _magtwin("dataset", "build", *files, "--map", ROOT / "maps/lab/lab.usdc", "--out", folder / "set")


def _network(folder: Path) -> None:
    (folder / "train.toml").write_text("layers = [8, 8]\nepochs = 2\nbatch = 64\n", encoding="utf-8")
    words = ("--config", folder / "train.toml", "--epochs", 1)
    _magtwin("train", folder / "set", "--out", folder / "net.safetensors", *words)


def _localized(folder: Path) -> None:
    text = (
        'name = "tiny"\nseed = 5\nchunk = 1\n\n[[scenario]]\nname = "exact"\nruns = 2\nsessions = 1\n'
        'duration_s = 2.0\n\n[[localizer]]\nmethod = "odometry"\n'
    )
    (folder / "tiny.toml").write_text(text, encoding="utf-8")
    _magtwin("bench", folder / "tiny.toml", "--out", folder / "results", "--jobs", 1)


INPUTS: dict[str, tuple[tuple[str, ...], Callable[[Path], None]]] = {
    "scene": ((), _scene),
    "run": ((), _run),
    "readings": ((), _readings),
    "dataset": ((), _dataset),
    "network": (("dataset",), _network),
    "results": ((), _localized),
}
"""How each input is made, and from which others."""


def make_inputs(folder: Path, names: set[str]) -> None:
    """Make inputs that are not there yet."""
    for name, (before, make) in INPUTS.items():
        needed = name in names or any(name in INPUTS[other][0] for other in names)
        if needed and not (folder / f"{name}.done").exists():
            make_inputs(folder, set(before))
            print(f"Making the input {name}", file=sys.stderr, flush=True)
            make(folder)
            (folder / f"{name}.done").touch()


CART = ROOT / "tests" / "data" / "robots" / "cart.urdf"
LAB_MAP = ROOT / "maps" / "lab" / "lab.usdc"
PAPER = ROOT / "weights" / "turtlebot4_paper.safetensors"
RUN = ("run",)

COMMANDS = (
    Command("new", "new room.toml"),
    Command("schema", "schema --out schema"),
    Command("robot", f"robot {CART} --out cart --report cart.json"),
    Command("robot one file", f"robot {CART} --out cart --single-file"),
    Command("robot to urdf", f"robot {ROOT}/robots/turtlebot4/turtlebot4.usda --out back.urdf"),
    Command("scene", "scene IN/room.toml --out room --map IN/room/map/room.map.usdc", ("scene",)),
    Command("map import", "map import IN/survey --out map.usdc", ("readings",)),
    Command("map import table", "map import IN/survey --out map.parquet", ("readings",)),
    Command("map fit", "map fit IN/survey --out map.usdc", ("readings",)),
    Command("map export", "map export IN/map.usdc --out csv", ("readings",)),
    Command("plot", "plot IN/map.usdc --out map.png", ("readings",)),
    Command("map upward", "map upward IN/map.usdc --height-m 0.3 --out up.usdc", ("readings",)),
    Command("map occupancy", "map occupancy IN/room/room.usda --out floor.yaml", ("scene",)),
    Command(
        "map survey",
        "map survey IN/room/room.usda --spacing-m 2 --headings-deg 0,180 --readings 1 --out map.usdc",
        ("scene",),
    ),
    Command(
        "map survey adopt",
        "map survey room/room.usda --spacing-m 2 --headings-deg 0,180 --readings 1 "
        "--out room/new.usdc --adopt",
        ("scene",),
        begins="room",
    ),
    Command(
        "run",
        "run lab --duration-s 2 --out r --out r.parquet --out r.npz --out r.csv --out r.mcap --out r.rrd "
        "--out r.usdc --out r.usda",
    ),
    Command("convert parquet", "convert IN/run.parquet out.parquet", RUN),
    Command("convert npz", "convert IN/run.parquet out.npz", RUN),
    Command("convert csv", "convert IN/run.parquet out.csv", RUN),
    Command("convert mcap", "convert IN/run.parquet out.mcap", RUN),
    Command("convert bag", "convert IN/run.parquet bag", RUN),
    Command("convert rrd", "convert IN/run.parquet out.rrd", RUN),
    Command("convert usd", "convert IN/run.parquet out.usda", RUN),
    Command("report", "report IN/run.parquet --out page.html", RUN),
    Command("compare", "compare IN/run.parquet IN/run.parquet --out page.png", RUN),
    Command("localize", "localize IN/run.parquet --map lab --method odometry --out where", RUN),
    Command("plot picture", "plot IN/run.parquet --at 1 --size 160x120 --out run.png", RUN),
    Command("plot gif", "plot IN/run.parquet --size 160x120 --fps 2 --out run.gif", RUN),
    Command("plot mp4", "plot IN/run.parquet --size 160x120 --fps 2 --out run.mp4", RUN),
    Command("export folder", "export lab --out exported --no-thumbnail"),
    Command("export package", "export lab --out lab.usdz --no-thumbnail"),
    Command("export layer", "export lab --out lab.usdc --target viewer"),
    Command("export web", "export lab --out lab.glb"),
    Command("export gazebo", "export lab --out world.sdf"),
    Command(
        "dataset build",
        f"dataset build IN/days/run_00000.parquet IN/days/run_00001.parquet --map {LAB_MAP} --out set",
        ("dataset",),
    ),
    Command(
        "train",
        "train IN/set --out net.safetensors --config IN/train.toml",
        ("dataset", "network"),
    ),
    Command("train linear", "train IN/set --out net.safetensors --model linear", ("dataset",)),
    Command("model export", "model export IN/net.safetensors --out net.onnx", ("network",)),
    Command(
        "evaluate",
        f"evaluate IN/net.safetensors --dataset IN/set --map {LAB_MAP} --out scores",
        ("network",),
    ),
    Command("sweep", "sweep lab --count 2 --duration-s 2 --path sine --out runs"),
    Command("sweep jobs", "sweep lab --count 2 --duration-s 2 --path sine --out runs --jobs 1", keeps=True),
    Command("bench", "bench IN/tiny.toml --out results --jobs 1", ("results",), keeps=True),
    Command("bench report", "bench report IN/results --out page", ("results",)),
)
