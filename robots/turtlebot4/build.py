"""Build the TurtleBot 4: its meshes, its URDF, and the USD asset.

    python robots/turtlebot4/build.py

The shapes are our own drawing of the robot from its published measures; nothing is taken from its
makers' models. Lengths are metres, masses kilograms. Needs trimesh and mapbox_earcut.
"""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree

import mapbox_earcut
import numpy as np
import trimesh

HERE = Path(__file__).resolve().parent

# Measures. Sources: iRobot Create 3 and TurtleBot 4 user manuals, and the joint poses of their ROS
# descriptions (github.com/turtlebot/turtlebot4, github.com/iRobotEducation/create3_sim).
WHEEL_RADIUS, WHEEL_WIDTH, WHEEL_SEPARATION, WHEEL_HEIGHT = 0.03575, 0.015, 0.233, 0.0402
GROUND = WHEEL_HEIGHT - WHEEL_RADIUS  # height of the floor in base_link
CASTER_RADIUS = 0.01
BASE_TOP, SHELL_HEIGHT, PLATE_HEIGHT = 0.0942, 0.045, 0.3468
STANDOFFS = {"front_left": (0.0306, 0.1143), "front_right": (0.0306, -0.1143)}
STANDOFFS |= {"rear_left": (-0.0761, 0.0907), "rear_right": (-0.0761, -0.0907)}
HEAD_ABOVE_PLATE = 0.06  # the magnetometer's head over the plate's upper face

COLOURS = {
    "charcoal": (0.27, 0.28, 0.30),
    "black": (0.15, 0.155, 0.165),
    "glass": (0.05, 0.05, 0.08),
    "rubber": (0.13, 0.13, 0.13),
    "shell": (0.74, 0.755, 0.77),
    "panel": (0.83, 0.84, 0.85),
    "aluminium": (0.62, 0.64, 0.66),
    "steel": (0.45, 0.46, 0.48),
    "nylon": (0.95, 0.94, 0.90),
    "sensor": (0.06, 0.42, 0.80),
    "light": (0.25, 0.85, 0.90),
}


def circle(radius, n=64, centre=(0.0, 0.0), phase=0.0):
    """Outline of a regular n-gon, counter-clockwise, shape (n, 2)."""
    a = 2 * np.pi * np.arange(n) / n + phase
    return radius * np.column_stack([np.cos(a), np.sin(a)]) + centre


def rounded(points, radius, n=6):
    """An outline with each corner replaced by an arc, shape (N, 2)."""
    points, out = np.asarray(points, float), []
    for before, corner, after in zip(np.roll(points, 1, 0), points, np.roll(points, -1, 0), strict=True):
        u, v = before - corner, after - corner
        u, v = u / np.linalg.norm(u), v / np.linalg.norm(v)
        half = np.arccos(np.clip(u @ v, -1, 1)) / 2
        if half > np.radians(88):  # on a curve already
            out.append(corner)
            continue
        back = radius / np.tan(half)
        centre = corner + (u + v) / np.linalg.norm(u + v) * radius / np.sin(half)
        start, end = corner + u * back - centre, corner + v * back - centre
        sweep = np.arctan2(start[0] * end[1] - start[1] * end[0], start @ end)
        for t in np.linspace(0, sweep, n):
            c, s = np.cos(t), np.sin(t)
            out.append(centre + np.array([c * start[0] - s * start[1], s * start[0] + c * start[1]]))
    return np.array(out)


def rectangle(x0, x1, y0, y1):
    """Outline of a rectangle, counter-clockwise."""
    return np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], float)


def sector(inner, outer, half_angle, n=64):
    """Outline of a part of a ring about +x; `inner` and `outer` give the radius at an angle."""
    a = np.linspace(-half_angle, half_angle, n)
    ring = [np.column_stack([r(t) * np.cos(t), r(t) * np.sin(t)]) for r, t in ((outer, a), (inner, a[::-1]))]
    return np.vstack(ring)


def inset(outline, distance):
    """An outline moved inwards by `distance`, its points keeping their number."""
    if distance == 0:
        return outline
    edge = np.roll(outline, -1, 0) - outline
    normal = np.column_stack([-edge[:, 1], edge[:, 0]]) / np.linalg.norm(edge, axis=1, keepdims=True)
    mean = normal + np.roll(normal, 1, 0)
    mean /= np.maximum(np.sum(mean * normal, axis=1, keepdims=True), 0.3)
    return outline + distance * mean


def shrunk(outline, distance):
    """An outline whose points move towards the origin by `distance`: for round ones with steps."""
    return outline * (1 - distance / np.linalg.norm(outline, axis=1, keepdims=True))


def loft(outline, levels, holes=(), inset=inset):
    """A solid between inset copies of an outline, with holes straight through.

    Args:
        outline: Counter-clockwise outline, shape (N, 2).
        levels: Pairs of inset and height, from below upwards.
        holes: Counter-clockwise outlines inside.
        inset: How copies are made smaller.
    """
    vertices, faces, start = [], [], 0
    rings = [[np.column_stack([inset(outline, d), np.full(len(outline), z)]) for d, z in levels]]
    for hole in holes:
        bottom, top = levels[0][1], levels[-1][1]
        rings.append([np.column_stack([hole[::-1], np.full(len(hole), z)]) for z in (bottom, top)])
    caps = {0: [], -1: []}
    for stack in rings:
        n = len(stack[0])
        here = np.arange(n)
        there = (here + 1) % n
        for k in range(len(stack) - 1):
            a, b = start + k * n, start + (k + 1) * n
            faces += [np.column_stack([a + here, a + there, b + there])]
            faces += [np.column_stack([a + here, b + there, b + here])]
        caps[0].append(start + here)
        caps[-1].append(start + (len(stack) - 1) * n + here)
        vertices += stack
        start += n * len(stack)
    vertices = np.vstack(vertices)
    ends = np.cumsum([len(stack[0]) for stack in rings]).astype(np.uint32)
    for level, index in caps.items():
        index = np.concatenate(index)
        cut = mapbox_earcut.triangulate_float64(vertices[index, :2], ends).reshape(-1, 3).astype(int)
        p = vertices[index[cut]][..., :2]
        u, v = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
        turn = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
        up = np.where((turn > 0)[:, None], cut, cut[:, ::-1])
        faces.append(index[up if level else up[:, ::-1]])
    mesh = trimesh.Trimesh(vertices, np.vstack(faces), process=False)
    if not (mesh.is_watertight and mesh.volume > 0):
        raise ValueError("a loft must be closed; do its insets cross?")
    return mesh


def disc(radius, z0, z1, centre=(0.0, 0.0), chamfer=0.0, n=48):
    """An upright cylinder with chamfered edges."""
    c = chamfer
    levels = [(0, z0), (0, z1)] if c == 0 else [(c, z0), (0, z0 + c), (0, z1 - c), (c, z1)]
    return loft(circle(radius, n, centre), levels)


def block(x0, x1, y0, y1, z0, z1):
    """A box between planes."""
    return loft(rectangle(x0, x1, y0, y1), [(0, z0), (0, z1)])


def along_x(mesh):
    """A solid whose z becomes x, its x becoming y and its y becoming z."""
    turned = mesh.copy()
    turned.vertices = mesh.vertices[:, [2, 0, 1]]
    return turned


def together(*meshes):
    """Several solids as one mesh."""
    return trimesh.util.concatenate(meshes)


@dataclass
class Link:
    """A link of the URDF: what it weighs, shows and touches with."""

    mass: float
    looks: list = field(default_factory=list)  # (name, mesh or primitive, colour)
    touch: tuple | None = None  # (primitive or mesh name, pose xyz)
    solid: object = None  # trimesh solid that the mass fills evenly; first look if none
    inertial: tuple | None = None  # (centre xyz, (ixx, iyy, izz)) where published
    friction: float = 0.5


def primitive(kind, **figures):
    """A URDF primitive as (kind, attributes)."""
    return kind, {k: " ".join(f"{v:g}" for v in np.atleast_1d(value)) for k, value in figures.items()}


def base_radius(angle):
    """Radius of the base at an angle from the front: 342 mm long, 339 mm wide."""
    return 0.1695 + 0.0015 * np.abs(np.cos(angle))


def base_link():
    """The Create 3: body with wheel wells, and the face that shows in front of the shell."""
    a = 2 * np.pi * np.arange(128) / 128 - np.pi
    front = np.abs(a) < np.radians(98)
    r = np.where(front, 0.1630, base_radius(a))
    outline = np.column_stack([r * np.cos(a), r * np.sin(a)])
    wells = [rectangle(-0.040, 0.040, y - 0.0115, y + 0.0115) for y in (-0.1165, 0.1165)]
    lower = loft(outline, [(0.026, 0.0150), (0.008, 0.0210), (0, 0.0280), (0, 0.0780)], wells, shrunk)
    upper = loft(
        outline,
        [(0.0003, 0.0770), (0.001, 0.0850), (0.004, 0.0900), (0.010, 0.0930), (0.018, BASE_TOP)],
        (),
        shrunk,
    )
    face = loft(circle(0.149, 96), [(0, BASE_TOP), (0.0015, BASE_TOP + 0.0012)])
    knobs = [disc(0.0065, BASE_TOP, BASE_TOP + 0.003, (0.095, y), 0.0008) for y in (-0.030, 0.030)]
    knobs.append(disc(0.0105, BASE_TOP, BASE_TOP + 0.003, (0.095, 0), 0.0008))
    ring = loft(
        circle(0.0145, 48, (0.095, 0)),
        [(0, BASE_TOP), (0, BASE_TOP + 0.002)],
        [circle(0.0118, 48, (0.095, 0))],
    )
    return Link(
        2.3,
        [
            ("base_body", together(lower, upper), "charcoal"),
            ("base_face", together(face, *knobs), "black"),
            ("base_light_ring", ring, "light"),
        ],
        (primitive("cylinder", radius=0.164, length=0.06), (0, 0, 0.0492)),
        inertial=((0.0228, 0, 0.0742), (0.0162, 0.0162, 0.0309)),
    )


def bumper():
    """The front half ring, its frame 39.2 mm above base_link's."""
    half = np.radians(96.5)
    ring = sector(lambda t: np.full_like(t, 0.1640), base_radius, half)
    shape = loft(ring, [(0.002, -0.0220), (0, -0.0190), (0, 0.0400), (0.0008, 0.0440), (0.0022, 0.0470)])
    eyes = sector(lambda t: np.full_like(t, 0.1680), lambda t: base_radius(t) + 0.0004, np.radians(70), 48)
    window = loft(eyes, [(0, 0.0130), (0, 0.0230)])
    return Link(
        0.1, [("bumper_ring", shape, "black"), ("bumper_window", window, "glass")], ("bumper_ring", (0, 0, 0))
    )


def wheel():
    """Tyre and hub, turning about z."""
    n, half = 40, WHEEL_WIDTH / 2
    a = 2 * np.pi * np.arange(4 * n) / (4 * n)
    r = np.where(np.arange(4 * n) % 4 < 2, WHEEL_RADIUS, WHEEL_RADIUS - 0.0012)
    tread = np.column_stack([r * np.cos(a), r * np.sin(a)])
    tyre = loft(
        tread, [(0.001, -half), (0, -half + 0.001), (0, half - 0.001), (0.001, half)], [circle(0.024, 48)]
    )
    holes = [
        circle(0.0058, 20, 0.0145 * np.array([np.cos(t), np.sin(t)])) for t in 2 * np.pi * np.arange(5) / 5
    ]
    hub = loft(circle(0.024, 48), [(0, -half + 0.0006), (0, half - 0.0006)], holes)
    return Link(
        0.2,
        [("wheel_tyre", tyre, "rubber"), ("wheel_hub", hub, "aluminium")],
        (primitive("cylinder", radius=WHEEL_RADIUS, length=WHEEL_WIDTH), (0, 0, 0)),
        inertial=((0, 0, 0), (6.8e-5, 6.8e-5, 1.28e-4)),
        friction=1.0,
    )


def caster():
    """The ball in front."""
    ball = primitive("sphere", radius=CASTER_RADIUS)
    return Link(
        0.01,
        [("ball", ball, "steel")],
        (ball, (0, 0, 0)),
        solid=trimesh.creation.icosphere(subdivisions=3, radius=CASTER_RADIUS),
        friction=0.05,
    )


def shell_link():
    """The shell on the base, open in front of the base's buttons; its frame is the base's top."""
    a = np.radians([37, *np.linspace(46, 314, 78), 323])  # room for the corners' arcs
    outline = 0.1370 * np.column_stack([np.cos(a), np.sin(a)])
    notch = [[0.058, -0.052], [0.058, 0.052]]
    outline = rounded(np.vstack([outline, notch]), 0.014, 10)
    body = loft(
        outline, [(0.0015, 0.0012), (0, 0.0030), (0, 0.0405), (0.0012, 0.0430), (0.0035, SHELL_HEIGHT)]
    )
    band = loft(inset(outline, -0.0005), [(0, 0.0070), (0, 0.0120)])
    lid = loft(
        inset(outline, 0.0075),
        [(0, SHELL_HEIGHT - 0.001), (0, SHELL_HEIGHT + 0.0004), (0.0008, SHELL_HEIGHT + 0.001)],
    )
    screen = loft(rounded(rectangle(-0.036, 0.008, 0.062, 0.086), 0.003), [(0, 0.045), (0.0006, 0.0478)])
    keys = [disc(0.0045, 0.045, 0.0478, (x, -0.074), 0.0008, 24) for x in (-0.036, -0.022, -0.008, 0.006)]
    return Link(
        0.39,
        [
            ("shell_body", body, "shell"),
            ("shell_lid", lid, "panel"),
            ("shell_band", band, "charcoal"),
            ("shell_screen", together(screen, *keys), "glass"),
        ],
        ("shell_body", (0, 0, 0)),
    )


def standoff():
    """An aluminium rod, 205 mm long, with the stud that carries the plate."""
    rod = disc(0.006, -0.1025, 0.1025, chamfer=0.0008, n=32)
    stud = disc(0.0035, 0.1020, 0.1052, n=24)
    # The maker's description gives each rod 260 g; 65 g is what aluminium of this size weighs.
    return Link(
        0.065, [("standoff", together(rod, stud), "aluminium")],
        (primitive("cylinder", radius=0.006, length=0.205), (0, 0, 0)), solid=rod,
    )  # fmt: skip


def tower_sensor_plate():
    """The plate on top, with a grid of holes."""
    grid = 0.02 * np.stack(np.meshgrid(np.arange(-6, 7), np.arange(-6, 7)), -1).reshape(-1, 2)
    distance = np.linalg.norm(grid, axis=1)
    clear = (distance > 0.025) & (distance < 0.126)
    for xy in STANDOFFS.values():
        clear &= np.linalg.norm(grid - xy, axis=1) > 0.012
    # Turned against each other: edges in one line make triangles without an area.
    holes = [circle(0.0026, 10, xy, phase=0.35 + 0.37 * i) for i, xy in enumerate(grid[clear])]
    plate = loft(circle(0.137, 96), [(0.0004, 0), (0, 0.0004), (0, 0.0026), (0.0004, 0.003)], holes)
    screws = [disc(0.005, 0.0028, 0.0055, xy, 0.0008, 24) for xy in STANDOFFS.values()]
    return Link(
        0.332,
        [("plate", plate, "charcoal"), ("plate_screws", together(*screws), "steel")],
        (primitive("cylinder", radius=0.137, length=0.003), (0, 0, 0.0015)),
    )


def hull(*outlines):
    """Outline around outlines."""
    from scipy.spatial import ConvexHull

    points = np.vstack(outlines)
    return points[ConvexHull(points).vertices]


def rplidar_link():
    """The RPLIDAR A1: a head that spins over a body with its motor at +y; its frame is the scan plane's."""
    tray = loft(
        hull(circle(0.0355), circle(0.0155, 48, (0, 0.0465))),
        [(0.001, -0.0300), (0, -0.0290), (0, -0.0220), (0.001, -0.0210)],
    )
    feet = [
        disc(0.0030, -0.0537, -0.0295, xy, n=20)
        for xy in ((0.024, -0.018), (-0.024, -0.018), (0.016, 0.040), (-0.016, 0.040))
    ]
    neck = disc(0.0260, -0.0215, -0.0175)
    head = disc(0.0345, -0.0180, 0.0100, chamfer=0.0018, n=64)
    band = disc(0.0348, -0.0075, 0.0030, n=64)
    motor = disc(0.0115, -0.0480, -0.0295, (0, 0.0470), 0.001)
    pulley = disc(0.0080, -0.0215, -0.0170, (0, 0.0470), 0.0008, 32)
    return Link(
        0.17,
        [
            ("lidar_body", together(tray, neck, head, *feet), "black"),
            ("lidar_window", band, "glass"),
            ("lidar_motor", together(motor, pulley), "steel"),
        ],
        (primitive("box", size=(0.071, 0.1, 0.06)), (0, 0.013, -0.019)),
        solid=together(tray, head),
    )


def oakd_camera_bracket():
    """The bracket behind the LiDAR, whose arm carries the camera over it."""
    foot = loft(rounded(rectangle(-0.012, 0.010, -0.020, 0.020), 0.004), [(0, -0.0078), (0, -0.0048)])
    riser = block(-0.0110, -0.0080, -0.014, 0.014, -0.0060, 0.0768)
    arm = block(-0.0105, 0.0560, -0.0139, 0.0139, 0.0738, 0.0770)
    rib = along_x(loft(rectangle(-0.0015, 0.0015, 0.0540, 0.0745), [(0, -0.0085), (0, 0.0050)]))
    return Link(0.033, [("bracket", together(foot, riser, arm, rib), "charcoal")], solid=together(riser, arm))


def oakd_link():
    """The OAK-D, looking along x."""
    case = along_x(
        loft(
            rounded(rectangle(-0.0485, 0.0485, -0.020, 0.010), 0.008),
            [(0.0012, -0.02225), (0, -0.0210), (0, -0.0012), (0.0012, 0.0)],
        )
    )
    glass = along_x(
        loft(rounded(rectangle(-0.0445, 0.0445, -0.014, 0.004), 0.005), [(0, -0.001), (0, 0.0005)])
    )
    eyes = [(0.0, 0.0070), (0.0375, 0.0060), (-0.0375, 0.0060)]
    rims = [along_x(disc(r, 0.0, 0.0022, (y, -0.005), 0.0004, 32)) for y, r in eyes]
    pupils = [along_x(disc(0.66 * r, 0.0, 0.0027, (y, -0.005), n=32)) for y, r in eyes]
    return Link(
        0.061,
        [
            ("oakd_case", case, "steel"),
            ("oakd_glass", together(glass, *pupils), "glass"),
            ("oakd_rims", together(*rims), "aluminium"),
        ],
        (primitive("box", size=(0.0225, 0.097, 0.03)), (-0.011, 0, -0.005)),
    )


def magnetometer_link():
    """The sensor head on its non-magnetic stand, its frame in the middle of the head."""
    foot = disc(0.018, -HEAD_ABOVE_PLATE, -HEAD_ABOVE_PLATE + 0.004, chamfer=0.001)
    post = disc(0.006, -HEAD_ABOVE_PLATE + 0.003, -0.0120, n=32)
    collar = disc(0.011, -0.0160, -0.0115, chamfer=0.001, n=40)
    head = loft(
        rounded(rectangle(-0.020, 0.020, -0.014, 0.014), 0.006, 8),
        [(0.002, -0.0120), (0, -0.0100), (0, 0.0100), (0.002, 0.0120)],
    )
    return Link(
        0.05,
        [
            ("magnetometer_head", head, "sensor"),
            ("magnetometer_stand", together(foot, post, collar), "nylon"),
        ],
        (primitive("box", size=(0.04, 0.028, 0.024)), (0, 0, 0)),
    )


def weight_block():
    """Ballast under the shell."""
    size = (0.036, 0.040, 0.008)
    return Link(0.061, [("block", primitive("box", size=size), "steel")], solid=trimesh.creation.box(size))


def imu_link():
    """The IMU, a chip inside the base."""
    return Link(0.01, solid=trimesh.creation.box((0.01, 0.01, 0.01)))


def robot():
    """Links with their parents, poses (xyz, rpy) and joint kinds, parents first."""
    side, quarter, still = WHEEL_SEPARATION / 2, np.pi / 2, (0, 0, 0)

    def on_shell(x, y, z):
        return x, y, z - BASE_TOP

    yield "base_link", base_link(), "base_footprint", (0, 0, -GROUND), still, "fixed"
    yield "bumper", bumper(), "base_link", (0, 0, 0.0392), still, "fixed"
    yield "left_wheel", wheel(), "base_link", (0, side, WHEEL_HEIGHT), (-quarter, 0, 0), "continuous"
    yield "right_wheel", wheel(), "base_link", (0, -side, WHEEL_HEIGHT), (-quarter, 0, 0), "continuous"
    yield "front_caster", caster(), "base_link", (0.125, 0, GROUND + CASTER_RADIUS), still, "fixed"
    yield "imu_link", imu_link(), "base_link", (0.0506, 0.0437, 0.0844), still, "fixed"
    yield "shell_link", shell_link(), "base_link", (0, 0, BASE_TOP), still, "fixed"
    for name, y in (("left", 0.0876), ("right", -0.0876)):
        for level, z in (("bottom", 0.0985), ("top", 0.1070)):
            link = f"front_{name}_{level}_weight_block"
            yield link, weight_block(), "base_link", (0.0601, y, z), still, "fixed"
    for name, (x, y) in STANDOFFS.items():
        yield f"{name}_tower_standoff", standoff(), "shell_link", on_shell(x, y, 0.2418), still, "fixed"
    plate, above = "tower_sensor_plate", 0.003 + HEAD_ABOVE_PLATE
    yield plate, tower_sensor_plate(), "shell_link", on_shell(0, 0, PLATE_HEIGHT), still, "fixed"
    yield "rplidar_link", rplidar_link(), "shell_link", on_shell(-0.04, 0, 0.1929), (0, 0, quarter), "fixed"
    bracket = "oakd_camera_bracket"
    yield bracket, oakd_camera_bracket(), "shell_link", on_shell(-0.118, 0, 0.1468), still, "fixed"
    yield "oakd_link", oakd_link(), bracket, (0.0584, 0, 0.0967), still, "fixed"
    yield "magnetometer_link", magnetometer_link(), plate, (0, 0, above), still, "fixed"


def text(values):
    """Numbers as the URDF has them."""
    return " ".join(f"{round(float(v), 12) + 0.0:.12g}" for v in values)


def add_geometry(parent, shape):
    """A `<geometry>` of a primitive, or of a mesh by its name."""
    geometry = ElementTree.SubElement(parent, "geometry")
    if isinstance(shape, tuple):
        ElementTree.SubElement(geometry, *shape)
    else:
        ElementTree.SubElement(geometry, "mesh", filename=f"meshes/{shape}.obj")


def add_inertial(parent, link):
    """An `<inertial>`: as published, or of the solid that the mass fills evenly."""
    if link.inertial is not None:
        centre, moments = link.inertial
        products = (0.0, 0.0, 0.0)
    else:
        solid = (link.solid if link.solid is not None else link.looks[0][1]).copy()
        solid.density = link.mass / solid.volume
        centre, tensor = solid.center_mass.round(5), solid.moment_inertia
        least = 1e-3 * np.trace(tensor)
        moments = np.diag(tensor)
        products = [v if abs(v) > least else 0.0 for v in (tensor[0, 1], tensor[0, 2], tensor[1, 2])]
    inertial = ElementTree.SubElement(parent, "inertial")
    ElementTree.SubElement(inertial, "origin", xyz=text(centre))
    ElementTree.SubElement(inertial, "mass", value=f"{link.mass:g}")
    names, values = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz"), (*moments, *products)
    ElementTree.SubElement(inertial, "inertia", {n: f"{v:.4g}" for n, v in zip(names, values, strict=True)})


def write(folder):
    """Write the meshes and the URDF to a folder; returns the path of the URDF."""
    (folder / "meshes").mkdir(parents=True, exist_ok=True)
    tree = ElementTree.Element("robot", name="turtlebot4")
    tree.append(ElementTree.Comment(" Written by build.py; README.md says where the figures come from. "))
    for name, rgb in COLOURS.items():
        material = ElementTree.SubElement(tree, "material", name=name)
        ElementTree.SubElement(material, "color", rgba=text((*rgb, 1)))
    ElementTree.SubElement(tree, "link", name="base_footprint")
    for name, link, parent, xyz, rpy, kind in robot():
        element = ElementTree.SubElement(tree, "link", name=name)
        add_inertial(element, link)
        for look, shape, colour in link.looks:
            visual = ElementTree.SubElement(element, "visual", name=look)
            if not isinstance(shape, tuple):
                lines = shape.export(
                    file_type="obj",
                    digits=5,
                    include_normals=False,
                    include_color=False,
                    header="TurtleBot 4",
                )
                (folder / "meshes" / f"{look}.obj").write_text(lines.rstrip() + "\n", encoding="ascii")
            add_geometry(visual, shape if isinstance(shape, tuple) else look)
            ElementTree.SubElement(visual, "material", name=colour)
        if link.touch is not None:
            collision = ElementTree.SubElement(element, "collision", name=f"{name}_collision")
            ElementTree.SubElement(collision, "origin", xyz=text(link.touch[1]))
            add_geometry(collision, link.touch[0])
            gazebo = ElementTree.SubElement(tree, "gazebo", reference=name)
            ElementTree.SubElement(gazebo, "mu1").text = f"{link.friction:g}"
            ElementTree.SubElement(gazebo, "mu2").text = f"{link.friction:g}"
        joint = ElementTree.SubElement(tree, "joint", name=f"{name.removesuffix('_link')}_joint", type=kind)
        ElementTree.SubElement(joint, "parent", link=parent)
        ElementTree.SubElement(joint, "child", link=name)
        ElementTree.SubElement(joint, "origin", xyz=text(xyz), rpy=text(rpy))
        if kind == "continuous":
            ElementTree.SubElement(joint, "axis", xyz="0 0 1")
            # 0.46 m/s, the base's highest speed, at the rim; torque enough for 0.9 m/s2 and a door sill.
            ElementTree.SubElement(joint, "limit", effort="2", velocity=f"{0.46 / WHEEL_RADIUS:.4g}")
    ElementTree.indent(tree)
    urdf = folder / "turtlebot4.urdf"
    urdf.write_text(
        f'<?xml version="1.0"?>\n{ElementTree.tostring(tree, encoding="unicode")}\n', encoding="utf-8"
    )
    return urdf


if __name__ == "__main__":
    from magtwin.author.robot import build_robot
    from magtwin.figures.pictures import picture_of_stage

    report = build_robot(
        write(HERE),
        HERE / "robot.toml",
        HERE / "turtlebot4.usda",
        force=True,
        thumbnail=lambda asset, png: picture_of_stage(asset, png, size=(256, 256)),
    )
    sys.stdout.write(f"{report.summary().title}\n")
