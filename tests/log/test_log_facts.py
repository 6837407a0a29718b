"""Test whether log times are dates."""

from datetime import UTC, datetime

from levid.log.log_facts import VIRTUAL_EPOCH_NS, flight_date, is_virtual

IN_2023_NS = 1_700_000_000_000_000_000


def test_log_times_of_real_flights_are_dates() -> None:
    assert flight_date(IN_2023_NS, {"rig.yaml": b""}) == datetime(
        2023, 11, 14, 22, 13, 20, tzinfo=UTC
    )
    assert not is_virtual(IN_2023_NS)


def test_virtual_flights_and_imported_data_have_no_date() -> None:
    assert is_virtual(VIRTUAL_EPOCH_NS)
    assert flight_date(VIRTUAL_EPOCH_NS, {"rig.yaml": b""}) is None
    assert flight_date(0, {"signals.yaml": b""}) is None
    assert flight_date(IN_2023_NS, {"signals.yaml": b""}) is None
