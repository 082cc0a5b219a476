"""The answer of ``demandops why`` as text."""

from __future__ import annotations

from collections.abc import Iterator

from demandops.cli.json_output import Json, time_text
from demandops.config.durations import duration_text

_OF_RELEASES = {"node": "runs", "appdef": "runs", "override": "applies to"}


def lines_of(answer: Json) -> Iterator[str]:
    runs = answer["runs"]
    yield f"{answer['kind']} {answer['name']} {_state(answer)} at {answer['commit'][:10]}"
    if runs or answer["kind"] in ("node", "appdef", "override"):
        yield f"  what        {answer['what']}"
    if runs and "node" in answer:
        yield (
            f"  where       node {answer['node']}, cluster {answer['cluster']}, namespace "
            f"{answer['namespace']}, access domain {answer['domain']}"
        )
    if answer["file"]:
        yield f"  file        {answer['file']}"
    for reason in answer["missing_inputs"]:
        yield f"  missing     {reason}"
    for path in answer["not_rendered"]:
        yield f"  pending     a generator has yet to write or remove {path}"
    if answer.get("denied_by"):
        yield f"  denied by   {_override_text(answer['denied_by'])}"
    for each in answer.get("releases", ()) if runs else ():
        word = _OF_RELEASES.get(answer["kind"], "needs")
        yield f"  {word:11} {each['name']} on {each['node']} ({each['file']})"
    if answer.get("claims"):
        yield from _claim_lines(answer["claims"])
    if answer.get("shaped_by"):
        yield "configured by"
        for each in answer["shaped_by"]:
            entry = f" {each['entry']}" if each["entry"] else ""
            yield f"  {each['file']}{entry}: {each['what']}"
    if answer.get("overrides"):
        yield "overridden by"
        yield from (f"  {_override_text(each)}" for each in answer["overrides"])
    yield from _history_lines(answer)


def _state(answer: Json) -> str:
    """Return the predicate of the first line, such as ``runs`` or ``is suspended``."""
    runs, kind = answer["runs"], answer["kind"]
    if kind in ("file", "claim") and not runs:
        return "no longer exists" if answer["stopped"] else "exists"
    if kind in ("demand", "requester"):
        return "holds claims" if runs else "is suspended" if answer["claims"] else "holds nothing"
    if kind == "node":
        return "is used" if runs else "is not used"
    if kind == "override":
        nothing = answer["state"] == "matches nothing"
        return "has no effect now" if nothing else f"is {answer['state']}"
    return "runs" if runs else "does not run"


def _claim_lines(claims: list[Json]) -> Iterator[str]:
    yield "requested by"
    for claim in claims:
        lease, subject = claim["lease"], f"{claim['subject']['kind']} '{claim['subject']['id']}'"
        until = f", lease of {duration_text(lease['seconds'])}" if lease else ""
        if lease:
            until += f" until {time_text(lease['until'])}" if lease["until"] else ", not started"
        until += (
            ", which has passed; a generator has yet to release the claim"
            if claim["overdue"]
            else ""
        )
        version = f", version {claim['version']}" if claim["version"] else ""
        yield f"  {', '.join(claim['requesters'])} since {time_text(claim['since'])}, for {subject}"
        yield f"    demand {claim['demand']}, request '{claim['request']}'{version}{until}"
        yield f"    {claim['file']}"
        if claim["place"] is not None:
            required = ", ".join(f"{name} {value}" for name, value in claim["place"].items())
            yield f"    the demand requires of the application's node: {required or 'nothing'}"
        if claim["services"]:
            nodes = ", ".join(f"{name} on {node}" for name, node in claim["services"].items())
            yield f"    services on nodes of their own: {nodes}"
        if claim["suspended_by"]:
            yield f"    suspended by {_override_text(claim['suspended_by'])}"
        if claim["kept_by"]:
            yield f"    kept by {_override_text(claim['kept_by'])}"
            yield f"    to release it: {claim['release_by']} by pull request"
        else:
            yield (
                f"    to release it: {claim['release_by']}, or delete the claim's file by pull "
                "request"
            )


def _override_text(override: Json) -> str:
    until = f", until {time_text(override['until'])}" if override["until"] else ""
    return (
        f"{override['file']}: {', '.join(override['effects'])} (priority "
        f"{override['priority']}{until}), of {override['owner']}: {override['reason']}"
    )


def _history_lines(answer: Json) -> Iterator[str]:
    if answer["stopped"]:
        yield "stopped by"
        yield from _commit_lines(answer["stopped"], why=True)
    if answer["changes"]:
        yield "changed by"
        for entry in answer["changes"]:
            yield from _commit_lines(entry, why=False)
    if answer["more_changes"]:
        git_log = f", or run git log -- {answer['file']}" if answer["file"] else ""
        yield f"  and {answer['more_changes']} earlier commits; to see them, raise -n{git_log}"
    if answer["started"]:
        yield "started by"
        yield from _commit_lines(answer["started"], why=True)


def _commit_lines(entry: Json, *, why: bool) -> Iterator[str]:
    when, word = time_text(entry["time"]), entry["operation"] or "by hand"
    yield f"  {entry['commit'][:10]} {when}  {word}, {entry['author']}: {entry['summary']}"
    if why and entry["why"]:
        yield f"    {entry['why']}"
    for each in entry["carries_out"]:
        yield f"    carries out commit {each['commit'][:10]} of {each['author']}: {each['summary']}"
