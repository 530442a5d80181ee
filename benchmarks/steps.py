"""Steps a second of one TurtleBot 4 in closed loop: magtwin's compiled loop, MuJoCo and Newton.

A robot follows the figure of eight among the walls of the lab, by the same controller everywhere. A step of
magtwin's is one of control, 20 ms: controller, motors, tyres, contact, pose, all in the compiled loop, and
timed there; what it takes to plan the path and to make a Motion of the steps is told beside. MuJoCo has the
shipped URDF, its fixed links fused, in steps of 1/240 s: once with a command before each step, as a closed
loop of equal steps; once with one every fifth; once in C alone with a constant command, which no closed loop
can surpass. Newton, where the extra `physics` is installed, has the shipped stage, also with a constant
command. The ways take turns in rounds, so that a busy machine slows all alike; medians, in processor time.

    python benchmarks/steps.py [rounds]
"""

import json
import math
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

WANTED = 150
"""How many times MuJoCo's closed loop of equal steps."""

STEP_S = 1 / 240
PER_CONTROL = 5
"""Steps of MuJoCo and Newton a control step, of 20.8 ms."""

SPEED, COUNT = 0.2, 180_000
OURS, CLOSED = "magtwin, compiled loop", "MuJoCo, closed every step"
ROBOT = Path(__file__).parents[1] / "robots/turtlebot4"


def walls():
    """Those of the lab, as obstacles."""
    import numpy as np

    from magtwin.spec.obstacles import Obstacles

    boxes = {
        "north": (-3, 1.75, 3, 1.8),
        "south": (-3, -1.8, 3, -1.75),
        "east": (3, -1.8, 3.05, 1.8),
        "west": (-3.05, -1.8, -3, 1.8),
    }
    corners = [np.array([[a, b], [c, b], [c, d], [a, d]]) for a, b, c, d in boxes.values()]
    return Obstacles(tuple(boxes), tuple(corners))


def magtwins() -> dict[str, Callable[[], int]]:
    """An hour of control steps in the compiled loop, and all that it takes to have them as a Motion."""
    import numpy as np

    from magtwin.path import path_named
    from magtwin.sim.motion import closed_loop
    from magtwin.sim.motion.follow import loop_along
    from magtwin.spec.drive import DriveSpec

    closed_loop.warm_up()
    room = walls()

    def planned() -> closed_loop.ClosedLoop:
        return loop_along(
            path_named("figure8"),
            DriveSpec(),
            speed=SPEED,
            duration_s=COUNT / 50,
            obstacles=room,
            footprint_radius_m=0.171,
        )

    once = planned()
    code, only = closed_loop.LOOPS.open(), np.zeros(1, np.intp)

    def steps() -> int:
        record, made = closed_loop.Robots([once], room).step(0, COUNT, only, code=code)
        if made[0] != COUNT or record[0, -1].any():
            sys.exit("magtwin's robot did not drive for the whole time")
        return COUNT

    def whole() -> int:
        return len(closed_loop.run_loops([planned()], room)[0].v)

    return {OURS: steps, "magtwin, planned and told": whole}


def mujocos() -> dict[str, Callable[[], int]]:
    """MuJoCo's bare steps, and closed loop around them; nothing where it is not installed."""
    try:
        import mujoco
    except ImportError:
        print("MuJoCo is not installed: pip install -c constraints.txt mujoco")
        return {}
    from magtwin.path import path_named
    from magtwin.sim.motion.controllers import guide_along
    from magtwin.sim.motion.drive import limiter, wheel_rates
    from magtwin.spec.drive import DriveSpec

    drive = DriveSpec()
    spec = mujoco.MjSpec.from_file(str(ROBOT / "turtlebot4.urdf"))
    spec.worldbody.first_body().add_freejoint()
    spec.compiler.discardvisual = spec.compiler.fusestatic = True  # three bodies are left: the fewest
    spec.option.timestep, spec.option.integrator = STEP_S, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    for geom in spec.geoms:
        geom.friction[0] = 1.0 if geom.parent.name.endswith("_wheel") else 0.05
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[9, 9, 0.1], friction=[0.05, 0.005, 1e-4])
    for outline in walls().outlines:
        low, high = outline.min(axis=0), outline.max(axis=0)
        middle, half = (low + high) / 2, (high - low) / 2
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=[*middle, 0.15],
            size=[*half, 0.15],
            friction=[0.05, 0.005, 1e-4],
        )
    for joint in (drive.left_wheel_joint, drive.right_wheel_joint):
        motor = spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.set_to_velocity(kv=5.0)
    model = spec.compile()
    data = mujoco.MjData(model)
    path, half = path_named("figure8"), drive.wheel_separation_m / 2
    guides = {
        every: guide_along("follower", path, drive, speed=SPEED, dt=every * STEP_S)
        for every in (1, PER_CONTROL)
    }

    def bare() -> int:
        mujoco.mj_resetData(model, data)
        data.ctrl[:] = wheel_rates(SPEED, 0.0, drive)
        steps = 2_400  # 2 m of straight line
        mujoco.mj_step(model, data, nstep=steps)
        if not 1.8 < data.qpos[0] < 2.05:
            sys.exit(f"MuJoCo's robot went {data.qpos[0]:.2f} m of 2 m")
        return steps

    def closed(every: int) -> int:
        dt = every * STEP_S
        guide, limit = guides[every], limiter(drive, dt)
        guide.node, guide.driven_m = 0, 0.0
        mujoco.mj_resetData(model, data)
        x, y, yaw = guide.pose0
        data.qpos[:2] = x, y
        data.qpos[3:7] = math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)
        v = w = 0.0
        controls = 2_400 // every
        for k in range(controls):
            qw, qx, qy, qz = data.qpos[3:7].tolist()
            yaw = math.atan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz))
            x, y = data.qpos[:2].tolist()
            v, w = limit(*guide.command(k * dt, x, y, yaw, v, w), v, w)
            left = (v - w * half) / drive.wheel_radius_m
            data.ctrl[0], data.ctrl[1] = left, left + 2 * w * half / drive.wheel_radius_m
            mujoco.mj_step(model, data, nstep=every)
        off = abs(path.nearest([data.qpos[:2]])[1][0])
        if off > 0.1:
            sys.exit(f"MuJoCo's robot is {off:.2f} m off its path")
        return controls * every

    return {
        CLOSED: lambda: closed(1),
        "MuJoCo, closed every fifth": lambda: closed(PER_CONTROL),
        "MuJoCo, in C alone": bare,
    }


def newton_steps() -> None:
    """Time Newton on the shipped stage; in a process of its own, as its schemas come before USD."""
    import newton
    import warp
    from pxr import Usd

    warp.config.quiet = True
    builder = newton.ModelBuilder(up_axis=newton.Axis.Z)
    newton.solvers.SolverMuJoCo.register_custom_attributes(builder)
    builder.add_usd(
        Usd.Stage.Open(str(ROBOT / "turtlebot4.usda")),
        xform=warp.transform((0.0, 0.0, 0.006), warp.quat_identity()),
    )
    builder.add_ground_plane(cfg=newton.ModelBuilder.ShapeConfig(mu=0.05))
    model = builder.finalize(device="cpu")
    solver = newton.solvers.SolverMuJoCo(model)
    now, then, control = model.state(), model.state(), model.control()
    newton.eval_fk(model, model.joint_q, model.joint_qd, now)
    index = {label.split("/")[-1]: i for i, label in enumerate(model.joint_label)}
    asked = control.joint_target_qd.numpy().copy()
    for joint in ("left_wheel_joint", "right_wheel_joint"):
        asked[model.joint_qd_start.numpy()[index[joint]]] = SPEED / 0.03575
    control.joint_target_qd.assign(asked)

    def drive(steps: int) -> None:
        nonlocal now, then
        for _ in range(steps):
            now.clear_forces()
            solver.step(now, then, control, None, STEP_S)
            now, then = then, now

    drive(100)
    start, x = time.process_time(), float(now.body_q.numpy()[0][0])
    drive(500)
    took = time.process_time() - start
    print(json.dumps({"steps": 500 / took, "went_m": float(now.body_q.numpy()[0][0]) - x}))


def newtons() -> float | None:
    """Newton's steps a second, none where it is not installed."""
    call = [sys.executable, __file__, "--newton"]
    done = subprocess.run(call, capture_output=True, text=True, check=False)
    if done.returncode:
        why = (done.stderr.strip().splitlines() or ["it stopped"])[-1]
        print(f"Newton is not timed ({why}): pip install -c constraints.txt -e '.[physics]'")
        return None
    seen = json.loads(done.stdout.splitlines()[-1])
    wanted = SPEED * 500 * STEP_S
    if abs(seen["went_m"] - wanted) > 0.1 * wanted:
        sys.exit(f"Newton's robot went {seen['went_m']:.3f} m of {wanted:.3f} m")
    return float(seen["steps"])


def main(rounds: int = 9) -> None:
    works = {**magtwins(), **mujocos()}
    rates: dict[str, list[float]] = {name: [] for name in works}
    for turn in range(rounds + 1):
        for name, work in works.items():
            start = time.process_time()
            steps = work()
            if turn:  # the first is warm-up
                rates[name].append(steps / (time.process_time() - start))
    newton = newtons()
    if newton is not None:
        rates["Newton, constant command"] = [newton]
    ours = statistics.median(rates[OURS])
    print(f"{'one TurtleBot 4':28}{'steps a second':>16}{'x real time':>14}{'magtwin makes':>16}")
    for name, seen in rates.items():
        rate = statistics.median(seen)
        real = rate * (0.02 if name.startswith("magtwin") else STEP_S)
        times = "" if name.startswith("magtwin") else f"{ours / rate:,.0f} times"
        print(f"{name:28}{rate:16,.0f}{real:14,.0f}{times:>16}")
    if CLOSED in rates:
        ratios = [a / b for a, b in zip(rates[OURS], rates[CLOSED], strict=True)]
        print(
            f"closed loop beside MuJoCo's: {statistics.median(ratios):.0f} times the steps (from "
            f"{min(ratios):.0f} to {max(ratios):.0f}); wanted: over {WANTED}"
        )


if __name__ == "__main__":
    if sys.argv[1:] == ["--newton"]:
        newton_steps()
    else:
        main(*map(int, sys.argv[1:]))
