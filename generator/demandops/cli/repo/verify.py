"""``demandops verify``: a proof that commits match their ledger and configuration."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict

import click

from demandops.cli.json_output import Json, output_option, show
from demandops.cli.output import progress
from demandops.cli.target import state_repo_option
from demandops.errors import fault
from demandops.evaluator.process import processor_time
from demandops.staterepo import reader
from demandops.staterepo.audit.verification import Verdict


@click.command()
@click.argument("revisions", required=False, metavar="[REV|A..B]")
@state_repo_option
@click.option(
    "--whole",
    is_flag=True,
    help="Load and render each commit completely. Without this option, each commit between the "
    "first and the last is verified by its differences from the commit before it.",
)
@output_option
def verify(revisions: str | None, state_repo: str, whole: bool, output: str) -> None:
    """Render commits again from their ledger and compare the bytes.

    REV names one commit, A..B the commits after A up to B; default: the newest commit. REV, A and B
    are commits or times. Once the state repo has policy/allowed-signers, each further commit of the
    generator must have a good signature. The version of this file in the commit's parent must list
    the signing key (docs/audit.md).

    \b
    Examples:
      demandops verify
      demandops verify main~50..main
      demandops verify main --whole
    """
    # what was rendered once must not fail here because this machine is slower
    with (
        processor_time(each=60),
        reader.opened(state_repo) as repo,
        progress("rendering again") as report,
    ):
        verdicts = repo.verify(repo.revisions(revisions), whole=whole, progress=report)
    rows: list[Json] = []
    for verdict in verdicts:
        row = {name: None if value == "" else value for name, value in asdict(verdict).items()}
        message = row.pop("fault")
        rows.append(row | {"faults": [asdict(fault("", message))] if message else []})
    show(output, rows, _lines(verdicts))
    if not all(verdict.holds for verdict in verdicts):
        raise click.exceptions.Exit(1)


def _lines(verdicts: list[Verdict]) -> Iterator[str]:
    for verdict in verdicts:
        word = "skipped" if verdict.skipped else "verified"
        if not verdict.holds:
            differs = verdict.fault or verdict.differing or verdict.touched
            word = "DIFFERS" if differs else "UNSIGNED"
        note = f" ({verdict.skipped})" if verdict.skipped else ""
        yield f"{verdict.commit[:10]} {word}{note}  {verdict.summary}"
        if verdict.fault:
            yield f"    the ledger of this commit can no longer be rendered: {verdict.fault}"
        yield from (f"    {path}" for path in verdict.differing)
        yield from (f"    {path} (this commit must not change it)" for path in verdict.touched)
        if verdict.signature:
            yield f"    it {verdict.signature}"
    skipped = sum(bool(verdict.skipped and verdict.holds) for verdict in verdicts)
    verified = sum(verdict.holds for verdict in verdicts) - skipped
    note = f", {skipped} skipped" if skipped else ""
    yield f"{verified} of {len(verdicts)} commits are verified{note}"
    signed = sum(verdict.signed for verdict in verdicts)
    if signed:
        good = sum(bool(verdict.signer) for verdict in verdicts)
        listed = f", {good} by keys that policy/allowed-signers lists" if good else ""
        yield f"{signed} of {len(verdicts)} are signed{listed}"
