"""``demandops version``: the versions of the program and of the formats that it writes."""

from __future__ import annotations

import platform
import shutil
import subprocess

import click

from demandops import __version__, settings
from demandops.cli.json_output import output_option, show


@click.command()
@output_option
def version(output: str) -> None:
    """Print the versions of the program and of its formats.

    The render version says how the program renders the files in `clusters/`. A generator refuses a
    state repo of another render version. If the repo's version is older, run `demandops upgrade`;
    if it is newer, update the generator.

    \b
    Examples:
      demandops version
      demandops version -o json
    """
    git = None
    if shutil.which("git"):
        told = subprocess.run(["git", "--version"], capture_output=True, text=True, check=False)
        git = told.stdout.strip().removeprefix("git version ") or None
    data = {
        "version": __version__,
        "render_version": settings.RENDER_VERSION,
        "api_version": settings.API_VERSION,
        "ledger_api_version": settings.LEDGER_API_VERSION,
        "python": platform.python_version(),
        "git": git,
    }
    names = {"version": "demandops"}
    lines = [
        f"{names.get(name, name.replace('_', ' ')):18} {value}" for name, value in data.items()
    ]
    show(output, data, lines)
