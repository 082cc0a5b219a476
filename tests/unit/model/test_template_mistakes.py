"""The message about a mistake in an appdef's values template names the template and the line."""

from __future__ import annotations

import json
from collections.abc import Mapping
from operator import itemgetter
from typing import Any

import pytest
from demandops.base.errors import InvalidInput
from demandops.decide.state import try_configuration
from demandops.model.config.load import load

from tests.kit import plain_yaml
from tests.kit.config import configuration, skeleton, state_of
from tests.kit.goals import perception
from tests.kit.http import serving
from tests.kit.memory import MemoryRepo
from tests.unit.model.test_config_mistakes import APPDEF, changed

TEMPLATE = "appdefs/object-detection-fusion/values/object-detection.yaml.j2"
SCHEMA = "appdefs/object-detection-fusion/charts/object-detection/values.schema.json"
LAST = skeleton()[TEMPLATE].count("\n") + 1  # the line that is appended to the template
LISTED = plain_yaml.beside(__file__, "template-mistakes")


def refused(changed: Mapping[str, str | None]) -> list[str]:
    """Send a demand that needs the template, and return the faults for which it is refused."""
    books = MemoryRepo(changed)
    before = dict(books.files)
    with pytest.raises(InvalidInput) as invalid:
        books.send(perception())
    assert books.files == before
    return [str(found) for found in invalid.value.faults]


def appended(text: str) -> list[str]:
    """Return the faults of the skeleton's template with ``text`` appended."""
    return refused({TEMPLATE: skeleton()[TEMPLATE] + text})


@pytest.mark.parametrize(
    ("word", "text"), [(word, text) for word, texts in LISTED["lines"].items() for text in texts]
)
def test_a_mistake_is_told_with_template_and_line(word: str, text: str) -> None:
    (found,) = appended(f"{text}\n")
    assert found.startswith(f"{TEMPLATE}:{LAST}: ")
    assert word.lower() in found.lower()
    assert found.endswith("; fix the template")


@pytest.mark.parametrize(("text", "word"), LISTED["without end"])
def test_a_template_without_end_is_told(text: str, word: str) -> None:
    (found, *_) = appended(text.replace("ITSELF", f"'{TEMPLATE}'"))
    assert found.startswith(f"{TEMPLATE}:")
    assert word in found


def test_a_file_that_it_includes_and_that_does_not_exist_is_told() -> None:
    for name in ("other.yaml.j2", "../../../../etc/passwd", "/etc/passwd", "demandops.yaml"):
        (found,) = appended("{% include '" + name + "' %}\n")
        assert found.startswith(f"{TEMPLATE}:{LAST}: ")
        assert "root:" not in found
        # the message says more than the name
        assert not found.startswith(f"{TEMPLATE}:{LAST}: {name}; ")


def with_parameters(value: object) -> dict[str, str]:
    """Return files in which a node gets its ROS parameters from the parameter `net`."""
    net = json.dumps({"net": {"default": value}})
    text = skeleton()[APPDEF].replace("\nservices:", f"\nparameters: {net}\nservices:")
    template = skeleton()[TEMPLATE] + "parameters:\n  node: {{ parameters.net }}\n"
    return {APPDEF: text, TEMPLATE: template}


@pytest.mark.parametrize(("value", "place", "told"), LISTED["ros parameters"]["refused"])
def test_what_ros_cannot_carry_is_refused_with_the_parameter_that_it_comes_from(
    value: object, place: str, told: str
) -> None:
    (found,) = refused(with_parameters(value))
    assert found.startswith(f"{TEMPLATE}:{LAST + 1}: values.parameters.node.{place}: ")
    assert told in found
    assert found.endswith(", or demand another value of the parameter net")


def test_numbers_keep_their_type_on_the_way_through_json() -> None:
    given, written = LISTED["ros parameters"]["taken"]
    books = MemoryRepo(with_parameters(given))
    books.send(perception())
    release = books.objects("HelmRelease")["od-edge-vehicle00"]
    assert release["spec"]["values"]["parameters"] == {"node": written}


@pytest.mark.parametrize("case", LISTED["edited"], ids=itemgetter("is"))
def test_values_that_do_not_fit_are_told_with_their_lines(case: dict[str, Any]) -> None:
    found = refused(changed({path: case[path] for path in (TEMPLATE, APPDEF) if path in case}))
    for (line, word), one in zip(case["told"], sorted(found), strict=True):
        assert one.startswith(f"{TEMPLATE}:{line}: " if line else f"{TEMPLATE}: values: ")
        assert word in one


def test_a_template_must_give_a_mapping() -> None:
    for text in ("", "- a\n", "true\n", "{# nothing #}", "~\n"):
        assert refused({TEMPLATE: text}) == [f"{TEMPLATE}: must give a mapping of Helm values"]


@pytest.mark.parametrize("end", ["\\n", "\\n\\n\\n", "", " \\n"])
def test_a_text_of_several_lines_stays_as_it_is(end: str) -> None:
    books = MemoryRepo({TEMPLATE: skeleton()[TEMPLATE] + f'podAnnotations: {{a: "x\\ny{end}"}}\n'})
    books.send(perception())
    release = books.objects("HelmRelease")["od-edge-vehicle00"]
    text = f"x\\ny{end}".replace("\\n", "\n")
    assert release["spec"]["values"]["podAnnotations"] == {"a": text}


@pytest.mark.parametrize(
    ("word", "schema"), [(word, one) for word, all_ in LISTED["schemas"].items() for one in all_]
)
def test_a_schema_that_reads_elsewhere_or_does_not_end_is_refused(
    word: str, schema: dict[str, Any]
) -> None:
    labels = f"podLabels: {{'{'a' * 900}!': x}}\n"
    changed = {SCHEMA: json.dumps(schema), TEMPLATE: skeleton()[TEMPLATE] + labels}
    (found,) = refused(changed)
    assert word in found


def test_a_schema_reads_no_url_but_may_refer_to_itself_for_parts() -> None:
    with serving() as server:
        (found,) = refused({SCHEMA: json.dumps({"properties": {"image": {"$ref": server.url}}})})
    assert f"'{server.url}' is outside this file" in found
    assert server.calls == []
    tree = {"properties": {"image": {"$ref": "#"}, "ros": {"$ref": "#top"}}, "$anchor": "top"}
    MemoryRepo({SCHEMA: json.dumps(tree)}).send(perception())


def test_check_renders_all_templates_although_nobody_demands_them() -> None:
    try_configuration(state_of(load(configuration())))
    both = (TEMPLATE, TEMPLATE.replace("detection.yaml", "fusion.yaml"))
    changed = {path: skeleton()[path] + "x: {{ nope }}\n" for path in both}
    with pytest.raises(InvalidInput) as invalid:
        try_configuration(state_of(load(configuration(dict(changed)))))
    assert [str(found).split(":")[0] for found in invalid.value.faults] == [*both]


def test_each_listed_version_is_rendered_before_anybody_asks_for_it() -> None:
    with pytest.raises(InvalidInput) as invalid:
        try_configuration(MemoryRepo(changed(LISTED["a version"])).state)
    (found,) = invalid.value.faults
    assert found.file == "appdefs/object-detection-fusion/values/object-fusion.yaml.j2"
    assert '"missing" is a required property' in found.message
