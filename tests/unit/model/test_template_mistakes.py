"""The message about a mistake in an appdef's values template names the template and the line."""

from __future__ import annotations

import json
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

TEMPLATE = "appdefs/object-detection-fusion/values/object-detection.yaml.j2"
APPDEF = "appdefs/object-detection-fusion/appdef.yaml"
CHART = "appdefs/object-detection-fusion/charts/object-detection"
SCHEMA = f"{CHART}/values.schema.json"
LAST = skeleton()[TEMPLATE].count("\n") + 1
"""The number of the line that is appended to the template."""
LISTED = plain_yaml.beside(__file__, "template-mistakes")


def refused(changed: dict[str, str]) -> list[str]:
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


def test_formats_of_usual_size_work() -> None:
    used = (
        "[{{ '%03d' % 7 }}, {{ '{:>5}'.format(1) }}, {{ 'a'.ljust(8) }}, {{ 'a' | indent(4) }}, "
        "{{ '%s' | format(1) }}, {{ 7 % 4 }}]"
    )
    (found,) = appended(f"extra: {used}\n")
    assert "('extra' was unexpected)" in found


def test_a_file_that_it_includes_and_that_does_not_exist_is_told() -> None:
    for name in ("other.yaml.j2", "../../../../etc/passwd", "/etc/passwd", "demandops.yaml"):
        (found,) = appended("{% include '" + name + "' %}\n")
        assert found.startswith(f"{TEMPLATE}:{LAST}: ")
        assert "root:" not in found
        # the message says more than the name
        assert not found.startswith(f"{TEMPLATE}:{LAST}: {name}; ")


def test_every_value_that_does_not_fit_the_charts_schema_is_told() -> None:
    text = skeleton()[TEMPLATE].replace("replicas: {{ replicas }}", "replicas: many")
    found = refused({TEMPLATE: text.replace("{{ node.host_network }}", "maybe")})
    assert all(one.startswith(f"{TEMPLATE}:") for one in found)
    assert all(one.endswith(f"; fix the template or {CHART}") for one in found)
    places = sorted(one.split(": ")[1] for one in found)
    assert places == ["values.hostNetwork", "values.replicas"]


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


@pytest.mark.parametrize(("text", "above", "word"), LISTED["topics"])
def test_a_topic_that_the_schema_or_yaml_does_not_take(text: str, above: int, word: str) -> None:
    (found,) = refused({TEMPLATE: skeleton()[TEMPLATE].replace("{{ source_topic }}", text)})
    assert found.startswith(f"{TEMPLATE}:{LAST - above}: ")
    assert word in found


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
    folder = "appdefs/object-detection-fusion/charts/next"
    next = f"    channels: {{next: {{folder: {folder}, version: 9.0.0}}}}\n"
    chart = {
        f"{folder}/Chart.yaml": "apiVersion: v2\nname: object-fusion\nversion: 9.0.0\n",
        f"{folder}/values.schema.json": json.dumps({"required": ["missing"]}),
        "registry/charts.yaml": skeleton()["registry/charts.yaml"] + next,
    }
    pinned = {"1.0.0": {}, "3.0.0": {"charts": {"object-fusion": "9.0.0"}}}
    versions = {"apiVersion": "demandops/v1", "kind": "Versions"}
    versions |= {
        "applications": {"object-detection-fusion": {"default": "1.0.0", "versions": pinned}}
    }
    files = chart | {"registry/versions.yaml": json.dumps(versions)}
    with pytest.raises(InvalidInput) as invalid:
        try_configuration(MemoryRepo(files).state)
    (found,) = invalid.value.faults
    assert found.file == "appdefs/object-detection-fusion/values/object-fusion.yaml.j2"
    assert '"missing" is a required property' in found.message
