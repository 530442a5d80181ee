"""Tree: the frames of a recording, by /tf, /tf_static and the robot's description."""

from collections.abc import Mapping
from contextlib import suppress
from functools import partial

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.frames import IDENTITY_XYZW, quat_multiply, rotate
from magtwin.io.bags.bag import Bag
from magtwin.io.bags.cdr import NS, Index, Messages, decode
from magtwin.io.bags.topics import DESCRIPTION, TF, TF_STATIC
from magtwin.io.recording.frames import StaticFrames, Transform, kind_of, plain, transforms
from magtwin.io.recording.poses import poses_at

Array = NDArray[np.float64]

STILL = 1e-9  # Largest change of a transform on /tf that does not move [m] and parts of a quaternion
MOST_DESCRIPTION = 4_000_000  # Longest description that is read [characters]


def topics_of_frames(bag: Bag) -> list[str]:
    """The topics of a bag that tell of frames."""
    ends = {TF.name: TF.kind, TF_STATIC.name: TF.kind, "robot_description": DESCRIPTION.kind}
    return [n for n, kind in bag.kinds.items() if any(n.endswith(e) and kind == ends[e] for e in ends)]


class Tree:
    """The frames of a bag, by the messages of `topics_of_frames`.

    Attributes:
        static: Transforms that do not change; also those of /tf that never do.
        moving: By frame: its parent, the stamps [ns], and its origin and axes (xyzw) there, shape (M, 7).
    """

    def __init__(self, bag: Bag, messages: Mapping[str, Messages]) -> None:
        self.static = StaticFrames()
        self.moving: dict[str, tuple[str, Index, Array]] = {}
        edges: dict[tuple[str, str], list[tuple[Index, Array]]] = {}
        with np.errstate(over="ignore", invalid="ignore"):
            for name in topics_of_frames(bag):
                with suppress(InputError):
                    if bag.kinds[name] != TF.kind:
                        for text in decode(bag.layout(name), messages[name], ["data"])["data"][-1:]:
                            self.static.describe(text[:MOST_DESCRIPTION])
                        continue
                    for each in transforms(messages[name], partial(bag.layout, name)):
                        if name.endswith(TF_STATIC.name):
                            for row in zip(each.parents, each.children, each.p, each.q_xyzw, strict=True):
                                self.static.add(*row)
                        else:
                            _collect(each, edges)
        for (parent, child), parts in edges.items():
            self._move(parent, child, *(np.concatenate(column) for column in zip(*parts, strict=True)))

    def _move(self, parent: str, child: str, ns: Index, pose: Array) -> None:
        """Take the transforms of an edge; of several parents, that of most transforms counts."""
        ns, first = np.unique(ns, return_index=True)
        pose = pose[first]
        if kind_of(parent) != "fixed" and np.ptp(pose, axis=0).max(initial=0) < STILL:
            if child not in self.static.parents:
                self.static.add(parent, child, pose[0, :3], pose[0, 3:])
        elif child not in self.moving or len(self.moving[child][1]) < len(ns):
            self.moving[child] = parent, ns, pose

    def up(self, frame: str) -> list[str]:
        """A frame and those above it, up to the root of its tree."""
        way = [plain(frame)]
        while (parent := self._parent(way[-1])) and parent not in way:
            way.append(parent)
        return way

    def _parent(self, frame: str) -> str:
        return self.moving[frame][0] if frame in self.moving else self.static.parents.get(frame, ("",))[0]

    def at(self, frame: str, ns: Index) -> tuple[Array, Array]:
        """Origin [m] and axes (xyzw) of a frame in the root of its tree at times [ns], shapes (M, 3), (M, 4).

        p_root = p + rotate(q, p_child) and q_root = q q_child for each edge upwards. Between transforms it is
        interpolated, and beyond them the nearest one counts.
        """
        p, q = np.zeros((len(ns), 3)), np.tile(IDENTITY_XYZW, (len(ns), 1)).astype(float)
        for name in self.up(frame)[:-1]:
            if name in self.moving:
                _, times, pose = self.moving[name]
                if len(times) == 1:
                    times, pose = np.append(times, times + NS), np.repeat(pose, 2, axis=0)
                # from the first stamp, so that a float holds the times to the nanosecond
                p_here, q_here, _ = poses_at((ns - times[0]) / NS, (times - times[0]) / NS, pose)
            else:
                _, p_here, q_here = self.static.parents[name]
            p, q = p_here + rotate(q_here, p), quat_multiply(q_here, q)
        return p, q

    def base(self, near: str = "") -> str:
        """The robot's base, whose pose moves in a frame that stands still; "" if there is none.

        A frame `near` on the robot decides between several robots, which are refused else.
        """
        names = {*self.moving, *self.static.parents}
        ways = {name: self.up(name) for name in names if kind_of(name) == "base"}
        found = [n for n, way in ways.items() if kind_of(way[-1]) == "fixed" and {*way} & self.moving.keys()]
        if near:
            above = {*self.up(near)} & self.moving.keys()
            found = [name for name in found if above & {*ways[name]}] or found
        for rank in ("base_link", "base_footprint", ""):
            if best := sorted(name for name in found if name.endswith(rank)):
                if len(best) > 1 and rank:
                    robots = ", ".join(best)[:200]
                    raise InputError(f"/tf has {len(best)} robots, {robots}; record one of them")
                return best[0]
        return ""

    def stamps(self, frame: str) -> Index:
        """Times of the transforms of the edge above a frame that has most [ns]."""
        return max((self.moving[name][1] for name in self.up(frame) if name in self.moving), key=len)


def _collect(each: Transform, edges: dict[tuple[str, str], list[tuple[Index, Array]]]) -> None:
    """Put transforms of messages to those of their edge."""
    pose = np.concatenate([each.p, each.q_xyzw], axis=1)
    ends = list(zip(map(plain, each.parents), map(plain, each.children), strict=True))
    for pair in dict.fromkeys(ends):
        rows = slice(None) if len(set(ends)) == 1 else [k for k, other in enumerate(ends) if other == pair]
        edges.setdefault(pair, []).append((each.stamps[rows], pose[rows]))
