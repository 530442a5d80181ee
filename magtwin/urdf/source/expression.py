"""Expression: the arithmetic of a xacro's `${...}`, interpreted, so that a description runs no code.

The language is a part of Python's: numbers, texts, lists, tuples and dictionaries; names of properties;
`+ - * / // % **`, comparisons, `and or not in`, `x if c else y`, indices and slices; comprehensions and
`lambda`; calls of the functions that `GLOBALS` lists and of the methods that `METHODS` lists. A dot reads
a key of a dictionary or of a namespace. There are no other attributes, no other names, no files, no
imports; and nothing grows without bound, since each step and each character is paid for from a `Budget`.
"""

import ast
import math
import operator
import re
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from magtwin.errors import hint

LONGEST = 2_000
"""Characters of an expression."""

LARGEST = 65_536
"""Characters of a text, or entries of a list with all that it holds."""

BITS = 4_096
"""Bits of a whole number."""


class ExpressionError(ValueError):
    """An expression that has no value here; the text says why, without file and line."""


class Budget:
    """What an expansion may cost in all: steps taken, elements copied, characters written."""

    def __init__(self, units: int) -> None:
        self._units = self._left = units

    def spend(self, units: int = 1) -> None:
        """Pay for work.

        Raises:
            ExpressionError: Nothing is left.
        """
        self._left -= units
        if self._left < 0:
            raise ExpressionError(
                f"expands without end (over {self._units} steps); look for what repeats itself"
            )


def _eager(function: Callable[..., Any]) -> Callable[..., list[Any]]:
    """The function with its iterator drawn to a list."""
    return lambda *arguments, **options: list(function(*arguments, **options))


def _range(*arguments: int) -> list[int]:
    steps = range(*arguments)
    if len(steps) > LARGEST:
        raise ExpressionError(f"range{arguments} has over {LARGEST} steps")
    return list(steps)


def _round(number: float, digits: int = 0) -> float:
    if not -300 <= digits <= 300:
        raise ExpressionError(f"round to {digits} digits is not allowed")
    return round(number, digits) if digits else round(number)


def _set(values: Any = ()) -> list[Any]:
    """Each value once, in the order of the first, so that one input has one output."""
    return list(dict.fromkeys(values))


def _sum(values: Any, start: float = 0) -> float:
    values = [start, *values]
    if not all(isinstance(value, int | float) for value in values):
        raise ExpressionError("sum is of numbers only")
    return sum(values)


_UNBOUNDED = ("factorial", "comb", "perm", "prod", "lcm")

MATH: Mapping[str, Any] = {
    name: value for name, value in vars(math).items() if not name.startswith("_") and name not in _UNBOUNDED
}

PYTHON: Mapping[str, Any] = {
    **{f.__name__: f for f in (abs, all, any, bool, dict, divmod, float, int, len, list, max, min, ord)},
    **{f.__name__: f for f in (repr, sorted, str, tuple)},
    **{f.__name__: _eager(f) for f in (enumerate, filter, map, reversed, zip)},
    "range": _range,
    "round": _round,
    "set": _set,
    "sum": _sum,
    "isinstance": isinstance,
}

_BARE = (
    *("bool", "dict", "float", "int", "len", "list", "map", "max", "min", "range", "round", "sorted", "str"),
)

GLOBALS: Mapping[str, Any] = {
    **MATH,
    **{name: PYTHON[name] for name in _BARE},
    "math": dict(MATH),
    "python": dict(PYTHON),
}
"""Names that every expression knows."""

_OF_TEXT = (
    *("capitalize", "count", "endswith", "find", "index", "isdigit", "join", "lower", "lstrip", "replace"),
    *("rstrip", "split", "startswith", "strip", "title", "upper"),
)

METHODS: Mapping[type, frozenset[str]] = {
    str: frozenset(_OF_TEXT),
    list: frozenset({"count", "index"}),
    tuple: frozenset({"count", "index"}),
    dict: frozenset({"get", "items", "keys", "values"}),
}
"""Methods by the type that has them."""

_BINARY: Mapping[type[ast.operator], Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.FloorDiv: operator.floordiv,
    ast.Mod: operator.mod,
    ast.Pow: operator.pow,
}

_UNARY: Mapping[type[ast.unaryop], Callable[[Any], Any]] = {
    ast.UAdd: operator.pos,
    ast.USub: operator.neg,
    ast.Not: operator.not_,
}

_COMPARE: Mapping[type[ast.cmpop], Callable[[Any, Any], Any]] = {
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.Is: operator.is_,
    ast.IsNot: operator.is_not,
    ast.In: lambda a, b: a in b,
    ast.NotIn: lambda a, b: a not in b,
}


def evaluate(text: str, names: Mapping[str, Any], budget: Budget) -> Any:
    """The value of an expression.

    Args:
        text: The expression, without its `${` and `}`.
        names: Values by name; functions among them may be called.
        budget: What it may cost.

    Raises:
        ExpressionError: It is no expression, or has something in it that is not of the language.
    """
    text = text.strip()
    if len(text) > LONGEST:
        raise ExpressionError(f"an expression of {len(text)} characters is too long (over {LONGEST})")
    try:
        tree = ast.parse(text, mode="eval")
        return _Interpreter(names, budget).value(tree.body)
    except ExpressionError as error:
        if "(in expression" in str(error):  # that of a property which this one reads
            raise
        raise ExpressionError(f"{error} (in expression {text!r})") from error
    except SyntaxError as error:
        raise ExpressionError(f"not an expression: {text!r}") from error
    except RecursionError:
        raise
    except (ArithmeticError, AttributeError, LookupError, MemoryError, TypeError, ValueError) as error:
        raise ExpressionError(f"{type(error).__name__}: {error} (in expression {text!r})") from error


def check_size(value: Any, budget: Budget, *, plain: bool = False) -> Any:
    """`value`, if it is not too large with all that it holds.

    Args:
        value: Of any type.
        budget: Pays for its size.
        plain: Whether functions and the like are refused, which no text stands for.

    Raises:
        ExpressionError: It is too large, or not plain.
    """
    pending, size = [value], 0
    while pending:
        entry = pending.pop()
        if isinstance(entry, str | bytes):
            size += len(entry)
        elif isinstance(entry, int) and entry.bit_length() > BITS:
            raise ExpressionError(f"a whole number of over {BITS} bits")
        elif isinstance(entry, dict):
            size += len(entry)
            pending += [*entry.keys(), *entry.values()] if size <= LARGEST else []
        elif isinstance(entry, list | tuple):
            size += len(entry)
            pending += entry if size <= LARGEST else []
        elif plain and not isinstance(entry, int | float | None):
            raise ExpressionError(f"a {type(entry).__name__} is no value")
        if size > LARGEST:
            raise ExpressionError(f"a value of over {LARGEST} characters or entries")
    budget.spend(1 + size)
    return value


class _Interpreter:
    """Walks an expression's tree; what it does not know, it refuses."""

    def __init__(self, names: Mapping[str, Any], budget: Budget) -> None:
        self._names = names
        self._budget = budget

    def value(self, node: ast.expr) -> Any:
        self._budget.spend()
        visit = getattr(self, f"_{type(node).__name__.lower()}", None)
        if visit is None:
            raise ExpressionError(f"{type(node).__name__} is not allowed")
        return visit(node)

    def _constant(self, node: ast.Constant) -> Any:
        if not isinstance(node.value, str | int | float | None):
            raise ExpressionError(f"{type(node.value).__name__} is not allowed")
        return check_size(node.value, self._budget)

    def _name(self, node: ast.Name) -> Any:
        try:
            return self._names[node.id]
        except KeyError:
            known = [name for name in self._names if isinstance(name, str) and not name.startswith("*")]
            near = hint(node.id, known) if known else ""
            raise ExpressionError(
                f"no property {node.id!r}" + (f"; {near}" if near.startswith("did") else "")
            ) from None

    def _attribute(self, node: ast.Attribute) -> Any:
        holder = self.value(node.value)
        if isinstance(holder, dict):
            try:
                return holder[node.attr]
            except KeyError:
                raise ExpressionError(
                    f"no {node.attr!r} in it; {hint(node.attr, map(str, holder))}"
                ) from None
        raise ExpressionError(f"attribute {node.attr!r} of type {type(holder).__name__} is not allowed")

    def _call(self, node: ast.Call) -> Any:
        method = self._method(node.func)
        function = method or self.value(node.func)
        if not callable(function):
            raise ExpressionError(f"a {type(function).__name__} cannot be called")
        arguments: list[Any] = []
        for argument in node.args:
            if isinstance(argument, ast.Starred):
                arguments += self.value(argument.value)
            else:
                arguments.append(self.value(argument))
        options = {}
        for keyword in node.keywords:
            if keyword.arg is None:
                raise ExpressionError("** is not allowed in a call")
            options[keyword.arg] = self.value(keyword.value)
        for argument in arguments:  # paid for before it is worked on
            check_size(argument, self._budget)
        return check_size(function(*arguments, **options), self._budget)

    def _method(self, function: ast.expr) -> Callable[..., Any] | None:
        """The method that is called, none if a function is."""
        if not isinstance(function, ast.Attribute):
            return None
        holder = self.value(function.value)
        allowed = METHODS.get(type(holder), frozenset())
        if function.attr in allowed:
            return _bounded(holder, function.attr)
        if isinstance(holder, dict):
            return None
        raise ExpressionError(
            f"method {function.attr!r} of type {type(holder).__name__} is not allowed"
            + (f"; allowed: {', '.join(sorted(allowed))}" if allowed else "")
        )

    def _binop(self, node: ast.BinOp) -> Any:
        operation = _BINARY.get(type(node.op))
        if operation is None:
            raise ExpressionError(f"operator {type(node.op).__name__} is not allowed")
        left, right = self.value(node.left), self.value(node.right)
        if isinstance(node.op, ast.Mult):
            _check_repeat(left, right)
            _check_repeat(right, left)
        if isinstance(node.op, ast.Pow):
            _check_power(left, right)
        if isinstance(node.op, ast.Mod) and isinstance(left, str) and _WIDE.search(left):
            raise ExpressionError("a format of over two digits is not allowed")
        return check_size(operation(left, right), self._budget)

    def _unaryop(self, node: ast.UnaryOp) -> Any:
        operation = _UNARY.get(type(node.op))
        if operation is None:
            raise ExpressionError(f"operator {type(node.op).__name__} is not allowed")
        return operation(self.value(node.operand))

    def _boolop(self, node: ast.BoolOp) -> Any:
        stop_at = isinstance(node.op, ast.Or)
        result = None
        for operand in node.values:
            result = self.value(operand)
            if bool(result) is stop_at:
                break
        return result

    def _compare(self, node: ast.Compare) -> bool:
        left = self.value(node.left)
        for operation, comparator in zip(node.ops, node.comparators, strict=True):
            right = self.value(comparator)
            if not _COMPARE[type(operation)](left, right):
                return False
            left = right
        return True

    def _ifexp(self, node: ast.IfExp) -> Any:
        return self.value(node.body if self.value(node.test) else node.orelse)

    def _subscript(self, node: ast.Subscript) -> Any:
        holder = self.value(node.value)
        if not isinstance(holder, str | list | tuple | dict):
            raise ExpressionError(f"a {type(holder).__name__} has no entries")
        if isinstance(node.slice, ast.Slice):
            ends = (node.slice.lower, node.slice.upper, node.slice.step)
            return holder[slice(*(None if end is None else self.value(end) for end in ends))]  # type: ignore[index]
        return holder[self.value(node.slice)]

    def _list(self, node: ast.List) -> list[Any]:
        return check_size([self.value(entry) for entry in node.elts], self._budget)

    def _tuple(self, node: ast.Tuple) -> tuple[Any, ...]:
        return check_size(tuple(self.value(entry) for entry in node.elts), self._budget)

    def _dict(self, node: ast.Dict) -> dict[Any, Any]:
        if None in node.keys:
            raise ExpressionError("** is not allowed in a dictionary")
        made = {self.value(k): self.value(v) for k, v in zip(node.keys, node.values, strict=True) if k}
        return check_size(made, self._budget)

    def _listcomp(self, node: ast.ListComp | ast.GeneratorExp) -> list[Any]:
        made = [scope.value(node.elt) for scope in self._scopes(node.generators)]
        return check_size(made, self._budget)

    _generatorexp = _listcomp

    def _dictcomp(self, node: ast.DictComp) -> dict[Any, Any]:
        made = {s.value(node.key): s.value(node.value) for s in self._scopes(node.generators)}
        return check_size(made, self._budget)

    def _lambda(self, node: ast.Lambda) -> Callable[..., Any]:
        names = [argument.arg for argument in node.args.args]
        if len(names) != sum(1 for _ in ast.walk(node.args)) - 1:
            raise ExpressionError("a lambda takes plain arguments only")
        return lambda *values: self._inside(dict(zip(names, values, strict=True))).value(node.body)

    def _inside(self, names: Mapping[str, Any]) -> "_Interpreter":
        return _Interpreter(_Scope(names, self._names), self._budget)

    def _scopes(self, generators: list[ast.comprehension]) -> "Iterator[_Interpreter]":
        """An interpreter for each turn of a comprehension."""
        if not generators:
            yield self
            return
        first, *others = generators
        values = self.value(first.iter)
        if not isinstance(values, str | list | tuple | dict):
            raise ExpressionError(f"a {type(values).__name__} has no entries")
        for value in values:
            self._budget.spend()
            scope = self._inside(_bind(first.target, value))
            if all(scope.value(condition) for condition in first.ifs):
                yield from scope._scopes(others)


class _Scope(Mapping[str, Any]):
    """Names of a comprehension or lambda, before those around it."""

    def __init__(self, inner: Mapping[str, Any], outer: Mapping[str, Any]) -> None:
        self._inner, self._outer = inner, outer

    def __getitem__(self, name: str) -> Any:
        return self._inner[name] if name in self._inner else self._outer[name]

    def __iter__(self) -> Iterator[str]:
        return iter({**dict.fromkeys(self._outer), **dict.fromkeys(self._inner)})

    def __len__(self) -> int:
        return len({*self._inner, *self._outer})


_WIDE = re.compile(r"%(\(.*?\))?[^%a-zA-Z]*?(\*|\d{3})", re.DOTALL)
"""A format, as `%s` is one, whose width or precision is of three digits or given beside it."""


def _check_repeat(one: Any, times: Any) -> None:
    """A text or list times a number."""
    if isinstance(one, str | list | tuple) and isinstance(times, int) and len(one) * times > LARGEST:
        raise ExpressionError(f"a value of over {LARGEST} characters or entries")


def _check_power(base: Any, exponent: Any) -> None:
    """A whole number to the power of another."""
    if isinstance(base, int) and isinstance(exponent, int) and base.bit_length() * abs(exponent) > BITS:
        raise ExpressionError(f"a whole number of over {BITS} bits")


def _bind(target: ast.expr, value: Any) -> dict[str, Any]:
    """Names that a comprehension's target gives to a value."""
    if isinstance(target, ast.Name):
        return {target.id: value}
    if isinstance(target, ast.Tuple):
        pairs = zip(target.elts, value, strict=True)
        return {name: entry for part, one in pairs for name, entry in _bind(part, one).items()}
    raise ExpressionError(f"{type(target).__name__} is not allowed as a name")


def _bounded(holder: Any, name: str) -> Callable[..., Any]:
    """A method whose result cannot be too large."""
    method = getattr(holder, name)

    def call(*arguments: Any) -> Any:
        if name == "replace" and isinstance(holder, str):
            old, new = arguments[:2]
            if len(holder) + holder.count(old) * len(new) > LARGEST:
                raise ExpressionError(f"a value of over {LARGEST} characters")
        if name == "join":
            parts = list(arguments[0])
            if sum(map(len, parts)) + len(holder) * len(parts) > LARGEST:
                raise ExpressionError(f"a value of over {LARGEST} characters")
            return method(parts)
        result = method(*arguments)
        return list(result) if name in ("items", "keys", "values") else result

    return call
