"""Processor time of a variant of a room in a sweep of scenes, over that of a bare USD edit and its run.

    python benchmarks/variants.py

Both read at 20 Hz for 20 s and tell that the map is stale. A ratio above 1.2 fails.
"""

import resource
import sys
import tempfile
import warnings
from pathlib import Path

from pxr import Usd

import magtwin as mt

COUNT, MOST = 12, 1.2


def spent_s() -> float:
    """Processor time so far, that of children included [s]."""
    uses = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(use.ru_utime + use.ru_stime for use in uses)


def main() -> int:
    warnings.simplefilter("ignore")
    room = (
        mt.Room(6, 4)
        .shelf((-2.5, 0))
        .desk((1.5, 1.5), yaw=-1.57)
        .cabinet((2.6, -1), yaw=3.14)
        .robot(at=(0, -1))
    )
    scene, options = room.scene, {"duration_s": 20, "rate_hz": 20}
    places = [(-2.5, -1 + k / 10, 0.0) for k in range(COUNT + 1)]
    with tempfile.TemporaryDirectory() as folder:
        file = mt.author_scene(scene, Path(folder) / "room")

        def edited(place: tuple[float, float, float], number: int) -> mt.Run:
            stage = Usd.Stage.Open(str(file))
            stage.GetPrimAtPath("/World/Furniture/shelf").GetAttribute("xformOp:translate").Set(place)
            stage.GetRootLayer().Export(str(file.parent / f"edit_{number}.usda"))
            stage.Reload()
            return mt.simulate(file.parent / f"edit_{number}.usda", "figure8", seed=number, **options)

        edited(places[-1], COUNT)  # imports and compiled loops
        begin = spent_s()
        bare = [edited(place, k) for k, place in enumerate(places[:COUNT])]
        middle = spent_s()
        variants = [scene.with_({"furniture.shelf.p_world": place}) for place in places[:COUNT]]
        swept = list(mt.sweep(variants, "figure8", **options))
        end = spent_s()
    assert all(
        a["b_truth_nt"].tobytes() == b["b_truth_nt"].tobytes() for a, b in zip(bare, swept, strict=True)
    )
    each = (middle - begin) / COUNT, (end - middle) / COUNT
    print(f"bare edit and run {each[0]:.3f} s, variant {each[1]:.3f} s, ratio {each[1] / each[0]:.2f}")
    return int(each[1] > MOST * each[0])


if __name__ == "__main__":
    sys.exit(main())
