"""What mkdocs runs while it builds the site (mkdocs.yml).

It adds the pages that are generated from the code and those of the project's root, and lists the
decisions. It warns of links, lists and tables that the site would not show as such. A warning makes
the build fail.
"""

from __future__ import annotations

import logging
import posixpath
import re
from collections.abc import Iterator
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from docs_site import commands, errors, interfaces, schemas, vocabulary

ROOT = Path(__file__).parents[1]
GENERATED = {
    "generated/commands.md": commands.page,
    "generated/schemas.md": schemas.page,
    "generated/json.md": vocabulary.page,
    "generated/ros.md": interfaces.page,
    "generated/errors.md": errors.page,
}
OF_THE_ROOT = {
    "README.md": "index.md",
    "CHANGELOG.md": "project/changelog.md",
    "ARCHITECTURE.md": "project/architecture.md",
    "CONTRIBUTING.md": "project/contributing.md",
    "appdefs/charts/ros-service/README.md": "project/ros-service.md",
    "examples/experiment/rules.yaml": "project/rules.yaml",
    "examples/experiment/unlisted/rules.yaml": "project/unlisted-rules.yaml",
    "examples/lane-detection/README.md": "project/lane-detection.md",
    "examples/lane-detection/appdefs/lane-detection/charts/ros-launch/README.md": (
        "project/ros-launch.md"
    ),
    "examples/experiment/full/README.md": "project/experiment.md",
    "tests/README.md": "project/tests.md",
    "tests/scenarios/README.md": "project/scenarios.md",
    "tests/e2e/README.md": "project/e2e.md",
    "tests/e2e/PROOF.md": "project/e2e-proof.md",
    "tests/e2e/rig/README.md": "project/e2e-rig.md",
}
"""The pages and files outside of docs/ that pages link to, each with its path on the site."""

_LINK = re.compile(r"(?<=\]\()(?!\w+:)([^)#\s]+)(#[^)\s]*)?(?=\))")
_CODE = re.compile(r"^```[\s\S]*?^```|^(?: {4}|\t).*$|`[^`\n]+`", re.MULTILINE)
_BAR = re.compile(r"`[^`\n]*\\\|[^`\n]*`")
# The path above a file's block. Forges need it, because they do not show the block's title.
_PATH = re.compile(r"^`([^`\n]+)`:\n\n(?=```\w* title=\"\1\")", re.MULTILINE)
# A paragraph that begins like a list or a table: Markdown did not recognize the list or table.
_LOST = re.compile(r"<p>(?:[-*|] |\d+\. )|<p>[^<]*\n(?:[-*|] |\d+\. )")
_OTHER_HOST = re.compile(
    r"<(?:script|link|img|iframe|source)\b[^>]*(?:src|href)=\"?(?:https?:)?//[^ >]*"
)
_log = logging.getLogger("mkdocs.hooks.docs_site")


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Replace each folder in the navigation, such as `decisions/`, by its files."""
    config["nav"] = _with_folders(config.nav, Path(config.docs_dir))
    return config


def _with_folders(entry: object, docs: Path) -> object:
    if isinstance(entry, dict):
        return {title: _with_folders(inner, docs) for title, inner in entry.items()}
    if isinstance(entry, list):
        return [_with_folders(inner, docs) for inner in entry]
    if not isinstance(entry, str) or not entry.endswith("/"):
        return entry
    return sorted(f"{entry}{page.name}" for page in docs.joinpath(entry).glob("*.md"))


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages, the JSON Schemas and the pages of the root."""
    for path, make in GENERATED.items():
        files.append(File.generated(config, path, content=make()))
    for path, text in schemas.json_files().items():
        files.append(File.generated(config, path, content=text))
    for source, path in OF_THE_ROOT.items():
        text = _moved(ROOT.joinpath(source).read_text(), source, path)
        files.append(File.generated(config, path, content=text))
    return files


def on_page_markdown(markdown: str, page: Page, **_: object) -> str:
    """Adapt a page's Markdown to the site.

    A link out of docs/ leads to the site's page. In code, `\\|` becomes `|`, as the forges show it.
    The path above a file's block, which only the forges need, is removed: here it is the block's
    title.
    """
    if page.file.src_uri not in (*OF_THE_ROOT.values(), *GENERATED):
        markdown = _moved(markdown, f"docs/{page.file.src_uri}", page.file.src_uri)
    markdown = _PATH.sub("", markdown)
    return _BAR.sub(lambda code: code[0].replace("\\|", "|"), markdown)


def _moved(markdown: str, source: str, path: str) -> str:
    """Return a page's Markdown with the links changed for the site.

    ``source`` is the page's path in the repository, ``path`` its path on the site.
    """

    def rewritten(link: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(posixpath.dirname(source), link[1]))
        if link[1].endswith("/"):
            target += "/"
        if target in OF_THE_ROOT:
            there = OF_THE_ROOT[target]
        elif target == "docs/decisions/":
            there = "decisions/0002-names.md"
        elif target.startswith("docs/"):
            there = target.removeprefix("docs/")
        else:
            _log.warning("%s links to %s, which the site does not have", source, target)
            return link[0]
        return posixpath.relpath(there, posixpath.dirname(path)) + (link[2] or "")

    parts = []
    for text, is_code in _split(markdown):
        parts.append(text if is_code else _LINK.sub(rewritten, text))
    return "".join(parts)


def _split(markdown: str) -> Iterator[tuple[str, bool]]:
    """Yield the parts of a page, and whether each is code."""
    end = 0
    for code in _CODE.finditer(markdown):
        yield markdown[end : code.start()], False
        yield code[0], True
        end = code.end()
    yield markdown[end:], False


def on_page_content(html: str, page: Page, **_: object) -> str:
    """Warn of a list or a table that would be shown as a paragraph."""
    for lost in _LOST.finditer(html):
        text = html[lost.start() : lost.start() + 120].replace("\n", " ")
        _log.warning("%s: a list or table is read as a paragraph: %s", page.file.src_uri, text)
    return html


def on_post_page(output: str, page: Page, **_: object) -> str:
    """Warn of everything that a browser would fetch from another host."""
    for found in _OTHER_HOST.finditer(output):
        _log.warning("%s: is fetched from another host: %s", page.file.src_uri, found[0])
    return output
