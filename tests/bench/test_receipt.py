"""Receipts, and the check of a sample of runs; journals and parts."""

import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from magtwin.bench.receipt import read_receipt, rows_sha256
from magtwin.bench.results import read_results
from magtwin.bench.runner import Plan, benchmark, verify
from magtwin.bench.store import PART_ROWS, SCHEMAS, Journal, Order, done_runs, merge
from magtwin.bench.suite import load_suite
from magtwin.errors import InputError

SUITE = """
name = "own"
seed = 3
chunk = 2

[[scenario]]
name = "office"
source = "drawn"
places = ["office"]
runs = 4
duration_s = 4.0

[[localizer]]
method = "odometry"

[[localizer]]
method = "bad_localizers:Nan"
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("own")
    (folder / "own.toml").write_text(SUITE)
    benchmark(folder / "own.toml", folder / "results", jobs=1)
    return folder / "results"


def test_a_receipt_names_code_environment_suite_rows_and_who_was_sealed(made):
    told = read_receipt(made)
    rows = read_results(made).rows
    assert told["rows"] == {"count": 8, "sha256": rows_sha256(rows)}
    assert told["suite"]["sha256"] == load_suite(made / "suite.toml").sha256
    assert set(told["localizers"]) == {"odometry", "bad_localizers:Nan"}
    assert told["localizers"]["odometry"] == "of magtwin"
    assert told["localizers"]["bad_localizers:Nan"] in ("sealed", "not sealed")
    assert len(told["code"]["bad_localizers:Nan"]) == len(told["code"]["magtwin"]) == 64


def test_a_sample_is_made_again_and_a_changed_row_is_found(made):
    report = verify(made / "receipt.json", runs=2, jobs=1)
    figures = {figure.name: figure.value for figure in report.figures}
    assert (figures["rows"], figures["made again"], figures["different"]) == (8, 4, 0)
    part = made / "rows/office/part-00000.parquet"
    before, receipt = part.read_bytes(), (made / "receipt.json").read_bytes()
    table = pq.read_table(part)
    values = table["rmse_m"].to_numpy().copy()
    values[0] *= 0.5
    pq.write_table(table.set_column(table.column_names.index("rmse_m"), "rmse_m", pa.array(values)), part)
    try:
        with pytest.raises(InputError, match="the rows are not those of the receipt"):
            verify(made)
        told = json.loads(receipt)
        told["rows"]["sha256"] = rows_sha256(read_results(made).rows)
        (made / "receipt.json").write_text(json.dumps(told))
        report = verify(made, runs=4, jobs=1)
        assert report.title.endswith("NOT the same rows")
        assert "office, odometry, run 0: rmse_m is" in str(report.metadata["differences"])
    finally:
        part.write_bytes(before)
        (made / "receipt.json").write_bytes(receipt)


def test_a_part_of_a_suite_with_a_localizer_that_draws_is_made_again_alike(tmp_path):
    (tmp_path / "own.toml").write_text(SUITE)
    benchmark(tmp_path / "own.toml", tmp_path / "part", runs=2, localizers=["rbpf"], jobs=1)
    report = verify(tmp_path / "part", runs=2, jobs=1)
    figures = {figure.name: figure.value for figure in report.figures}
    assert (figures["made again"], figures["different"]) == (2, 0)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"format": 2}, "a receipt of version 2, and this magtwin reads 1"),
        ({"rows": {}}, "no receipt of magtwin bench"),
        (None, "no receipt of magtwin bench"),
    ],
)
def test_what_is_no_receipt_is_refused(made, tmp_path, change, said):
    told = json.loads((made / "receipt.json").read_text())
    file = tmp_path / "receipt.json"
    file.write_text("[]" if change is None else json.dumps({**told, **change}))
    with pytest.raises(InputError, match=said):
        verify(file)


def rows_in(scenario, localizer, runs):
    text = {"scenario": scenario, "localizer": localizer, "status": "ok", "reason": ""}
    kinds = {"int64": 0, "bool": False, "double": 0.5}
    plain = {each.name: kinds[str(each.type)] for each in SCHEMAS["rows"] if str(each.type) in kinds}
    return {"rows": [{**plain, **text, "run": run, "rmse_m": run / 7} for run in runs]}


def test_journals_in_any_order_of_any_writers_make_the_same_parts(tmp_path):
    file = tmp_path / "own.toml"
    file.write_text(SUITE.replace("runs = 4", "runs = 100_000"))
    order = Order(load_suite(file))
    assert order.runs == PART_ROWS // 2
    found = []
    for turn in (1, -1):
        folder = tmp_path / f"results{turn}"
        folder.mkdir()
        with Journal(folder, order) as one, Journal(folder, order) as other:
            for first in range(0, 60_000, 20_000)[::turn]:
                writer = (one, other)[first // 20_000 % 2]
                writer.add(rows_in("office", "odometry", range(first, first + 20_000, 1000)))
                writer.add(rows_in("office", "z", range(first, first + 20_000, 1000)))
        assert not list(folder.glob("journal-*"))
        found.append({file.name: file.read_bytes() for file in folder.rglob("*.parquet")})
    assert found[0] == found[1]
    assert sorted(found[0]) == ["part-00000.parquet", "part-00001.parquet"]


def test_what_is_done_is_known_while_another_writes_and_left_out_of_the_plan(tmp_path):
    file = tmp_path / "own.toml"
    file.write_text(SUITE)
    suite, order = load_suite(file), Order(load_suite(file))
    with Journal(tmp_path, order) as journal:
        journal.add(rows_in("office", "odometry", (1, 2)))
        merge(tmp_path, order)  # of another program: it leaves the journal that is written
        assert len(list(tmp_path.glob("journal-*"))) == 1
        done = done_runs(tmp_path, suite)
        assert done["office", "odometry"].tolist() == [False, True, True, False]
        plan = Plan(suite, done)
        assert plan.size == 6
        assert [task.done for task in plan] == [{(1, "odometry")}, {(2, "odometry")}]
        assert [len(Plan(suite, done, (k, 2))) for k in range(2)] == [1, 1]
        done = {key: np.ones(4, bool) for key in (("office", "odometry"), ("office", "bad_localizers:Nan"))}
        assert not Plan(suite, done)
