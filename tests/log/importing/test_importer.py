"""Test the import of foreign data: imported values, and errors that name the faulty place."""

from __future__ import annotations

import struct
import subprocess

import numpy as np
import pytest
import scipy.io
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from repository_folders import ROOT

from levid.config.base import ConfigError, parse_text
from levid.config.model import ModelConfig
from levid.identification.trace.records.check_common_session_time import overlap
from levid.identification.trace.records.record_from_log import trace_record
from levid.log.errors import LogError
from levid.log.importing import mat_file_reader
from levid.log.importing.importer import import_file
from levid.log.importing.signals_yaml import SignalsFile
from levid.log.reader import read_log

MEASURED = ROOT.parent / "shared" / "data"
SIGNALS = ROOT / "config" / "signals"

HEAD = "levid: signals\nrate_hz: 100\n"
BY_NAME = """columns:
  - {column: V1, name: u_v, unit: V, role: input}
  - {column: V2, name: y_v, unit: V, role: output}
"""
BY_NUMBER = BY_NAME.replace("V1", "0").replace("V2", "1")
ONE_DOF = """
levid: model
name: one
dof: [{name: y_v, unit: V}]
inputs: [{name: u_v, unit: V}]
parameters: {m: {value: 1.0, unit: s^2, min: 0.1, max: 10}}
M: [[m]]
D: [[0]]
K: [[1]]
"""
THOUSANDS = 'thousands: "."\n'
GOOD = [[1.0, -2.0], [0.5, 3e-3], [-1e3, 0.25]]


def run(tmp_path, data, signals, *, name="data.csv"):
    """Import `data` (text, or a function that writes the file) and read the log."""
    source = tmp_path / name
    if callable(data):
        data(source)
    else:
        source.write_text(data)
    (tmp_path / "signals.yaml").write_text(signals)
    out = tmp_path / "out.mcap"
    found = import_file(source, tmp_path / "signals.yaml", out)
    log = read_log(out)
    assert found.rows == log.rows.size
    return log


def columns_of(log):
    return np.stack([log.field("u_v"), log.field("y_v")], axis=1).tolist()


@pytest.mark.parametrize(
    ("name", "text", "columns"),
    [
        ("a.csv", "V1,V2\n1,-2\n.5,3e-3\n-1e3,.25\n", BY_NAME),
        ("a.csv", '"V1","V2",\n1,-2,\n.5,3e-3,\n-1e3,.25,\n', BY_NAME),
        ("a.csv", "1,-2\n.5,3e-3\n-1e3,.25\n", BY_NUMBER),
        ("a.csv", "V1,V2\r\n1,-2\r\n\r\n.5,3e-3\r\n-1e3,.25", BY_NUMBER),
        ("a.csv", "\ufeffV1;V2\n1;-2\n.5;3e-3\n-1e3;.25\n", BY_NAME),
        ("a.csv", "t,V2,V1\n0,-2,1\n,3e-3,.5\nx,.25,-1e3\n", BY_NAME),
        ("a.dat", "  1  -2 \n\n .5\t3e-3\n-1e3 .25\n", BY_NUMBER),
        ("a.txt", "% by hand\nV1 V2\n1 -2\n# pause\n.5 3e-3\n-1e3 .25\n", BY_NAME),
        ("a.log", "1 -2\n.5 3e-3\n-1e3 .25\n", "format: text\n" + BY_NUMBER),
        ("a.any", "1 -2\n.5 3e-3\n-1e3 .25\n", BY_NUMBER),
        ("a.csv", "V1;V2\n1;\u22122\n0,5;3e-3\n\u20131.000;0,25\n", THOUSANDS + BY_NAME),
        ("a.csv", "V1;V2\n1;-2\n0,5;3E-3\n-1\u202f000,0;0,25\n", BY_NAME),
        ("a.csv", "V1;V2\n1;-2\n.5;3D-3\n-1'000;.25\n", BY_NAME),
        ("a.csv", "V1 ;V2\u00a0\n1;-2\n.5;3e-3\n-1e3;.25\n", BY_NAME),
        ("a.csv", "V1;V2\n1 V;-2 V\n500 mV;3e-3 V\n-1e3 V;.25 V\n", BY_NAME),
        ("a.csv", "Log 7\nV1;V2\nV;V\n1;-2\nV1;V2\n# 2nd\n.5;3e-3\nstop\n-1e3;.25\nEOF\n", BY_NAME),
    ],
)
def test_text_formats_are_imported(tmp_path, name, text, columns):
    log = run(tmp_path, text, HEAD + columns, name=name)
    assert columns_of(log) == GOOD
    assert log.complete
    assert log.schema_name == "levid/msg/Signals"
    np.testing.assert_array_equal(log.field("cycle"), [0, 1, 2])
    np.testing.assert_array_equal(log.field("time_s"), [0, 0.01, 0.02])
    np.testing.assert_array_equal(log.log_time_ns, [0, 10_000_000, 20_000_000])
    assert log.rate_hz == 100.0
    assert log.metadata["kind"] == "import"
    assert log.metadata["name"] == "a"
    assert log.metadata["input_hold"] == "zoh"


def test_imported_log_has_roles_and_units(tmp_path):
    log = run(tmp_path, "1,2\n", HEAD + BY_NUMBER)
    signals = parse_text(log.attachments["signals.yaml"], SignalsFile, "signals.yaml")
    assert [c.name for c in signals.with_role("input")] == ["u_v"]
    assert [(c.name, c.unit) for c in signals.with_role("output")] == [("y_v", "V")]
    with log.path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        ((schema, _, _, message),) = reader.iter_decoded_messages()
    assert b"float64 u_v  # [V]" in schema.data
    assert (message.u_v, message.y_v, message.time_s, message.cycle) == (1.0, 2.0, 0.0, 0)


def test_scale_offset_and_rows(tmp_path):
    signals = HEAD + "rows: {first: 1, last: 2}\n" + BY_NUMBER.replace("V, r", "V, scale: 10, r", 1)
    signals = signals.replace("role: output", "offset: -1, role: output")
    log = run(tmp_path, "9,9\n1,2\n3,4\n9,9\nno,number\n", signals)
    assert columns_of(log) == [[10.0, 1.0], [30.0, 3.0]]
    np.testing.assert_array_equal(log.field("time_s"), [0, 0.01])


def test_records_of_one_session_follow_each_other(tmp_path):
    """The trace searches drifts over several records only where these do not overlap in time."""
    data = "V1,V2\n" + "1,2\n2,1\n" * 30
    logs = []
    for begin in (0.0, 12.5):
        folder = tmp_path / f"{begin}"
        folder.mkdir()
        logs.append(run(folder, data, HEAD + f"begins_s: {begin}\n" + BY_NAME))
    assert [log.rows["time_s"][0] for log in logs] == [0.0, 12.5]
    assert logs[1].rows["time_s"][-1] == pytest.approx(13.09)
    records = [trace_record(log, parse_text(ONE_DOF, ModelConfig, "one")) for log in logs]
    assert overlap(records) == ""
    assert overlap([records[0], records[0]])


def npz(**variables):
    return lambda path: np.savez(path, **variables)


def mat(**variables):
    return lambda path: scipy.io.savemat(path, variables)


U, Y = np.array(GOOD).T
UY = np.array(GOOD)
MATRIX = BY_NAME.replace("column: V1", "column: D, index: 0").replace(
    "column: V2", "column: D, index: 1"
)


IN_STRUCTS = BY_NAME.replace("V1", "S(1).values").replace("V2", "S(2).values")


def struct_array(*values):
    found = np.zeros((1, len(values)), [("values", object)])
    for index, value in enumerate(values):
        found[0, index]["values"] = value
    return found


@pytest.mark.parametrize(
    ("name", "data", "columns"),
    [
        ("a.npz", npz(V1=U, V2=Y, other=np.arange(9)), BY_NAME),
        ("a.npz", npz(V1=U[None], V2=Y[:, None]), BY_NAME),
        ("a.npz", npz(D=UY), MATRIX),
        ("a.npz", npz(D=UY.T), "samples: columns\n" + MATRIX),
        ("a.mat", mat(V1=U, V2=Y), BY_NAME),
        ("a.mat", mat(V1=U[:, None], V2=Y[None]), BY_NAME),
        ("a.mat", mat(D=UY), MATRIX),
        ("a.mat", mat(S={"u": U, "y": Y}), BY_NAME.replace("V1", "S.u").replace("V2", "S.y")),
        ("a.mat", mat(S=struct_array(U, Y)), IN_STRUCTS),
        ("a.mat", mat(S=[{"values": U}, {"values": Y}]), IN_STRUCTS),
        ("a.mat", mat(S={"T": {"u": UY}}), MATRIX.replace("column: D", "column: S.T.u")),
        ("a.mat", mat(D=UY, name="motor"), BY_NUMBER),
        ("a.npz", npz(D=UY, u=U), BY_NUMBER),
        ("a.npy", lambda path: np.save(path, UY), BY_NUMBER),
        # Simulink saves signals that are matrices as (width, 1, samples).
        ("a.mat", mat(D=UY.T[:, None]), "samples: columns\n" + MATRIX),
    ],
)
@pytest.mark.usefixtures("mat_in_this_process")
def test_npz_and_mat_arrays_are_imported(tmp_path, name, data, columns):
    assert columns_of(run(tmp_path, data, HEAD + columns, name=name)) == GOOD


@pytest.mark.parametrize(
    ("text", "columns", "expected_error"),
    [
        ("V1,V2\n1,2\n3\n", BY_NAME, "line 3: expected 2 cells, as in the first row, found 1"),
        ("V1,V2\n1,2\n3,4,5\n", BY_NAME, "line 3: expected 2 cells, as in the first row, found 3"),
        ("1,2\n3,four\n", BY_NUMBER, "line 2, column 1: expected a number, found 'four'"),
        ("1,2\n3,1_0\n", BY_NUMBER, "line 2, column 1: expected a number, found '1_0'"),
        ("1,2\n3,nan\n5,6\n", BY_NUMBER, "found 0 of 3 rows in such parts (missing: row 1)"),
        ("1,2\n3,4\n", BY_NAME, "column 'V1': the file has no header"),
        (
            "V1,W2\n3,4\n",
            BY_NAME,
            "column 'V2': expected once in the header, found nowhere; there is V1, W2",
        ),
        ("V1,V2,V2\n3,4,5\n", BY_NAME, "column 'V2': expected once in the header, found twice"),
        ("1\n2\n", BY_NUMBER, "column 1: expected a column number from 0 to 0"),
        ("", BY_NUMBER, "expected rows of numbers, found none"),
        ("V1,V2\n", BY_NAME, "expected rows 0 on, found 0 rows"),
        ("1,2\n3,4\n", "rows: {last: 2}\n" + BY_NUMBER, "expected rows 0 to 2, found 2 rows"),
        ("1,2\n", "rows: {first: 5}\n" + BY_NUMBER, "expected rows 5 on, found 1 rows"),
        ("1,2\n", MATRIX, "column 'D', index 0: index is for variables of NPZ and MAT files"),
        ("\0\1,\2\n", BY_NUMBER, "data.csv: "),
        ("V1,V2\n1,5,2,5\n", BY_NAME, "if commas are decimal commas, separate the columns by"),
        ("V1;V2\n1.5;2\n1,5;2\n", BY_NAME, "line 3, column 'V1': expected decimal points or dec"),
        ("V1;V2\n1.234,5;2\n1,5;2\n", BY_NAME, "found '1.234,5'; set thousands: \".\" in the"),
        (
            "V1;V2\n1.234;2\n2.345;2\n",
            BY_NAME,
            "'1.234': 1.234 or 1234; set decimal: \".\" or thou",
        ),
        ("V1;V2\n1.234;2\n0,5;2\n", BY_NAME, "1234, as other numbers have another sign; set thou"),
        ('V1,V2\n"1,234",0.5\n', BY_NAME, "'1,234': 1234, as other numbers have another sign"),
        ("V1;V2\n1.5;2\n3\u0417.4;2\n", BY_NAME, "is cyrillic capital letter ze"),
        ("V\u0445;V2\n1.5;2\n", BY_NAME.replace("V1", "Vx"), "is cyrillic small letter ha"),
        ("V1;V2\n1.5;2\nlost;2\n", BY_NAME, "list it in the signals file: missing: ['lost']"),
        ('V1,V2,n\n1,2,ok\n3,4,"bad\n5,6,ok\n', BY_NAME, "cannot be read: unexpected end of data"),
        ("1,2\n3e20,4\n", "rate_hz: 1e-12\n" + BY_NUMBER, "expected 2 samples to last at most"),
        (
            "1,2\n3e20,4\n",
            BY_NUMBER.replace("0,", "0, scale: 1e300,"),
            "row 1: expected a number that stays finite with scale 1e+300, found 3e+20",
        ),
    ],
)
def test_invalid_table_is_reported_with_line_and_column(tmp_path, text, columns, expected_error):
    head = "" if "rate_hz" in columns else HEAD
    with pytest.raises(LogError) as caught:
        run(tmp_path, text, (head or "levid: signals\n") + columns)
    assert expected_error in str(caught.value)
    assert str(tmp_path) in str(caught.value)
    assert not (tmp_path / "out.mcap").exists()


@pytest.mark.parametrize(
    ("name", "data", "columns", "expected_error"),
    [
        ("a.npz", npz(V1=U), BY_NAME, "column 'V2': no such variable; there is V1"),
        ("a.npz", npz(V1=U, V2=Y[:2]), BY_NAME, "expected 3 samples, as column 'V1' has, found 2"),
        ("a.npz", npz(V1=UY, V2=Y), BY_NAME, "a vector, or an index into a matrix, found shape (3"),
        ("a.npz", npz(D=U), MATRIX.replace("index: 0", "index: 3"), "expected a vector, found"),
        ("a.npz", npz(D=UY), MATRIX.replace("index: 0", "index: 2"), "expected index 0 to 1"),
        ("a.npz", npz(V1=U + 1j, V2=Y), BY_NAME, "expected real numbers, found complex numbers"),
        ("a.npz", npz(V1=U, V2=np.array([1.0, np.inf, 0.0])), BY_NAME, "(missing: row 1)"),
        ("a.npz", npz(V1=U), BY_NUMBER, "column 0: expected a variable's name; a number"),
        ("a.npz", npz(V1=np.array([{}]), V2=Y), BY_NAME, "found a cell array or objects"),
        ("a.npz", "no zip", BY_NAME, "not a usable NPZ file"),
        ("a.mat", "no mat", BY_NAME, "not a usable MAT file"),
        ("a.mat", mat(S={"u": U}), BY_NAME.replace("V1", "S.v"), "no such variable; there is u"),
        (
            "a.mat",
            mat(S=struct_array(U, Y)),
            BY_NAME.replace("V1", "S.values"),
            "there is (1), (2)",
        ),
        ("a.mat", mat(S=struct_array(U, Y)), BY_NAME.replace("V1", "S(3).x"), "from S(1) to S(2)"),
        ("a.mat", mat(S={"u": U}), BY_NAME.replace("V1", "S"), "found a struct with the fields u"),
        ("a.mat", mat(V1="text"), BY_NAME, "expected real numbers, found text"),
        ("a.npz", npz(A=UY, B=UY), BY_NUMBER, "the file's only matrix, found matrices: A, B"),
        (
            "a.npz",
            npz(D=np.ones((2, 9))),
            BY_NUMBER,
            "found shape (2, 9) with samples along rows; ",
        ),
        ("a.npz", npz(D=np.ones((2, 9))), BY_NUMBER, "set samples: columns"),
        (
            "a.xls",
            lambda path: path.write_bytes(bytes(100)),
            BY_NUMBER,
            "expected a text file, or one of .csv, .txt",
        ),
    ],
)
@pytest.mark.usefixtures("mat_in_this_process")
def test_invalid_array_is_reported_with_its_name(tmp_path, name, data, columns, expected_error):
    with pytest.raises(LogError) as caught:
        run(tmp_path, data, HEAD + columns, name=name)
    assert expected_error in str(caught.value)
    assert not (tmp_path / "out.mcap").exists()


@pytest.mark.parametrize("seed", [11, 212, 235])
def test_damaged_mat_file_does_not_crash_the_program(tmp_path, seed):
    """One to three wrong bytes with these seeds crash the reader of scipy 1.17."""
    scipy.io.savemat(
        tmp_path / "a.mat",
        {
            "V1": np.arange(50.0),
            "V2": np.arange(50.0),
            "S": {"u": np.arange(4), "s": "hi", "c": np.array([1, "a"], object)},
        },
    )
    data = bytearray((tmp_path / "a.mat").read_bytes())
    rng = np.random.default_rng(seed)
    for _ in range(rng.integers(1, 4)):
        data[rng.integers(128, len(data))] = rng.integers(256)
    with pytest.raises(LogError, match=r"a\.mat: (not a usable MAT file|.*expected)"):
        run(tmp_path, lambda path: path.write_bytes(data), HEAD + BY_NAME, name="a.mat")


@pytest.mark.parametrize(
    ("code", "expected_error"),
    [(-11, "was ended by SIGSEGV"), (-200, "by signal 200"), (1, "exit code 1")],
)
def test_exit_of_the_mat_reader_process_is_reported(tmp_path, monkeypatch, code, expected_error):
    ended = subprocess.CompletedProcess([], code, b"", b"")
    monkeypatch.setattr(mat_file_reader.subprocess, "run", lambda *_, **__: ended)
    with pytest.raises(LogError, match=f"not a usable MAT file: its reader .*{expected_error}"):
        run(tmp_path, mat(V1=U, V2=Y), HEAD + BY_NAME, name="a.mat")


@pytest.mark.usefixtures("mat_in_this_process")
def test_matlab_object_is_rejected_with_a_remedy(tmp_path):
    """MATLAB saves a timeseries in a form that scipy does not read; not even its name is known."""

    def element(kind, data):
        return struct.pack("<II", kind, len(data)) + data + bytes(-len(data) % 8)

    flags = element(6, struct.pack("<II", 17, 0))  # class 17: an opaque object
    array = element(6, struct.pack("<II", 6, 0)) + element(5, struct.pack("<ii", 1, 1))
    array = element(14, array + element(1, b"") + element(9, struct.pack("<d", 1.0)))
    names = b"".join(element(1, name) for name in (b"V1", b"MCOS", b"timeseries"))
    data = b"MATLAB 5.0 MAT-file".ljust(116) + bytes(8) + b"\0\1IM"
    data += element(14, flags + names + array)
    with pytest.raises(LogError, match=r"a MATLAB object \(a timeseries.*t = x\.Time; y = x\.Data"):
        run(tmp_path, lambda path: path.write_bytes(data), HEAD + BY_NAME, name="a.mat")


@pytest.mark.usefixtures("mat_in_this_process")
def test_matlab_7_3_file_is_rejected_with_a_remedy(tmp_path):
    # The header that MATLAB writes; HDF5 follows at byte 512.
    text = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(116) + bytes(8) + b"\0\2IM"
    data = text.ljust(512, b"\0") + b"\x89HDF\r\n\x1a\n"
    with pytest.raises(LogError, match=r"found 7\.3 \(HDF5\); in MATLAB.*'-v7'"):
        run(tmp_path, lambda path: path.write_bytes(data), HEAD + BY_NAME, name="a.mat")


@pytest.mark.parametrize(
    ("signals", "expected_error"),
    [
        (HEAD.replace("100", "0") + BY_NAME, "rate_hz"),
        (
            HEAD.replace("rate_hz: 100\n", "") + BY_NAME,
            "expected rate_hz or a column of role time, found neither",
        ),
        (HEAD + BY_NAME.replace("name: y_v", "name: u_v"), "found 'u_v' again"),
        (HEAD + BY_NAME.replace("name: y_v", "name: time_s"), "found 'time_s' again"),
        (HEAD + BY_NAME.replace("name: y_v", "name: Y V"), "columns[1].name"),
        (HEAD + BY_NAME.replace("unit: V", "unit: '#V'"), "columns[0].unit"),
        (HEAD + BY_NAME.replace("role: input", "role: u"), "columns[0].role"),
        (HEAD + "columns: []\n", "columns"),
        (HEAD + "rows: {first: 3, last: 2}\n" + BY_NAME, "expected last >= first, found 3 to 2"),
        (HEAD + "rate: 5\n" + BY_NAME, "rate: unknown key"),
        ("levid: rig\nrate_hz: 1\n" + BY_NAME, "levid"),
    ],
)
def test_invalid_signals_file_is_reported_with_its_key(tmp_path, signals, expected_error):
    with pytest.raises(ConfigError) as caught:
        run(tmp_path, "1,2\n", signals)
    assert expected_error in str(caught.value)


def test_missing_data_file_and_existing_log_are_rejected(tmp_path):
    with pytest.raises(LogError, match=r"data\.csv: expected a file, found none"):
        run(tmp_path, lambda _: None, HEAD + BY_NUMBER)
    run(tmp_path, "1,2\n", HEAD + BY_NUMBER)
    before = (tmp_path / "out.mcap").read_bytes()
    with pytest.raises(LogError, match="exists"):
        run(tmp_path, "3,4\n", HEAD + BY_NUMBER)
    assert (tmp_path / "out.mcap").read_bytes() == before


def measured_data(name):
    path = MEASURED / name
    if not path.exists():
        pytest.skip(f"the measured data {name} are not beside this repository")
    return path


def test_measured_cd_player_arm_is_imported(tmp_path):
    data = measured_data("daisy/CD_player_arm.dat")
    out = tmp_path / "arm.mcap"
    assert import_file(data, SIGNALS / "cd-player-arm.yaml", out).rows == 2048
    log = read_log(out)
    table = np.loadtxt(data)
    for column, name in enumerate(("u1", "u2", "y1", "y2")):
        np.testing.assert_array_equal(log.field(name), table[:, column])


def test_measured_silverbox_is_imported(tmp_path):
    data = measured_data("silverbox/SNLS80mV.csv")
    out = tmp_path / "box.mcap"
    assert import_file(data, SIGNALS / "silverbox.yaml", out).rows == 105_712 - 40_650
    log = read_log(out)
    table = np.loadtxt(data, delimiter=",", skiprows=1, usecols=(0, 1))[40_650:105_712]
    np.testing.assert_array_equal(log.field("u_v"), table[:, 0])
    np.testing.assert_array_equal(log.field("y_v"), table[:, 1])
    assert log.rate_hz == pytest.approx(610.35, abs=0.01)  # as its authors state


def test_empty_cells_in_unused_columns_are_ignored(tmp_path):
    # The column of overload flags has a value in the first row only.
    data = measured_data("silverbox/Schroeder80mV.csv")
    (tmp_path / "signals.yaml").write_text(HEAD + BY_NAME)
    assert import_file(data, tmp_path / "signals.yaml", tmp_path / "out.mcap").rows == 131_072


def test_python_objects_in_unused_variables_are_ignored(tmp_path):
    log = run(tmp_path, npz(V1=U, V2=Y, meta=np.array({"a": 1})), HEAD + BY_NAME, name="a.npz")
    assert columns_of(log) == GOOD


def test_file_name_that_is_not_valid_text_is_imported(tmp_path):
    # File names are bytes; a log contains text.
    log = run(tmp_path, "1,-2\n.5,3e-3\n-1e3,.25\n", HEAD + BY_NUMBER, name="a\udce9.csv")
    assert columns_of(log) == GOOD
    assert log.metadata["source"] == "a?.csv"


def test_signal_with_the_name_of_a_cycle_field_keeps_its_unit(tmp_path):
    named = BY_NUMBER.replace("y_v", "z_m")
    run(tmp_path, "1,2\n3,4\n", HEAD + named)
    with (tmp_path / "out.mcap").open("rb") as file:
        (schema,) = make_reader(file).get_summary().schemas.values()
    assert "float64 z_m  # [V]" in schema.data.decode().replace("z_m #", "z_m  #")
