"""Words: names of earlier releases and what they are now."""

OLD = {
    "calibrate": "model calibrate",
    "compensate": "model compensate",
    "film": "plot",
    "map plot": "plot --show field",
    "network": "model",
    "picture": "plot --show picture",
}
"""Commands of earlier releases, and what to type now. They still run."""

OLD_OPTIONS = {"--time-s": "--at", "--quantity": "--show"}
"""Options of commands that became `plot`."""


def as_of_today(arguments: list[str]) -> list[str]:
    """Arguments with the name of an earlier release as they are typed now."""
    for count in (2, 1):
        if new := OLD.get(" ".join(arguments[:count])):
            command, _, show = new.partition(" --")
            rest = [_renamed(word) if command == "plot" else word for word in arguments[count:]]
            told = any(word.partition("=")[0] == "--show" for word in rest)
            return [*command.split(), *(f"--{show}".split() if show and not told else ()), *rest]
    return arguments


def _renamed(word: str) -> str:
    name, equals, value = word.partition("=")
    return OLD_OPTIONS.get(name, name) + equals + value
