"""Helm's output becomes faults with file and line; the texts here are those of helm 4."""

from __future__ import annotations

import pytest
from demandops.decide.changeset import trial_releases
from demandops.repo.pull_request.helm import Report, parsed_error, parsed_kinds, parsed_lint
from demandops.repo.pull_request.rendered_charts import _Run

from tests.kit.config import edited
from tests.kit.memory import MemoryRepo


@pytest.mark.parametrize(
    ("err", "file", "line"),
    [
        ("parse error at (camera/templates/service.yaml:7): unclosed action",
         "camera/templates/service.yaml", 7),
        ("execution error at (camera/charts/ros-service/templates/_names.tpl:31:4): no",
         "camera/charts/ros-service/templates/_names.tpl", 31),
        ("cannot load values.yaml: error converting YAML to JSON", "camera", None),
        # a line number that a template made up
        (f"camera/templates/x.yaml:{'9' * 5000}: made up", "camera/templates/x.yaml", None),
    ],
)  # fmt: skip
def test_an_error_names_template_and_line(err: str, file: str, line: int | None) -> None:
    fault = parsed_error(f"level=WARN msg=x\nError: {err}\n\nUse --debug flag\n", "camera")
    assert (fault.file, fault.line) == (file, line)
    assert fault.message.startswith(f"helm says '{err[:40]}")
    assert "--debug" not in fault.message


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
    assert "'/replicas': got string, want integer - at '/image': missing prop" in error.message


DOMAINS = "policy/access-domains.yaml"
KINDS = "kinds: [ConfigMap, Deployment, Secret]"


@pytest.mark.parametrize(
    ("field", "kind", "remedy"),
    [
        ("", "apps/DaemonSet", f"list DaemonSet in 'kinds' in {DOMAINS} together with all kinds"),
        (KINDS, "apps/DaemonSet", f"add DaemonSet to 'kinds' in {DOMAINS}"),
        (KINDS, "example.org/Robot", "add Robot, with its group and resource, to 'kinds'"),
        ("network: namespace", "networking.k8s.io/NetworkPolicy", "remove 'network: namespace'"),
    ],
)
def test_what_to_do_about_a_kind(field: str, kind: str, remedy: str) -> None:
    state = MemoryRepo(edited(DOMAINS, 'nodes: ["*"]', f'nodes: ["*"]\n    {field}')).state
    release = next(one for found in trial_releases(state.config).values() for one in found)
    group, _, name = kind.partition("/")
    (fault,) = _Run(None, state)._kinds_refused(Report(((group, name),)), release)
    assert f"renders a {name}, which is not among the kinds of access domain 'perc" in fault.message
    assert remedy in fault.message
