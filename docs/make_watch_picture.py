"""Writes docs/img/watch.svg, the screen of `levid watch`: `python docs/make_watch_picture.py`.

A daemon flies the simulated rig in real time, about half a minute.
"""

from __future__ import annotations

import asyncio
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import yaml

from levid.cli.watch.screen import WatchApp
from levid.config.shipped import shipped
from levid.daemon.client import Client, DaemonError

PICTURE = Path(__file__).parent / "img" / "watch.svg"
SIZE = 100, 30
READY_S, FLOWN_S = 60.0, 15.0
LEVID = (sys.executable, "-m", "levid.cli.main")
SESSION = """
levid: session
name: white-noise
excitations:
  z: {input: z, rms_n: 0.5}
  psi: {input: psi, rms_n_m: 0.03}
steps:
  - levitate: {settle_s: 1, check_coils: false}
  - record: {name: lift-and-tilt, duration_s: 60, settle_s: 0.5, excite: [z, psi]}
  - land: {}
"""


def main() -> None:
    """Fly, watch, and write the picture."""
    with tempfile.TemporaryDirectory() as folder:
        rig_file, socket = _rig(Path(folder))
        daemon = subprocess.Popen([*LEVID, "run", rig_file])
        try:
            _until_idle(socket)
            session = Path(folder) / "session.yaml"
            session.write_text(SESSION)
            options = ["--rig", rig_file, "--out", Path(folder) / "today", "--if-gone", "land"]
            flight = subprocess.Popen([*LEVID, "excite", session, *options])
            picture = asyncio.run(_watched(socket))
            flight.terminate()
        finally:
            daemon.terminate()
            daemon.wait()
    # Fonts of other hosts are not loaded in a page, and slow it down.
    PICTURE.write_text(re.sub(r"\s*@font-face \{.*?\}", "", picture, flags=re.DOTALL))


def _rig(folder: Path) -> tuple[Path, Path]:
    """Write the loopback rig with a socket in `folder`; return its file and the socket."""
    plain = yaml.safe_load(shipped("rigs/loopback.yaml").read_text())
    socket = folder / "levid.sock"
    plain |= {
        "model": str(shipped("models/rig.yaml")),
        "sim": str(shipped("sims/nominal.yaml")),
        "socket": str(socket),
        "rate_hz": 500,
        "recording": {"faults": str(folder / "faults")},
    }
    plain["limits"] |= {"late_cycles": 10_000, "late_in_window": 1_000_000, "stall_s": 20.0}
    rig_file = folder / "rig.yaml"
    rig_file.write_text(yaml.safe_dump(plain))
    return rig_file, socket


def _until_idle(socket: Path) -> None:
    give_up_s = time.monotonic() + READY_S
    while time.monotonic() < give_up_s:
        try:
            with Client(socket) as client:
                if client.request("status")["state"] == "IDLE":
                    return
        except DaemonError:
            pass
        time.sleep(0.2)
    raise SystemExit("the daemon did not become idle")


async def _watched(socket: Path) -> str:
    app = WatchApp(lambda: socket, 0.2)
    async with app.run_test(size=SIZE) as pilot:
        await pilot.pause(FLOWN_S)
        return app.export_screenshot(title="levid watch")


if __name__ == "__main__":
    main()
