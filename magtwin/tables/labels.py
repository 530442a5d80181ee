"""Labels: the words and the unit in the header of a column, and the quantity that they name."""

import re
import unicodedata
from typing import NamedTuple

from magtwin.tables.quantities import IN_BRACKETS, QUANTITIES, UNITS

_SIGNS = str.maketrans(
    dict.fromkeys("\N{DEGREE SIGN}\N{MASCULINE ORDINAL INDICATOR}", "deg")
    | dict.fromkeys("\N{MICRO SIGN}\N{GREEK SMALL LETTER MU}", "u")
)
_BRACKETS = re.compile(r"[\[\]()]")
_LEFT_OUT = ("in", "per")  # Words between a name and its unit, and in a unit
MOST_WORDS = 12  # Labels of more words name nothing
LONGEST = 500  # Characters of a label that are read


class Label(NamedTuple):
    """A header of a column."""

    words: tuple[str, ...]  # Words in lower case
    unit: str  # Unit in brackets at its end, in lower case; "" if there is none


class Meaning(NamedTuple):
    """How a label names a quantity; the least is the best."""

    name: int  # Index of the name in those of the quantity
    around: int  # Number of words around the name
    unit: str  # Unit of the label, in lower case; "" if there is none


def split_label(text: str) -> Label:
    """Words and unit of a label.

    `pose.position.x [cm]` has the words pose, position, x and the unit cm; `posX` has the words pos and x.
    `field.` at the beginning, as rostopic writes it, is no word, and letters have no accents.
    """
    text = unicodedata.normalize("NFKD", text[:LONGEST].strip().translate(_SIGNS))
    text = "".join(letter for letter in text if not unicodedata.combining(letter))
    name = bare(text)
    unit = "_".join(word for word in words_of(text[len(name) :]) if word not in _LEFT_OUT)
    words: list[str] = []
    for part in re.split(r"[\W_]+", name.removeprefix("field.")):
        both = part if part.lower() in UNITS else re.sub(r"(?<=[a-z])(?=[A-Z])", "_", part)
        words += words_of(both)
    return Label(tuple(words), unit)


def meaning_of(text: str, symbol: str) -> Meaning | None:
    """How a label names a quantity; None if it does not, or in a unit of another one."""
    words, unit = split_label(text)
    quantity = QUANTITIES[symbol]
    if len(words) > MOST_WORDS or (unit in UNITS and unit not in quantity.units):
        return None
    for begin in range(len(words)):
        if not quantity.around.issuperset(words[:begin]):
            return None
        for end in range(len(words), begin, -1):
            name, behind = "_".join(words[begin:end]), words[end:]
            if name not in quantity.places:
                continue
            if quantity.around.issuperset(behind):
                return Meaning(quantity.places[name], begin + len(behind), unit)
            for cut in range(len(behind) if not unit else 0):
                last = "_".join(word for word in behind[cut:] if word not in _LEFT_OUT)
                known = last in quantity.units and last not in IN_BRACKETS
                if known and quantity.around.issuperset(behind[:cut]):
                    return Meaning(quantity.places[name], begin + cut, last)
    return None


def unit_of(text: str, symbol: str) -> str:
    """The unit in a label, for a column that holds a quantity by whatever name; "" if there is none."""
    words, unit = split_label(text)
    for begin in range(1, len(words) if not unit else 0):
        last = "_".join(word for word in words[begin:] if word not in _LEFT_OUT)
        if last in QUANTITIES[symbol].units and last not in IN_BRACKETS:
            return last
    return unit


def is_on_earth(text: str) -> bool:
    """Whether a label is that of a latitude or longitude."""
    if split_label(text).unit.startswith("deg") and any(meaning_of(bare(text), axis) for axis in "xy"):
        return True
    return any(meaning_of(text, angle) for angle in ("lat", "lon"))


def bare(label: str) -> str:
    """The name of a column without its unit in brackets."""
    label = label.strip()
    at = max(label.rfind("["), label.rfind("("))
    has_unit = at >= 0 and label.endswith(("]", ")")) and len(_BRACKETS.findall(label, at)) == 2
    return label[:at].rstrip() if has_unit else label


def words_of(text: str) -> tuple[str, ...]:
    """Words of a text in lower case, without the marks between them: `m/s` has the words m and s."""
    return tuple(word for word in re.split(r"[\W_]+", text.lower()) if word)
