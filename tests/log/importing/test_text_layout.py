"""Test separator, header, units and decimal commas of text files as programs write them."""

from __future__ import annotations

import codecs

import numpy as np
import pytest

from levid.log.errors import LogError
from levid.log.importing.delimited_text import read_delimited
from levid.log.importing.recording_rate import stated_rate
from levid.log.importing.signals_yaml import SignalsFile
from levid.log.importing.text_layout import text_layout

ROWS = "0.0,1.5,-2\n0.1,2.5,-3\n0.2,3.5,-4\n"


def layout(text, *, whitespace=False):
    return text_layout(text.splitlines(keepends=True), whitespace=whitespace)


def read(path, *columns, whitespace=False):
    signals = SignalsFile.model_validate(
        {
            "levid": "signals",
            "rate_hz": 1,
            "columns": [
                {"column": column, "name": f"c{i}", "unit": "s", "role": role}
                for i, (column, role) in enumerate(columns)
            ],
        }
    )
    return read_delimited(path, signals, whitespace=whitespace)


@pytest.mark.parametrize(
    ("text", "separator", "names", "units"),
    [
        ("t;u [V];y\n" + ROWS.replace(",", ";"), ";", ["t", "u", "y"], ["", "V", ""]),
        ("t,u,y\ns,V,mm\n" + ROWS, ",", ["t", "u", "y"], ["s", "V", "mm"]),
        ("Source,CH1,CH2\nSecond,Volt,Volt\n" + ROWS, ",", ["Source", "CH1", "CH2"], None),
        ("t u y\n" + ROWS.replace(",", " "), None, ["t", "u", "y"], None),
        ("t [s] u [V] y\n" + ROWS.replace(",", "  "), None, ["t", "u", "y"], ["s", "V", ""]),
        ("motor time\tu\ty\n" + ROWS.replace(",", "\t"), "\t", ["motor time", "u", "y"], None),
        ("# t u y\n" + ROWS.replace(",", " "), None, ["t", "u", "y"], None),
        ("#t,u,y\n" + ROWS, ",", ["t", "u", "y"], None),
        ("Device 7\nRate;10\nt;u;y\n" + ROWS.replace(",", ";"), ";", ["t", "u", "y"], None),
        ("t;u;y;\n" + ROWS.replace(",", ";").replace("\n", ";\n"), ";", ["t", "u", "y"], None),
        (ROWS.replace(",", ", "), ",", None, None),
        (ROWS.replace(",", " ").replace(".", ","), None, None, None),
        (ROWS.replace(",", ";").replace(".", ","), ";", None, None),
    ],
)
@pytest.mark.parametrize("whitespace", [False, True])
def test_layout_is_found_whatever_the_ending_of_the_file(text, separator, names, units, whitespace):
    found = layout(text, whitespace=whitespace)
    assert found.separator == separator
    assert found.width == 3
    if names is None:
        assert found.cells is None
    else:
        assert [cell.name for cell in found.cells] == names
    if units is not None:
        assert [cell.unit for cell in found.cells] == units


def test_rows_that_are_no_numbers_do_not_become_a_header():
    found = layout("t,u,state\n0,1,ok\nerror,error,error\n2,3,ok\n")
    assert [cell.name for cell in found.cells] == ["t", "u", "state"]
    assert found.first_line == 2


def test_lines_above_the_header_are_counted(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("made by hand\n\nt,u,y\n" + ROWS)
    found = read(path, ("u", "other"))
    assert found.values[0].tolist() == [1.5, 2.5, 3.5]
    assert found.notes == ("1 line of text above the header skipped",)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "cp1252"])
def test_encoding_is_recognised(tmp_path, encoding):
    path = tmp_path / "a.csv"
    path.write_bytes(codecs.encode("t;Weg [µm]\n0;1,5\n1;-2,5\n", encoding))
    found = read(path, ("Weg", "other"))
    assert found.values[0].tolist() == [1.5, -2.5]
    assert found.units == ["µm"]


@pytest.mark.parametrize(
    ("cells", "expected_s"),
    [
        (["2024-05-01T12:00:00.000", "2024-05-01T12:00:00.002", "2024-05-02T00:00:00"], 43200.0),
        (["2024-05-01 12:00:00", "2024-05-01 12:00:01,5", "2024-05-01 12:00:02"], 2.0),
        (["12:00:00.000", "12:00:00.250", "12:01:00.500"], 60.5),
    ],
)
def test_dates_and_times_of_day_become_seconds(tmp_path, cells, expected_s):
    path = tmp_path / "a.csv"
    path.write_text("t;y\n" + "".join(f"{cell};1\n" for cell in cells))
    (time_s,) = read(path, ("t", "time")).values
    assert time_s[0] == 0.0
    assert time_s[2] == pytest.approx(expected_s, abs=1e-9)
    with pytest.raises(LogError, match=r"line 2, column 't': expected a number, found '"):
        read(path, ("t", "other"))


def test_name_with_two_units_must_be_given_with_its_unit(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("Position [mm],Position [deg]\n1,2\n3,4\n")
    assert read(path, ("Position [deg]", "other")).values[0].tolist() == [2.0, 4.0]
    with pytest.raises(LogError, match=r"found twice .*; give the name with its unit"):
        read(path, ("Position", "other"))


def test_incomplete_last_line_is_left_out(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("t,u,y\n" + ROWS + "0.3,4")
    found = read(path, ("u", "other"))
    assert found.values[0].tolist() == [1.5, 2.5, 3.5]
    assert found.notes == ("line 5, the last one, is not complete; it is left out",)
    path.write_text("t,u,y\n" + ROWS + "0.3,4\n")
    with pytest.raises(LogError, match="line 5: expected 3 cells, as in the first row, found 2"):
        read(path, ("u", "other"))


def test_empty_and_infinite_cells_are_missing_values(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("t,y\n0,\n1,NaN\n2,n/a\n3,-inf\n4,5\n")
    (y,) = read(path, ("y", "other")).values
    assert np.isnan(y).tolist() == [True, True, True, True, False]


@pytest.mark.parametrize(
    ("head", "names", "rate"),
    [
        ("F sensor,,x sensor\nF,t,x\nNewton,seconds,mm\n", ["F", "t", "x"], None),
        ("t,u,y\nREAL,REAL,REAL\ns,V,mm\n", ["t", "u", "y"], None),
        ("Model,D7,\nSample Interval,2e-3,s\nOffset,0,0\nt,u,y\n", ["t", "u", "y"], 500.0),
        ("Sampling Rate: 0.25 kHz\n\nt,u,y\n", ["t", "u", "y"], 250.0),
        ("# fs = 100\n# t,u,y\n", ["t", "u", "y"], 100.0),
        ("dt[ms],5,\nTitle\n", None, 200.0),
        ("17,0.25\nt,u,y\n", ["t", "u", "y"], None),
        ("Rate,10,\nRate,20,\nt,u,y\n", ["t", "u", "y"], None),
    ],
)
def test_header_and_stated_rate_are_found_above_the_table(head, names, rate):
    found = layout(head + ROWS * 4)
    assert found.width == 3
    assert found.numeric == (0, 1, 2)
    assert (found.cells and [cell.name for cell in found.cells]) == names
    stated = stated_rate(found.entries)
    assert (stated and stated[1]) == (None if rate is None else pytest.approx(rate))


def test_summary_below_the_rows_is_left_out(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("t,u,y\n" + 4 * ROWS + "\nMean,2.5,-3\nCount,3,3\n")
    found = read(path, ("u", "other"))
    assert found.values[0].tolist() == 4 * [1.5, 2.5, 3.5]
    assert found.notes == ("2 lines of text between or below the rows left out (lines 15 to 16)",)


@pytest.mark.parametrize(
    ("entry", "rows"),
    [
        ('Date,"2024/05/17","2024/05/17"\n', 20),
        ("Offset,0,0\nScale,1,1\n", 20),
        ("trace,0,5\n", 21),  # goes on in the rows
    ],
)
def test_entries_above_the_rows_are_no_rows(tmp_path, entry, rows):
    path = tmp_path / "a.csv"
    path.write_text("Name,t,y\n" + entry + "".join(f",{k},{k % 3}\n" for k in range(1, 21)))
    assert len(read(path, ("t", "other")).values[0]) == rows
