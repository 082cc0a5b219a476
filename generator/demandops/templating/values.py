"""Evaluates what people write: values templates, charts' schemas, patterns."""

from __future__ import annotations

import fnmatch
import glob
import json
import re
import traceback
from collections.abc import Callable, ItemsView, Iterable, Iterator, KeysView, Mapping, ValuesView
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import jsonschema_rs
from jinja2 import FunctionLoader, TemplateError
from jinja2.exceptions import SecurityError, TemplateNotFound, TemplateSyntaxError
from jinja2.runtime import Context
from jinja2.sandbox import ImmutableSandboxedEnvironment

from demandops.base import strict_yaml
from demandops.base.errors import Fault, InvalidInput, fault, field_path
from demandops.base.quantities import amount_of
from demandops.base.quoting import quoted
from demandops.base.ros_parameters import exact_numbers, flat_parameters
from demandops.templating import charts
from demandops.templating.engine import FILTERS, OPTIONS, CompiledTemplates

# ---- the line of a template that wrote a faulty line ----

_EXPRESSION = re.compile(r"\{\{.*?\}\}|\{%.*?%\}|\{#.*?#\}")
_PLACE = re.compile(r"line (\d+)")
_PARAMETER = re.compile(r"\bparameters(?:\.|\[['\"])(\w+)")
# The most characters that a searched line may have. The search for a longer line could take too
# long.
_LONGEST = 2_000


def with_template_lines(faults: Iterable[Fault], template: str, rendered: str) -> Iterator[Fault]:
    template_lines, rendered_lines = template.splitlines(), rendered.splitlines()
    fields: Mapping[str, int] | None = None
    for problem in faults:
        if place := _PLACE.match(problem.field):
            number: int | None = int(place[1])
        else:
            fields = strict_yaml.lines(rendered) if fields is None else fields
            number = strict_yaml.nearest(problem.field.removeprefix("values."), fields)
        candidates: list[int] = []
        if number and number <= len(rendered_lines):
            written = rendered_lines[number - 1]
            lines = [*enumerate(template_lines, 1)] if len(written) <= _LONGEST else []
            candidates = [at for at, line in lines if line == written]
            candidates = candidates or [at for at, line in lines if _may_write(line, written)]
        # a wrong line would mislead, so of several none is named
        line = candidates[0] if len(candidates) == 1 else None
        yield replace(problem, line=problem.line or line)


def _may_write(line: str, rendered: str) -> bool:
    # whether `rendered` has all text around the expressions of the template's line
    parts = _EXPRESSION.split(line)
    pattern = fnmatch.translate("*".join(map(glob.escape, parts)))
    return len(parts) > 1 and bool("".join(parts).strip()) and bool(re.match(pattern, rendered))


# ---- a Jinja sandbox in which a template gives the same text in every process ----
#
# Templates can use only the filters and methods listed here, and the engine's own filters. Many of
# the others give random results or make HTML. How long a template runs and how large its values
# become is not the sandbox's matter: it runs in a process with limits (:mod:`.evaluator`).

_FILTERS = re.findall(
    r"\w+",
    "abs attr batch capitalize center count d default dictsort first float format groupby indent "
    "int items join last length list lower map max min reject rejectattr replace reverse round "
    "select selectattr slice sort string sum title trim truncate unique upper urlencode "
    "wordcount",
)
_METHODS: dict[type, list[str]] = {
    str: re.findall(
        r"\w+",
        "capitalize center count endswith find index isalnum isalpha isdigit islower isnumeric "
        "isupper join ljust lower lstrip partition removeprefix removesuffix replace rfind rjust "
        "rpartition rsplit rstrip split splitlines startswith strip title upper zfill",
    ),
    dict: ["get", "items", "keys", "values"],
    list: ["count", "index"],
    tuple: ["count", "index"],
}
_BUILT_IN = (str, int, float, bytes, dict, list, tuple, range)
# Where the text of something that is no data has an address of memory, as that of a method has
_ADDRESS = re.compile(" at 0x[0-9a-f]+")


class Sandbox(ImmutableSandboxedEnvironment):
    _COMPILED = CompiledTemplates()

    def __init__(self, load: Callable[[str], tuple[str, str, Callable[[], bool]] | None]) -> None:
        loader = FunctionLoader(load)
        super().__init__(loader=loader, bytecode_cache=self._COMPILED, **OPTIONS)

        def written(value: object) -> object:
            if isinstance(value, (Iterator, KeysView, ItemsView, ValuesView)):
                value = [*value]
            text = OPTIONS["finalize"](value)
            if _ADDRESS.search(str(text)):
                raise SecurityError("a template may write only data, and no function or method")
            return text

        self.finalize = written
        self.filters = {**{name: self.filters[name] for name in _FILTERS}, **FILTERS}
        del self.tests["sameas"]  # whether two values are one object is an accident
        del self.globals["lipsum"]  # writes random text

    def call(__self, __context: Context, __obj: Any, *args: Any, **kwargs: Any) -> Any:  # noqa: ANN401
        owner = getattr(__obj, "__self__", None)
        for kind in _BUILT_IN:
            if isinstance(owner, kind) and __obj.__name__ not in _METHODS.get(kind, ()):
                raise SecurityError(f"a template may not call the method '{__obj.__name__}'")
        return super().call(__context, __obj, *args, **kwargs)


# ---- the Helm values of a service: from a values template, a chart and overrides ----
#
# What people write may never end. So this module runs in another process, which can be killed
# (:mod:`.evaluator`). That process starts quickly only because nothing here imports the
# configuration or pydantic. The core gets a function of the type :data:`Evaluate`, as it gets the
# time, and so does not know where the values are computed.

_MAX_LENGTH = 100_000  # characters of a values template
_MAX_RENDERED = 1_000_000  # characters that it writes; Kubernetes takes objects of 1.5 MB
_REFERENCES = ("$ref", "$dynamicRef", "$recursiveRef")


@dataclass(frozen=True, slots=True)
class ValuesTask:
    """What the values of a service are computed from; all paths are those of the state repo."""

    file: str  # the template; named if the task takes too long
    context: Mapping[str, Any]
    chart: str | None  # its folder, if it is in the state repo
    # The values of overrides in the order in which they apply, each with the override's path
    patches: tuple[tuple[str, Any], ...] = ()
    # What each pod requests of its node, by Kubernetes' names
    requests: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class SchemaTask:
    """A ``values.schema.json`` to check, with values that ``origin`` gives, if any."""

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
        values = _mapping(text, task.file)
        if task.chart and task.requests:
            values = _with_requests(values, task.requests, charts.defaults(task.chart, files))
        if task.chart:
            _check(values, task.chart, files, task.file, "the template")
    except InvalidInput as error:
        template, faults = files[task.file], list[Fault]()
        for each in with_template_lines(error.faults, template, text):
            line = template.splitlines()[each.line - 1] if each.line else ""
            named = ", ".join(dict.fromkeys(_PARAMETER.findall(line)))
            hint = f", or demand another value of the parameter {named}" if named else ""
            faults.append(replace(each, message=each.message + hint))
        raise InvalidInput(faults) from None
    below: dict[str, Any] | None = None
    if task.chart and task.patches:
        with suppress(InvalidInput):  # YAML that only Helm reads, for example with anchors
            libraries = (library.alias for library in charts.dependencies(task.chart, files))
            below = charts.defaults(task.chart, files) | dict.fromkeys(libraries)
    for override, patch in task.patches:
        values = charts.overridden(values, patch, below)
        if task.chart:
            _check(values, task.chart, files, override, "the override")
    if task.chart and "parameters" in values and charts.takes_parameters(task.chart, files):
        values = values | {"parameters": exact_numbers(values["parameters"])}
    return values


def takes_requests(defaults: Mapping[str, Any]) -> bool:
    # whether a chart with these default values gives its pods what a service requests
    return isinstance(defaults.get("resources"), dict)


def _with_requests(
    values: dict[str, Any], requests: Mapping[str, str], defaults: Mapping[str, Any]
) -> dict[str, Any]:
    # above what the chart has by default, and below what the template writes
    written = values.get("resources", {})
    if not takes_requests(defaults) or not isinstance(written, dict):
        return values
    most, limits = defaults["resources"].get("limits") or {}, {}
    for name, amount in requests.items():
        # Kubernetes refuses other requests than limits of a GPU, and requests above a limit
        with suppress(ValueError):  # a limit in a form that only Kubernetes reads
            if "/" in name or (name in most and amount_of(amount) > amount_of(str(most[name]))):
                limits[name] = amount
    for part, amounts in (("requests", requests), ("limits", limits)):
        own = written.get(part, {})
        if amounts and isinstance(own, dict):
            written = {**written, part: {**amounts, **own}}
    return {**values, "resources": written}


def _rendered(files: Mapping[str, str], task: ValuesTask) -> str:
    def load(path: str) -> tuple[str, str, Callable[[], bool]] | None:
        text = files.get(path)
        if text is not None and len(text) > _MAX_LENGTH:
            message = f"has {len(text)} characters; at most {_MAX_LENGTH} are allowed"
            raise TemplateSyntaxError(message, 1)
        return None if text is None else (text, path, lambda: True)

    try:
        text = Sandbox(load).get_template(task.file).render(**task.context)
        if len(text) <= _MAX_RENDERED:
            return text
        problem, line = f"writes {len(text)} characters; at most {_MAX_RENDERED} are allowed", None
    except TemplateNotFound as error:
        problem, line = f"'{error.name}' does not exist", _line(error, task.file)
    except TemplateSyntaxError as error:
        problem, line = str(error.message), error.lineno
    except TemplateError as error:
        problem, line = str(error) or type(error).__name__, _line(error, task.file)
    except MemoryError:  # a limit of this process, and so nobody's fault for sure
        raise
    except Exception as error:  # whatever an expression raises, only the template's author mends it
        problem, line = f"{type(error).__name__}: {error}", _line(error, task.file)
    # each process has other addresses, and all generators must write the same problem report
    message = f"{_ADDRESS.sub('', problem)}; fix the template"
    raise InvalidInput([fault("", message, line=line).within(task.file)])


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


def _check(
    values: Mapping[str, Any], chart: str, files: Mapping[str, str], origin: str, author: str
) -> None:
    path, merged, faults = f"{chart}/values.schema.json", values, list[Fault]()
    if path in files:
        # as Helm does, because a schema may require a value that has a default
        merged = charts.merged(charts.defaults(chart, files), values)
        for error in validator(files[path], path).iter_errors(merged):
            place = field_path(("values", *error.instance_path))
            faults.append(fault(place, f"{error.message}; fix {author} or {chart}"))
    if charts.takes_parameters(chart, files) and isinstance(merged.get("parameters"), dict):
        try:
            flat_parameters(merged["parameters"], "values.parameters")
        except InvalidInput as error:
            faults += error.faults
    if faults:
        raise InvalidInput(each.within(origin) for each in faults)


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
    raise InvalidInput(fault.within(file) for fault in faults)


def _refuse(uri: str) -> None:
    raise ValueError(f"{uri} is outside this file")


def _foreign(schema: object, place: tuple[int | str, ...], id: str) -> Iterator[Fault]:
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
