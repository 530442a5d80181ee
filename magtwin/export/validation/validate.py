"""Validate: a file held to every validator there is, in one answer.

`core` is OpenUSD's own validators, `nvidia` usd-validation-nvidia, `simready` SimReady's profiles, `isaac`
and `magtwin` the rules of `isaac_rules` and `rules`, `newton` a load in Newton.
"""

import os
import tempfile
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

from magtwin.errors import InputError, find, hint
from magtwin.export.usdz import unpack
from magtwin.export.validation.findings import Findings
from magtwin.export.validation.inspection import Inspection, inspect
from magtwin.export.validation.validators import newton, nvidia, simready
from magtwin.files import existing

AGAINST = ("core", "nvidia", "simready", "isaac", "newton", "magtwin")
"""What a file can be held to, in the order of the answer."""

SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")

SAFE = ("default-prim", "units", "relative-paths", "extents", "material-bindings")
"""What can be mended without a guess, of `magtwin.export.validation.fix`."""


def validate(
    file: str | os.PathLike[str],
    against: Collection[str] = AGAINST,
    *,
    inputs: Collection[str] | None = None,
    fix: Collection[str] = (),
    progress: Callable[[str], Any] | None = None,
) -> Findings:
    """Hold a stage to validators.

    The file is read in processes of their own: what is damaged ends them, not the caller.

    Args:
        file: A .usd, .usda, .usdc or .usdz.
        against: Of `AGAINST`.
        inputs: Names of the inputs that a network may have; any unless given.
        fix: What to mend first, of `magtwin.export.validation.fix.FIXES`.
        progress: Told the name of each validator before it looks.

    Raises:
        InputError: No such file, it is not USD or is damaged, an entry of a package would lie outside of
            it, or a name is none of `AGAINST`, or of what can be mended.
    """
    file = existing(file, "USD file")
    if file.is_dir():
        raise InputError(f"{file}: a folder; give the root layer in it")
    if file.suffix not in SUFFIXES:
        raise InputError(f"{file}: no USD file; {hint(file.suffix, SUFFIXES)}")
    names = {name: name for name in AGAINST}
    wanted = [name for name in AGAINST if name in {find("validator", given, names) for given in against}]
    if fix and file.suffix == ".usdz":
        raise InputError(
            f"{file}: a package is not mended; `magtwin export` it to a folder, mend that, and pack it again"
        )
    say = progress or (lambda name: None)
    with tempfile.TemporaryDirectory() as folder:
        home = Path(folder) if file.suffix == ".usdz" else None
        root = None if home is None else unpack(file, home)
        seen = Inspection(())
        if fix or set(wanted) - {"nvidia"}:
            say("core, isaac and magtwin")
            seen = inspect(file, wanted, root=root, home=home, inputs=inputs, fix=fix)
        checks = {check.validator: [check] for check in seen.checks}
        for name, look in (
            ("nvidia", lambda: [nvidia(file)]),
            ("simready", lambda: simready(seen.robots, packed=root is not None)),
            ("newton", lambda: [newton(root or file, seen.bodies)]),
        ):
            if name in wanted:
                say(name)
                checks[name] = look()
    return Findings(file, tuple(check for name in wanted for check in checks[name]), seen.mended)
