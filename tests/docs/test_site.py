"""The documentation's site is complete, and its build reports faults such as broken links."""

from __future__ import annotations

import html
import logging
import re
import shutil
from pathlib import Path

import pytest
from demandops.cli.authoring.schema import SCHEMAS
from demandops.cli.main import COMMANDS
from demandops_ros import node_parameters
from mkdocs.commands.build import build
from mkdocs.config import load_config

from tests.unit.messages.test_messages import FILE as MESSAGES

ROOT = Path(__file__).parents[2]
FAULTS = {
    "[gone](nowhere.md)": "contains a link 'nowhere.md'",
    "[gone](demand.md#nothing)": "does not contain an anchor '#nothing'",
    "[source](../Makefile)": "links to Makefile, which the site does not have",
    "A list:\n- lost": "a list or table is read as a paragraph",
    '<script src="https://cdn.example/x.js"></script>': "is fetched from another host",
}


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("NO_MKDOCS_2_WARNING", "1")
    return tmp_path / "site"


def test_the_reference_has_all_that_the_code_has(site: Path) -> None:
    build(load_config(str(ROOT / "mkdocs.yml"), site_dir=str(site)))
    assert (site / "recipes.html").read_text().count("fleet/inventory/nodes/vehicle07.yaml") == 1
    text = {path.stem: path.read_text() for path in (site / "generated").glob("*.html")}
    assert all(f'<h2 id="{name}">' in text["commands"] for name in COMMANDS)
    assert all(f'<h2 id="{name}">' in text["schemas"] for name in SCHEMAS)
    assert all(f"<code>{name}</code>" in text["ros"] for name in node_parameters.PARAMETERS)
    assert all(site.joinpath("schemas", f"{name}.json").is_file() for name in SCHEMAS)
    messages = MESSAGES.read_text().partition("\n# fields\n")[0]
    assert text["errors"].count("<br") + text["errors"].count("<tr>") - text["errors"].count(
        "<thead>"
    ) == messages.count("\n    ")
    raised = "there is no state repo yet, push one made by `demandops init DIR`"
    assert raised in html.unescape(re.sub(r"<[^>]+>", "", text["errors"]))


def test_what_would_be_lost_is_refused(
    site: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    docs = tmp_path / "docs"
    shutil.copytree(ROOT / "docs", docs)
    for number, fault in enumerate(FAULTS):
        docs.joinpath(f"unlisted{number}.md").write_text(f"# Page\n\n{fault}\n")
    config = load_config(
        str(ROOT / "mkdocs.yml"), docs_dir=str(docs), site_dir=str(site), strict=False
    )
    with caplog.at_level(logging.INFO, logger="mkdocs"):
        build(config)
    said = [record.getMessage() for record in caplog.records if record.levelno >= logging.INFO]
    for number, message in enumerate(FAULTS.values()):
        (one,) = [each for each in said if message in each]
        assert f"unlisted{number}.md" in one
    (unlisted,) = [each for each in said if "not included in the" in each]
    assert all(f"unlisted{number}.md" in unlisted for number in range(len(FAULTS)))
