"""Helm's output becomes faults with file and line; the texts here are those of helm 4."""

from __future__ import annotations

import pytest
from demandops.repo.pull_request.helm import parsed_error, parsed_kinds, parsed_lint


@pytest.mark.parametrize(
    ("err", "file", "line", "said"),
    [
        (
            "Error: parse error at (camera/templates/service.yaml:7): unclosed action\n\n"
            "Use --debug flag to render out invalid YAML\n",
            "camera/templates/service.yaml",
            7,
            "parse error at (camera/templates/service.yaml:7): unclosed action",
        ),
        (
            "Error: execution error at (camera/charts/ros-service/templates/_names.tpl:31:4): no",
            "camera/charts/ros-service/templates/_names.tpl",
            31,
            "execution error at (camera/charts/ros-service/templates/_names.tpl:31:4): no",
        ),
        (
            "level=WARN msg=x\nError: cannot load values.yaml: error converting YAML to JSON",
            "camera",
            None,
            "cannot load values.yaml: error converting YAML to JSON",
        ),
    ],
)
def test_an_error_names_template_and_line(err: str, file: str, line: int | None, said: str) -> None:
    fault = parsed_error(err, "camera")
    assert (fault.file, fault.line) == (file, line)
    assert fault.message == f"helm says '{said}'; fix the chart or its values"


def test_the_kinds_of_objects_are_read() -> None:
    out = (
        "---\n# Source: camera/templates/a.yaml\napiVersion: apps/v1\nkind: Deployment\nspec:\n"
        '  kind: inner\n---\napiVersion: "v1"\nkind: "ConfigMap"\ndata:\n'
        "  a: |\n    kind: text\n---\n"
        "# Source: camera/templates/empty.yaml\n"
    )
    assert [*parsed_kinds(out)] == [("apps", "Deployment"), ("", "ConfigMap")]


def test_lint_gives_errors_and_warnings_and_no_advice() -> None:
    found = parsed_lint(
        "==> Linting camera\n"
        "[INFO] Chart.yaml: icon is recommended\n"
        "[WARNING] camera/templates/hpa.yaml: autoscaling/v2beta1 is gone\n"
        "[ERROR] values.yaml: - at '/replicas': got string, want integer\n"
        "- at '/image': missing property 'tag'\n\n"
        "Error: 1 chart(s) linted, 1 chart(s) failed\n",
        "camera",
    )
    (warning,), (error,) = found.warnings, found.faults
    assert warning.file == "camera/templates/hpa.yaml"
    assert error.message == (
        "helm says 'values.yaml: - at '/replicas': got string, want integer - at '/image': missing "
        "property 'tag''; fix the chart or its values"
    )


def test_a_line_number_that_a_template_made_up_is_not_one() -> None:
    err = f"Error: camera/templates/x.yaml:{'9' * 5000}: made up"
    assert parsed_error(err, "camera").line is None
