"""Repairs: what a conversion repaired, left out or guessed, with file and line.

Each fault of a description has a kind in `FAULTS` with one documented repair. The whole conversion is handed
one `Repairs`, and `check` decides what `Options.strict` refuses.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from xml.etree.ElementTree import Element

from magtwin.errors import InputError, find

SUGGESTED = 100
"""Most unknown names of a description for which a near one is looked for."""

NOTE, LOSS = "note", "loss"
"""Kinds of entries that are no fault of their own: a guess, which strict accepts, and anything left out."""

UNKNOWN = ("element-unknown", "attribute-unknown")
"""Kinds of faults that a summary shows with their text, since it has the near name."""

FAULTS: Mapping[str, tuple[str, str]] = {
    "inertia-impossible": (
        "inertia that no body has",
        "nearest possible tensor (Frobenius norm, same axes); the mass is kept",
    ),
    "inertia-missing": (
        "mass without inertia, or with one of zeros",
        "that of the link's shape filled evenly with its mass, else of a ball of water",
    ),
    "inertia-unreadable": ("inertia with something that is no number", "counts as missing"),
    "mass-invalid": ("mass of 0, below 0 or without a number", "the <inertial> counts as none"),
    "mimic-leader": (
        "mimic of a joint that is missing, has no single value or leads back",
        "the mimic is left out",
    ),
    "mimic-fixed": ("mimic of a fixed joint, or with multiplier 0", "the joint is fixed at its offset"),
    "limit-missing": ("joint without limits", "moves without limits"),
    "limit-one-end": ("joint with one limit", "the other limit is 0, URDF's default"),
    "limit-zeros": (
        "revolute joint with effort and velocity of 0",
        "with a range of 0 or over one turn a wheel without limits; else it moves within its range, and the "
        "two count as not given",
    ),
    "limit-swapped": ("lower limit above the upper", "the two are swapped"),
    "limit-ignored": ("range of a continuous joint", "ignored"),
    "effort-invalid": ("effort or velocity below 0", "counts as not given"),
    "sensor-range": ("figure of a sensor out of range", "nearest possible figure"),
    "sensor-missing": ("sensor without its figures", "a frame with the figures it has, as metadata"),
    "number-range": ("number out of its range", "nearest allowed number"),
    "number-count": ("too many or too few numbers", "the reading that is evident"),
    "number-unreadable": ("something that is no number, where a default exists", "the default"),
    "element-unknown": ("unknown element", "kept as text"),
    "attribute-unknown": ("unknown attribute", "kept as text"),
    "turn-twice": ("<origin> with rpy and quat_xyzw", "quat_xyzw is used"),
    "tag-twice": ("second tag of one kind", "left out"),
    "tag-misplaced": ("<texture>, <material> or <color> in the wrong place", "moved to where it belongs"),
    "tag-empty": ("<texture>, <material> or <color> without content", "left out"),
    "shape-missing": ("visual or collision without a shape that is known", "left out"),
    "shape-empty": ("shape of size 0", "left out"),
    "material-twice": ("material defined twice", "the first definition is used"),
    "name-twice": ("link or joint defined twice alike", "the second is left out"),
    "name-unknown": (
        "tag about a link or joint that is missing",
        "left out; a <gazebo> is kept as text",
    ),
    "drive-incomplete": (
        "drive plugin or its controller with an unknown joint, no wheels on a side, or an invalid figure",
        "kept as text; the robot gets no drive from it",
    ),
    "name-missing": ("robot without a name", "the name of its file"),
    "mesh-missing": ("missing mesh", "a box of the link's size as a placeholder"),
    "mesh-unreadable": ("mesh that cannot be read", "a box of the link's size as a placeholder"),
    "mesh-flat": ("flat collision mesh", "thickened to a thin plate"),
    "file-name": ("path with odd slashes, or of a file that lies elsewhere", "read as meant"),
    "package-missing": ("missing package of $(find)", "files in it count as missing"),
    "include-renamed": (
        "missing include with the suffix .xacro or .urdf.xacro, beside a file with the other",
        "that file is included",
    ),
    "include-skipped": ("missing include of a xacro", "skipped; none of its macros is called"),
}
"""Faults by kind: the fault, and its repair."""


@dataclass(frozen=True)
class Repair:
    """One fault of a description, and what was done about it."""

    kind: str
    """A key of `FAULTS`, or `NOTE` or `LOSS`."""

    text: str
    """What was found and done, in words."""

    file: str = ""
    """File, relative to the folder of the description; "" if unknown."""

    line: int = 0
    """Line, from 1; 0 if unknown."""

    @property
    def place(self) -> str:
        """`file:line`, `file`, or ""."""
        return f"{self.file}:{self.line}" if self.line else self.file


@dataclass
class Repairs:
    """Every repair, loss and guess of one conversion, in the order found."""

    entries: dict[Repair, None] = field(default_factory=dict)
    """Each once."""

    supplies: dict[str, None] = field(default_factory=dict)
    """Options of the command line that would supply what is missing, such as `--package arm=FOLDER`."""

    about: dict[Element, list[tuple[str, str]]] = field(default_factory=dict)
    """Kinds and texts of repairs by the element with the fault."""

    suggested: int = 0
    """Names so far for which a near one was looked for."""

    def suggestion(self, name: str, known: Iterable[str], advise: Callable[[str, Iterable[str]], str]) -> str:
        """Advice on an unknown name, by `errors.near` or `errors.hint`, for the first `SUGGESTED`; then "".

        To compare each of many unknown names with each of many known ones would take too long.
        """
        self.suggested += 1
        return advise(name, known) if self.suggested <= SUGGESTED else ""

    def add(self, kind: str, text: str, place: tuple[str, int] = ("", 0)) -> None:
        """Add an entry, once.

        Args:
            kind: A key of `FAULTS`, `NOTE` or `LOSS`.
            text: What was found and done.
            place: File and line.
        """
        if kind not in (NOTE, LOSS):
            find("kind of repair", kind, FAULTS)
        self.entries[Repair(kind, text, *place)] = None

    @property
    def notes(self) -> tuple[str, ...]:
        """All texts, each once."""
        return tuple(dict.fromkeys(entry.text for entry in self.entries))

    @property
    def losses(self) -> tuple[str, ...]:
        """Texts of what was left out, each once."""
        return tuple(dict.fromkeys(entry.text for entry in self.entries if entry.kind == LOSS))

    def by_kind(self) -> dict[str, list[Repair]]:
        """Entries by kind, in the order of `FAULTS`, then losses; without guesses."""
        kinds = (*FAULTS, LOSS)
        grouped = {kind: [entry for entry in self.entries if entry.kind == kind] for kind in kinds}
        return {kind: entries for kind, entries in grouped.items() if entries}

    def check(self, source: str, *, strict: bool) -> None:
        """Refuse everything that was repaired or left out, if `strict`.

        Args:
            source: Name of the description's file.
            strict: Whether to refuse.

        Raises:
            InputError: One line with every fault and its place.
        """
        faults = [entry for entries in self.by_kind().values() for entry in entries]
        if not (strict and faults):
            return
        texts = [f"{entry.place}: {entry.text}" if entry.place else entry.text for entry in faults]
        count = f"{len(faults)} fault{'s' if len(faults) > 1 else ''}"
        supplied = f"; {' '.join(self.supplies)} would supply what is missing" if self.supplies else ""
        raise InputError(
            f"{source}: {count}: {'; '.join(texts)}{supplied}; "
            "convert without `strict=True` to accept the repairs"
        )
