"""Words: groups of commands, names of earlier releases, and which command is meant by another word."""

import difflib
import re
from functools import cache
from pathlib import Path

GROUPS = {
    "Start": ("see it work; begin your own", "demo new doctor"),
    "Build": ("robots, rooms, magnetic maps", "scene robot map fetch"),
    "Run": ("drive; record the sensors", "run sweep drive ros"),
    "Look": ("at runs, stages and maps", "view plot report compare info"),
    "Learn": ("models of the robot's own field", "dataset train evaluate model"),
    "Localize": ("by the magnetic field", "localize bench"),
    "Share": ("with programs and people", "export convert validate reproduce"),
    "More": ("USD schemas, TAB in your shell", "schema completion"),
}
"""Groups of commands: what each is for, and its commands."""

OLD = {
    "calibrate": "model calibrate",
    "compensate": "model compensate",
    "film": "plot",
    "map plot": "plot --show field",
    "network": "model",
    "picture": "plot --show picture",
    "version": "--version",
}
"""Commands of earlier releases, and what to type now. They still run."""

OLD_OPTIONS = {"--time-s": "--at", "--quantity": "--show"}
"""Options of commands that became `plot`."""

_words = re.compile("[a-z]+").findall

_NOUNS = _words(
    "scene robot map run model dataset data ros room lab world network file field stage report path mapping "
    "usd weights sensor magnetic grid collect magnetometer"
)
_ACTIONS = _words("build make create generate gen mk write add start use")
_FILLERS = frozenset(_words("to the a an my of from for with and in into by as on it magtwin me this please"))

_ENDINGS = _words("ations ation ating ators ator ated ates ate ings ing ions ion ers er ors or es ed s e")


def stem(word: str) -> str:
    """A word without its ending: plots, plotted, plotting and plotter are plot."""
    for ending in _ENDINGS:
        if word.endswith(ending) and len(word) - len(ending) >= 3:
            word = word.removesuffix(ending)
            break
    return word[:-1] if len(word) > 3 and word[-1] == word[-2] else word


LESS = dict.fromkeys(map(stem, _NOUNS), 0.5) | dict.fromkeys(map(stem, _ACTIONS), 0.4)
"""Words that decide less than others: what is acted on, and any action; and how much less."""


@cache
def _table() -> dict[str, str]:
    """Everyday words for each command, and names for each option; words with hyphens mean it together."""
    lines = Path(__file__).with_name("words.txt").read_text(encoding="utf-8").splitlines()
    return {name: words for name, _, words in (line.partition(": ") for line in lines)}


def option_meant(word: str) -> list[str]:
    """Options that somebody means by another name, without the leading hyphens."""
    return [name[2:] for name, words in _table().items() if name[:2] == "--" and word in words.split()]


@cache
def _commands() -> dict[str, str]:
    return {name: words for name, words in _table().items() if name[:2] != "--"}


@cache
def _vocabulary() -> tuple[dict[str, dict[str, float]], dict[str, list[frozenset[str]]]]:
    """By stem: the commands that a word names, and how much; and by command: words that mean it together."""
    single: dict[str, dict[str, float]] = {}
    together: dict[str, list[frozenset[str]]] = {}
    for command, text in _commands().items():
        *groups, own = command.split()
        sub = 0.2 * len(groups)  # of two that fit, the shorter command
        weighed = [(own, 2.1 - sub), *((group, 1.0) for group in groups)]
        for word, weight in (*weighed, *((word, 2.0 - sub) for word in text.split())):
            for part in word.split("-"):
                known = single.setdefault(stem(part), {})
                if part == word:
                    weight *= 1.0 if word in groups else LESS.get(stem(word), 1.0)
                    known[command] = max(known.get(command, 0.0), weight)
        pairs = [word.split("-") for word in text.split() if "-" in word]
        pairs += [command.split()] if groups else []
        together[command] = [frozenset(map(stem, pair)) for pair in pairs]
    return single, together


def guess(text: str, within: str = "") -> tuple[str, ...]:
    """The command, or the two, that somebody means by other words; none if that cannot be told.

    Args:
        text: What was typed, such as plot-map, plotMap, plotmap, urdf2usd, simulations or bechmark.
        within: Group whose commands are meant, such as map.
    """
    single, together = _vocabulary()
    parted = re.sub(r"(?<=[a-z])(?=[A-Z])", "-", text)
    parted = re.sub(r"(?<=[a-z]{3})2(?=[a-z]{3})", "-to-", parted.lower())
    typed = [word for word in re.split(r"[^a-z0-9]+", parted) if word and word not in _FILLERS]
    words = [part for word in typed for part in _known(word, single)]
    scores = {}
    for command in _commands():
        weights = [single[word].get(command, 0.0) * (1.0 if k else 1.15) for k, word in enumerate(words)]
        whole = [2.0 * len(pair) for pair in together[command] if pair <= {*words, stem(within)}]
        inside = 1.5 if within and any(weights) and command.startswith(f"{within} ") else 0.0
        scores[command] = sum(weights) + max(whole, default=0.0) + inside
    best = max(scores.values())
    ranked = sorted(scores, key=lambda command: (-scores[command], command.count(" ")))
    return tuple(command for command in ranked[:2] if scores[command] == best > 0.5)


def _known(word: str, single: dict[str, dict[str, float]]) -> list[str]:
    """The stems of a word, of a compound's parts, or of the nearest word that is spelled otherwise."""
    if stem(word) in single:
        return [stem(word)]
    for k in range(2, len(word) - 2):
        for second in (word[k:], word[k:].removeprefix("to"), word[k:].removeprefix("2")):
            if stem(word[:k]) in single and stem(second) in single:
                return [stem(word[:k]), stem(second)]
    words = [each for item in _commands().items() for each in re.split("[ -]", " ".join(item))]
    words = [each for each in words if each[:1] == word[:1]]
    swapped = [each for each in words if sorted(each) == sorted(word)]
    near = swapped or difflib.get_close_matches(word, words, n=1, cutoff=0.8)
    return [stem(near[0])] if near else []


def as_of_today(arguments: list[str]) -> list[str]:
    """Arguments with the name of an earlier release as they are typed now; `help X` is `X --help`."""
    if arguments[:1] == ["help"] and len(arguments) > 1:
        arguments = [*arguments[1:], "--help"]
    for count in (2, 1):
        if new := OLD.get(" ".join(arguments[:count])):
            command, _, show = new.partition(" --show")
            rest = arguments[count:]
            if command == "plot":
                parts = [word.partition("=") for word in rest]
                rest = [OLD_OPTIONS.get(name, name) + equals + value for name, equals, value in parts]
            told = any(word.partition("=")[0] == "--show" for word in rest)
            return [*command.split(), *(["--show", *show.split()] if show and not told else ()), *rest]
    return arguments
