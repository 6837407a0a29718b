"""Test logs and configuration of earlier versions: they still load and fly.

They are in tests/data/COMMIT; `sh tests/data/COMMIT/make.sh` makes them with that commit's code.
A release with a different file format gets another folder.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from repository_folders import ROOT

from levid.log.reader import read_log
from levid.log.signals import ros2msg

DATA = ROOT / "tests" / "data"
OLD = sorted(path for path in DATA.iterdir() if path.is_dir())
CONFIGS = sorted(DATA.glob("*/*/*.yaml"))
LOGS = sorted(DATA.glob("*/*.mcap"))

old = pytest.mark.parametrize("folder", OLD, ids=lambda path: path.name)
log = pytest.mark.parametrize("path", LOGS, ids=lambda path: f"{path.parent.name}-{path.stem}")


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.relative_to(DATA).as_posix())
def test_config_file_still_loads(path: Path, levid: Callable) -> None:
    rig = path.parents[1] / "rigs" / "loopback.yaml"
    code, out, err = levid("check", path, "--rig", rig)
    assert code == 0, err
    assert out.startswith(f"{path}: ")


@log
def test_log_still_has_the_rows_that_the_mcap_package_reads(path: Path) -> None:
    found = read_log(path)
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        messages = [(m.log_time, row) for _, _, m, row in reader.iter_decoded_messages()]
        attached = {one.name: one.data for one in reader.iter_attachments()}
        metadata = {one.name: one.metadata for one in reader.iter_metadata()}
    assert found.complete
    assert found.attachments == attached
    assert found.metadata == metadata["levid"]
    assert found.rate_hz == float(metadata["levid"]["rate_hz"])
    times, rows = zip(*messages, strict=True)
    np.testing.assert_array_equal(found.log_time_ns, times)
    assert found.rows.dtype.names == tuple(rows[0].__slots__)
    for name in rows[0].__slots__:
        read = found.field(name)
        decoded = np.array([getattr(row, name) for row in rows], read.dtype)
        np.testing.assert_array_equal(read, decoded, err_msg=name)


@old
def test_configuration_in_a_log_still_loads(folder: Path, tmp_path: Path, levid: Callable) -> None:
    attached = read_log(folder / "short.mcap").attachments
    assert {"rig.yaml", "session.yaml", "versions.json", "host.json"} <= set(attached)
    assert {"python", "levid", "numpy"} <= set(json.loads(attached["versions.json"]))
    rigs = tmp_path / "rigs"  # its paths refer to ../sims
    rigs.mkdir()
    (tmp_path / "sims").symlink_to(folder / "sims")
    for name in ("rig.yaml", "session.yaml"):
        (rigs / name).write_bytes(attached[name])
    code, _, err = levid("check", rigs / "rig.yaml", rigs / "session.yaml")
    assert code == 0, err


@old
def test_session_still_flies_and_logs_each_field_as_before(
    folder: Path, tmp_path: Path, levid: Callable
) -> None:
    """A program that reads fields by name and type can still read new logs."""
    rig, sim = folder / "rigs" / "loopback.yaml", folder / "sims" / "nominal.yaml"
    options = ("--virtual", "--rig", rig, "--sim", sim, "--out", tmp_path / "out")
    code, _, err = levid("excite", folder / "short.yaml", *options)
    assert code == 0, err
    before, after = read_log(folder / "short.mcap"), read_log(tmp_path / "out" / "01-short.mcap")
    types = [
        {name: str(one.rows.dtype[name]) for name in one.rows.dtype.names}
        for one in (before, after)
    ]
    assert types[0].items() <= types[1].items()
    assert before.metadata.items() <= after.metadata.items()
    assert set(before.attachments) <= set(after.attachments)
    np.testing.assert_array_equal(before.log_time_ns, after.log_time_ns)


@pytest.mark.usefixtures("unwritten_figures")
@old
def test_log_is_still_identified(folder: Path, tmp_path: Path, levid: Callable) -> None:
    """The masses agree with those of the simulator within five standard errors."""
    path = folder / "short.mcap"
    code, out, err = levid("identify", path, "--out", tmp_path / "out", "--json")
    assert code == 0, err
    found = json.loads(out)["grey_box"]["parameters"]
    truth = yaml.safe_load((folder / "sims" / "nominal.yaml").read_text())
    for name, true in (("m_p", truth["platform"]["m_p_kg"]), ("m_b", truth["beam"]["m_b_kg"])):
        assert found[name]["value"] == pytest.approx(true, abs=5 * found[name]["se"])


@pytest.mark.usefixtures("unwritten_figures")
@old
def test_imported_log_is_still_identified(folder: Path, tmp_path: Path, levid: Callable) -> None:
    path = folder / "short-import.mcap"
    code, out, err = levid("identify", path, "--out", tmp_path / "out", "--json")
    assert code == 0, err
    assert json.loads(out)["inputs"] == [{"name": "force_n", "unit": "N"}]


@log
def test_names_of_codes_are_all_that_new_schemas_have_more(path: Path) -> None:
    constant = re.compile(r"uint8 [A-Z_]+=\d+")
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    old = next(iter(summary.schemas.values())).data.decode().splitlines()
    assert not any(map(constant.fullmatch, old))
    rows = read_log(path).rows
    new = ros2msg(rows.dtype).splitlines()
    fields = [line for line in new if not constant.fullmatch(line)]
    assert ("uint8 STATE_LEVITATING=2" in new) == ("state" in rows.dtype.names)
    # The words of a field's meaning may have changed, but not its type, name and place.
    assert [line.split()[:2] for line in fields] == [line.split()[:2] for line in old]
