"""The reader of configuration files: it reads item by item, to find the faults of every item."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

from pydantic import BaseModel, TypeAdapter, ValidationError

from demandops import strict_yaml
from demandops.config.base_model import DnsLabel, faults_of, parse, parse_file
from demandops.errors import Fault, InvalidInput, fault, suggestion

Model = TypeVar("Model", bound=BaseModel)
Raw = TypeVar("Raw", list[Any], dict[str, Any])

_NAME = TypeAdapter(DnsLabel)


class ConfigReader:
    """Reads the configuration files of one state repo and collects every fault."""

    def __init__(self, files: Mapping[str, str]) -> None:
        self.files = files
        self.faults: list[Fault] = []
        self._positions: dict[str, dict[str, str]] = {}
        self._incomplete: set[str] = set()

    def add_fault(self, file: str, field: str, message: str) -> None:
        """Add a fault to :attr:`faults`."""
        self.faults.append(fault(field, message).within(file))

    def read_file(self, file: str, model: type[Model]) -> Model | None:
        """Return a file as ``model``; if it is missing or invalid, add the faults."""
        text = self.files.get(file)
        if text is None:
            self.add_fault(file, "", "is missing; `demandops init` creates an example")
            return None
        try:
            return parse_file(model, text, file)
        except InvalidInput as error:
            self.faults += error.faults
            return None

    def read_list(
        self, file: str, whole: type[BaseModel], field: str, item: type[Model], key: str
    ) -> dict[str, Model]:
        """Return the valid items of a file's list, by name; add the faults of invalid ones."""
        items: dict[str, Model] = {}
        positions: dict[str, str] = {}
        raw = self._collection(file, whole, field, list)
        complete = raw is not None
        for index, entry in enumerate(raw or ()):
            name = entry.get(key) if isinstance(entry, dict) else None
            if isinstance(name, str) and name in positions:
                self.add_fault(
                    file, f"{field}[{index}].{key}", f"'{name}' appears twice; remove one"
                )
                continue
            parsed = self._item(file, f"{field}[{index}]", item, entry)
            if parsed is None or not isinstance(name, str):
                complete = False
                continue
            items[name], positions[name] = parsed, f"{field}[{index}]"
        self._positions[file] = positions
        if not complete:
            self._incomplete.add(file)
        return items

    def read_mapping(
        self, file: str, whole: type[BaseModel], field: str, item: type[Model]
    ) -> dict[str, Model]:
        """Return the valid items of a file's map, by name; add the faults of invalid ones."""
        items: dict[str, Model] = {}
        raw = self._collection(file, whole, field, dict)
        for name, entry in (raw or {}).items():
            parsed = self._item(file, f"{field}.{name}", item, entry)
            try:
                _NAME.validate_python(name)
            except ValidationError as error:
                self.faults += [
                    fault(f"{field}.{name}", found.message).within(file)
                    for found in faults_of(error, item)
                ]
                parsed = None
            if parsed is not None:
                items[name] = parsed
        self._positions[file] = {name: f"{field}.{name}" for name in items}
        if raw is None or len(items) < len(raw):
            self._incomplete.add(file)
        return items

    def place_of(self, file: str, name: str) -> str:
        """Return the field of an item in its file: ``nodes[3]``."""
        return self._positions[file][name]

    def is_missing(self, file: str, name: str) -> bool:
        """Return whether a file lacks an item; False if an invalid item may be the one."""
        return file not in self._incomplete and name not in self._positions[file]

    def check_reference(self, file: str, field: str, name: str, known_in: str) -> None:
        """Add a fault if :meth:`is_missing` holds for ``name`` in the file ``known_in``."""
        if self.is_missing(known_in, name):
            where = known_in.removeprefix("inventory/")
            known = suggestion(name, self._positions[known_in])
            self.add_fault(file, field, f"'{name}' is not in {where}{known}")

    def _collection(
        self, file: str, whole: type[BaseModel], field: str, kind: type[Raw]
    ) -> Raw | None:
        """Return the raw value of ``field``; add the faults of the file's other fields."""
        text = self.files.get(file)
        if text is None:
            self.read_file(file, whole)
            return None
        try:
            data = strict_yaml.load(text, file)
        except InvalidInput as error:
            self.faults += error.faults
            return None
        raw = data.get(field) if isinstance(data, dict) else None
        if not isinstance(data, dict) or not isinstance(raw, kind):
            self.read_file(file, whole)
            return None
        try:
            parse(whole, {**data, field: kind()}, file)
        except InvalidInput as error:
            self.faults += error.faults
        return raw

    def _item(self, file: str, place: str, model: type[Model], raw: object) -> Model | None:
        try:
            return model.model_validate(raw)
        except ValidationError as error:
            for found in faults_of(error, model):
                inner = found.field
                glue = "" if not inner or inner.startswith("[") else "."
                self.faults.append(fault(f"{place}{glue}{inner}", found.message).within(file))
            return None
