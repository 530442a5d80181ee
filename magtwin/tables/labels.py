"""Labels: the words and the unit in the header of a column."""

import re

_SIGNS = str.maketrans(
    {
        "\N{DEGREE SIGN}": "deg",
        "\N{MASCULINE ORDINAL INDICATOR}": "deg",
        "\N{MICRO SIGN}": "u",
        "\N{GREEK SMALL LETTER MU}": "u",
    }
)


def split_label(text: str) -> tuple[tuple[str, ...], str]:
    """Words of a label and the unit in brackets at its end, in lower case.

    `pose.position.x [cm]` has the words pose, position, x and the unit cm; `posX` has the words pos and x.
    """
    text, unit = text.strip().translate(_SIGNS), ""
    if text.endswith(("]", ")")) and (begin := max(text.rfind("["), text.rfind("("))) > 0:
        text, unit = text[:begin], text[begin + 1 : -1].strip().lower()
    return words_of(re.sub(r"(?<=[a-z])(?=[A-Z])", "_", text)), unit


def words_of(text: str) -> tuple[str, ...]:
    """Words of a text in lower case, without the marks between them: `m/s` has the words m and s."""
    return tuple(word for word in re.split(r"[\W_]+", text.lower()) if word)
