"""A map of 100 x 100 m at 5 cm in 36 headings: time and memory of making, opening and reading it.

The field is that of 60 dipoles below the floor and a robot's hard iron: 4 million nodes in 36 headings, with
a standard deviation at each. It is written tile by tile. Each row is a process of its own; "memory" is the
most that was resident in it, which includes the pages of the file that it touched and the libraries.

    python benchmarks/large_maps.py [folder] [side in m]
"""

import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

SPACING_M, HEADINGS = 0.05, 36
RUN_S, RATE_HZ, SPEED_M_S = 600, 50, 0.2

ROWS = {
    "write": "write it, tile by tile",
    "open": "open it",
    "run": f"look up a run of {RUN_S // 60} min ({RUN_S * RATE_HZ:,} poses) with sd and gradient",
    "everywhere": "look up 100,000 poses all over it",
    "validate": "`magtwin map info`: read and check every tile",
}


def write(file: Path, side_m: float) -> None:
    from magtwin.field.grid import Grid
    from magtwin.field.maps.tiles import Tile
    from magtwin.usd.maps.tiled_layer import save_tiled_map

    rng, nodes = np.random.default_rng(0), round(side_m / SPACING_M) + 1
    headings = np.arange(HEADINGS) * 2 * np.pi / HEADINGS
    grid = Grid(
        origin_m=(-side_m / 2, -side_m / 2),
        cell_m=(SPACING_M, SPACING_M),
        headings_rad=tuple(headings.tolist()),
        rows=nodes,
        columns=nodes,
    )
    p = np.column_stack([rng.uniform(-side_m / 2, side_m / 2, (60, 2)), rng.uniform(-3, -0.8, 60)])
    m = rng.normal(0, 300, (60, 3))
    iron = np.stack([400 * np.cos(headings), 400 * np.sin(headings), np.zeros(HEADINGS)])  # turns with it

    def field_of(rows: slice, columns: slice) -> Tile:
        x, y = np.meshgrid(grid.x_m[columns], grid.y_m[rows])
        r = np.stack([x, y, np.full_like(x, 0.3)])[:, None] - p.T[:, :, None, None]
        d2 = np.einsum("c...,c...", r, r)
        along = 3 * np.einsum("cn...,nc->n...", r, m) / d2
        b = 100 * ((along * r - m.T[:, :, None, None]) / d2**1.5).sum(axis=1)  # mu_0 / 4 pi is 100 nT m/A
        b += np.array([18_000.0, 0.0, -44_000.0])[:, None, None]
        values = np.sqrt(np.einsum("c...,c...", b, b) + 2 * np.einsum("c...,ch->h...", b, iron) + 400.0**2)
        sd = np.broadcast_to(20 + 0.5 * np.hypot(*b[:2] - 18_000) / 1000, values.shape)
        return Tile(values.astype(np.float32), np.ones(values.shape, bool), (sd * sd).astype(np.float32))

    save_tiled_map(file, grid, field_of, name="warehouse", height_m=0.3, method="60 dipoles", force=True)


def poses(extent: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """A drive at a steady speed that turns slowly, from a corner of the map inwards."""
    t = np.arange(RUN_S * RATE_HZ) / RATE_HZ
    yaw = np.pi / 4 + 0.9 * np.sin(0.05 * t) + 0.4 * np.sin(0.23 * t)
    steps = SPEED_M_S / RATE_HZ * np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)
    return np.array([extent[0] + 1, extent[2] + 1]) + np.cumsum(steps, axis=0), yaw


def measure(what: str, file: Path, side_m: float) -> str:
    from magtwin.usd.maps.layer import load_map

    before, start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.perf_counter()
    busy = time.process_time()
    if what == "write":
        write(file, side_m)
        note = f"{file.stat().st_size / 1e9:.2f} GB"
    else:
        field = load_map(file)
        if what == "run":
            field.lookup_all(*poses(field.extent))
        elif what == "everywhere":
            rng = np.random.default_rng(1)
            x0, x1, y0, y1 = field.extent
            field.lookup(rng.uniform((x0, y0), (x1, y1), (100_000, 2)), rng.uniform(0, 7, 100_000))
        elif what == "validate":
            from magtwin.field.maps.statistics import map_metadata

            map_metadata(field)
        note = f"{len(field.opened)} of {len(field.tiling)} tiles"
    seconds = time.perf_counter() - start
    busy = time.process_time() - busy
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return f"{seconds:.2f} s | {busy:.2f} s | {most / 1e3:,.0f} MB (libraries {before / 1e3:,.0f}) | {note}"


def main(folder: Path, side_m: float) -> None:
    print("| | time | of a processor | memory | |\n|---|---|---|---|---|")
    for what, text in ROWS.items():
        command = [sys.executable, __file__, what, str(folder / "large.usdc"), str(side_m)]
        done = subprocess.run(command, check=True, capture_output=True, text=True)
        print(f"| {text} | {done.stdout.strip()} |", flush=True)


if __name__ == "__main__":
    if sys.argv[1:2] and sys.argv[1] in ROWS:
        print(measure(sys.argv[1], Path(sys.argv[2]), float(sys.argv[3])))
    elif sys.argv[1:2]:
        main(Path(sys.argv[1]), float((sys.argv[2:] or [100])[0]))
    else:
        with tempfile.TemporaryDirectory() as scratch:
            main(Path(scratch), 100.0)
