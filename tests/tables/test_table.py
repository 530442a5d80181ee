import time

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from numpy.testing import assert_array_equal

from magtwin.errors import InputError
from magtwin.tables.delimited import LONGEST_LINE
from magtwin.tables.table import read_table


def written(tmp_path, content, name="a.csv"):
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@pytest.mark.parametrize(
    "text",
    [
        "x,y\n1,2\n3,4\n",
        "# x, y\n1,2\n3,4\n",
        "\ufeffx;y\r\n1;2\r\n\r\n3;4\r\n",
        "x\ty\n1\t2\n# a remark\n3\t4",
        "x y\n 1  2 \n3 4\n",
        '"x","y"\n"1","2"\n3,4\n',
    ],
    ids=["commas", "hash", "semicolons", "tabs and a remark", "blanks", "quotes"],
)
def test_a_table_is_the_same_whatever_stands_between_its_values(tmp_path, text):
    table = read_table(written(tmp_path, text))
    assert table.names == ["x", "y"]
    assert_array_equal(table.numbers("x"), [1, 3])
    assert_array_equal(table.numbers("2"), [2, 4])


def test_columns_without_a_header_are_numbered_from_1(tmp_path):
    table = read_table(written(tmp_path, "1,2\n3,nan\n"))
    assert table.names == ["1", "2"]
    assert_array_equal(table.numbers("2"), [2, np.nan])
    with pytest.raises(InputError, match="no header: name columns by number, 1 to 2"):
        table.numbers("x")


def test_a_missing_column_is_refused_by_the_near_name(tmp_path):
    table = read_table(written(tmp_path, "x,y,heading\n1,2,3\n"))
    with pytest.raises(InputError, match=r"a\.csv: no column 'headin'; did you mean 'heading'"):
        table.numbers("headin")


def test_two_columns_of_one_name_are_told_apart_by_number(tmp_path):
    table = read_table(written(tmp_path, "x,x\n1,2\n"))
    with pytest.raises(InputError, match="2 columns are called 'x'; name it by its number"):
        table.numbers("x")
    assert_array_equal(table.numbers("2"), [2])


@pytest.mark.parametrize(
    ("cell", "said"),
    [
        ("east", "'east'"),
        ("inf", "'inf'"),
        ("1e999", "'1e999'"),
        ("1_000", "'1_000'"),
        ("0x10", "'0x10'"),
        ("=cmd|'/C calc'!A0", r"\"=cmd\|'/C calc'!A0\""),
        ("__import__('os').system('touch x')", '"__import__'),
        ("1" * 60_000 + "x", "'1{60}'$"),
    ],
)
def test_a_cell_that_is_no_finite_number_is_refused_with_its_line(tmp_path, cell, said):
    table = read_table(written(tmp_path, f"x,y\n1,2\n\n{cell},3\n"))
    with pytest.raises(InputError, match=rf"a\.csv:4: x must be a finite number, got {said}"):
        table.numbers("x")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.csv"]


@pytest.mark.parametrize(
    ("content", "what"),
    [
        ("", r"a\.csv: empty"),
        ("\n # only a remark\n", r"a\.csv: empty"),
        ("x,y\n", r"a\.csv: no rows below the header"),
        ("x,y\n1,2\n3\n", r"a\.csv:3: 2 values expected, got 1"),
        ("sep=,\nx,y\nm,m,m\n3,4,5\n", r"a\.csv:3: 2 values expected, got 3"),
        ('x,y\n1,"2\n', r"a\.csv:2: not CSV"),
        (b"\x89PNG\r\n\x1a\n\x00\x00", r"a\.csv: not a text file"),
        ("x,y\n1,2\n" + "7" * (LONGEST_LINE + 1), r"a\.csv:3: longer than 65,536 characters"),
    ],
)
def test_a_broken_table_is_refused_with_its_line(tmp_path, content, what):
    with pytest.raises(InputError, match=what) as refusal:
        read_table(written(tmp_path, content))
    assert len(str(refusal.value)) < 500
    assert "\n" not in str(refusal.value)


def test_tables_side_by_side_number_their_columns_on_and_know_their_own_files(tmp_path):
    left = read_table(written(tmp_path, "1\n2\n"))
    right = read_table(written(tmp_path, "a,b\n3,4\nfive,6\n", "b.csv"))
    both = left.beside(right)
    assert_array_equal(both.numbers("b"), [4, 6])
    assert_array_equal(both.numbers("3"), [4, 6])
    with pytest.raises(InputError, match=r"b\.csv:3: a must be a finite number, got 'five'"):
        both.numbers("a")
    with pytest.raises(InputError, match=r"c\.csv: 1 rows, but .*a\.csv has 2"):
        left.beside(read_table(written(tmp_path, "3,4\n", "c.csv")))


def test_a_parquet_table_has_nan_for_nulls_and_keeps_words(tmp_path):
    table = pa.table({"x": pa.array([1, None], pa.int32()), "run": ["a", "b"], "list": [[1], [2]]})
    pq.write_table(table, tmp_path / "a.parquet")
    table = read_table(tmp_path / "a.parquet")
    assert table.names == ["x", "run"]
    assert_array_equal(table.numbers("x"), [1, np.nan])
    assert table.texts("run") == ["a", "b"]
    with pytest.raises(InputError, match="column 'run' must hold numbers, got texts"):
        table.numbers("run")


def test_an_infinite_number_in_parquet_is_refused_with_its_row(tmp_path):
    pq.write_table(pa.table({"x": [1.0, np.inf]}), tmp_path / "a.parquet")
    with pytest.raises(InputError, match=r"a\.parquet, row 1: x must be a finite number, got inf"):
        read_table(tmp_path / "a.parquet").numbers("x")


def test_the_header_may_stand_above_remarks(tmp_path):
    file = tmp_path / "a.csv"
    file.write_text('# x,y,field\n# said "so" by, a friend\n# units: ["m", "m", "nT"]\n1,2,3\n4,5,6\n')
    assert read_table(file).names == ["x", "y", "field"]


@pytest.mark.parametrize(
    "above",
    ["Test started 2019-03-04 12:01:02.5\n", "Magnetometer 7\nby hand, at noon\n\n", "a;b\n" * 20],
    ids=["a line", "more", "most"],
)
@pytest.mark.parametrize("mark", [",", ";", "\t"])
def test_prose_above_the_header_is_left_out_and_noted(tmp_path, above, mark):
    if mark in above:
        pytest.skip("prose with as many marks as the table")
    table = read_table(written(tmp_path, above + "x,y,b\n1,2,3\n4,5,6\n".replace(",", mark)))
    assert table.names == ["x", "y", "b"]
    assert_array_equal(table.numbers("y"), [2, 5])
    line = above.count("\n") + 1
    assert table.notes == (f"line {line} as the header, and the lines above it as prose",)


@pytest.mark.parametrize(
    ("text", "refused"),
    [
        ("7,8\nx,y,b\n1,2,3\n4,5,6\n", "2: 2 values expected, got 3"),
        ("x,y\n1,2,3\n4,5,6\n", "2: 2 values expected, got 3"),
        ("x,y\n1,two,3\n4,five,6\n", "2: 2 values expected, got 3"),
    ],
    ids=["numbers above", "a short header", "a short header above texts"],
)
def test_only_prose_above_a_header_is_left_out(tmp_path, text, refused):
    with pytest.raises(InputError, match=refused):
        read_table(written(tmp_path, text))


@pytest.mark.parametrize(
    ("dates", "wanted"),
    [
        (
            ["2025-11-22T08:26:40.5+00:00", "2025-11-22 09:26:41+01:00", "", "20251122T082643Z"],
            [0.5, 1, np.nan, 3],
        ),
        (["22-Nov-2025 08:26:40", "22-nov-2025 08:26:40.25"], [0, 0.25]),
        (["2025/11/22 08:26:40", "2025/11/22 08:26:41"], [0, 1]),
        (["22.11.2025 08:26:40", "22.11.2025 08:27"], [0, 20]),
        (["11/22/2025 8:26:40 AM", "11/22/2025 8:26:40 pm"], [0, 12 * 3600]),
        (["05.11.2025 08:26:40"], "a.csv:2: .*cannot be told apart"),
        (["22-Dez-2025", "2025-11-22T08:26:40"], "a.csv:2: .*must be a date and time"),
        (["31.02.2025 08:00", "2025-11-22T08:26:40"], "a.csv:2: .*must be a date and time"),
        (["11/22/2025 13:00 PM", "2025-11-22T08:26:40"], "a.csv:2: .*must be a date and time"),
        (["2025-11-22T08:26:40", "noon"], "a.csv:3: .*must be a date and time, got 'noon'"),
        (["2025-11-22T08:26:40", "7"], "a.csv:3: .*must be a date and time, got '7'"),
    ],
)
def test_times_may_be_dates(tmp_path, dates, wanted):
    table = read_table(written(tmp_path, "t,x\n" + "".join(f"{date},1\n" for date in dates)))
    if isinstance(wanted, str):
        with pytest.raises(InputError, match=wanted):
            table.times("t")
        return
    assert_array_equal(table.times("t") - 1763800000.0, wanted)


ROWS = "".join(f"{k}.5,1,{50 + k}.25\n" for k in range(9))


@pytest.mark.parametrize(
    ("last", "why"),
    [
        ("9.5,1", "and 2 of 3 values"),
        ("9.5", "and 1 of 3 values"),
        ('9.5,"1', "and 2 of 3 values"),
        ("9.5,1,6", "and its 6 is far below all other values"),
        ("9.5,1,6.3e-", "and its 6.3e- begins a number"),
    ],
)
def test_a_last_line_that_was_cut_short_is_left_out_and_noted(tmp_path, last, why):
    table = read_table(written(tmp_path, "t,x,b\n" + ROWS + last))
    assert table.notes == (f"line 11 as cut short and left out: it has no end, {why}",)
    b = table.numbers("b")
    assert_array_equal(b[np.isfinite(b)], 50.25 + np.arange(9))


@pytest.mark.parametrize(
    "text", ["x y b\n" + ROWS.replace(",", " "), "x,y,b\n" + ROWS, "x,y,b\n1,2,3\n4,5,6\n"]
)
@pytest.mark.parametrize("end", ["END OF FILE", "END OF FILE\n"])
def test_prose_below_the_rows_is_left_out_and_noted(tmp_path, text, end):
    table = read_table(written(tmp_path, text + end))
    assert table.rows == text.count("\n") - 1
    (note,) = table.notes
    assert "left out" in note
    with pytest.raises(InputError, match=r"values expected|must be a finite number, got 'END'"):
        read_table(written(tmp_path, text + "END OF FILE\n" + text.partition("\n")[2])).numbers("x")


def test_headers_that_are_repeated_are_left_out_and_counted(tmp_path):
    log = "t, x\ns,cm\n1,2\n"
    table = read_table(written(tmp_path, log + log + log))
    assert table.notes == ("line 2 as the units of the columns", "lines that repeat the header left out: 4")
    assert_array_equal(table.numbers("x [cm]"), [2, 2, 2])
    assert table.columns[0].where(2).endswith("a.csv:9")


@pytest.mark.parametrize("row", ["s,cm,,uT", "[s],[cm],-,[µT]"])
def test_a_row_of_units_is_joined_to_the_names(tmp_path, row):
    table = read_table(written(tmp_path, f"t,x,y_cm,b\n{row}\n1,2,3,4\n"))
    assert table.names == ["t [s]", "x [cm]", "y_cm", f"b [{row.rpartition(',')[2].strip('[]')}]"]
    assert_array_equal(table.numbers("4"), [4])


@pytest.mark.parametrize("row", ["m,nan,nan", "T,,", "s,m,7"])
def test_a_row_of_texts_or_numbers_is_not_one_of_units(tmp_path, row):
    assert read_table(written(tmp_path, f"run,x,y\n{row}\nm,5,6\n")).names == ["run", "x", "y"]


@pytest.mark.parametrize(
    "above",
    ["Device,S,SM-1,Android,14\nDate,2025-11-22,,,\n,,,,\n", "Rate,10,,,\n" * 20, "Device,of,a,friend,Bob\n"],
)
def test_prose_that_was_filled_to_the_width_of_the_table_is_left_out(tmp_path, above):
    table = read_table(written(tmp_path, above + "t,x,y,yaw,b\ns,m,m,rad,uT\n1,2,3,4,5\n6,7,8,9,10\n"))
    assert [name[0] for name in table.names] == ["t", "x", "y", "y", "b"]
    line = above.count("\n") + 1
    assert table.notes[0] == f"line {line} as the header, and the lines above it as prose"


@pytest.mark.parametrize(
    ("rows", "wrong"),
    [
        ("a,,,\na,1,2,3\n", None),
        ("a,nan,-,NULL\nb,1,2,3\n", None),
        ("a,b,c,1\nd,e,f,2\ng,1,2,3\n", "'b'"),
        ("a,b,c,d\ng,1,2,3\n", "'b'"),
    ],
    ids=["missing", "missing by words", "texts", "only texts"],
)
def test_rows_with_texts_are_not_taken_for_a_header(tmp_path, rows, wrong):
    table = read_table(written(tmp_path, "run,x,y,b\n" + rows))
    assert table.names == ["run", "x", "y", "b"]
    if wrong:
        with pytest.raises(InputError, match=rf"a\.csv:2: x must be a finite number, got {wrong}"):
            table.numbers("x")


def test_the_xyz_of_geosoft_is_read(tmp_path):
    rule, row = "/ -----\n", " 1.0 2.0 *\n"
    head = f"{rule}/ DATABASE [.\\lab.gdb]\n{rule}/\n/  X  Y  Mag_TMI\n/=== === ===\n/\n"
    text = f"{head}Line   10\n{row}Tie T2\n{row}/ x\n"
    table = read_table(written(tmp_path, text, "a.xyz"))
    assert table.names == ["X", "Y", "Mag_TMI"]
    assert_array_equal(table.numbers("Y"), [2, 2])
    assert np.isnan(table.numbers("Mag_TMI")).all()
    assert table.notes == ("lines such as 'Line   10' left out: 2",)
    topics = read_table(written(tmp_path, "/odom/x,/odom/y\n1,2\n"))
    assert topics.names == ["/odom/x", "/odom/y"]


@pytest.mark.parametrize(
    ("cells", "values"),
    [
        (['"45,529.4"', "999.5", ""], [45529.4, 999.5, np.nan]),
        (['"1,234,567"', '"-2,000"', "7"], [1234567, -2000, 7]),
        (["45'529.4", "1'000", "0.5"], [45529.4, 1000, 0.5]),
        (["45\u202f529.4", "1\u202f000", "nan"], [45529.4, 1000, np.nan]),
        (['"45,529"', '"45,530"', '"45,531"'], "45,529"),
        (['"45,529.4"', '"0,584"', "1"], "45,529.4"),
        (['"45,529.4"', "45529.5", "1"], "45,529.4"),
        (["45'529", "45.5291e3", "1"], "45'529"),
    ],
)
def test_marks_between_thousands_are_read_if_all_numbers_of_a_column_fit(tmp_path, cells, values):
    table = read_table(written(tmp_path, "x,b\n" + "".join(f"0.5,{cell}\n" for cell in cells)))
    if isinstance(values, str):
        with pytest.raises(InputError, match=rf"a\.csv:2: b must be a finite number, got ['\"]{values}"):
            table.numbers("b")
        return
    assert_array_equal(table.numbers("b"), values)
    assert table.notes == ("numbers of b with marks between thousands",)


def test_a_column_is_found_by_its_name_without_a_unit(tmp_path):
    table = read_table(written(tmp_path, "East (cm),b [uT],b [nT],b\n1,2,3,4\n"))
    assert_array_equal(table.numbers("East"), [1])
    assert_array_equal(table.numbers("b"), [4])
    with pytest.raises(InputError, match=r"no column 'c'"):
        read_table(written(tmp_path, "c [uT],c [nT]\n1,2\n")).numbers("c")


def test_long_words_take_no_long_time(tmp_path):
    start, digits = time.process_time(), "1" * 60_000
    table = read_table(written(tmp_path, f"Line {digits} x,b\n1,2\n3,{digits}x"))
    with pytest.raises(InputError, match=r"a\.csv:3: b must be a finite number"):
        table.numbers("b")
    assert time.process_time() - start < 60  # hours, in the square of the digits
