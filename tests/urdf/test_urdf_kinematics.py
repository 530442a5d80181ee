"""Forward kinematics: bodies moved through the joints of a converted stage stand where yourdfpy puts them."""

import numpy as np
import pytest
from made import joint, link, urdf
from numpy.testing import assert_allclose
from pxr import Usd, UsdGeom, UsdPhysics

from magtwin.author.from_urdf import link_poses
from magtwin.errors import InputError
from magtwin.frames import matrix_from_quat
from magtwin.urdf.convert import convert_urdf
from magtwin.urdf.options import Options

POSES = 100
TOLERANCE = 1e-6
"""Of positions [m]; frames of joints are single precision, some 1e-8 of their lengths."""


class StageKinematics:
    """The bodies of a stage, moved by composing the frames of its joints: nothing of the converter's."""

    def __init__(self, path):
        self.stage = Usd.Stage.Open(str(path))
        self.stage.Reload()
        self.robot = self.stage.GetDefaultPrim()
        prims = list(Usd.PrimRange(self.robot))
        self.bodies = [p for p in prims if p.HasAPI(UsdPhysics.RigidBodyAPI)]
        self.joints = {p.GetName(): p for p in prims if p.IsA(UsdPhysics.Joint)}
        self.sites = [p for p in prims if "IsaacSiteAPI" in p.GetPrimTypeInfo().GetAppliedAPISchemas()]

        self.rest = {p.GetPath(): self._pose(p, self.robot) for p in self.bodies}
        self.on_bodies = [
            (s.GetName(), s.GetParent().GetPath(), self._pose(s, s.GetParent())) for s in self.sites
        ]
        self.held = {}
        for name, prim in self.joints.items():
            joint = UsdPhysics.Joint(prim)
            (child,), (parent,) = joint.GetBody1Rel().GetTargets(), joint.GetBody0Rel().GetTargets()
            first = _frame(joint.GetLocalPos0Attr().Get(), joint.GetLocalRot0Attr().Get())
            second = _frame(joint.GetLocalPos1Attr().Get(), joint.GetLocalRot1Attr().Get())
            self.held[child] = name, parent, first, np.linalg.inv(second)

    def poses(self, values):
        """T_robot_link of each body and site, (4, 4), with joints at `values`: numbers, or (4, 4) motions."""
        placed = {self.robot.GetPath(): np.eye(4)}

        def place(path):
            if path not in placed:
                if path in self.held:
                    name, parent, first, second = self.held[path]
                    motion = _motion(self.joints[name], values.get(name, 0.0))
                    placed[path] = place(parent) @ first @ motion @ second
                else:
                    placed[path] = self.rest[path]
            return placed[path]

        named = {body.GetName(): place(body.GetPath()) for body in self.bodies}
        return named | {name: place(above) @ T for name, above, T in self.on_bodies}

    def _pose(self, prim, above):
        cache = UsdGeom.XformCache()
        to_above = cache.GetLocalToWorldTransform(above).GetInverse()
        return np.array(cache.GetLocalToWorldTransform(prim) * to_above).T


def _frame(p, q):
    T = np.eye(4)
    T[:3, :3] = matrix_from_quat(np.array([*q.imaginary, q.real]) / np.linalg.norm([*q.imaginary, q.real]))
    T[:3, 3] = p
    return T


def _motion(prim, value):
    """Motion of a joint's second frame in its first: a matrix as it is, a number along or about the axis."""
    T = np.eye(4)
    if isinstance(value, np.ndarray) or prim.IsA(UsdPhysics.FixedJoint):
        return value if isinstance(value, np.ndarray) else T
    if not value:
        return T
    i = "XYZ".index(prim.GetAttribute("physics:axis").Get())
    if prim.IsA(UsdPhysics.PrismaticJoint):
        T[i, 3] = value
        return T
    j, k = (i + 1) % 3, (i + 2) % 3
    T[j, j] = T[k, k] = np.cos(value)
    T[k, j], T[j, k] = np.sin(value), -np.sin(value)
    return T


def compare(path, out, rng, *, still=()):
    """Hold every link against yourdfpy's at random values of the joints that it can move; how many links."""
    import yourdfpy

    peer = yourdfpy.URDF.load(str(path), load_meshes=False)
    stage = StageKinematics(out)
    joints = {joint.name: joint for joint in peer.robot.joints}
    base = peer.base_link
    for _ in range(POSES):
        values = {}
        for name in peer.actuated_joint_names:
            joint = joints[name]
            if joint.type == "continuous":
                values[name] = rng.uniform(-np.pi, np.pi)
            elif joint.type in ("revolute", "prismatic"):
                values[name] = rng.uniform(joint.limit.lower, joint.limit.upper)
            if name in still:
                values[name] = 0.0
        peer.update_cfg([values.get(name, 0.0) for name in peer.actuated_joint_names])
        every = dict(values)
        for joint in peer.robot.joints:
            if joint.mimic is not None:
                every[joint.name] = joint.mimic.multiplier * values[joint.mimic.joint] + joint.mimic.offset
        mine = stage.poses(every)
        assert set(mine) == {link.name for link in peer.robot.links}
        root = np.linalg.inv(mine[base])
        for name, T in mine.items():
            theirs = peer.get_transform(name, base)
            assert_allclose((root @ T)[:3, 3], theirs[:3, 3], atol=TOLERANCE, err_msg=name)
            assert_allclose((root @ T)[:3, :3], theirs[:3, :3], atol=2e-6, err_msg=name)
    return len(mine)


def arms(joints):
    """A chain of links held by (type, inner XML) each."""
    parts = [link("l0")]
    for i, (kind, inner) in enumerate(joints):
        parts += [link(f"l{i + 1}"), joint(f"j{i + 1}", f"l{i}", f"l{i + 1}", kind, inner)]
    return "\n".join(parts)


LIMIT = '<limit lower="-1.2" upper="0.9" effort="5" velocity="2"/>'
CHAIN = [
    ("revolute", f'<origin xyz="0.1 0.2 0.3" rpy="0.3 -0.7 1.1"/><axis xyz="0.3 -0.5 0.8"/>{LIMIT}'),
    ("prismatic", f'<origin xyz="0 -0.4 0.2" rpy="-1.5 0.1 0.4"/><axis xyz="0 0.6 -0.8"/>{LIMIT}'),
    ("fixed", '<origin xyz="0.2 0 0.1" rpy="0 0.5 0"/>'),
    ("continuous", '<origin xyz="0 0.3 0" rpy="1 1 1"/><axis xyz="0 -1 0"/>'),
    ("revolute", f'<origin xyz="0 0 0.3"/><axis xyz="1 0 0"/>{LIMIT}'),
]
TREE = """
<link name="base_footprint"/> <link name="base">{BODY}</link> <link name="plate">{BODY}</link>
<link name="left">{BODY}</link> <link name="right">{BODY}</link>
<link name="tip"/> <link name="rider">{BODY}</link>
<joint name="up" type="fixed"><parent link="base_footprint"/><child link="base"/>
  <origin xyz="0 0 0.1"/></joint>
<joint name="on" type="fixed"><parent link="base"/><child link="plate"/>
  <origin xyz="0.1 0 0.2" rpy="0 0 0.7"/></joint>
<joint name="finger" type="prismatic"><parent link="plate"/><child link="left"/><origin xyz="0 0.1 0"/>
  <axis xyz="0 1 0"/><limit lower="0" upper="0.05" effort="5" velocity="1"/></joint>
<joint name="other" type="prismatic"><parent link="plate"/><child link="right"/>
  <origin xyz="0 -0.1 0" rpy="0 0 3.14159"/><axis xyz="0 1 0"/>
  <limit lower="0" upper="0.06" effort="5" velocity="1"/>
  <mimic joint="finger" multiplier="0.8" offset="0.01"/></joint>
<joint name="nail" type="fixed"><parent link="right"/><child link="tip"/><origin xyz="0 0 0.02"/></joint>
<joint name="swing" type="continuous"><parent link="tip"/><child link="rider"/>
  <origin xyz="0.05 0 0" rpy="0.2 0 0"/><axis xyz="0 0.6 0.8"/></joint>"""


@pytest.mark.parametrize("merge", [False, True])
@pytest.mark.parametrize(("name", "body"), [("chain", arms(CHAIN)), ("tree", TREE)])
def test_links_of_a_robot_with_every_joint_of_one_axis_stand_where_yourdfpy_puts_them(
    tmp_path, name, body, merge
):
    path = urdf(tmp_path, body, name)
    options = Options(merge_fixed=merge, single_file=True)
    out = convert_urdf(path, tmp_path / f"{name}.usda", options=options)
    assert compare(path, out, np.random.default_rng(1)) == {"chain": 6, "tree": 7}[name]


def test_links_of_the_real_robot_stand_where_yourdfpy_puts_them(tmp_path, real_robot):
    path, out, _ = real_robot
    options = Options(single_file=True, merge_fixed=True, fix_base=True, profile="diff-drive")
    dead = ("wheel_drop_left_joint", "wheel_drop_right_joint")  # neither effort nor speed: welded
    for each in (out, convert_urdf(path, tmp_path / "tb4.usda", options=options)):
        assert compare(path, each, np.random.default_rng(2), still=dead) > 40


def test_a_planar_joint_slides_and_turns_in_its_plane_only(tmp_path):
    normal = np.array([0.2, -0.6, 0.77])
    words = " ".join(map(str, normal))
    chain = [("planar", f'<origin xyz="0.1 0.2 0.3" rpy="0.3 -0.7 1.1"/><axis xyz="{words}"/>'), CHAIN[0]]
    path = urdf(tmp_path, arms(chain), "sled")
    stage = StageKinematics(convert_urdf(path, tmp_path / "sled.usda", options=Options(single_file=True)))
    joint = stage.joints["j1"]
    limits = {
        axis: (
            UsdPhysics.LimitAPI(joint, axis).GetLowAttr().Get(),
            UsdPhysics.LimitAPI(joint, axis).GetHighAttr().Get(),
        )
        for axis in ("transX", "transY", "transZ", "rotX", "rotY", "rotZ")
    }
    free = {axis for axis, (low, high) in limits.items() if low == -np.inf and high == np.inf}
    assert free == {"transY", "transZ", "rotX"}  # an oblique normal becomes X of the joint's frame
    assert all(low > high for axis, (low, high) in limits.items() if axis not in free)  # UsdPhysics: locked
    before, motion = stage.poses({})["l1"], np.eye(4)
    motion[:3, 3] = [0, 0.3, -0.2]
    motion[1:3, 1:3] = [[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]]
    after = stage.poses({"j1": motion})["l1"]
    moved = np.linalg.inv(before) @ after
    assert abs(moved[:3, 3] @ normal) < 1e-6
    assert_allclose(np.linalg.norm(moved[:3, 3]), np.hypot(0.3, 0.2), atol=1e-6)
    assert_allclose(moved[:3, :3] @ normal, normal, atol=1e-6)


def test_a_floating_joint_holds_nothing_and_a_floating_base_is_the_base(tmp_path):
    body = TREE.replace('"up" type="fixed"', '"up" type="floating"').replace(
        '"on" type="fixed"', '"on" type="floating"'
    )
    path = urdf(tmp_path, body, "kite")
    stage = StageKinematics(convert_urdf(path, tmp_path / "kite.usda", options=Options(single_file=True)))
    assert set(stage.joints) == {"finger", "other", "swing"}
    assert stage.robot.GetPrimAtPath("base/base_footprint")
    assert_allclose(stage.poses({})["plate"][:3, 3], [0.1, 0, 0.3], atol=1e-9)


FOLLOWERS = arms(
    [
        ("prismatic", f'<axis xyz="0 3 4"/>{LIMIT}'),  # of length 5
        ("revolute", f'<axis xyz="0 0 2"/>{LIMIT}<mimic joint="j1" multiplier="2" offset="0.1"/>'),
        ("revolute", f'<origin xyz="1 0 0"/><axis xyz="0 0 1"/>{LIMIT}<mimic joint="j2" multiplier="-1"/>'),
    ],
)


def test_links_stand_where_an_axis_of_any_length_and_followers_of_followers_put_them(tmp_path):
    file = urdf(tmp_path, FOLLOWERS, "followers")
    poses, turn = link_poses(file, {"j1": 0.5}), 2 * 0.5 + 0.1
    assert_allclose(poses["l1"][:3, 3], [0, 0.3, 0.4], atol=1e-15)
    assert_allclose(poses["l2"][:2, 0], [np.cos(turn), np.sin(turn)], atol=1e-15)
    assert_allclose(poses["l3"][:3, 3], [np.cos(turn), 0.3 + np.sin(turn), 0.4], atol=1e-15)
    for positions, text in (({"j9": 1.0}, "no joint .*'j9'"), ({"j2": 1.0}, "'j2' follows 'j1'")):
        with pytest.raises(InputError, match=text):
            link_poses(file, positions)
