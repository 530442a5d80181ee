"""A URDF told from another link down."""

from pathlib import Path
from xml.etree import ElementTree

import made
import numpy as np
import pytest

from magtwin.errors import InputError
from magtwin.frames import matrix_from_quat, quat_from_rpy
from magtwin.urdf.reroot import reroot

HERE = Path("robot.urdf")


def robot(*joints: str) -> str:
    links = "".join(f'<link name="{name}"/>' for name in ("world", "footprint", "base_link", "top"))
    return f'<robot name="r">{links}{"".join(joints)}</robot>'


def joint(parent: str, child: str, kind: str = "fixed", xyz: str = "0 0 0", rpy: str = "0 0 0") -> str:
    return made.joint(f"{parent}_{child}", parent, child, kind, f'<origin xyz="{xyz}" rpy="{rpy}"/>')


def frames(text: str) -> dict[tuple[str, str], np.ndarray]:
    """Where each child is in its parent."""
    found = {}
    for one in ElementTree.fromstring(text).iter("joint"):
        T, origin = np.eye(4), one.find("origin")
        if origin is not None:
            T[:3, :3] = matrix_from_quat(quat_from_rpy([float(v) for v in origin.get("rpy").split()]))
            T[:3, 3] = [float(v) for v in origin.get("xyz").split()]
        found[one.find("parent").get("link"), one.find("child").get("link")] = T
    return found


def test_frames_above_the_base_hang_below_it_where_they_were() -> None:
    before = robot(
        joint("world", "footprint", xyz="1 2 3", rpy="0.3 -0.2 2.5"),
        joint("footprint", "base_link", xyz="0.1 0 0.05", rpy="0 0 1"),
        joint("base_link", "top", "revolute", xyz="0 0 0.3"),
    )
    was, now = frames(before), frames(reroot(before, "base_link", HERE))
    assert set(now) == {("footprint", "world"), ("base_link", "footprint"), ("base_link", "top")}
    for parent, child in (("footprint", "world"), ("base_link", "footprint")):
        np.testing.assert_allclose(now[parent, child] @ was[child, parent], np.eye(4), atol=1e-12)
    np.testing.assert_array_equal(now["base_link", "top"], was["base_link", "top"])


@pytest.mark.parametrize(
    "joints",
    [
        (joint("base_link", "top"),),
        (joint("world", "base_link", "floating"),),
        (joint("footprint", "base_link"), joint("base_link", "footprint")),
    ],
    ids=["a root", "on a joint that moves", "in a ring"],
)
def test_joints_that_cannot_or_need_not_be_inverted_stay(joints: tuple[str, ...]) -> None:
    assert reroot(robot(*joints), "base_link", HERE) == robot(*joints)
    assert reroot(robot(*joints), "chassis", HERE) == robot(*joints)


def test_an_invalid_origin_is_refused_with_its_joint() -> None:
    for xyz in ("1 2 x", "1 2"):
        with pytest.raises(InputError, match="footprint_base_link"):
            reroot(robot(joint("footprint", "base_link", xyz=xyz)), "base_link", HERE)
