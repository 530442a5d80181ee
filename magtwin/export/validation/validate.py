"""Validate a file with every validator.

`core` are OpenUSD's own validators, `nvidia` is usd-validation-nvidia, `simready` are SimReady's profiles,
`isaac` are Isaac Sim's own rules, `magtwin` are the rules of `rules`. `rule` explains how to add a rule.
"""

import os
import tempfile
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

from magtwin.errors import InputError, find, hint
from magtwin.export.usdz import unpack
from magtwin.export.validation.findings import Check, Findings
from magtwin.export.validation.inspection import Inspection, inspect
from magtwin.export.validation.isaac_sim import isaac
from magtwin.export.validation.validators import nvidia, simready
from magtwin.files.file import existing
from magtwin.files.kinds import expected

AGAINST = ("core", "nvidia", "simready", "isaac", "magtwin")
"""Validators, in the order of the results."""

SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")


def validate(
    file: str | os.PathLike[str],
    against: Collection[str] = AGAINST,
    *,
    inputs: Collection[str] | None = None,
    progress: Callable[[str], Any] | None = None,
) -> Findings:
    """Check a stage with validators.

    Other processes read the file, so that a damaged one does not crash the caller.

    Args:
        file: A .usd, .usda, .usdc or .usdz.
        against: Some of `AGAINST`.
        inputs: Names of the inputs that a network may have. None allows any.
        progress: Function that is called with the name of each validator.

    Raises:
        InputError: The file is missing, not USD or damaged; a package has an entry outside its folder; the
            stage names files outside its folder; or a name is not in `AGAINST`.
    """
    from magtwin.usd.layers import check_stage

    file = existing(file, "USD file")
    if file.is_dir():
        raise InputError(f"{file}: a folder; give the root layer in it")
    expected(file, "USD file")
    if file.suffix.lower() not in SUFFIXES:
        raise InputError(f"{file}: no USD file; {hint(file.suffix, SUFFIXES)}")
    names = {name: name for name in AGAINST}
    wanted = [name for name in AGAINST if name in {find("validator", given, names) for given in against}]
    check_stage(file)
    say = progress or (lambda name: None)
    with tempfile.TemporaryDirectory() as folder:
        home = Path(folder) if file.suffix.lower() == ".usdz" else None
        root = None if home is None else unpack(file, home)
        seen = Inspection(())
        if set(wanted) - {"nvidia"}:
            say("core and magtwin")
            seen = inspect(file, wanted, root=root, home=home, inputs=inputs)
        checks: dict[str, list[Check]] = {}
        for check in seen.checks:
            checks.setdefault(check.validator.split()[0], []).append(check)
        for name, look in (
            ("nvidia", lambda: [nvidia(file)]),
            ("simready", lambda: simready(seen.robots, packed=root is not None)),
            ("isaac", lambda: [isaac(root or file, seen.robots, home=home, package=file)]),
        ):
            if name in wanted:
                say(name)
                checks[name] = look()
    return Findings(file, tuple(check for name in wanted for check in checks[name]))
