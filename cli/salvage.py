"""`levid salvage`: recover the rows of damaged logs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ..config.command_line import command_line
from .path_types import FOLDER, LOG
from .progress import say

if TYPE_CHECKING:
    from ..log.salvage import Salvaged


@click.command()
@click.argument("logs", nargs=-1, required=True, type=LOG)
@click.option(
    "--out",
    type=FOLDER,
    help="Folder of the new logs. Default: that of each damaged log.",
)
@click.option(
    "--like",
    type=LOG,
    help="Undamaged log of the same session, for the description of logs that have lost theirs.",
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object instead of text.")
def command(logs: tuple[Path, ...], out: Path | None, like: Path | None, as_json: bool) -> int:
    """Recover all rows in undamaged chunks of LOGS and write them to new logs.

    Readers stop at the first damage in a log. This command finds the chunks after it. It accepts
    only chunks with a correct checksum, so it returns no wrong row. It does not change LOGS; the
    new logs are NAME.salvaged.mcap.

    \b
    Examples:
      levid salvage out/first/02-noise.mcap
      levid salvage out/first/02-noise.mcap --like out/first/01-still.mcap
    """
    from ..config.files.folders import make_folder
    from ..log.errors import LogError
    from ..log.salvage import salvage

    results: list[dict[str, object]] = []
    failed = False
    for log in logs:
        target = (log.parent if out is None else out) / f"{log.stem}.salvaged.mcap"
        try:
            found = salvage(log, like)
            if out is not None:
                make_folder(out)
            written = () if found.whole else found.write(target)
        except (LogError, OSError) as error:
            failed = True
            results.append({"log": str(log), "error": str(error)})
            if not as_json:
                say(f"error: {error}" if isinstance(error, LogError) else f"error: {log}: {error}")
            continue
        results.append(_as_json(found, written))
        if not as_json:
            _print(found, written)
    if as_json:
        click.echo(json.dumps({"logs": results}, indent=1))
    return 1 if failed else 0


def _print(found: Salvaged, written: tuple[Path, ...]) -> None:
    if not written:
        click.echo(f"{found.path}: undamaged, nothing to salvage")
        return
    click.echo(
        f"{found.path}: {len(found.rows)} rows in {found.chunks} undamaged chunks, described by "
        f"{found.described_by}"
    )
    for lost in found.lost:
        if lost.rows == 0:
            click.echo(f"  damaged: bytes {lost.begin} to {lost.end}, which held no rows")
            continue
        rows = "an unknown number of rows" if lost.rows is None else f"{lost.rows} rows"
        if lost.begin == lost.end:
            click.echo(f"  lost: {rows} behind byte {lost.end}, where the file ends")
            continue
        click.echo(
            f"  lost: {rows} in bytes {lost.begin} to {lost.end}, before row {lost.before_row}"
        )
    for path in written:
        click.echo(f"{path}: written")
    if not found.metadata:
        say(
            "the session's description is lost, and `levid identify` needs it: salvage again with "
            "--like and an undamaged log of the same session"
        )
        return
    say(f"next: {command_line('identify', logs=written, out=written[0].with_suffix(''))}")


def _as_json(found: Salvaged, written: tuple[Path, ...]) -> dict[str, object]:
    return {
        "log": str(found.path),
        "rows": len(found.rows),
        "chunks": found.chunks,
        "described_by": found.described_by,
        "lost": [
            {"begin": o.begin, "end": o.end, "before_row": o.before_row, "rows": o.rows}
            for o in found.lost
        ],
        "written": [str(path) for path in written],
    }
