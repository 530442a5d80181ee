"""Expression: an interpreter for xacro's `${...}`, so that a description never runs Python code.

The language is a subset of Python: numbers, strings, lists, tuples, dictionaries and sets; property names;
`+ - * / // % **`, comparisons, `and or not in`, `x if c else y`, indices and slices; comprehensions and
`lambda`; the functions in `GLOBALS` and the methods in `METHODS`. A dot reads a key of a dictionary. There
are no other attributes or names, no files and no imports. A `Budget` limits time and memory.
"""

import ast
import math
import operator
import re
from collections.abc import Callable, Iterator, Mapping
from types import MappingProxyType
from typing import Any

from magtwin.errors import hint

LONGEST = 2_000
"""Most characters of an expression."""

LARGEST = 65_536
"""Most characters of a string, or entries of a list including all that it contains."""

BITS = 4_096
"""Most bits of an integer."""

FACTORS = 500
"""Most factors of a product, so that it has no more bits."""


NODE, SCOPE = 2, 4
"""Cost of each step, and of each turn of a comprehension or call of a lambda."""


class ExpressionError(ValueError):
    """An expression without a value; the message gives the reason, without file and line."""


class Budget:
    """Limit on the total cost of an expansion: steps, copied elements and written characters."""

    def __init__(self, units: int) -> None:
        self._units = self._left = units

    def spend(self, units: int = 1) -> None:
        """Pay for work.

        Raises:
            ExpressionError: The budget is used up.
        """
        self._left -= units
        if self._left < 0:
            raise ExpressionError(f"expands without end (over {self._units} steps); look for a repetition")


def _range(*arguments: int) -> list[int]:
    steps = range(*arguments)
    if len(steps) > LARGEST:
        raise ExpressionError(f"range{arguments} has over {LARGEST} steps")
    return list(steps)


def _round(number: float, digits: int = 0) -> float:
    if not -300 <= digits <= 300:
        raise ExpressionError(f"round to {digits} digits is not allowed")
    return round(number, digits) if digits else round(number)


def _sum(values: Any, start: float = 0) -> float:
    values = [start, *values]
    if not all(isinstance(value, int | float) for value in values):
        raise ExpressionError("sum takes numbers only")
    return sum(values)


class _Set(list[Any]):
    """A set in the order of its entries' first mention, so that output is reproducible."""

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        return f"{{{', '.join(map(repr, self))}}}" if self else "set()"


def _operation(name: str) -> Callable[[_Set, Any], Any]:
    """An operator of sets for `_Set`: a set in order, or whether it compares so."""

    def apply(left: _Set, right: Any) -> Any:
        both = dict.fromkeys([*left, *right]) if isinstance(right, list) else {}
        made = getattr(set(left), name)(set(right) if isinstance(right, list) else right)
        return _Set(entry for entry in both if entry in made) if isinstance(made, set) else made

    return apply


for _name in ("and", "or", "sub", "xor", "eq", "ne", "le", "lt", "ge", "gt"):
    setattr(_Set, f"__{_name}__", _operation(f"__{_name}__"))


def _bounded(count: int) -> int:
    """A count of factors whose product is not too long."""
    if not 0 <= count <= FACTORS:
        raise ExpressionError(f"a product of over {FACTORS} factors")
    return count


def _prod(values: Any, start: float = 1) -> float:
    values = [start, *values]
    if not all(isinstance(value, int | float) for value in values):
        raise ExpressionError("prod takes numbers only")
    if sum(value.bit_length() for value in values if isinstance(value, int)) > BITS:
        raise ExpressionError(f"an integer of over {BITS} bits")
    return math.prod(values)


_UNBOUNDED = ("factorial", "comb", "perm", "prod", "lcm")

MATH = {name: f for name, f in vars(math).items() if not name.startswith("_") and name not in _UNBOUNDED}
MATH |= {"factorial": lambda n: math.factorial(_bounded(n)), "prod": _prod}
MATH |= {"comb": lambda n, k: math.comb(_bounded(n), k), "perm": lambda n, *k: math.perm(_bounded(n), *k)}

_PLAIN = (
    *(abs, all, any, bool, dict, divmod, float, int, len, list, max, min, ord, repr, sorted, str, tuple),
)

PYTHON: Mapping[str, Any] = {
    **{f.__name__: f for f in _PLAIN},
    **{f.__name__: lambda *a, f=f, **b: list(f(*a, **b)) for f in (enumerate, filter, map, reversed, zip)},
    "range": _range,
    "round": _round,
    "set": lambda values=(): _Set(dict.fromkeys(values)),
    "sum": _sum,
    "isinstance": isinstance,
}

SET_METHODS: Mapping[str, Callable[..., Any]] = {
    "difference": operator.sub,
    "intersection": operator.and_,
    "issubset": operator.le,
    "issuperset": operator.ge,
    "symmetric_difference": operator.xor,
    "union": operator.or_,
}

_BARE = (bool, dict, float, int, len, list, map, max, min, range, round, set, sorted, str)

GLOBALS: Mapping[str, Any] = {
    **MATH,
    **{f.__name__: PYTHON[f.__name__] for f in _BARE},
    "math": dict(MATH),
    "python": dict(PYTHON),
}
"""Names that are available in every expression."""

_SIZED = (str, list, tuple, dict)

METHODS: Mapping[type, frozenset[str]] = {
    str: frozenset(
        (
            *("capitalize", "casefold", "count", "endswith", "find", "index", "isalnum", "isalpha"),
            *("isascii", "isdecimal", "isdigit", "isidentifier", "islower", "isnumeric", "isspace"),
            *("istitle", "isupper", "join", "lower", "lstrip", "partition", "removeprefix"),
            *("removesuffix", "replace", "rfind", "rindex", "rpartition", "rsplit", "rstrip", "split"),
            *("splitlines", "startswith", "strip", "swapcase", "title", "upper"),
        )
    ),
    list: frozenset({"count", "index"}),
    tuple: frozenset({"count", "index"}),
    _Set: frozenset(SET_METHODS),
    dict: frozenset({"get", "items", "keys", "values"}),
}
"""Allowed methods by type."""

OPERATORS: Mapping[type[ast.AST], Callable[..., Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.FloorDiv: operator.floordiv,
    ast.Mod: operator.mod,
    ast.Pow: operator.pow,
    ast.BitAnd: operator.and_,
    ast.BitOr: operator.or_,
    ast.BitXor: operator.xor,
    ast.LShift: operator.lshift,
    ast.RShift: operator.rshift,
    ast.Invert: operator.invert,
    ast.UAdd: operator.pos,
    ast.USub: operator.neg,
    ast.Not: operator.not_,
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

_WIDE = re.compile(r"%[^%a-zA-Z)]*(\*|\d{3})")
"""A `%` format with a width or precision of three digits, or with a variable one."""

_WIDE_KEYED = re.compile(_WIDE.pattern.replace("%", "[%)]", 1))
"""The same in a text with keys, `%(key)`, which end with a parenthesis."""

_SURROGATE = re.compile("[\ud800-\udfff]")
"""Halves of characters in UTF-16, which no file can hold."""

NARROW = 420
"""Most characters of a number of type float in a format of two digits, 1e308 as "%.99f"."""


def evaluate(text: str, names: Mapping[str, Any], budget: Budget) -> Any:
    """The value of an expression.

    Args:
        text: The expression, without its `${` and `}`.
        names: Values by name; may include functions.
        budget: Limit on the cost.

    Raises:
        ExpressionError: The text is not an expression, uses something outside the language, or fails.
    """
    text = text.strip()
    if len(text) > LONGEST:
        raise ExpressionError(f"an expression of {len(text)} characters is too long (over {LONGEST})")
    budget.spend(len(text))  # to parse it
    try:
        return _Interpreter(names, budget).value(ast.parse(text, mode="eval").body)
    except ExpressionError as error:
        if "(in expression" in str(error):  # from the expression of a property that this one reads
            raise
        raise ExpressionError(f"{error} (in expression {text!r})") from error
    except SyntaxError as error:
        raise ExpressionError(f"not an expression: {text!r}") from error
    except RecursionError:
        raise
    except (ArithmeticError, AttributeError, LookupError, MemoryError, TypeError, ValueError) as error:
        raise ExpressionError(f"{type(error).__name__}: {error} (in expression {text!r})") from error


def check_size(value: Any, budget: Budget, *, plain: bool = False) -> Any:
    """Return `value` if it is not too large.

    Args:
        value: A value of any type.
        budget: Pays for the size.
        plain: Whether to refuse functions and other objects that have no text form.

    Raises:
        ExpressionError: The value is too large, not plain, or has half of a character.
    """
    pending, size = [value], 0
    while pending:
        entry = pending.pop()
        if isinstance(entry, str | bytes):
            size += len(entry)
            if isinstance(entry, str) and not entry.isascii() and _SURROGATE.search(entry):
                raise ExpressionError("half of a character (U+D800 to U+DFFF)")
        elif isinstance(entry, int):
            size += entry.bit_length() // 64  # a number of the usual size costs nothing
            if entry.bit_length() > BITS:
                raise ExpressionError(f"an integer of over {BITS} bits")
        elif isinstance(entry, dict | list | tuple):
            size += len(entry)
            if size <= LARGEST:
                pending += [*entry.keys(), *entry.values()] if isinstance(entry, dict) else entry
        elif plain and not isinstance(entry, int | float | None):
            raise ExpressionError(f"a {type(entry).__name__} is not a value")
        _check_length(size)
    budget.spend(1 + size)
    return value


class _Interpreter:
    """Evaluates the tree of an expression; refuses every node that it does not list."""

    def __init__(
        self, names: Mapping[str, Any], budget: Budget, inner: Mapping[str, Any] = MappingProxyType({})
    ) -> None:
        self._names, self._budget = names, budget
        self._inner = inner  # names of lambdas and comprehensions, which hide the others
        self._depth: int = getattr(names, "depth", 0)  # of the macros whose properties are looked through

    def value(self, node: ast.expr) -> Any:
        self._budget.spend(NODE)
        match node:
            case ast.Constant() if isinstance(node.value, str | int | float | None):
                return check_size(node.value, self._budget)
            case ast.Name():
                return self._name(node.id)
            case ast.Attribute():
                return self._attribute(self.value(node.value), node.attr)
            case ast.Call():
                return self._call(node)
            case ast.BinOp() if type(node.op) in OPERATORS:
                return self._binary(node.op, self.value(node.left), self.value(node.right))
            case ast.UnaryOp():
                return OPERATORS[type(node.op)](self.value(node.operand))
            case ast.BoolOp():
                for operand in node.values[:-1]:
                    result = self.value(operand)
                    if bool(result) is isinstance(node.op, ast.Or):
                        return result
                return self.value(node.values[-1])
            case ast.Compare():
                return self._compared(node)
            case ast.IfExp():
                return self.value(node.body if self.value(node.test) else node.orelse)
            case ast.Subscript():
                values = _entries(self.value(node.value))
                if not isinstance(node.slice, ast.Slice):
                    return values[self.value(node.slice)]
                ends = (node.slice.lower, node.slice.upper, node.slice.step)
                part = values[slice(*(None if end is None else self.value(end) for end in ends))]
                return check_size(part, self._budget)
            case ast.List() | ast.Tuple() | ast.Set():
                return check_size(KINDS.get(type(node), list)(self._all(node.elts)), self._budget)
            case ast.Dict():
                made: dict[Any, Any] = {}
                for key, entry in zip(node.keys, node.values, strict=True):
                    made |= self.value(entry) if key is None else {self.value(key): self.value(entry)}
                return check_size(made, self._budget)
            case ast.ListComp() | ast.GeneratorExp() | ast.SetComp():
                values = []
                for scope in self._scopes(node.generators):
                    values.append(scope.value(node.elt))
                    _check_length(len(values))
                return check_size(KINDS.get(type(node), list)(values), self._budget)
            case ast.DictComp():
                scopes = self._scopes(node.generators)
                return check_size({s.value(node.key): s.value(node.value) for s in scopes}, self._budget)
            case ast.Lambda():
                return self._lambda(node)
            case ast.JoinedStr():
                texts = [self.value(part) for part in node.values]
                return check_size("".join(texts), self._budget)
            case ast.FormattedValue():
                return self._formatted(node)
        raise ExpressionError(f"{type(getattr(node, 'op', node)).__name__} is not allowed")

    def _compared(self, node: ast.Compare) -> bool:
        left = self.value(node.left)
        for comparison, operand in zip(node.ops, node.comparators, strict=True):
            right = self.value(operand)
            self._pay(comparison, left, right)
            if not OPERATORS[type(comparison)](left, right):
                return False
            left = right
        return True

    def _name(self, name: str) -> Any:
        if name in self._inner:
            return self._inner[name]
        self._budget.spend(self._depth)
        try:
            return self._names[name]
        except KeyError:
            keys = (*self._inner, *self._names)
            known = [key for key in keys if isinstance(key, str) and not key.startswith("*")]
            near = hint(name, known) if known else ""
            advice = f"; {near}" if near.startswith("did") else ""
            raise ExpressionError(f"no property {name!r}{advice}") from None

    def _attribute(self, holder: Any, name: str) -> Any:
        if not isinstance(holder, dict):
            raise ExpressionError(f"attribute {name!r} of type {type(holder).__name__} is not allowed")
        if name not in holder:
            raise ExpressionError(f"no {name!r} in it; {hint(name, map(str, holder))}")
        return holder[name]

    def _call(self, node: ast.Call) -> Any:
        function = self._function(node.func)
        if not callable(function):
            raise ExpressionError(f"a {type(function).__name__} cannot be called")
        arguments, options = self._all(node.args), dict[str, Any]()
        for keyword in node.keywords:
            given = self.value(keyword.value)
            options |= given if keyword.arg is None else {keyword.arg: given}
        for value in (*arguments, *options.values()):  # paid for before the function works on it
            check_size(value, self._budget)
        return check_size(function(*arguments, **options), self._budget)

    def _all(self, nodes: list[ast.expr]) -> list[Any]:
        """Values of the entries of a list or call; those with a star are unpacked."""
        values: list[Any] = []
        for node in nodes:
            if isinstance(node, ast.Starred):
                values += _entries(self.value(node.value))
            else:
                values.append(self.value(node))
            _check_length(len(values))
        return values

    def _lambda(self, node: ast.Lambda) -> Callable[..., Any]:
        """A function of plain arguments, the last of which may have defaults."""
        names = [argument.arg for argument in node.args.args]
        if node.args.vararg or node.args.kwarg or node.args.kwonlyargs or node.args.posonlyargs:
            raise ExpressionError("a lambda takes plain arguments only")
        first = len(names) - len(node.args.defaults)
        usual = dict(zip(names[first:], map(self.value, node.args.defaults), strict=True))

        def function(*values: Any, **options: Any) -> Any:
            given = usual | dict(zip(names, values, strict=False)) | options
            if len(values) > len(names) or given.keys() != set(names):
                raise TypeError(f"a lambda takes {', '.join(names) or 'no arguments'}")
            return self._inside(given).value(node.body)

        return function

    def _formatted(self, node: ast.FormattedValue) -> str:
        """A value in an f-string; its format has at most two digits in a row."""
        value = self.value(node.value)
        form = "" if node.format_spec is None else str(self.value(node.format_spec))
        if re.search(r"\d{3}", form):
            raise ExpressionError("a format of over two digits is not allowed")
        check_size(value, self._budget, plain=True)
        if node.conversion in (ord("r"), ord("a")):
            value = repr(value)
        return format(value, form)

    def _function(self, node: ast.expr) -> Any:
        """The function or bound method that a call names."""
        if not isinstance(node, ast.Attribute):
            return self.value(node)
        holder, name = self.value(node.value), node.attr
        allowed = METHODS.get(type(holder), frozenset())
        if name in allowed:
            if not isinstance(holder, dict):  # whose methods do not look at its entries
                check_size(holder, self._budget)
            return lambda *arguments: _call_method(holder, name, *arguments)
        if isinstance(holder, dict):
            return self._attribute(holder, name)
        known = f"; allowed: {', '.join(sorted(allowed))}" if allowed else ""
        raise ExpressionError(f"method {name!r} of type {type(holder).__name__} is not allowed{known}")

    def _binary(self, kind: ast.operator, left: Any, right: Any) -> Any:
        if isinstance(kind, ast.Mult):
            for values, times in ((left, right), (right, left)):
                if isinstance(values, str | list | tuple) and isinstance(times, int):
                    _check_length(len(values) * times)
        shifts = isinstance(kind, ast.LShift) and isinstance(left, int) and isinstance(right, int)
        if shifts and left.bit_length() + right > BITS:
            raise ExpressionError(f"an integer of over {BITS} bits")
        if isinstance(left, _Set | dict):  # paid for before they are compared
            check_size([left, right], self._budget)
        integers = isinstance(left, int) and isinstance(right, int)
        if isinstance(kind, ast.Pow) and integers and left.bit_length() * abs(right) > BITS:
            raise ExpressionError(f"an integer of over {BITS} bits")
        if isinstance(kind, ast.Mod) and isinstance(left, str):
            self._check_format(left, right)
        return check_size(OPERATORS[type(kind)](left, right), self._budget)

    def _pay(self, comparison: ast.cmpop, left: Any, right: Any) -> None:
        """Pay for the entries and characters that a comparison looks at."""
        is_within = isinstance(comparison, ast.In | ast.NotIn)
        if is_within and isinstance(right, dict):
            check_size(left, self._budget)  # its hash
        elif is_within or (isinstance(left, _SIZED) and isinstance(right, _SIZED)):
            check_size(left, self._budget)
            check_size(right, self._budget)

    def _check_format(self, text: str, operand: Any) -> None:
        """Refuse a `%` format whose result could be too large."""
        keyed = "%(" in text
        if (_WIDE_KEYED if keyed else _WIDE).search(text):
            raise ExpressionError("a format of over two digits is not allowed")
        by_key = isinstance(operand, dict) and not re.search(r"%(?!\()", text)  # else it is shown as a whole
        parts = operand.values() if by_key else operand if isinstance(operand, tuple) else (operand,)
        largest = max((len(ascii(part)) for part in parts), default=0)  # no format of a text is longer
        self._budget.spend(largest)
        _check_length(len(text) + text.count("%") * (largest + NARROW))

    def _inside(self, names: dict[str, Any]) -> "_Interpreter":
        self._budget.spend(SCOPE + len(self._inner) // SCOPE)
        return _Interpreter(self._names, self._budget, {**self._inner, **names})

    def _scopes(self, generators: list[ast.comprehension]) -> "Iterator[_Interpreter]":
        """An interpreter for each iteration of a comprehension."""
        if not generators:
            yield self
            return
        first, *others = generators
        for value in _entries(self.value(first.iter)):
            scope = self._inside(_bind(first.target, value))
            if all(scope.value(condition) for condition in first.ifs):
                yield from scope._scopes(others)


def _entries(values: Any) -> Any:
    if not isinstance(values, str | list | tuple | dict):
        raise ExpressionError(f"a {type(values).__name__} has no entries")
    return values


KINDS: Mapping[type[ast.AST], Callable[..., Any]] = {
    ast.Tuple: tuple,
    ast.Set: lambda values: _Set(dict.fromkeys(values)),
    ast.SetComp: lambda values: _Set(dict.fromkeys(values)),
}
"""What a display makes of its entries; the others make lists."""


def _check_length(length: int) -> None:
    if length > LARGEST:
        raise ExpressionError(f"a value of over {LARGEST} characters or entries")


def _bind(target: ast.expr, value: Any) -> dict[str, Any]:
    """Names that the target of a comprehension gives to a value."""
    if isinstance(target, ast.Name):
        return {target.id: value}
    if isinstance(target, ast.Tuple):
        parts = [_bind(part, entry) for part, entry in zip(target.elts, value, strict=True)]
        return {name: entry for part in parts for name, entry in part.items()}
    raise ExpressionError(f"{type(target).__name__} is not allowed as a name")


def _call_method(holder: Any, name: str, *arguments: Any) -> Any:
    """Call an allowed method; check the size of the result first where it can be large."""
    if name == "replace":
        old, new = arguments[:2]
        _check_length(len(holder) + holder.count(old) * len(new))
    if name == "join":
        arguments = (list(arguments[0]),)
        _check_length(sum(map(len, arguments[0])) + len(holder) * len(arguments[0]))
    if isinstance(holder, _Set):
        return SET_METHODS[name](holder, _Set(dict.fromkeys(arguments[0])))
    result = getattr(holder, name)(*arguments)
    return list(result) if name in ("items", "keys", "values") else result
