"""Check that the package stays small: what functions reach by imports, lines of each room, long functions.

    python .ci/house.py

`REACH`, `ROOMS` and `TESTS` are bounds. Lower one when you can. Raise one only in a commit that says why.
"""

import ast
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

REACH = {
    "read_survey": ("magtwin.io.surveys.survey", 8_600),
    "fit_map": ("magtwin.field.fit.fit", 4_030),
    "simulate": ("magtwin.twin.simulation", 18_050),
    "open_twin": ("magtwin.twin.opening", 20_000),
    "localize": ("magtwin.tasks.localizing", 18_700),
    "from_urdf": ("magtwin.author.from_urdf", 11_650),
    "ros magnetometer": ("magtwin.ros.magnetometer", 14_550),
}
"""Module of a public function, and the most lines of magtwin that it reaches.

Imports inside functions and the `__init__` of packages count. Imports for type checkers do not, nor modules
that a table names as text, since these are loaded for one format or method only.
"""

ROOMS = {
    "magtwin": 1_230,
    "author": 3_520,
    "bench": 4_730,
    "cli": 5_000,
    "export": 3_540,
    "fetch": 170,
    "field": 9_450,
    "files": 1_660,
    "figures": 4_830,
    "io": 10_590,
    "learn": 9_880,
    "localization": 6_030,
    "parallel": 1_110,
    "path": 1_370,
    "report": 450,
    "ros": 4_310,
    "run": 1_690,
    "sim": 8_170,
    "spec": 2_450,
    "tables": 1_530,
    "tasks": 1_110,
    "twin": 2_140,
    "urdf": 11_290,
    "usd": 6_260,
}
"""Most lines of each room; "magtwin" are the files beside the rooms."""

TESTS = 49_800
"""Most lines of tests."""

LONG = 80
"""Most lines of a function, its docstring left out."""


def modules() -> dict[str, Path]:
    """Files of the package by the name of their module."""
    names = {}
    for path in sorted((ROOT / "magtwin").rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        names[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return names


def imported(tree: ast.AST) -> set[str]:
    """Names that a module imports at any depth, but for type checkers."""
    names: set[str] = set()
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            node = ast.Module(node.orelse, [])
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names |= {f"{node.module}.{alias.name}" for alias in node.names} | {str(node.module)}
        names |= imported(node)
    return names


def reached(start: str, imports: dict[str, set[str]]) -> set[str]:
    """Modules that are loaded with a module, itself and the packages around each of them included."""
    seen: set[str] = set()
    waiting = [start]
    while waiting:
        name = waiting.pop()
        if name in imports and name not in seen:
            seen.add(name)
            waiting += [name.rpartition(".")[0], *imports[name]]
    return seen


def long_functions(name: str, tree: ast.AST) -> list[str]:
    """Functions of a module that are too long."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            body = node.body[1:] if ast.get_docstring(node) and len(node.body) > 1 else node.body
            lines = body[-1].end_lineno - body[0].lineno + 1
            if lines > LONG:
                found.append(f"{name}.{node.name} has {lines} lines, at most {LONG}")
    return found


def main() -> int:
    """Print the figures, and what is beyond its bound; 1 if anything is."""
    files = modules()
    texts = {name: path.read_text(encoding="utf-8") for name, path in files.items()}
    trees = {name: ast.parse(text) for name, text in texts.items()}
    lines = {name: text.count("\n") for name, text in texts.items()}
    imports = {name: imported(tree) for name, tree in trees.items()}
    wrong = [said for name, tree in trees.items() for said in long_functions(name, tree)]

    def compare(what: str, count: int, most: int) -> None:
        print(f"{count:7,} of {most:7,}  {what}")
        if count > most:
            wrong.append(f"{what}: {count:,} lines, at most {most:,}")

    for function, (start, most) in REACH.items():
        compare(f"reached by {function}", sum(lines[name] for name in reached(start, imports)), most)
    rooms = dict.fromkeys(ROOMS, 0)
    for name, count in lines.items():
        parts = files[name].relative_to(ROOT).parts
        room = parts[1] if len(parts) > 2 else "magtwin"
        rooms[room] = rooms.get(room, 0) + count
    for room, count in rooms.items():
        compare(f"in {room}", count, ROOMS.get(room, 0))
    tests = sum(path.read_text(encoding="utf-8").count("\n") for path in (ROOT / "tests").rglob("*.py"))
    compare("in tests", tests, TESTS)
    print(f"{sum(lines.values()):7,}             in the package")
    print("\n".join(wrong), file=sys.stderr)
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
