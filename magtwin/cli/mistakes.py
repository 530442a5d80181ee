"""Mistakes: what is said of a command line that was typed wrong, in one line with what to type."""

import difflib
from collections.abc import Sequence
from pathlib import Path

from cyclopts import App, Argument, ArgumentCollection
from cyclopts.exceptions import (
    CycloptsError,
    MissingArgumentError,
    UnknownCommandError,
    UnknownOptionError,
    UnusedCliTokensError,
)

from magtwin.cli.help import examples, first_sentence, summary
from magtwin.cli.settings import is_setting, setting_text
from magtwin.cli.words import guess, option_meant

MOVED = {
    "run": {"commands": "path", "replay": "path"},
    "sweep": {"session": "sessions survey", "session-by": "sessions"},
}
"""Options of earlier releases, by command, and what they are now."""


def explain(error: CycloptsError) -> str:
    """One line about wrong usage."""
    command = " ".join(error.command_chain or ())
    app, arguments = error.app, error.argument
    if isinstance(error, UnknownCommandError) and error.unused_tokens:
        return unknown_command(error.unused_tokens[0], command)
    if isinstance(error, UnknownOptionError) and error.token.source == "cli":
        return _unknown_option(command, error.token.keyword or error.token.value, error.argument_collection)
    if type(error) is MissingArgumentError and arguments is not None:
        return _missing(command, arguments, error.keyword, app)
    if isinstance(error, UnusedCliTokensError) and error.unused_tokens:
        much = f"{error.unused_tokens[0]!r}, which is one too many"
        return f"magtwin {command} cannot use {much}{_example(command)}"
    text, file = str(error), getattr(getattr(error, "token", None), "source", "")
    return f"{file}: {text}" if Path(file).is_absolute() and file not in text else text


def unknown_command(word: str, group: str = "", more: Sequence[str] = ()) -> str:
    """What is said of a command that there is not; `group` is the one before it, `more` the next word."""
    from magtwin.cli import load
    from magtwin.cli.app import app
    from magtwin.files.kinds import kind_of

    kind = None if group else kind_of(Path(word))
    if kind and Path(word).exists():
        return f"no command {word!r}, which is {kind.noun}; {kind.remedy.format(file=word)}"
    if "/" in word or Path(word).suffix:
        return f"no command {word!r}, and no such file; magtwin help lists the commands"
    meant = []
    both = "-".join((word, *(each for each in more if each.isalpha())))
    for command in guess(both, group) or guess(word, group):
        if command != "help":
            load(command.split()[0])
        what = "List every command." if command == "help" else summary(app, command)
        meant.append(f"`magtwin {command}`: {what.rstrip('.')}")
    typed, see = f"{group} {word}".strip(), f"magtwin help {group}".strip()
    said = f"did you mean {', or '.join(meant)}?" if meant else f"{see} lists those that there are"
    return f"no command {typed!r}; {said}"


def _unknown_option(command: str, typed: str, arguments: ArgumentCollection) -> str:
    """What is said of an option that a command has not."""
    key = typed.partition("=")[0].strip("-").lower().replace("_", "-")
    known = {name.strip("-"): each for each in arguments for name in each.names if name.startswith("--")}
    if moved := MOVED.get(command, {}).get(key):
        return f"--{key} is now --{moved}{' FILE' if moved == 'path' else ''}"
    units = [f"{key}-{unit}" for unit in ("s", "m", "hz", "deg", "nt", "sd-m")]
    near = difflib.get_close_matches(key, known, n=1, cutoff=0.6)
    begun = [name for name in known if name.startswith(key)] if len(key) > 2 else []
    found = next((name for name in (*units, *option_meant(key), *near, *begun) if name in known), "")
    head = f"magtwin {command} has no option {typed.partition('=')[0]}"
    if not found:
        return f"{head}; magtwin {command} -h lists those that it has"
    if is_setting(known[found]):
        return f"{head}; {setting_text(known[found].name, tuple(command.split()))}"
    return f"{head}; did you mean {known[found].name}?"


def _missing(command: str, argument: Argument, typed: str | None, app: App | None) -> str:
    """What is said of an argument or a value that is needed."""
    known = app.assemble_argument_collection(parse_docstring=True) if app else ()
    helps = (each.parameter.help for each in known if each.name == argument.name)
    told = next((first_sentence(str(text)).rstrip(".") for text in helps if text), "")
    flag = typed or next((token.keyword for token in argument.tokens if token.keyword), None)
    if flag:
        return f"{flag} wants a value: {told}"
    positional = argument.field_info.is_positional
    name = argument.name.strip("-").upper() if positional else argument.name
    return f"magtwin {command} needs {name}: {told}{_example(command)}"


def _example(command: str) -> str:
    return "; for example: magtwin ".join(("", *examples(command)[:1]))
