"""Limits can be raised, and each fault that a fuzzer found stays a refusal."""

import resource
import struct
import subprocess
import sys

import pytest

from magtwin.errors import InputError
from magtwin.files import budget
from magtwin.files.settings import read_toml
from magtwin.usd import trial
from magtwin.usd.layers import open_stage

MOST = 300_000_000
"""Memory that a refusal may take [bytes]."""


def test_a_large_file_is_read_if_the_user_allows_it(tmp_path, monkeypatch):
    (tmp_path / "large.toml").write_text("#" * 3_000_000 + "\na = 1\n")
    monkeypatch.setenv(budget.ALLOW, "0.01")
    assert read_toml(tmp_path / "large.toml") == {"a": 1}
    monkeypatch.setenv(budget.ALLOW, "much")
    with pytest.raises(InputError, match="must be a number of gigabytes"):
        read_toml(tmp_path / "large.toml")


def test_each_format_of_the_table_has_sane_limits():
    for name, limits in budget.BUDGETS.items():
        assert limits.file > 0, name
        assert 0 < limits.depth <= 200, name  # Python's stack holds 1000 frames
    assert budget.decoded_limit(0) == budget.SPARE
    assert budget.decoded_limit(10**9) == 5 * 10**9


def usda(body):
    return f'#usda 1.0\n(defaultPrim = "W")\ndef Xform "W" {{\n{body}\n}}\n'.encode(
        "utf-8", "surrogateescape"
    )


def test_a_crate_whose_counts_lie_is_refused_without_its_memory(tmp_path):
    """Each 8 bytes of a crate's sections in turn become a huge number."""
    from pxr import Sdf

    layer = Sdf.Layer.CreateAnonymous(".usda")
    layer.ImportFromString(usda("double[] x = [1, 2, 3, 4]\nint y = 3").decode())
    layer.Export(str(tmp_path / "whole.usdc"))
    whole, refused = (tmp_path / "whole.usdc").read_bytes(), 0
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    for at in range(88, len(whole) - 8, 23):
        content = bytearray(whole)
        content[at : at + 8] = struct.pack("<Q", 0x7FFFFFFFFFF)
        (tmp_path / f"{at}.usdc").write_bytes(content)
        try:
            open_stage(tmp_path / f"{at}.usdc")
        except InputError:
            refused += 1
    assert refused
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 - before < MOST


def test_a_stage_is_tried_below_a_limit_of_the_users(tmp_path):
    """`ulimit -t` and `ulimit -v` of a shell may be lower than the limits of the trial."""
    (tmp_path / "s.usda").write_bytes(usda('def Xform "x" {}'))
    program = (
        "import resource, sys\n"
        "resource.setrlimit(resource.RLIMIT_CPU, (30, 30))\n"
        "resource.setrlimit(resource.RLIMIT_AS, (2_000_000_000,) * 2)\n"
        "from magtwin.usd.layers import open_stage\n"
        "print(open_stage(sys.argv[1]).GetDefaultPrim().GetPath())\n"
    )
    command = [sys.executable, "-c", program, str(tmp_path / "s.usda")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.stdout == "/W\n", done.stderr


@pytest.mark.skipif(sys.platform != "linux", reason="processor time is limited on Linux")
def test_references_that_multiply_each_other_are_refused_and_the_next_stage_is_read(tmp_path, monkeypatch):
    for level in range(9):
        names = f"@{level + 1}.usda@</a>" if level < 8 else "None"
        inner = "".join(f'def "b{k}" (references = {names}) {{}}\n' for k in range(8))
        (tmp_path / f"{level}.usda").write_text(f'#usda 1.0\ndef "a" {{\n{inner}}}\n')
    monkeypatch.setattr(trial, "PROCESSOR_S", 2.0)
    with pytest.raises(
        InputError, match=r"0\.usda: USD does not open it in 2 s of the processor: .*multiply"
    ):
        open_stage(tmp_path / "0.usda")
    assert len(list(open_stage(tmp_path / "6.usda").Traverse())) == 1 + 8 + 64 + 512
