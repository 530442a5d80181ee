"""Xacro: macros expanded to plain URDF by the xacro library, with its access to the outside replaced.

The library evaluates `${...}` and `$(eval ...)` as Python, `load_yaml` and `<xacro:include>` read any file,
and `$(env)` reads any variable. Here, `expression` evaluates the text, files are read from the folder of the
description and from packages only, and environment variables are not read: `$(env)` and `$(optenv)` take
arguments instead. The library still handles macros, scopes, blocks, conditions and lazy properties.
"""

import importlib.util
import os
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any
from xml.dom import DOMException, minidom
from xml.etree import ElementTree
from xml.parsers.expat import ExpatError

from magtwin.errors import InputError, hint
from magtwin.files.file import read_bytes
from magtwin.files.settings import yaml_loader
from magtwin.urdf.repairs import NOTE, Repairs
from magtwin.urdf.source.expression import GLOBALS, LARGEST, Budget, ExpressionError, check_size, evaluate
from magtwin.urdf.source.markup import UnsafeError, parse_markup
from magtwin.urdf.source.package import MissingFileError, Packages

UNITS, ELEMENT, FILE = 20_000_000, 100, 1_000
"""Budget of an expansion, the cost of each element, and that of each file or package that is looked for.
A unit is about half a microsecond."""

COPY, TEXT, PER_YAML = 40, 4, 20
"""Cost of each element that is copied; of each text; and of each byte of YAML, which is read slowly."""

SIBLINGS = 16
"""Children of an element that are looked through for one unit."""

PLACE = "magtwin.place"
"""Key of a node's user data: its file and line."""

_PIECES = re.compile(
    r"(?P<escaped>\$\$+[{(])|\$\{(?P<expression>[^}]*)\}|\$\((?P<command>[^)]*)\)|(?P<text>[^$]+|\$[^{($]+|\$$)"
)
"""Tokens of a text, as xacro defines them."""

_WILD = re.compile(r"[*?\[]")

_PARAMETER = re.compile(
    r"^\s*([^\s:=]+?)\s*:?=\s*(\^\|?)?"
    r"""(\$\{.*?\}|\$\(.*?\)|(?:'[^'\n]*+'|"[^"\n]*+"|[^\s'"]++)++|)(?:\s+|$)(.*)"""
)
"""A parameter of a macro with its default, as in the library, whose pattern takes exponential time."""

Place = tuple[Path, int]


def expand(
    path: Path,
    packages: Packages,
    arguments: Mapping[str, str],
    repairs: Repairs,
    *,
    skip_missing_includes: bool = False,
) -> tuple[ElementTree.Element, dict[ElementTree.Element, Place]]:
    """Expand a xacro to URDF.

    A package that is missing and from which nothing is included is a repair: files in it count as missing.
    So is an include that ends in .xacro or .urdf.xacro where only the other of the two exists.

    Args:
        path: The xacro.
        packages: Packages for `$(find)`, and the folders from which files may be included.
        arguments: Values of `<xacro:arg>`; they override its defaults.
        repairs: Receives repairs and notes.
        skip_missing_includes: Whether to skip missing includes of which no macro is called.

    Returns:
        `<robot>`; and file and line of each element.

    Raises:
        InputError: The file is not XML, reads outside the packages, has an expression outside the language,
            or expands without end; the message gives file and line. Or includes, arguments or macros are
            missing; the message lists all, with the options that would supply them.
    """
    return _Expansion(path, packages, arguments, repairs, skip_missing_includes).run()


class _Expansion:
    """One expansion, on a fresh instance of the library's module, because the library keeps global state."""

    def __init__(
        self, path: Path, packages: Packages, arguments: Mapping[str, str], repairs: Repairs, skip: bool
    ) -> None:
        self._path, self._packages, self._arguments = path, packages, dict(arguments)
        self._repairs, self._skip = repairs, skip
        self._absent: dict[str, str] = {}  # what the expansion cannot do without, and where
        self._skipped: dict[str, str] = {}  # includes, and where
        self._near: dict[str, str] = {}  # near names of missing packages
        self._optional = self._including = False
        self._asked: set[str] = set()
        self._budget = Budget(UNITS)
        self._placed = _Placed(self._budget)
        self._at: Place = (path, 1)
        self._library = _library()
        library = self._library
        ours: dict[str, Callable[..., Any]] = {  # of every function that evaluates, reads or prints
            **dict.fromkeys(("safe_eval", "eval_extension", "load_yaml"), _forbidden),
            **dict.fromkeys(("warning", "message", "error"), self._note),
            "eval_text": self._text,
            "parse": self._parse,
            "get_include_files": self._included,
            "parse_macro_arg": self._parameter,
            "print_location": lambda: None,
            "replace_node": self._replaced(library.replace_node),
            "resolve_macro": self._resolved(library.resolve_macro),
        }
        for name in ("check_attrs", "eval_all", "handle_macro_call", "reqd_attrs"):
            ours[name] = self._followed(getattr(library, name))
        ours["handle_macro_call"] = self._called(ours["handle_macro_call"])
        for name, replacement in ours.items():
            if not hasattr(library, name):
                raise InputError(f"xacro: this version has no {name}; install xacro 2.1")
            setattr(library, name, replacement)
        shown = {"abs_filename": library.abs_filename_spec, "dotify": dict, "load_yaml": self._yaml}
        names = dict.fromkeys(("warning", "message", "error"), self._note)
        xacro = {**shown, **names, "arg": self._argument, "fatal": _fatal, "tokenize": _tokenize}
        vars(library)["_global_symbols"] = {**GLOBALS, **shown, "xacro": xacro}

    def run(self) -> tuple[ElementTree.Element, dict[ElementTree.Element, Place]]:
        try:
            document = self._expanded()
        except UnsafeError:
            raise
        except InputError as error:
            self._check_absent()  # what is missing may be the cause
            if not self._skipped:
                raise
            supplied = " ".join(self._repairs.supplies) or "the files in their place"
            raise InputError(
                f"{error}; this may come from a skipped include: {', '.join(self._skipped)}; give {supplied}"
            ) from error
        self._check_absent()
        for include, place in self._skipped.items():
            file, _, line = place.rpartition(":")
            self._repairs.add(
                "include-skipped", f"include {include!r} is missing: skipped", (file, int(line))
            )
        unknown = [name for name in self._arguments if name not in self._asked]
        if unknown:
            known = hint(unknown[0], self._asked) if self._asked else "it has none"
            raise InputError(f"{self._path}: no xacro argument {unknown[0]!r}; {known}")
        assert document.documentElement is not None
        return _to_tree(document.documentElement, (self._path, 1))

    def _expanded(self) -> minidom.Document:
        library = self._library
        try:
            library.init_stacks(str(self._path))
            document = self._parse(None, str(self._path))
            library.process_doc(document, mappings=dict(self._arguments), verbosity=0)
        except RecursionError as error:
            raise self._refused("expands without end: a macro or an include leads to itself") from error
        except ExpressionError as error:
            raise self._refused(str(error)) from error
        except library.XacroException as error:
            raise self._refused(" ".join(str(error.args[0] or error).split())) from error
        except InputError:
            raise
        except (
            *(ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError),
            DOMException,
        ) as error:
            raise self._refused(f"cannot be expanded: {error}") from error
        return document

    def _check_absent(self) -> None:
        """Refuse everything that is missing, in one line.

        Raises:
            InputError: Something is missing, and the expansion cannot do without it.
        """
        absent = dict(self._absent)
        if absent or not self._skip:
            near = {name: self._near.get("/".join(name.split("/")[:3]), "") for name in self._skipped}
            includes = {f"include {name!r}{near[name]}": place for name, place in self._skipped.items()}
            absent = includes | absent
        if not absent:
            return
        faults = ", ".join(f"{what} ({place})" for what, place in absent.items())
        supplies = list(self._repairs.supplies)
        advice = f"; give {' '.join(supplies)}" if supplies else "; put the files in their place"
        if self._skipped and not any(what.startswith("macro") for what in self._absent):
            skip = ["`skip_missing_includes=True`", *(each for each in supplies if each.startswith("--arg"))]
            advice += f", or {' '.join(skip)}, as none of their macros is called"
        raise InputError(f"{self._path}: missing: {faults}{advice}")

    def _miss(self, what: str, supply: str = "") -> None:
        """Record something without which the expansion cannot be used."""
        self._absent.setdefault(what, self._place())
        if supply:
            self._repairs.supplies[supply] = None

    def _repair(self, kind: str, text: str, place: str | None = None) -> None:
        """Add a repair at a place. Default: the current node's."""
        file, _, line = (place or self._place()).rpartition(":")
        self._repairs.add(kind, text, (file, int(line)))

    def _place(self) -> str:
        """File, relative to the folder of the xacro, and line of the current node."""
        file, line = self._at
        return f"{Path(os.path.relpath(file, self._path.parent)).as_posix()}:{line}"

    def _called(self, handle: Callable[..., Any]) -> Callable[..., Any]:
        """The library's macro call; an unknown macro counts as missing if an include is missing."""

        def call(node: minidom.Element, *arguments: Any) -> Any:
            try:
                return handle(node, *arguments)
            except self._library.XacroException as error:
                if not self._skipped or f"unknown macro name: {node.tagName}" not in str(error.args[0] or ""):
                    raise
                self._miss(f"macro {node.tagName!r}")
                self._library.replace_node(node, by=None)
                return True

        return call

    def _refused(self, text: str) -> InputError:
        file, line = self._at
        return InputError(f"{file}:{line}: {text}")

    def _followed(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """The library's function; records the current node and pays for it."""

        def follow(node: minidom.Element, *arguments: Any) -> Any:
            self._budget.spend(ELEMENT)
            self._at = node.getUserData(PLACE) or self._at
            if node.tagName == "xacro:arg":
                self._asked.add(node.getAttribute("name"))
            if node.tagName == "xacro:include":
                self._optional = node.getAttribute("optional").lower() in ("true", "1")
            return function(node, *arguments)

        return follow

    def _replaced(self, replace: Callable[..., Any]) -> Callable[..., Any]:
        """The library's replacement of a node by others; pays for the siblings among which it looks."""

        def replaced(node: minidom.Element, by: Any, content_only: bool = False) -> None:
            new = by if isinstance(by, list) else [] if by is None else [by]
            count = sum(len(one.childNodes) for one in new) if content_only else len(new)
            siblings = 0 if node.parentNode is None else len(node.parentNode.childNodes)
            self._budget.spend((2 + count) * (siblings + count) // SIBLINGS)
            replace(node, by, content_only)

        return replaced

    def _resolved(self, resolve: Callable[..., Any]) -> Callable[..., Any]:
        """The library's look-up of a macro; pays to compare its parameters with those of the call."""

        def resolved(*arguments: Any) -> Any:
            match = resolve(*arguments)
            self._budget.spend(len(match[2].params or ()) ** 2 // SIBLINGS)
            return match

        return resolved

    def _parameter(self, text: str) -> tuple[str, tuple[str | None, str | None] | None, str]:
        """The first parameter of a macro, the argument that it forwards and its default, and the others."""
        self._budget.spend(1 + len(text) // SIBLINGS)
        match = _PARAMETER.match(text)
        if match is not None:
            name, forward, default, rest = match.groups()
            return name, (name if forward else None, default or None), rest
        name, *others = text.split(None, 1)
        return name, None, others[0] if others else ""

    def _text(self, text: str, symbols: Mapping[str, Any]) -> Any:
        """The value of a text: that of a single expression, or all parts joined to a string."""
        self._budget.spend(TEXT + len(text) // SIBLINGS)
        values: list[Any] = []
        end = 0
        for piece in _PIECES.finditer(text):
            if piece.start() != end:
                break
            end = piece.end()
            content = piece[piece.lastgroup or 0]
            if piece.lastgroup == "escaped":
                content = content[1:]
            elif piece.lastgroup == "expression":
                value = evaluate(str(self._text(content, symbols)), symbols, self._budget)
                content = check_size(value, self._budget, plain=True)
            elif piece.lastgroup == "command":
                content = self._command(str(self._text(content, symbols)))
            values.append(content)
        if end != len(text):
            raise ExpressionError(f"not closed: {text[end : end + 40]!r}")
        if len(values) == 1:
            return values[0]
        joined = ""
        for value in values:
            joined += str(check_size(value, self._budget))
            if len(joined) > 16 * LARGEST:
                raise ExpressionError(f"a text of over {16 * LARGEST} characters")
        return joined

    def _command(self, text: str) -> str:
        """The value of `$(...)`."""
        self._budget.spend(TEXT)
        command, _, rest = text.strip().partition(" ")
        words = rest.split()
        if command == "eval":
            return str(evaluate(rest, _Arguments(self), self._budget))
        if command in ("find", "arg", "env") and len(words) != 1:
            raise ExpressionError(f"$({text}): {command} takes one name")
        if command in ("find", "arg", "env"):
            read = {"find": self._find, "arg": self._argument, "env": self._variable}[command]
            return str(read(words[0]))
        if command == "optenv" and words:
            return self._variable(words[0], " ".join(words[1:]))
        if command == "dirname":
            return str(Path(self._library.filestack[-1]).resolve().parent)
        raise ExpressionError(f"$({text}) is not known; known: arg, dirname, env, eval, find, optenv")

    def _find(self, name: str) -> str:
        self._budget.spend(FILE)
        try:
            return str(self._packages.find(name))
        except MissingFileError as error:
            self._repairs.supplies[error.supply] = None
            self._near[f"package://{name}"] = error.near
            if not self._including:
                self._repair(
                    "package-missing", f"$(find {name}): no such package: files in it count as missing"
                )
            return f"package://{name}"

    def _argument(self, name: str) -> Any:
        self._asked.add(name)
        table = self._library.substitution_args_context["arg"]
        if name not in table:
            self._miss(f"argument {name!r}", f"--arg {name}=VALUE")
            return "0"
        return table[name]

    def _variable(self, name: str, default: str | None = None) -> str:
        self._asked.add(name)
        if name in self._arguments:
            return self._arguments[name]
        if default is None:
            self._miss(f"environment variable {name!r}, which is not read", f"--arg {name}=VALUE")
            return ""
        self._note(f"environment variable {name} is not read, {default!r} is taken; give --arg {name}=VALUE")
        return default

    def _included(self, filename: str, names: Mapping[str, Any]) -> Iterator[str]:
        """Files of an `<xacro:include>`."""
        self._including = True
        try:
            text = str(self._text(filename, names))
        finally:
            self._including = False
        if text.startswith("package://"):
            if not self._optional:
                self._skipped[text] = self._place()
            return
        file = self._library.abs_filename_spec(text)
        if _WILD.search(file):
            raise ExpressionError(f"include {filename!r} has a wildcard; name each file")
        path = self._check_inside(file, "include")
        if not (path.exists() or self._optional):
            name, other = os.path.relpath(path, self._path.parent), _other_suffix(path)
            if not self._check_inside(str(other), "include").is_file():
                self._skipped[name] = self._place()
                return
            self._repair(
                "include-renamed", f"include {name!r} is missing: {other.name} beside it is included"
            )
            file = str(other)
        yield file

    def _check_inside(self, file: str, what: str) -> Path:
        self._budget.spend(FILE)
        path = Path(os.path.normpath(file))
        if not self._packages.holds(path):
            raise ExpressionError(
                f"{what} {str(path)!r} lies outside {self._packages.home} and of all packages; "
                "name its folder by --package NAME=FOLDER"
            )
        return path

    def _parse(self, text: None, filename: str) -> minidom.Document:
        """The DOM of a file; each element carries its file and line."""
        path = Path(os.path.normpath(filename))
        try:
            path.stat()
            content = read_bytes(path, "xacro file", "XML")
        except (OSError, InputError) as error:
            self._library.filestack.pop()
            reason = getattr(error, "strerror", None) or error
            raise self._library.XacroException(
                f"include {str(path)!r} cannot be read: {reason}", exc=error
            ) from error
        self._budget.spend(FILE + len(content))
        markup = parse_markup(content, path)
        attributes = sum(len(element.attrib) for element in markup.lines)
        self._budget.spend(ELEMENT * (len(markup.lines) + attributes // 4))
        try:
            document = minidom.parseString(content)
        except ExpatError as error:
            reason = f"{error}".partition(":")[0]
            raise InputError(
                f"{path}:{error.lineno}: not XML: {reason}; declare xmlns:xacro in <robot>"
            ) from error
        elements = document.getElementsByTagName("*")
        for element, line in zip(elements, markup.lines.values(), strict=True):
            element.setUserData(PLACE, (path, line), self._placed)
        return document

    def _yaml(self, filename: str) -> Any:
        """Data of a YAML file, with angles and lengths converted by their unit tags."""
        import yaml

        if str(filename).startswith("package://"):
            self._miss(f"settings {filename!r}")
            return {}
        path = self._check_inside(self._library.abs_filename_spec(str(filename)), "load_yaml")

        UnitLoader: Any = type("UnitLoader", (yaml_loader(),), {})

        def number(factor: float) -> Callable[[Any, Any], float]:
            return lambda loader, node: (
                factor * float(evaluate(str(loader.construct_scalar(node)), GLOBALS, self._budget))
            )

        for unit in self._library.ConstructUnits:
            UnitLoader.add_constructor(unit.value.tag, number(unit.value.conversion_constant))
        try:
            content = read_bytes(path, "YAML file", "YAML")
            self._budget.spend(PER_YAML * len(content))
            return check_size(yaml.load(content, UnitLoader), self._budget)
        except OSError as error:
            raise ExpressionError(f"load_yaml: {path} cannot be read ({error.strerror})") from error
        except yaml.YAMLError as error:
            raise ExpressionError(f"load_yaml: {path} is not YAML: {' '.join(str(error).split())}") from error
        except RecursionError as error:
            raise ExpressionError(f"load_yaml: {path} nests too deep") from error

    def _note(self, *words: Any, **_: Any) -> str:
        text = f"{self._at[0].name}:{self._at[1]}: " + " ".join(map(str, words))
        self._repairs.add(NOTE, text)
        return ""


class _Arguments(dict[str, Any]):
    """Names in `$(eval ...)`: a few functions, and arguments, as numbers where they are numbers."""

    def __init__(self, expansion: _Expansion) -> None:
        super().__init__(
            GLOBALS,
            true=True,
            false=False,
            arg=lambda name: _typed(str(expansion._argument(name))),
            find=expansion._find,
            env=lambda name: expansion._variable(name),
            optenv=lambda name, default="": expansion._variable(name, default),
            dirname=lambda: expansion._command("dirname"),
        )
        self._expansion = expansion

    def __missing__(self, name: str) -> Any:
        if name in self._expansion._library.substitution_args_context["arg"]:
            return _typed(str(self._expansion._argument(name)))
        raise KeyError(name)


class _Placed:
    """Copies the place of an element to its copies, and pays for them (DOM level 3, UserDataHandler)."""

    def __init__(self, budget: Budget) -> None:
        self._budget = budget

    def handle(self, operation: int, key: str, data: Any, src: Any, dst: Any) -> None:
        self._budget.spend(COPY * (1 + len(src.attributes) // 4 + len(src.childNodes) // 4))
        if dst is not None:
            dst.setUserData(key, data, self)


def _library() -> ModuleType:
    """A fresh instance of the xacro library's module."""
    spec = importlib.util.find_spec("xacro")
    if spec is None or spec.loader is None:
        raise InputError("reading xacro files needs the package xacro; install it: pip install xacro")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _forbidden(*_: Any, **__: Any) -> Any:
    raise ExpressionError("this version of xacro evaluates text without a guard; install xacro 2.1")


def _fatal(*words: Any) -> None:
    raise ExpressionError(" ".join(map(str, words)))


def _tokenize(text: str, sep: str = ",; ", skip_empty: bool = True) -> list[str]:
    """Words of a text, split at any of the characters `sep`."""
    if not sep:
        raise ExpressionError("tokenize: sep is empty; give the characters between the words")
    words = text.translate(dict.fromkeys(map(ord, sep), sep[0])).split(sep[0])
    return [word for word in words if word or not skip_empty]


def _other_suffix(path: Path) -> Path:
    """`a.xacro` for `a.urdf.xacro`, and the reverse."""
    stem, dot, suffixes = path.name.partition(".")
    return path.with_name(stem + dot + {"urdf.xacro": "xacro", "xacro": "urdf.xacro"}.get(suffixes, suffixes))


def _typed(text: str) -> Any:
    """An argument as a number or boolean if it reads as one."""
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return {"true": True, "false": False}.get(text.lower(), text)


def _to_tree(
    node: minidom.Element, place: Place
) -> tuple[ElementTree.Element, dict[ElementTree.Element, Place]]:
    """A DOM element as an ElementTree, and the place of each element in it."""
    places: dict[ElementTree.Element, Place] = {}
    builder = ElementTree.TreeBuilder()

    def add(node: minidom.Element, place: Place) -> None:
        place = node.getUserData(PLACE) or place
        attributes = {name: value for name, value in node.attributes.items() if name != "xmlns:xacro"}
        places[builder.start(node.tagName, attributes)] = place
        for child in node.childNodes:
            if child.nodeType == child.ELEMENT_NODE:
                add(child, place)
            elif child.nodeType in (child.TEXT_NODE, child.CDATA_SECTION_NODE):
                builder.data(child.data)
        builder.end(node.tagName)

    add(node, place)
    return builder.close(), places
