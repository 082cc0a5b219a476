"""The message about a mistake in an appdef's values template names the template and the line."""

from __future__ import annotations

import json

import pytest
from demandops.base.errors import InvalidInput
from demandops.decide.state import try_configuration
from demandops.model.config.load import load

from tests.kit.config import configuration, skeleton, state_of
from tests.kit.goals import perception
from tests.kit.http import serving
from tests.kit.memory import MemoryRepo

TEMPLATE = "appdefs/object-detection-fusion/values/object-detection.yaml.j2"
CHART = "appdefs/object-detection-fusion/charts/object-detection"
TOPIC = "/vehicles/vehicle00/drivers/lidar/pointcloud"
LAST = skeleton()[TEMPLATE].count("\n") + 1
"""The number of the line that is appended to the template."""


def faults(template: str) -> list[str]:
    """Send a demand that needs this template, and return the faults for which it is refused."""
    books = MemoryRepo({TEMPLATE: template})
    before = dict(books.files)
    with pytest.raises(InvalidInput) as invalid:
        books.send(perception())
    assert books.files == before
    return [str(found) for found in invalid.value.faults]


def appended(text: str) -> list[str]:
    """Return the faults of the skeleton's template with ``text`` appended."""
    return faults(skeleton()[TEMPLATE] + text)


APPENDED: dict[str, tuple[str, str]] = {
    "a statement without end": ("{% if %}\n", "end of"),
    "an expression without end": ("x: {{ release \n", "end of"),
    "a block that is never closed": ("{% if true %}\n", "end of"),
    "a tag that does not exist": ("{% fro x in y %}\n", "'fro'"),
    "a filter that does not exist": ("x: {{ release | nope }}\n", "'nope'"),
    "a name that does not exist": ("x: {{ nope }}\n", "'nope'"),
    "a name below one that does not exist": ("x: {{ nope.x }}\n", "'nope'"),
    "a field that does not exist": ("x: {{ node.nope }}\n", "'nope'"),
    "a name that does not exist, in a condition": ("{% if nope %}{% endif %}\n", "'nope'"),
    "a name that does not exist, in a loop": ("{% for x in nope %}{% endfor %}\n", "'nope'"),
    "a way to Python's classes": ("x: {{ ''.__class__.__mro__ }}\n", "unsafe"),
    "a way to Python's classes by filter": ("x: {{ '' | attr('__class__') }}\n", "unsafe"),
    "a way to Python's classes by subscript": ("x: {{ ''['__class__'] }}\n", "unsafe"),
    "a way to Python's classes by format": ("x: {{ '{0.__class__}'.format(1) }}\n", "unsafe"),
    "a way to Python's classes by format_map": (
        "x: {{ '{a.__class__}'.format_map({'a': 1}) }}\n",
        "unsafe",
    ),
    "a way to a shell by a global": (
        "x: {{ cycler.__init__.__globals__.os.popen('id').read() }}\n",
        "unsafe",
    ),
    "a way to a shell by an undefined name": ("x: {{ nope.__init__.__globals__ }}\n", "unsafe"),
    "a change of what it is given": ("{% set x = node.update({'id': 'other'}) %}\n", "unsafe"),
    "two documents": ("---\na: b\n", "another document starts here; only one is allowed"),
    "a key twice": (
        "hostNetwork: true\n",
        "not valid YAML: the key 'hostNetwork' appears twice; remove one",
    ),
    "a loop without end": ("{% for i in range(1000000000) %}{% endfor %}\n", "Range too big"),
    "a division by nothing": ("x: {{ 1 / 0 }}\n", "zero"),
    "a value that YAML has no word for": (
        "x: {{ ''.join }}\n",
        "lists and mappings, but not a builtin_function_or_method; add '()' to call it",
    ),
    "a method that is not listed": (
        "x: {{ ''.swapcase() }}\n",
        "a template may not call the method 'swapcase'",
    ),
}
"""Lines of a template with a mistake, each with a word of Jinja's message."""


@pytest.mark.parametrize(
    ("text", "word"),
    APPENDED.values(),
    ids=APPENDED,
)
def test_a_mistake_is_told_with_template_and_line(text: str, word: str) -> None:
    (found,) = appended(text)
    assert found.startswith(f"{TEMPLATE}:{LAST}: ")
    assert word.lower() in found.lower()
    assert found.endswith("; fix the template")


@pytest.mark.parametrize(
    "text",
    [
        "{% macro a() %}{{ a() }}{% endmacro %}{{ a() }}\n",
        "{% include '" + TEMPLATE + "' %}\n",
        "{% extends '" + TEMPLATE + "' %}\n",
        "{% import '" + TEMPLATE + "' as x %}\n",
        "x: {{ self }}\n",
        "x: {{ cycler }}\n",
        "{{ caller() }}\n",
        "{% set x = [1][5] %}{{ x }}\n",
        *(f"podLabels: {{{key}: x}}\n" for key in ("5", "~", "true", "1.5")),
    ],
)
def test_whatever_a_template_does_it_is_told_as_the_templates_fault(text: str) -> None:
    (found, *_) = appended(text)
    assert found.startswith(f"{TEMPLATE}:")


def test_a_text_that_no_cluster_takes_is_the_templates_fault() -> None:
    (found,) = appended("x: {{ 'a' * 1000001 }}\n")
    assert "at most 1000000 are allowed" in found


@pytest.mark.parametrize(
    "expression",
    [
        "[1, 2] | random",
        "lipsum()",
        "namespace() | string",
        "'' ~ [''.join]",
        "'%s' % [cycler(1)]",
        "'{}'.format(joiner())",
        "[cycler(1)] | map('string')",
        "'a' | replace('a', joiner())",
    ],
)
def test_nothing_random_gets_into_a_value(expression: str) -> None:
    (found,) = appended("x: {{ " + expression + " }}\n")
    assert found.startswith(f"{TEMPLATE}:{LAST}: ")


def test_formats_of_usual_size_work() -> None:
    used = (
        "[{{ '%03d' % 7 }}, {{ '{:>5}'.format(1) }}, {{ 'a'.ljust(8) }}, {{ 'a' | indent(4) }}, "
        "{{ '%s' | format(1) }}, {{ 7 % 4 }}]"
    )
    assert appended("extra: " + used + "\n") == [
        f"{TEMPLATE}: values: Additional properties are not allowed ('extra' was unexpected); "
        f"fix the template or {CHART}"
    ]


def test_a_file_that_it_includes_and_that_does_not_exist_is_told() -> None:
    for name in ("other.yaml.j2", "../../../../etc/passwd", "/etc/passwd", "demandops.yaml"):
        (found,) = appended("{% include '" + name + "' %}\n")
        assert found.startswith(f"{TEMPLATE}:{LAST}: ")
        assert "root:" not in found
        assert not found.startswith(f"{TEMPLATE}:{LAST}: {name}; "), (
            "the message does not say what is wrong"
        )


class TestValues:
    """The result of a template is parsed, and checked against the chart's schema."""

    def test_every_value_that_does_not_fit(self) -> None:
        text = skeleton()[TEMPLATE].replace("replicas: {{ replicas }}", "replicas: many")
        text = text.replace("hostNetwork: {{ node.host_network }}", "hostNetwork: maybe")
        assert self.places(faults(text)) == ["values.hostNetwork", "values.replicas"]

    def test_a_value_that_is_missing(self) -> None:
        text = skeleton()[TEMPLATE].replace("{{ source_topic }}", "null")
        (found,) = faults(text)
        assert self.places([found]) == ["values.detection"]
        assert '"pointCloudTopic"' in found

    @staticmethod
    def places(found: list[str]) -> list[str]:
        assert all(one.endswith(f"; fix the template or {CHART}") for one in found)
        assert all(one.startswith(f"{TEMPLATE}:") for one in found)
        return sorted(one.split(": ")[1] for one in found)

    def test_text_glued_to_a_value_does_not_become_another_value(self) -> None:
        """``/prefix{{ topic }}`` gives ``/prefix"/points"``: the quotes are part of the text."""
        text = skeleton()[TEMPLATE].replace("{{ source_topic }}", "/prefix{{ source_topic }}")
        (found,) = faults(text)
        assert found.startswith(
            rf'{TEMPLATE}:{LAST - 2}: values.detection.pointCloudTopic: "/prefix\"{TOPIC}\"'
        )

    def test_a_value_in_quotes_is_no_yaml(self) -> None:
        text = skeleton()[TEMPLATE].replace("{{ source_topic }}", '"{{ source_topic }}"')
        (found,) = faults(text)
        assert found.startswith(f"{TEMPLATE}:{LAST - 2}: line ")
        assert found.endswith("; fix the template")
        assert " of the rendered text: not valid YAML: " in found

    @pytest.mark.parametrize("text", ["", "- a\n", "true\n", "{# nothing #}", "~\n"])
    def test_no_mapping(self, text: str) -> None:
        assert faults(text) == [f"{TEMPLATE}: must give a mapping of Helm values"]

    @pytest.mark.parametrize("end", ["\\n", "\\n\\n", "\\n\\n\\n", "", " \\n"])
    def test_a_text_of_several_lines_stays_as_it_is(self, end: str) -> None:
        books = MemoryRepo(
            {TEMPLATE: skeleton()[TEMPLATE] + f'podAnnotations: {{a: "x\\ny{end}"}}\n'}
        )
        books.send(perception())
        release = books.objects("HelmRelease")["od-edge-vehicle00"]
        text = f"x\\ny{end}".replace("\\n", "\n")
        assert release["spec"]["values"]["podAnnotations"] == {"a": text}


class TestSchema:
    """Validation by a chart's schema reads no other file."""

    def faults(self, schema: object) -> list[str]:
        text = schema if isinstance(schema, str) else json.dumps(schema)
        books = MemoryRepo({f"{CHART}/values.schema.json": text})
        with pytest.raises(InvalidInput) as invalid:
            books.send(perception())
        return [str(found) for found in invalid.value.faults]

    @pytest.mark.parametrize("scheme", ["http", "file", ""])
    def test_a_reference_out_of_the_document_is_not_followed(self, scheme: str) -> None:
        with serving() as server:
            target = {"http": server.url, "file": "file:///etc/passwd", "": "secret.json"}[scheme]
            found = self.faults({"properties": {"image": {"allOf": [{"$ref": target}]}}})
        assert found == [
            f"{CHART}/values.schema.json: properties.image.allOf[0].$ref: '{target}' is outside "
            "this file; only references that start with '#' are followed, so copy the definition "
            "here"
        ]
        assert server.calls == []

    @pytest.mark.parametrize("pattern", ["^(a+)+$", "^(a|a)*$", "^(a*)*b"])
    def test_a_pattern_ends_soon_on_any_text(self, pattern: str) -> None:
        schema = {"properties": {"podLabels": {"propertyNames": {"pattern": pattern}}}}
        path, labels = f"{CHART}/values.schema.json", f"podLabels: {{'{'a' * 900}!': x}}\n"
        books = MemoryRepo({path: json.dumps(schema), TEMPLATE: skeleton()[TEMPLATE] + labels})
        with pytest.raises(InvalidInput, match=r"values\.podLabels"):
            books.send(perception())

    def test_a_schema_may_refer_to_itself_for_parts(self) -> None:
        tree = {"properties": {"image": {"$ref": "#"}, "ros": {"$ref": "#top"}}, "$anchor": "top"}
        MemoryRepo({f"{CHART}/values.schema.json": json.dumps(tree)}).send(perception())

    @pytest.mark.parametrize(
        "schema",
        [
            {"properties": {"image": {"$id": "https://example.invalid/other"}}},
            {"$defs": {"a": {"$id": "#a"}}},
            {
                "$schema": "http://json-schema.org/draft-04/schema#",
                "properties": {"image": {"id": "https://example.invalid/other"}},
            },
        ],
        ids=["of a property", "of a definition", "as draft 4 writes it"],
    )
    def test_an_id_below_the_root_would_change_what_references_mean(self, schema: object) -> None:
        (found,) = self.faults(schema)
        assert "only the whole schema may have an id" in found

    @pytest.mark.parametrize("pattern", ["^(?=(a+)+b)", r"(a)\1", "(?<!a)b"])
    def test_a_pattern_that_must_track_back_is_a_fault(self, pattern: str) -> None:
        (found,) = self.faults({"properties": {"image": {"pattern": pattern}}})
        assert "look-around" in found


class TestBeforeTheFirstDemand:
    """``demandops check`` renders every service once, although nobody demands it."""

    def rehearsal(self, changed: dict[str, str | None]) -> list[str]:
        with pytest.raises(InvalidInput) as invalid:
            try_configuration(state_of(load(configuration(changed))))
        return [str(found) for found in invalid.value.faults]

    def test_a_template_that_nobody_has_demanded_is_checked(self) -> None:
        text = skeleton()[TEMPLATE] + "x: {{ nope }}\n"
        assert self.rehearsal({TEMPLATE: text}) == [
            f"{TEMPLATE}:{LAST}: 'nope' is undefined; fix the template"
        ]

    def test_all_templates_are_checked_together(self) -> None:
        other = TEMPLATE.replace("detection.yaml", "fusion.yaml")
        change = {path: skeleton()[path] + "x: {{ nope }}\n" for path in (TEMPLATE, other)}
        assert [found.split(":")[0] for found in self.rehearsal(dict(change))] == [TEMPLATE, other]

    def test_the_configuration_of_init_passes(self) -> None:
        try_configuration(state_of(load(configuration())))
