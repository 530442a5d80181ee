"""Compiled loops: opened when they pay, the same without a cache folder, shared between threads."""

import os
import subprocess
import sys
import threading

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from magtwin.compiled import Loops, in_threads


def test_loops_open_after_as_much_work_as_opening_costs(monkeypatch):
    monkeypatch.delitem(sys.modules, "numba", raising=False)
    loops = Loops("json", pays=1_000)
    assert loops.after(400) is None
    assert loops.after(500) is None
    assert loops.after(100) is sys.modules["json"]
    assert loops.after(0) is loops.open() is loops.code


def test_without_numba_the_plain_code_goes_on_and_opening_raises_import_error(monkeypatch):
    monkeypatch.setitem(sys.modules, "magtwin.field.maps.loops", None)  # importing it raises ImportError
    loops = Loops("magtwin.field.maps.loops", pays=100)
    for _ in range(3):
        assert loops.after(1e9) is None
    with pytest.raises(ImportError):
        loops.open()


def test_compiling_works_without_a_cache_folder(tmp_path):
    (tmp_path / "__pycache__").write_text("a file in the place of the folder")
    (tmp_path / "probe.py").write_text(
        "from numba import types\n"
        "from magtwin.compiled import compiled, inlined\n"
        "@inlined\n"
        "def added(x, y):\n"
        "    return x + y\n"
        "@compiled(types.float64)\n"
        "def twice(x):\n"
        "    return added(x, x)\n"
        "assert twice(2.5) == added(2.5, 2.5) == 5.0\n"
    )
    home = {"HOME": str(tmp_path / "probe.py"), "XDG_CACHE_HOME": str(tmp_path / "probe.py" / "cache")}
    subprocess.run([sys.executable, tmp_path / "probe.py"], check=True, env={**os.environ, **home})
    assert {file.name for file in tmp_path.iterdir()} == {"__pycache__", "probe.py"}


@pytest.mark.parametrize("processors", [1, 2, 3, None])
@pytest.mark.parametrize("rows", [0, 99, 1_000, 1_001])
def test_threads_work_on_every_row_once(monkeypatch, processors, rows):
    monkeypatch.setattr(os, "cpu_count", lambda: processors)
    done, workers = np.zeros(rows, int), set()

    def work(part):
        workers.add(threading.get_ident())
        done[part] += 1

    in_threads(work, rows, 100)
    assert_array_equal(done, 1)
    assert len(workers) <= (processors or 1)


def test_an_error_in_a_thread_is_raised(monkeypatch):
    monkeypatch.setattr(os, "cpu_count", lambda: 3)
    with pytest.raises(ZeroDivisionError):
        in_threads(lambda part: 1 // (part.start - 900), 1_000, 100)
