"""Let one converted robot settle in PhysX on the CPU, then move its first joint.

    python physx_trial.py < JOBS

A server of jobs, see `serving.py`, for a Python with ovphysx; needs neither magtwin nor pxr. A job has
`room` (the stage, on a ground if it floats), `answer`, `bodies` (paths), `base`, `floats`, and `drives`:
path, kind, gains and limits of each driven joint, in the units of UsdPhysics.
"""

import json
import math
import sys
from importlib import metadata
from pathlib import Path

import numpy as np
from ovphysx.types import SimObjectType
from serving import serve

sys.path.insert(0, str(Path(__file__).parents[1] / "physx"))
from physx_world import open_stage, read, write

STEP_S = 1 / 240
SETTLE_S, WATCH_S, MOVE_S = 3.0, 1.0, 1.0
TURN_DEG, SLIDE_M = math.degrees(0.2), 0.02

LINK, JOINT = SimObjectType.ARTICULATION_LINK, SimObjectType.ARTICULATION_JOINT

LIMIT_GB = 16


class Trial:
    """One robot in PhysX."""

    def __init__(self, job: dict) -> None:
        self._physx, self._stage = open_stage(job["room"])
        self._bodies = job["bodies"]
        self.top_speed = 0.0

    def read(self, kind: SimObjectType, path: str, name: str) -> list[float]:
        """An attribute of a prim."""
        return read(self._physx, kind, path, name)

    def write(self, path: str, name: str, value: float) -> None:
        """Set an attribute of a joint."""
        write(self._physx, JOINT, path, name, [value])

    def places(self) -> np.ndarray:
        return np.array([self.read(LINK, body, "position") for body in self._bodies])

    def run(self, seconds: float) -> bool:
        """Step; False if a value is not finite."""
        last = self.places()
        parts = 10
        for _ in range(parts):
            for _ in range(round(seconds / STEP_S / parts)):
                self._physx.step_sync(STEP_S)
            now = self.places()
            if not np.isfinite(now).all():
                return False
            speed = np.linalg.norm(now - last, axis=1).max() / (seconds / parts)
            self.top_speed, last = max(self.top_speed, float(speed)), now
        return True

    def move(self, drives: list[dict]) -> dict | None:
        """Move the first joint that has a drive; the motion as a share of the step."""
        for drive in drives:
            path, step = drive["path"], SLIDE_M if drive["slides"] else TURN_DEG
            before = self.read(JOINT, path, "jointPosition")[0]
            if drive["stiffness"]:
                up, down = min(step, drive["upper"] - before), min(step, before - drive["lower"])
                step = up if up >= down else -down
                self.write(path, "jointPositionTarget", drive["target"] + step)
            else:
                self.write(path, "jointVelocityTarget", step / MOVE_S)
            fine = self.run(MOVE_S)
            share = (self.read(JOINT, path, "jointPosition")[0] - before) / step if fine else math.nan
            return {"what": path.rpartition("/")[2], "share": share}
        return None


def main(job_file: str) -> None:
    job = json.loads(Path(job_file).read_text())
    trial = Trial(job)
    masses = {body: trial.read(LINK, body, "mass")[0] for body in job["bodies"]}
    seen: dict = {
        "engine": f"ovphysx {metadata.version('ovphysx')}",
        "mass_kg": sum(masses.values()),
        "masses_kg": masses,
        "bodies": len(masses),
        "floats": job["floats"],
    }
    start = trial.places()
    fine = trial.run(SETTLE_S)
    settled = trial.places()
    fine = fine and trial.run(WATCH_S)
    if fine:
        after, base = trial.places(), job["bodies"].index(job["base"])
        creep, moved = (np.linalg.norm(after - other, axis=1) for other in (settled, start))
        i, j, _, _ = trial.read(LINK, job["base"], "orientation")
        seen |= {
            "creep_m": float(creep.max()),
            "creeps": job["bodies"][int(creep.argmax())],
            "base_moved_m": float(moved[base]),
            "moved_m": float(moved.max()),
            "moves": job["bodies"][int(moved.argmax())],
            "tilt_deg": math.degrees(math.acos(max(-1.0, min(1.0, 1 - 2 * (i * i + j * j))))),
            "motion": trial.move(job["drives"]),
        }
    seen |= {"finite": fine, "top_speed_m_s": trial.top_speed}
    Path(job["answer"]).write_text(json.dumps(seen))


if __name__ == "__main__":
    serve(main, LIMIT_GB)
