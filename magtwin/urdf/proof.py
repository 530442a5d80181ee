"""Proof: what became of each element and attribute of a description, and the prim that carries it."""

from collections.abc import Iterator, Mapping

from pxr import Tf, Usd, UsdPhysics

from magtwin.urdf.description.tag import KEPT, Element, Tags, label_of, text_of
from magtwin.urdf.material import LOOKS
from magtwin.urdf.repairs import UNKNOWN
from magtwin.urdf.report import FATES, Ledger, ProofLine
from magtwin.usd.schema import attribute_name

TURNS = ("physics:localRot0", "xformOp:orient", "physics:principalAxes")
SIZES = ("xformOp:scale", "radius", "height", "points", "extent")
DRIVES = tuple(f"drive:{axis}:physics:maxForce" for axis in ("angular", "linear", "transX", "rotX", "rotZ"))
CARRIERS: Mapping[str, tuple[str, ...]] = {
    "mass/value": ("physics:mass",),
    "inertia": ("physics:diagonalInertia",),
    "origin": (
        *("physics:localPos0", "physics:localRot0", "xformOp:translate", "xformOp:orient"),
        *("physics:centerOfMass", "physics:principalAxes", "points"),
    ),
    "box": SIZES,
    "capsule": SIZES,
    "cylinder": SIZES,
    "sphere": SIZES,
    "mesh": ("points", *SIZES),
    "axis": ("physics:axis", "limit:transX:physics:low"),
    "limit/lower": ("physics:lowerLimit",),
    "limit/upper": ("physics:upperLimit",),
    "limit/effort": DRIVES,
    "limit/velocity": ("newton:velocityLimit",),
    "dynamics/damping": ("newton:damping",),
    "dynamics/friction": ("newton:friction",),
    "mimic/joint": ("newton:mimicJoint",),
    "mimic/multiplier": ("newton:mimicCoef1",),
    "mimic/offset": ("newton:mimicCoef0",),
    "color": ("inputs:diffuseColor", "primvars:displayColor"),
    "texture": ("inputs:file",),
    "friction": ("physics:dynamicFriction",),
    "restitution": ("physics:restitution",),
    "stiffness": ("physxMaterial:compliantContactStiffness",),
    "damping": ("physxMaterial:compliantContactDamping",),
}
"""Properties that carry an attribute, by its element or by `element/attribute`; or a number of `extensions`.

An attribute without a row is a name: the prim itself carries it.
"""

WHOLE = ("inertia-impossible", "inertia-missing", "mesh-missing", "mesh-unreadable", "mesh-flat")
"""Repairs that concern all attributes of their element."""

UNWORN = "no visual wears it"

REASONS = {
    "limit": "0 and infinite count as not given",
    "color": "a texture or a mesh file gives the look",
    "texture": "its shape has no texture coordinates",
    "origin": "another body carries its link",
}
"""Why no property of a prim carries an element; of a fixed joint, since it does not move."""


def make_proof(tags: Tags, stage: Usd.Stage, ledger: Ledger) -> tuple[ProofLine, ...]:
    """A line for each element and attribute, in the order of the description.

    Args:
        tags: Tags of the description, after the robot is authored.
        stage: The robot.
        ledger: Prims of each part.
    """
    proof = _Proof(tags, stage, ledger)
    lines = tuple(proof.lines(tags.description.xml))
    count = sum(1 + len(e.attrib) for e in tags.description.xml.iter())
    assert len(lines) == count, (len(lines), count)
    assert {line.fate for line in lines} <= set(FATES)
    return lines


class _Proof:
    def __init__(self, tags: Tags, stage: Usd.Stage, ledger: Ledger) -> None:
        self._description, self._tags, self._stage, self._ledger = tags.description, tags, stage, ledger
        self._robot = stage.GetDefaultPrim()
        prims = [prim for prim in stage.Traverse() if prim.GetCustomDataByKey(KEPT)]
        texts = {text: prim for prim in prims for text in prim.GetCustomDataByKey(KEPT)}
        self._kept: dict[tuple[Element, str], Usd.Prim | None] = {}
        for _, depth, left in tags.left():
            key = (left.way[-1], left.name) if left.element is None else (left.element, "")
            self._kept[key] = texts.get(text_of(left, depth))

    def lines(self, element: Element, *above: Element) -> Iterator[ProofLine]:
        """The lines of an element and of everything below it."""
        way = (*above, element)
        for name in ("", *(f"@{attribute}" for attribute in element.attrib)):
            item = "/".join((*map(label_of, way), *([name] if name else ())))
            value = element.get(name[1:], "") if name else ""
            fate, prim, carried = self._fate(way, name)
            path = str(prim.GetPath()) if prim else ""
            yield ProofLine(self._description.where(element), item, value, fate, path, carried)
        for child in element:
            yield from self.lines(child, *way)

    def _fate(self, way: tuple[Element, ...], name: str) -> tuple[str, Usd.Prim | None, str]:
        """Fate of an element or attribute, the prim that carries it, and how."""
        element = way[-1]
        for key in ((element, name), *((e, "") for e in reversed(way))):
            if key in self._kept:
                prim = self._kept[key]
                return ("text", prim, KEPT) if prim else ("lost", None, "its text is on no prim")
        if len(way) == 1:
            return "used", self._robot, ""
        if way[1].tag not in ("link", "joint", "material"):
            return self._tag(way)
        clean, given = self._description.checked.get(element), element.get(name[1:], "")
        same = not name or (
            clean is not None and given.replace(",", " ").split() == clean.get(name[1:], "").split()
        )
        if clean is None or not same:
            repair = self._repair(way, name)
            return ("repaired", None, repair) if repair else ("lost", None, "left out")
        prim = self._prim(way)
        for kind, text in self._about(way):
            named = name and kind not in UNKNOWN and name[1:] in text.split()
            if named or (kind in WHOLE and len(way) > 2):
                return "repaired", prim, text
        if prim is None:
            empty = [t for k, t in self._description.repairs.about.get(way[1], []) if k == "shape-empty"]
            worn = "material" in [e.tag for e in way]
            return ("repaired", None, empty[0]) if empty else ("lost", None, UNWORN if worn else "left out")
        table = next((CARRIERS[k] for k in (f"{element.tag}/{name[1:]}", element.tag) if k in CARRIERS), None)
        if not name or table is None:
            return "used", prim, ""
        if element.tag == "origin" and name == "@xyz":
            table = tuple(n for n in table if n not in TURNS)
        shown = _property(prim, table)
        if shown:
            return "used", *shown
        still = way[1].tag == "joint" and not prim.HasAPI(UsdPhysics.DriveAPI)
        return "lost", prim, "its joint does not move" if still else REASONS.get(element.tag, "left out")

    def _about(self, way: tuple[Element, ...]) -> list[tuple[str, str]]:
        """Repairs of an element, of the first one of its file, or of its link's inertia."""
        element, about = way[-1], self._description.repairs.about
        first = self._description.source.elements.get((element.tag, element.get("filename", "")), element)
        own = about.get(way[1], []) if element.tag == "inertia" else []
        texts = about.get(first, []) + [each for each in own if each[0] in WHOLE]
        role = way[2].tag if len(way) > 2 else ""
        return sorted(texts, key=lambda each: role not in each[1])

    def _repair(self, way: tuple[Element, ...], name: str) -> str:
        """Text of the repair that left out or changed an element or attribute; "" if there is none."""
        for depth in range(len(way), 1, -1):
            texts = [text for kind, text in self._about(way[:depth]) if kind not in UNKNOWN]
            named = [text for text in texts if name and name[1:] in text.split()] or texts
            if named:
                return named[0]
        return ""

    def _tag(self, way: tuple[Element, ...]) -> tuple[str, Usd.Prim | None, str]:
        """What became of a used part of a section such as `<gazebo>`."""
        prim = self._owner(next((e.get("reference", "") for e in way if "reference" in e.attrib), ""))
        sensor = next((e.get("name", "") for e in way if e.tag == "sensor"), "")
        joint = next((e.get("name", "") for e in way if e.tag == "joint"), "")
        if sensor:
            prim = prim.GetPrimAtPath(Tf.MakeValidIdentifier(sensor)) or prim
        prim = self._owner(joint) if joint else prim
        field = self._tags.fields.get(way[-1])
        if field is None:
            return "used", prim, ""
        names = CARRIERS.get(field, (attribute_name("drive", field),))
        return ("used", *(_property(prim, names) or _property(self._robot, names) or (prim, field)))

    def _owner(self, name: str) -> Usd.Prim:
        """Prim of a link or joint; the robot's for other names."""
        _, path = self._ledger.bodies.get(name, ("", self._ledger.joints.get(name)))
        return self._stage.GetPrimAtPath(path) if path else self._robot

    def _prim(self, way: tuple[Element, ...]) -> Usd.Prim | None:
        """Prim of a part of a link, joint or material."""
        part, tags = way[1], [e.tag for e in way]
        name = part.get("name", "")
        if part.tag == "joint":
            children = {joint.name: child for child, joint in self._description.joints.items()}
            owner = name if name in self._ledger.joints else children.get(name)
            return None if owner is None else self._owner(owner)
        if "material" in tags:
            return self._look(way)
        if len(way) == 2 or tags[2] not in ("visual", "collision", "inertial"):
            return self._owner(name)
        if tags[2] == "inertial":
            prim = self._owner(name)
            while prim and not prim.HasAPI(UsdPhysics.RigidBodyAPI):
                prim = prim.GetParent()
            return prim or None
        return self._shape(way)

    def _shape(self, way: tuple[Element, ...]) -> Usd.Prim | None:
        """Prim of the visual or collision that holds an element."""
        path = self._ledger.shapes.get(self._description.checked.get(way[2], way[2]))
        return self._stage.GetPrimAtPath(path) if path else None

    def _look(self, way: tuple[Element, ...]) -> Usd.Prim | None:
        """Prim of the look of a `<material>`: that of its name, or that which its visual wears."""
        material = next(e for e in way if e.tag == "material")
        scope = self._robot.GetPrimAtPath(LOOKS)
        name = Tf.MakeValidIdentifier(material.get("name", "")) if material.get("name") else ""
        all_looks = scope.GetChildren() if scope and name else []
        looks = [prim for prim in all_looks if prim.GetName().startswith(name)]
        return looks[0] if looks else None if way[1].tag == "material" else self._shape(way)


def _property(prim: Usd.Prim, names: tuple[str, ...]) -> tuple[Usd.Prim, str] | None:
    """The first of some properties that a prim or one below it has, with its value."""
    below = list(Usd.PrimRange(prim, Usd.TraverseInstanceProxies()))
    for name in names:
        for each in below:
            prop = each.GetProperty(name)
            if not prop or not prop.IsAuthored():
                continue
            if isinstance(prop, Usd.Relationship):
                value = ", ".join(map(str, prop.GetTargets()))
            else:
                held = prop.Get()
                value = f"{len(held)} points" if name == "points" else str(held)
            return each, f"{name} = {value}"
    return None
