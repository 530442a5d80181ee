"""A rule: one thing that every stage must hold to; and the stage that is checked.

To add a rule, write a generator in `rules.py` and decorate it:

    @rule("magtwin", "what to do if the rule is broken")
    def robot_name(subject: Subject) -> Iterator[Wrong]:
        '''Every robot has a name of letters.'''
        for prim in subject.having("robot"):
            if not prim.GetName().isalpha():
                yield Wrong("has another name", str(prim.GetPath()))

Then list it in docs/validate.md; a test compares that page with `RULES`.
"""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import entry_points
from pathlib import Path

from pxr import Sdf, Tf, Usd

from magtwin.errors import InputError, find
from magtwin.export.validation.findings import Finding, Severity
from magtwin.usd.placement import lab_on, labs_on, take_to_origin
from magtwin.usd.schema import prims_with

MOST_CHARACTERS = 120
"""Characters of a Python or USD error that a finding quotes."""

_NOT_ITS_TYPE = (Tf.ErrorException, ArithmeticError, AttributeError, LookupError, TypeError, ValueError)

_WHERE = re.compile(r"^(?P<file>[^<]*)<(?P<prim>/[^>]*)>:? ?(?P<text>.*)$", re.S)
"""How errors of usd/ begin, see `magtwin.usd.schema.place`."""


@dataclass(frozen=True)
class Wrong:
    """Something that breaks a rule."""

    text: str

    where: str = ""
    """Path of the prim, or name of the file."""

    advice: str = ""
    """What to do. Default: the rule's advice."""

    severity: Severity = "error"


@dataclass
class Subject:
    """A stage that is checked, with what the caller knows about it."""

    stage: Usd.Stage

    file: Path
    """Its root layer."""

    inputs: frozenset[str] | None = None
    """Names of the inputs that a network may have. None allows any."""

    packed: Path | None = None
    """Folder to which a .usdz was unpacked; nothing may lead out of it."""

    @property
    def folder(self) -> Path:
        """Folder that the stage and what it names lie in."""
        return (self.packed or self.file.resolve().parent).resolve()

    @cached_property
    def prims(self) -> list[Usd.Prim]:
        """Every prim that is active and defined, without those inside instances."""
        return list(self.stage.Traverse())

    @cached_property
    def layers(self) -> list[Sdf.Layer]:
        """Every layer that was read from a file."""
        return [layer for layer in self.stage.GetUsedLayers() if layer.realPath]

    @cached_property
    def labs(self) -> list[Usd.Stage]:
        """The stage once for each lab, in that lab's axes and without other labs; see `usd.placement`.

        A lab that is tilted or scaled is left out, as the rule `frames` reports it.
        """
        stages = []
        for path in dict.fromkeys(lab.path for lab in labs_on(self.stage)):
            stage = Usd.Stage.Open(self.stage.GetRootLayer())
            try:
                take_to_origin(stage, lab_on(stage, path))
            except InputError:
                continue
            stages.append(stage)
        return stages

    def owns(self, layer: Sdf.Layer) -> bool:
        """Whether a layer is in the stage's folder."""
        return Path(layer.realPath).resolve().is_relative_to(self.folder)

    def having(self, noun: str) -> list[Usd.Prim]:
        """The prims that have one of magtwin's schemas, by its noun."""
        return prims_with(self.stage.GetPseudoRoot(), noun)

    def name_of(self, layer: Sdf.Layer) -> str:
        """A layer's file, relative to the folder."""
        path = Path(layer.realPath).resolve()
        return path.relative_to(self.folder).as_posix() if self.owns(layer) else str(path)


@dataclass(frozen=True)
class Rule:
    """A rule."""

    name: str
    sentence: str
    """What is true of a stage that keeps the rule."""

    advice: str
    """What to do if it is broken."""
    look: Callable[[Subject], Iterator[Wrong]]

    def findings(self, subject: Subject) -> list[Finding]:
        """What breaks the rule. An InputError breaks it, and so does a value that is of another type."""
        wrongs: list[Wrong] = []
        try:
            wrongs.extend(self.look(subject))
        except InputError as error:
            wrongs.append(wrong_of(error))
        except _NOT_ITS_TYPE as error:
            reason = f"{type(error).__name__}: {' '.join(str(error).split())[:MOST_CHARACTERS]}"
            text = f"cannot be checked, a value is not of its type ({reason})"
            wrongs.append(Wrong(text, advice="author it anew; docs/schema.md lists the type of each value"))
        return [Finding(self.name, w.text, w.where, w.advice or self.advice, w.severity) for w in wrongs]


RULES: dict[str, dict[str, Rule]] = {"magtwin": {}}
"""Every rule by validator and name. Importing `rules` fills it."""

Look = Callable[[Subject], Iterator[Wrong]]


def rule(validator: str, advice: str) -> Callable[[Look], Look]:
    """Decorator that enters a function in `RULES`.

    The rule's name is the function's, with hyphens; its sentence is the first line of the docstring. A stage
    is checked in another process, which imports the module of the function: it cannot be a script's own.

    Args:
        validator: "magtwin".
        advice: What to do if the rule is broken.

    Raises:
        UnknownNameError: No such validator.
    """
    find("validator", validator, RULES)

    def register(look: Look) -> Look:
        name = look.__name__.replace("_", "-")
        RULES[validator][name] = Rule(name, (look.__doc__ or "").split("\n")[0], advice, look)
        return look

    return register


def added_modules() -> list[str]:
    """Modules of the rules that users and installed packages add.

    Raises:
        InputError: A rule is in a script.
    """
    modules = {rule.look.__module__ for rules in RULES.values() for rule in rules.values()}
    if "__main__" in modules:
        raise InputError("a rule is in the script that runs; move it to a module, and import that")
    installed = {point.module for point in entry_points(group="magtwin.rules")}
    return sorted({name for name in modules if not name.startswith("magtwin.")} | installed)


def wrong_of(error: InputError) -> Wrong:
    """An error as what is wrong, with its prim taken out of the text."""
    match = _WHERE.match(str(error))
    return Wrong(match["text"], match["prim"]) if match else Wrong(str(error))
