"""The reader of configuration files: it reads item by item, to find the faults of every item."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from pydantic import BaseModel, TypeAdapter, ValidationError

from demandops import strict_yaml
from demandops.config.base_model import DnsLabel, faults_of, field_path, parse, parse_file
from demandops.errors import Fault, InvalidInput, fault, suggestion

Model = TypeVar("Model", bound=BaseModel)
Valid = TypeVar("Valid")

_NAME = TypeAdapter(DnsLabel)


class ConfigReader:
    """Reads the configuration files of one state repo and collects every fault."""

    def __init__(self, files: Mapping[str, str]) -> None:
        self.files = files
        self.faults: list[Fault] = []
        self._positions: dict[str, dict[str, str]] = {}
        self._incomplete: set[str] = set()
        self._heads: dict[str, BaseModel] = {}

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

    def read_items(
        self, file: str, whole: type[BaseModel], field: str, item: type[Model], key: str = ""
    ) -> dict[str, Model]:
        """Return the valid items of a file, by name; add the faults of invalid ones.

        Args:
            file: the file.
            whole: its model.
            field: its field that has the items, a list or a mapping.
            item: the model of an item.
            key: the field with an item's name; empty if ``field`` is a mapping.
        """
        items: dict[str, Model] = {}
        positions = self._positions[file] = {}
        raw = self._collection(file, whole, field, list if key else dict)
        if raw is None:
            self._incomplete.add(file)
            return items
        for place, entry in enumerate(raw) if key else raw.items():
            name: Any = place
            if key:
                name = entry.get(key) if isinstance(entry, dict) else None
                if isinstance(name, str) and name in positions:
                    where = field_path((field, place, key))
                    self.add_fault(file, where, f"'{name}' appears twice; remove one")
                    continue
            at = (field, place)
            parsed = self._valid(item.model_validate, entry, item, file, at)
            label = key or self._valid(_NAME.validate_python, name, item, file, at)
            if parsed is None or label is None:
                self._incomplete.add(file)
            else:
                items[name], positions[name] = parsed, field_path(at)
        return items

    def head(self, file: str, model: type[Model]) -> Model | None:
        """Return a file that :meth:`read_items` read, without its items, if its rest is valid."""
        head = self._heads.get(file)
        return head if isinstance(head, model) else None

    def place_of(self, file: str, name: str) -> str:
        """Return the field of an item in its file: ``nodes[3]``."""
        return self._positions[file][name]

    def is_missing(self, file: str, name: str) -> bool:
        """Return whether a file lacks an item; False if any of its items is invalid."""
        return file not in self._incomplete and name not in self._positions[file]

    def check_reference(self, file: str, field: str, name: str, known_in: str) -> None:
        """Add a fault if :meth:`is_missing` holds for ``name`` in the file ``known_in``."""
        if self.is_missing(known_in, name):
            where = known_in.removeprefix("inventory/")
            known = suggestion(name, self._positions[known_in])
            self.add_fault(file, field, f"'{name}' is not in {where}{known}")

    def _valid(
        self,
        validate: Callable[[Any], Valid],
        value: object,
        model: type[BaseModel],
        file: str,
        place: tuple[int | str, ...],
    ) -> Valid | None:
        try:
            return validate(value)
        except ValidationError as error:
            self.faults += faults_of(error, model, file, place)
            return None

    def _collection(self, file: str, whole: type[BaseModel], field: str, kind: type[Any]) -> Any:  # noqa: ANN401 - raw data of the kind
        """Return the raw value of ``field``; add the faults of the file's other fields."""
        raw = None
        try:
            data = strict_yaml.load(self.files.get(file, ""), file)
            raw = data.get(field) if isinstance(data, dict) else None
            if not isinstance(raw, kind):
                self.read_file(file, whole)
                return None
            self._heads[file] = parse(whole, {**data, field: kind()}, file)
        except InvalidInput as error:
            self.faults += error.faults
        return raw
