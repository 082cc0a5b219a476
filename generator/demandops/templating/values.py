"""The Helm values of a service, from what people wrote: a values template, a chart, overrides.

What people write may never end. So this module runs in another process, which can be killed
(:mod:`demandops.evaluator`). That process starts quickly only because nothing here imports the
configuration or pydantic. The core gets a function of the type :data:`Evaluate`, as it gets the
time, and so does not know where the values are computed.
"""

from __future__ import annotations

import json
import re
import traceback
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import jsonschema_rs
from jinja2 import FunctionLoader, TemplateError
from jinja2.exceptions import TemplateNotFound, TemplateSyntaxError

from demandops import strict_yaml
from demandops.charts import chart_files
from demandops.errors import Fault, InvalidInput, fault, field_path
from demandops.quoting import quoted
from demandops.templating.engine import FILTERS, OPTIONS, CompiledTemplates
from demandops.templating.template_lines import with_template_lines
from demandops.templating.template_sandbox import Sandbox

_MAX_LENGTH = 100_000  # characters of a values template
_MAX_RENDERED = 1_000_000  # characters that it writes; Kubernetes takes objects of 1.5 MB
_ADDRESS = re.compile(" at 0x[0-9a-f]+")
_REFERENCES = ("$ref", "$dynamicRef", "$recursiveRef")


@dataclass(frozen=True, slots=True)
class ValuesTask:
    """What the values of a service are computed from; all paths are those of the state repo.

    ``chart`` is the folder of the chart, whose defaults and schema the values must fit; None if the
    chart is not in the state repo. ``patches`` are the values of overrides, each with the
    override's path, in the order in which they apply. Every value is plain JSON.
    """

    template: str
    context: Mapping[str, Any]
    chart: str | None
    patches: tuple[tuple[str, Any], ...] = ()

    @property
    def file(self) -> str:
        # named if the task takes too long
        return self.template


@dataclass(frozen=True, slots=True)
class SchemaTask:
    """A chart's ``values.schema.json`` that is checked, with values that ``origin`` gives, if any.

    The result is empty.
    """

    file: str
    values: Mapping[str, Any] | None = None
    origin: str = ""


# Returns the values of a task, given the files that it may need: path → text. Raises InvalidInput
# with the faults of what people wrote, or OverLimit if that takes too long.
Evaluate = Callable[[Mapping[str, str], ValuesTask | SchemaTask], dict[str, Any]]


def evaluate(files: Mapping[str, str], task: ValuesTask | SchemaTask) -> dict[str, Any]:
    if isinstance(task, SchemaTask):
        validator(files[task.file], task.file)
        if task.values is not None:
            chart = task.file.rpartition("/")[0]
            _check(task.values, chart, files, task.origin, "the values")
        return {}
    text = _rendered(files, task)
    try:
        values = _mapping(text, task.template)
        if task.chart:
            _check(values, task.chart, files, task.template, "the template")
    except InvalidInput as error:
        template = files[task.template]
        raise InvalidInput(with_template_lines(error.faults, template, text)) from None
    for override, patch in task.patches:
        values = chart_files.merge_patch(values, patch)
        if task.chart:
            _check(values, task.chart, files, override, "the override")
    return values


# ---- the template ----


_COMPILED = CompiledTemplates()


def _rendered(files: Mapping[str, str], task: ValuesTask) -> str:
    def load(path: str) -> tuple[str, str, Callable[[], bool]] | None:
        text = files.get(path)
        if text is not None and len(text) > _MAX_LENGTH:
            message = f"has {len(text)} characters; at most {_MAX_LENGTH} are allowed"
            raise TemplateSyntaxError(message, 1)
        return None if text is None else (text, path, lambda: True)

    loader = FunctionLoader(load)
    sandbox = Sandbox(FILTERS, loader=loader, bytecode_cache=_COMPILED, **OPTIONS)
    try:
        text = sandbox.get_template(task.template).render(**task.context)
        if len(text) <= _MAX_RENDERED:
            return text
        problem, line = f"writes {len(text)} characters; at most {_MAX_RENDERED} are allowed", None
    except TemplateNotFound as error:
        problem, line = f"'{error.name}' does not exist", _line(error, task.template)
    except TemplateSyntaxError as error:
        problem, line = str(error.message), error.lineno
    except TemplateError as error:
        problem, line = str(error) or type(error).__name__, _line(error, task.template)
    except MemoryError:  # a limit of this process, and so nobody's fault for sure
        raise
    except Exception as error:  # whatever an expression raises, only the template's author mends it
        problem, line = f"{type(error).__name__}: {error}", _line(error, task.template)
    # each process has other addresses, and all generators must write the same problem report
    message = f"{_ADDRESS.sub('', problem)}; fix the template"
    raise InvalidInput([fault("", message, line=line).within(task.template)])


def _line(error: Exception, template: str) -> int | None:
    frames = traceback.walk_tb(error.__traceback__)
    lines = [line for frame, line in frames if frame.f_code.co_filename == template]
    return lines[-1] if lines else None


def _mapping(text: str, template: str) -> dict[str, Any]:
    try:
        values = strict_yaml.load(text)
    except InvalidInput as error:
        raise InvalidInput(
            replace(
                each,
                field=f"{each.field} of the rendered text",
                message=f"{each.message}; fix the template",
                file=template,
            )
            for each in error.faults
        ) from None
    if not isinstance(values, dict):
        raise InvalidInput([fault("", "must give a mapping of Helm values").within(template)])
    return values


# ---- the chart's schema ----


def _check(
    values: Mapping[str, Any], chart: str, files: Mapping[str, str], origin: str, author: str
) -> None:
    """Raise InvalidInput, for the file ``origin``, if values do not match a chart's schema."""
    path = f"{chart}/values.schema.json"
    if path not in files:
        return
    schema = validator(files[path], path)
    # as Helm does, because a schema may require a value that has a default
    merged = chart_files.merged(chart_files.defaults(chart, files), values)
    faults = [
        fault(
            f"values.{place}" if place else "values", f"{error.message}; fix {author} or {chart}"
        ).within(origin)
        for error in schema.iter_errors(merged)
        for place in [field_path(tuple(error.instance_path))]
    ]
    if faults:
        raise InvalidInput(faults)


@lru_cache(maxsize=256)
def validator(text: str, file: str) -> Any:  # noqa: ANN401
    """Return the validator for a schema; one that refers to another document is a fault."""
    try:
        schema = json.loads(text)
        draft = str(schema.get("$schema")) if isinstance(schema, dict) else ""
        faults = list(_foreign(schema, (), "id" if "draft-04" in draft else "$id"))
        if not faults:
            # patterns in linear time, as Helm's Go has them, without look-arounds
            options = jsonschema_rs.RegexOptions()
            return jsonschema_rs.validator_for(schema, retriever=_refuse, pattern_options=options)
    except RecursionError:
        faults = [fault("", "is nested too deeply; make it flatter")]
    except (ValueError, TypeError) as error:
        reason = str(error).splitlines()[0]
        if reason.endswith('is not a "regex"'):
            reason += ", or needs a look-around or back reference, which Go's patterns lack too"
        faults = [fault("", f"is not a valid JSON schema: {reason}; fix it")]
    raise InvalidInput(each.within(file) for each in faults)


def _refuse(uri: str) -> None:
    raise ValueError(f"{uri} is outside this file")


def _foreign(schema: object, place: tuple[int | str, ...], id: str) -> Iterator[Fault]:
    """Yield a fault for each reference to another document, and for each ``id`` below the root."""
    if isinstance(schema, dict):
        for key, part in schema.items():
            if not isinstance(part, str):
                yield from _foreign(part, (*place, key), id)
            elif key in _REFERENCES and not part.startswith("#"):
                message = (
                    f"{quoted(part)} is outside this file; only references that start with '#' are "
                    "followed, so copy the definition here"
                )
                yield fault(field_path((*place, key)), message)
            elif key == id and place:  # it would change what a reference with # means in its part
                message = "only the whole schema may have an id; remove it, and refer by '#/…'"
                yield fault(field_path((*place, key)), message)
    elif isinstance(schema, list):
        for index, part in enumerate(schema):
            yield from _foreign(part, (*place, index), id)
