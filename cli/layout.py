"""`levid layout`: write layouts of Foxglove and PlotJuggler for a rig."""

from __future__ import annotations

from pathlib import Path

import click

from .path_types import FOLDER, RIG


@click.command("layout")
@click.argument("rig", type=RIG)
@click.option(
    "--out",
    type=FOLDER,
    default=Path(),
    help="Folder for the layouts. Default: this folder.",
)
def command(rig: Path, out: Path) -> int:
    """Write foxglove.json and plotjuggler.xml, layouts with the coils and sensors of RIG.yaml.

    They show the live stream and logs.

    \b
    Examples:
      levid layout loopback --out layouts
    """
    from ..config.files.atomic_write import write_file
    from ..config.files.folders import make_folder
    from ..config.rig import load_rig
    from ..log.errors import LogError, reason
    from ..log.viewer_layouts import layouts

    geometry = load_rig(rig).geometry
    texts = layouts(len(geometry.coil_x_m), len(geometry.sensors_x_m))
    try:
        make_folder(out)
        for name, text in texts.items():
            write_file(out / name, text)
            click.echo(f"{out / name}: written")
    except OSError as error:
        raise LogError(f"{out}: cannot be written: {reason(error)}") from None
    return 0
