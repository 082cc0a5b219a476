"""The base classes of all models that are parsed, and the types that they share."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime, timezone
from fnmatch import translate
from functools import lru_cache
from typing import Annotated, Any, Literal, TypeVar, get_args

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    PlainValidator,
    StringConstraints,
    TypeAdapter,
    ValidationError,
    ValidationInfo,
)
from pydantic.alias_generators import to_camel
from pydantic_core import PydanticKnownError

from demandops.base import strict_yaml
from demandops.base.errors import Fault, InvalidInput, fault, field_path, suggestion
from demandops.base.naming import PATTERN_WORDS, control_character, one_form
from demandops.base.quoting import quoted
from demandops.base.settings import API_VERSION, modeline

# ---- durations and times for people: ``1h30m``, ``in 10m``, ``3m20s ago`` ----

_DURATION = re.compile(r"(?:([0-9]{1,9})d)?(?:([0-9]{1,9})h)?(?:([0-9]{1,9})m)?(?:([0-9]{1,9})s)?")
_UNITS = ((86_400, "d"), (3_600, "h"), (60, "m"), (1, "s"))
_YEAR_S = 366 * 86_400


def seconds_of(text: str) -> int:
    match = _DURATION.fullmatch(text)
    if not text or match is None:
        raise ValueError(f"{quoted(text)} is not a duration; write one like 90s, 10m, 1h30m or 2d")
    pairs = zip(match.groups("0"), _UNITS, strict=True)
    seconds = sum(int(part) * size for part, (size, _) in pairs)
    if seconds > _YEAR_S:
        raise ValueError(f"'{text}' is longer than a year; choose a shorter duration")
    return seconds


def duration_text(seconds: float) -> str:
    text, left = "", round(seconds)
    for size, name in _UNITS:
        whole, left = divmod(left, size)
        text += f"{whole}{name}" if whole else ""
    return text or "0s"


_TIME = re.compile(
    r"(\d{4}-\d\d-\d\d)[Tt ](\d\d:\d\d:\d\d)(?:\.(\d{1,6})\d*)?([Zz]|[+-]\d\d:\d\d)", re.ASCII
)


def parse_time(text: str) -> datetime:
    """Parse an RFC 3339 time that has a time zone, and return it in UTC."""
    match = _TIME.fullmatch(text)
    if match is None:
        raise ValueError(
            f"{quoted(text)} is not a time with a time zone; write one like 2026-01-31T12:00:00Z"
        )
    day, clock, fraction, zone = match.groups("0")
    zone = "+00:00" if zone in "Zz" else zone
    try:
        moment = datetime.fromisoformat(f"{day}T{clock}.{fraction.ljust(6, '0')}{zone}")
        return moment.astimezone(timezone.utc)
    except (ValueError, OverflowError):
        raise ValueError(
            f"{quoted(text)} is a time that does not exist; correct the date or the clock time"
        ) from None


def time_text(moment: datetime) -> str:
    in_utc = moment.astimezone(timezone.utc).isoformat(timespec="microseconds")
    return f"{in_utc.removesuffix('+00:00')}Z"


def _moment(value: object) -> datetime:
    if isinstance(value, str):
        return parse_time(value)
    raise PydanticKnownError("string_type")


# A time in a file of the ledger: ISO 8601 in UTC.
Moment = Annotated[
    datetime,
    PlainValidator(_moment, json_schema_input_type=str),
    PlainSerializer(time_text, return_type=str),
]


def span(seconds: float) -> str:
    """Return a duration without its sign, rounded down, in one or two units: ``3h20m``."""
    left = int(abs(seconds))
    for place, (size, unit) in enumerate(_UNITS):
        if left >= size or size == 1:
            whole, remainder = divmod(left, size)
            text = f"{whole}{unit}"
            if whole < 10 and size > 1:  # beside two digits, the next unit says nothing
                smaller, name = _UNITS[place + 1]
                text += f"{remainder // smaller}{name}" if remainder >= smaller else ""
            return text
    raise AssertionError("the smallest unit is one second")


def relative(moment: datetime, now: datetime) -> str:
    seconds = (moment - now).total_seconds()
    return f"in {span(seconds)}" if seconds >= 1 else f"{span(seconds)} ago"


# ---- the base classes of every model that is parsed from a file or a message ----
#
# Models are frozen and strict, and reject unknown fields. :func:`parse` turns pydantic's errors
# into faults that name the field as it is written in the file.

Model = TypeVar("Model", bound=BaseModel)
Item = TypeVar("Item")

# A list in a file. The model has the items as a tuple.
Items = Annotated[tuple[Item, ...], Field(strict=False)]

Positive = Annotated[int, Field(ge=1)]

# A name that is valid in Kubernetes (RFC 1123 label)
DnsLabel = Annotated[
    str, StringConstraints(pattern=r"^[a-z0-9]([-a-z0-9]*[a-z0-9])?$", max_length=63)
]

# A short name in a configuration file, such as that of a role, a channel or a capability
Word = Annotated[str, StringConstraints(pattern=r"^[a-z][a-z0-9_-]*$", max_length=63)]


def without(problem_of: Callable[[str], str]) -> AfterValidator:
    def check(value: str) -> str:
        problem = problem_of(value)
        if problem:
            raise ValueError(problem)
        return value

    return AfterValidator(check)


def readable_by(parse: Callable[[str], object]) -> AfterValidator:
    def check(value: str) -> str:
        parse(value)
        return value

    return AfterValidator(check)


# A validator that rejects control characters, and characters that reorder text. Line breaks and
# tabs are valid.
Visible = without(
    lambda value: (
        (control := control_character(re.sub(r"[\n\t]", " ", value)))
        and f"{quoted(value)} has the control character {control}; remove it"
    )
)

# Any text that `Visible` accepts
Text = Annotated[str, Visible]

# A validator that writes ids, and the patterns of ids, in one form
OneForm = AfterValidator(one_form)

Pattern = Annotated[Text, OneForm]


def matches(name: str, patterns: tuple[str, ...]) -> bool:
    return any(name == pattern or _compiled(pattern)(name) for pattern in patterns)


@lru_cache(65_536)  # a policy may have thousands, more than Python's own cache
def _compiled(pattern: str) -> Callable[[str], object]:
    # fnmatch has sets of characters, which begin with a bracket; here a bracket is only itself
    return re.compile(translate(pattern.replace("[", "[[]"))).match


Approval = Literal["none", "required"]


# The configuration of a part that is a dataclass: pydantic reads it from a mapping, with no other
# fields, and :func:`plain` writes it. Code makes copies of it without any check.
PART = ConfigDict(extra="forbid")


# Given as context, it says that people or clients write what is read.
GOAL = "goal"


def _recorded(value: object, info: ValidationInfo) -> object:
    if info.context == GOAL:
        raise ValueError("is recorded by the generator; remove it")
    return value


# Marks a field that only the generator writes.
RECORDED = BeforeValidator(_recorded)


_AS_WRITTEN: Any = {"mode": "json", "by_alias": True, "exclude_defaults": True}


@lru_cache(maxsize=64)
def _adapter(model: type[Any]) -> TypeAdapter[Any]:
    return TypeAdapter(model)


def plain(part: object) -> dict[str, Any]:
    """Return a part as plain data, without the fields that have their defaults."""
    data: dict[str, Any] = _adapter(type(part)).dump_python(part, **_AS_WRITTEN)  # type: ignore[arg-type]
    return data


def _number(value: object) -> object:
    if isinstance(value, int | float) and not isinstance(value, bool):
        return value
    raise PydanticKnownError("float_type")


plain_number = BeforeValidator(_number)


class FrozenModel(BaseModel):
    """An immutable value that rejects unknown fields."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class CamelModel(FrozenModel):
    """A part of a configuration file. The field ``host_network`` is ``hostNetwork`` in the file."""

    model_config = ConfigDict(alias_generator=to_camel)


class FileModel(CamelModel):
    """A configuration file; ``apiVersion`` names its format."""

    apiVersion: Literal["demandops/v1"]


def faults_of(
    error: ValidationError,
    model: type[BaseModel],
    file: str = "",
    place: tuple[int | str, ...] = (),
    most: int | None = None,
) -> list[Fault]:
    """Return the first ``most`` faults of a failed validation; ``place`` is in the file."""
    faults = []
    for item in error.errors(include_url=False)[:most]:
        value = item.get("input")
        is_short = item["type"] == "too_short" and isinstance(value, list)
        # pydantic counts only valid items, and the invalid ones have faults of their own
        if is_short and len(value) >= item["ctx"]["min_length"]:
            continue
        path = field_path((*place, *item["loc"]))
        faults.append(fault(path, _message(dict(item), model)).within(file))
    return faults


_EXPECTED = {
    "model_type": "must be a mapping",
    "dataclass_type": "must be a mapping",
    "mapping_type": "must be a mapping",
    "dict_type": "must be a mapping",
    "list_type": "must be a list",
    "tuple_type": "must be a list",
    "bool_type": "must be true or false",
    "int_type": "must be a whole number",
    "string_type": "must be text",
}


_schema = lru_cache(maxsize=64)(lambda model: model.model_json_schema())


def _fields_at(part: Any, place: Sequence[int | str], whole: Any) -> set[str]:  # noqa: ANN401
    # the names of the fields that people may write at a place, by a part of a JSON schema
    if not isinstance(part, dict):
        return set()
    parts = [*part.get("anyOf", ())]
    if "$ref" in part:
        parts.append(whole["$defs"][part["$ref"].rpartition("/")[2]])
    names = {name for each in parts for name in _fields_at(each, place, whole)}
    own = part.get("properties", {})
    if not place:
        return {*names, *own}
    inside = [part.get("items"), part.get("additionalProperties"), own.get(place[0])]
    inside += part.get("patternProperties", {}).values()
    return names.union(*(_fields_at(each, place[1:], whole) for each in inside))


def _message(item: dict[str, Any], model: type[BaseModel]) -> str:
    kind, value = item["type"], item.get("input")
    if kind == "missing":
        return "is missing; add it"
    if kind in ("extra_forbidden", "unexpected_keyword_argument"):
        *place, name = item["loc"]
        schema = _schema(model)
        known = suggestion(str(name), _fields_at(schema, place, schema))
        return f"is not a field here; remove it or correct its spelling{known}"
    if kind == "string_type" and isinstance(value, int | float):
        return f"must be text, not {strict_yaml.short_repr(value)}; put it in quotes"
    if kind == "literal_error":
        expected = str(item["ctx"]["expected"]).replace("True", "true")  # as YAML has it
        return f"is {strict_yaml.short_repr(value)}, but must be {expected}"
    if kind == "string_pattern_mismatch":
        pattern = item["ctx"]["pattern"]
        return f"{value!r} cannot be used here; write {PATTERN_WORDS.get(pattern, pattern)}"
    if kind == "value_error":
        return str(item["ctx"]["error"])
    if kind in ("string_too_short", "too_short") and not value:
        return "is empty; fill it in"
    if kind == "too_short" and isinstance(value, list):
        return f"needs at least {item['ctx']['min_length']} entries, not {len(value)}"
    expected = _EXPECTED.get(kind) or f"{item['msg'][:1].lower()}{item['msg'][1:]}"
    return f"{expected}, not {strict_yaml.short_repr(value)}"


def parse(model: type[Model], data: object, file: str = "") -> Model:
    try:
        # rules about several fields are checked only if each field is valid
        return model.model_validate(data)
    except ValidationError as error:
        raise InvalidInput(faults_of(error, model, file)) from None


def parse_file(model: type[Model], text: str, file: str) -> Model:
    data = strict_yaml.load(text, file)
    if not isinstance(data, dict):
        message, version = "must be a mapping", model.model_fields.get("apiVersion")
        if version is not None:
            message += f" that starts with apiVersion: {get_args(version.annotation)[-1]}"
        raise InvalidInput.at("", message, file=file)
    return parse(model, data, file)


def document(path: str, schema: str, kind: str, fields: Mapping[str, Any], note: str = "") -> str:
    """Return the text of a file that people edit."""
    text = strict_yaml.dump({"apiVersion": API_VERSION, "kind": kind, **fields})
    comment = "".join(f"# {line}\n" for line in note.splitlines())
    return modeline(path, schema) + comment + text
