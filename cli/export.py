"""`levid export`: write logs as CSV, Parquet, MAT or NPZ tables."""

from __future__ import annotations

from pathlib import Path

import click

from .output_folder_check import writable_folder
from .path_types import ANY, LOG
from .progress import progress, say


@click.command("export")
@click.argument("logs", nargs=-1, required=True, type=LOG)
@click.option(
    "-o",
    "--out",
    required=True,
    type=ANY,
    help="FILE.csv, .parquet, .mat or .npz; with --format a folder that gets one file a log.",
)
@click.option(
    "--format",
    "kind",
    type=click.Choice(["csv", "parquet", "mat", "npz"]),
    help="Format of the files in the folder --out.",
)
@click.option(
    "--columns",
    metavar="NAME,...",
    help="Fields (gap_m), elements (gap_m_3) or groups (pose, coils, ...); default: all.",
)
@click.option(
    "--begin-s", type=float, metavar="SECONDS", help="First time in s, as in the log's time_s."
)
@click.option(
    "--end-s", type=float, metavar="SECONDS", help="Last time in s, as in the log's time_s."
)
@click.option(
    "--every",
    type=click.IntRange(1, 1000),
    metavar="N",
    default=1,
    help="Keep every N-th row; signals are low-pass filtered before, so that nothing aliases.",
)
@click.option("--overwrite", is_flag=True, help="Replace existing files.")
def command(
    logs: tuple[Path, ...],
    out: Path,
    kind: str | None,
    columns: str | None,
    begin_s: float | None,
    end_s: float | None,
    every: int,
    overwrite: bool,
) -> int:
    """Write LOGS as tables for other programs; units are in the column names and in the file.

    In CSV and Parquet each element of an array is a column (gap_m_0, gap_m_1, ...); in MAT and NPZ
    arrays stay arrays. A CSV file gets a FILE.signals.yaml beside it, with the units, which `levid
    import` reads. Logs of any length need little memory. Parquet needs: pip install 'levid[data]'.
    A log that cannot be exported is named, and the others are exported; the exit code is then 1.

    \b
    Examples:
      levid export out/first/02-left-psi.mcap -o psi.csv
      levid export out/first/02-left-psi.mcap -o psi.mat --columns gap_m,pose,v_psi_n_m
      levid export out/first/*.mcap --format parquet -o out/first/tables
      levid export out/first/02-left-psi.mcap -o slow.csv --begin-s 10 --end-s 60 --every 10
    """
    from ..log.errors import LogError
    from ..log.exporting.export_log import ExportOptions, export_log

    names = tuple(name.strip() for name in (columns or "").split(",") if name.strip())
    options = ExportOptions(names, begin_s, end_s, every, overwrite)
    failed = False
    with progress("exporting") as report:
        for number, (log, path, form) in enumerate(_targets(logs, out, kind)):
            report(log.name, number / len(logs))
            try:
                found = export_log(log, path, options, form)  # type: ignore[arg-type]
            except LogError as error:
                failed = True
                say(f"error: {error}")
                continue
            flat = sum(len(c.flat_names) for c in found.columns)
            click.echo(f"{found.path}: {found.rows} rows, {flat} columns")
            for note in found.notes:
                say(f"note: {note}")
    return 1 if failed else 0


def _targets(
    logs: tuple[Path, ...], out: Path, kind: str | None
) -> list[tuple[Path, Path, str | None]]:
    """Return log, file and format of each export; a folder is created."""
    from ..config.base import ConfigError
    from ..config.files.folders import make_folder
    from ..log.exporting.export_log import format_of

    if kind is None:
        if len(logs) > 1:
            raise click.UsageError(
                f"expected --format and a folder for {len(logs)} logs, found -o {out}"
            )
        return [(logs[0], out, format_of(out))]
    if len(logs) == 1 and out.suffix.lower() == f".{kind}":
        return [(logs[0], out, kind)]
    targets: dict[Path, Path] = {}
    for log in logs:
        path = out / f"{log.stem}.{kind}"
        if path in targets:
            raise ConfigError(
                f"{log} and {targets[path]} would both become {path}: export them into two folders"
            )
        targets[path] = log
    writable_folder(out, [path.name for path in targets])
    make_folder(out)
    return [(log, path, kind) for path, log in targets.items()]
