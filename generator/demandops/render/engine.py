"""The template engine: strict Jinja2 that writes every value as JSON.

``{{ x }}`` writes one JSON value, so a value cannot change the structure of the YAML. An undefined
name is an error. The program's own templates come from its ``templates`` folder. Templates of
appdefs come from the configuration and run in a sandbox.
"""

from __future__ import annotations

import re
import traceback
from collections.abc import Callable, Mapping
from dataclasses import replace
from types import CodeType
from typing import Any

from jinja2 import (
    BaseLoader,
    BytecodeCache,
    Environment,
    FileSystemLoader,
    StrictUndefined,
    TemplateError,
)
from jinja2.bccache import Bucket
from jinja2.environment import Template
from jinja2.exceptions import TemplateNotFound, TemplateRuntimeError, TemplateSyntaxError
from jinja2.runtime import Undefined

from demandops import naming, strict_yaml
from demandops.errors import InvalidInput, fault
from demandops.render.template_lines import TemplateLines
from demandops.render.template_sandbox import Sandbox, budget
from demandops.settings import data_folder

_TEMPLATE_FAULTS = (
    TemplateError,
    TypeError,
    ValueError,
    ArithmeticError,
    LookupError,
    RecursionError,
    SyntaxError,
    MemoryError,
)  # errors that a template causes, so that the template's author must fix them

_MAX_LENGTH = 100_000
"""How many characters a values template may have."""


class _Verbatim(str):
    """YAML text that a filter of this module returns. The engine writes it unchanged."""


class _FilesLoader(BaseLoader):
    """Loads templates from the configuration, by their path in the state repo."""

    def __init__(self, files: Mapping[str, str]) -> None:
        self._files = files

    def get_source(self, environment: Environment, template: str) -> tuple[str, str, Any]:
        if template not in self._files:
            raise TemplateNotFound(template)
        text = self._files[template]
        if len(text) > _MAX_LENGTH:
            message = f"has {len(text)} characters; at most {_MAX_LENGTH} are allowed"
            raise TemplateSyntaxError(message, 1)
        return text, template, lambda: True


class _CompiledTemplates(BytecodeCache):
    """Keeps compiled templates, so that a process seldom compiles a text twice."""

    _LIMIT = 256

    def __init__(self) -> None:
        self._kept: dict[tuple[str, str], CodeType] = {}

    def load_bytecode(self, bucket: Bucket) -> None:
        bucket.code = self._kept.get((bucket.key, bucket.checksum))

    def dump_bytecode(self, bucket: Bucket) -> None:
        """Keep the code of the bucket's template; at the limit, first drop all code kept so far."""
        if len(self._kept) >= self._LIMIT:
            self._kept.clear()
        if bucket.code:
            self._kept[bucket.key, bucket.checksum] = bucket.code


def _finalize(value: object) -> object:
    if isinstance(value, _Verbatim):
        return value
    if isinstance(value, Undefined):
        str(value)  # StrictUndefined raises an error here that names what is missing
    return strict_yaml.to_json(_plain(value))


def _plain(value: object) -> object:
    if isinstance(value, list | tuple):
        return [item if isinstance(item, str) else _plain(item) for item in value]
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    return value


def _block(value: Mapping[str, Any], indent: int) -> _Verbatim:
    text = strict_yaml.dump(value) if value else "{}\n"
    pad = " " * indent
    return _Verbatim("\n".join(line and pad + line for line in text.rstrip("\n").split("\n")))


def _literal(value: str, indent: int) -> _Verbatim:
    """Return ``value`` as the indented body of a YAML literal block (``|``)."""
    pad = " " * indent
    return _Verbatim("\n".join(pad + line for line in value.rstrip("\n").split("\n")))


def _bare(value: str) -> _Verbatim:
    """Return a path as text that a template writes, unquoted, into a comment.

    Raises:
        ValueError: if the path has characters that need quotes.
    """
    if not re.fullmatch(r"[A-Za-z0-9._/-]+", value):
        raise ValueError(f"'{value}' is not a plain path, so it cannot be written in a comment")
    return _Verbatim(value)


_FILTERS: dict[str, Callable[..., _Verbatim | str]] = {
    "block": _block,
    "literal": _literal,
    "bare": _bare,
    "ros_name": naming.ros_name,
}


_OPTIONS: dict[str, Any] = {
    "undefined": StrictUndefined,
    "finalize": _finalize,
    "autoescape": False,
    "trim_blocks": True,
    "lstrip_blocks": True,
    "keep_trailing_newline": True,
    "auto_reload": False,
}
_OWN_COMPILED, _CONFIG_COMPILED = _CompiledTemplates(), _CompiledTemplates()


class Engine:
    """Renders the program's own templates and the templates of one configuration."""

    def __init__(self, files: Mapping[str, str]) -> None:
        self._files = files
        own, config = FileSystemLoader(data_folder("templates")), _FilesLoader(files)
        self._own = Environment(loader=own, bytecode_cache=_OWN_COMPILED, **_OPTIONS)  # noqa: S701 - YAML, not HTML
        del self._own.filters["tojson"]  # _finalize writes JSON; tojson would quote the JSON again
        self._own.filters |= _FILTERS
        self._config = Sandbox(_FILTERS, loader=config, bytecode_cache=_CONFIG_COMPILED, **_OPTIONS)

    def text(self, template: str, **context: object) -> str:
        """Return the rendered text of one of the program's templates.

        A template is named by its path in the ``templates`` folder, like ``flux/release.yaml.j2``.
        """
        return self._own.get_template(template).render(**context)

    def data(
        self,
        template: str,
        check: Callable[[dict[str, Any]], None] = lambda values: None,
        **context: object,
    ) -> dict[str, Any]:
        """Return the Helm values that a values template of the configuration renders to.

        Args:
            template: the path of the template.
            check: raises InvalidInput if the values are not valid.
            context: the variables of the template.

        Raises:
            InvalidInput: if the template or the check fails. If the template fails, the error names
                the template. Each fault has the template's line, if that line is known.
        """
        text = ""
        try:
            text = self._rendered(template, context)
            values = _mapping(text, template)
            check(values)
        except InvalidInput as error:
            lines = TemplateLines(self._files[template], text)
            raise InvalidInput(map(lines.located, error.faults)) from None
        except TemplateNotFound as error:
            problem, line = f"'{error.name}' does not exist", _line(error, template)
        except TemplateSyntaxError as error:
            problem, line = str(error.message), error.lineno
        except _TEMPLATE_FAULTS as error:
            problem, line = str(error) or type(error).__name__, _line(error, template)
        else:
            return values
        raise InvalidInput([fault("", f"{problem}; fix the template", line=line).within(template)])

    def _rendered(self, template: str, context: dict[str, object]) -> str:
        """Return the text that a values template renders to, or raise one of _TEMPLATE_FAULTS."""
        try:
            with budget():
                compiled: Template = self._config.get_template(template)
            # a new budget, so that it does not matter whether the template was compiled before
            with budget():
                return compiled.render(**context)
        except _TEMPLATE_FAULTS:
            raise
        except Exception as error:  # a filter of Jinja may raise any other error
            problem = f"{type(error).__name__}: {error}"
            raise TemplateRuntimeError(problem).with_traceback(error.__traceback__) from None


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


def _line(error: Exception, template: str) -> int | None:
    frames = traceback.extract_tb(error.__traceback__)
    lines = [frame.lineno for frame in frames if frame.filename == template]
    return lines[-1] if lines else None
