"""The machine whose power was cut, switched on again: the service is there, and rests.

Run as root in the guest; nobody has told the service to start.
"""

from __future__ import annotations

from service import RATE_HZ, STATE, run, say, shown, status_when, until

from levid.log.reader import read_log

WATCHED_S = 2.0


def main() -> None:
    assert run("systemctl", "is-enabled", "levid").strip() == "enabled"
    until(lambda: shown("ActiveState") == "active", "the service, which starts by itself")
    assert shown("StatusText") == "IDLE", shown("StatusText")
    assert shown("NRestarts") == "0"
    say("active after the power cut")
    begun = status_when(lambda s: s["state"] == "IDLE")
    later = status_when(
        lambda s: s["state"] != "IDLE" or s["cycle"] > begun["cycle"] + WATCHED_S * RATE_HZ
    )
    assert (later["state"], later["fault"], later["session"]) == ("IDLE", "NONE", None), later
    # It was flying when the power was cut, at its working point: it lies on its stops.
    assert later["z_m"] < -0.5e-3, later
    assert not run("journalctl", "--no-pager", "-q", "--boot", "LEVID_STATE=LEVITATING")
    say(f"IDLE for {WATCHED_S:g} s: nothing lifts off by itself")
    rows = read_log(STATE / "cut-logs" / "01-tilt.mcap").rows
    say(f"the log that was cut off is there, {len(rows)} rows")


if __name__ == "__main__":
    main()
