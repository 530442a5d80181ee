"""Train the mixed model that ships: on sessions of the TurtleBot 4, and on plants.

    python weights/mixed.py --out FOLDER [--ship]

The twin of the default lab drives 8 worlds of the nominal plant and 4 of each of four families of
`magtwin.draw_plant`, in 5 sessions each, at drawn speeds. Labels are readings minus the lab's map at the
poses of motion capture. FOLDER gets recordings, data set, weights and model card, after about ten minutes on
two cores; recordings that are there are kept. --ship copies weights and card beside this file.
benchmarks/unknown_plants.py judges the result on plants that are neither in the families nor in the training.
"""

import argparse
import shutil
from pathlib import Path

import magtwin as mt
from magtwin.cli import main as magtwin
from magtwin.files.file import shipped
from magtwin.learn.data.alignment import fit_alignment

WORLDS = (
    *(("nominal", k) for k in range(8)),
    *((family, k) for family in ("hysteresis", "warm-up", "nonlinear", "drawn") for k in range(101, 105)),
)
"""Families of plants and seeds of their constants. What moves is found in the session: see
`magtwin.learn.mixed.hidden`."""

TRAINING = ("random", "sine", "lawnmower", "figure8", "continuous_cycle")
"""Path of each session of a world."""

SECONDS, RATE_HZ = 360.0, 8.0
"""Length of a recording, in which a robot warms up, and the rate of its readings."""

SHIPPED = "turtlebot4_mixed"
BEFORE = """
## After a drive

The errors above are before a drive, on plants too, with the intervals of the nominal plant. `magtwin model
calibrate` adapts the model to a session by a minute's drive; docs/calibrate.md has its errors on plants that
it never saw.
"""


def main() -> None:
    """Drive, label and train as given on the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of all outputs")
    parser.add_argument("--ship", action="store_true", help="copy the weights beside this file")
    given = parser.parse_args()
    folder, weights = given.out / "recordings", given.out / f"{SHIPPED}.safetensors"
    folder.mkdir(parents=True, exist_ok=True)
    twin = mt.open_twin(shipped("scenes", "lab", "lab.usda"), magnetometer="physical")
    for number, (family, k) in enumerate(WORLDS):
        world = folder / f"{family}_{k}"
        if not world.exists():
            options = {
                "sessions": len(TRAINING),
                "speeds": "drawn",
                "duration_s": SECONDS,
                "rate_hz": RATE_HZ,
            }
            seed, plant = 5000 + 10 * number, f"{family}:{k}"
            mt.sweep(twin, TRAINING, len(TRAINING), seed=seed, plant=plant, **options).save(world)
    data, layer = given.out / "set", shipped("maps", "lab", "lab.usdc")
    nominal = [mt.load_run(file) for file in sorted(folder.glob("nominal_*/*.parquet"))]
    alignment = fit_alignment(nominal, mt.load_map(layer))
    mt.build_dataset(
        sorted(folder.glob("*/*.parquet")), out=data, anomaly_map=layer, alignment=alignment, force=True
    )
    trained = ("--model", "mixed", "--licence", "Apache-2.0", "--out", weights, "--force")
    magtwin(["train", str(data), *map(str, trained)])
    card = weights.with_suffix(".md")
    card.write_text(card.read_text(encoding="utf-8") + BEFORE, encoding="utf-8")
    if given.ship:
        for end in (".safetensors", ".md"):
            shutil.copyfile(weights.with_suffix(end), Path(__file__).with_name(f"{SHIPPED}{end}"))


if __name__ == "__main__":
    main()
