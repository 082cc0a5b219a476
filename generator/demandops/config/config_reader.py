"""Reading configuration files item by item, so that one broken entry hides no other fault."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

from pydantic import BaseModel, TypeAdapter, ValidationError

from demandops import strict_yaml
from demandops.config.base_model import DnsLabel, faults_of, parse, parse_file
from demandops.errors import Fault, InvalidInput, fault

Model = TypeVar("Model", bound=BaseModel)
Raw = TypeVar("Raw", list[Any], dict[str, Any])

_NAME = TypeAdapter(DnsLabel)


class ConfigReader:
    """The files of one state repo, and every fault found in them so far."""

    def __init__(self, files: Mapping[str, str]) -> None:
        self.files = files
        self.faults: list[Fault] = []
        self._places: dict[str, dict[str, int]] = {}
        self._unsound: set[str] = set()

    def add_fault(self, file: str, field: str, message: str) -> None:
        """Note a fault."""
        self.faults.append(fault(field, message).within(file))

    def read_file(self, file: str, model: type[Model]) -> Model | None:
        """Parse a file into one model; nothing where it is missing or faulty, which is noted."""
        text = self.files.get(file)
        if text is None:
            self.add_fault(file, "", "is missing; `demandops init` shows what it holds")
            return None
        try:
            return parse_file(model, text, file)
        except InvalidInput as error:
            self.faults += error.faults
            return None

    def read_list(
        self, file: str, whole: type[BaseModel], field: str, item: type[Model], key: str
    ) -> dict[str, Model]:
        """Parse a file that is a list of items; return the sound ones by their name."""
        found: dict[str, Model] = {}
        places: dict[str, int] = {}
        raw = self._collection(file, whole, field, list)
        sound = raw is not None
        for index, entry in enumerate(raw or ()):
            name = entry.get(key) if isinstance(entry, dict) else None
            if isinstance(name, str) and name in places:
                self.add_fault(
                    file, f"{field}[{index}].{key}", f"'{name}' stands twice; remove one"
                )
                continue
            parsed = self._item(file, f"{field}[{index}]", item, entry)
            if parsed is None or not isinstance(name, str):
                sound = False
                continue
            found[name], places[name] = parsed, index
        self._places[file] = places
        if not sound:
            self._unsound.add(file)
        return found

    def read_mapping(
        self, file: str, whole: type[BaseModel], field: str, item: type[Model]
    ) -> dict[str, Model]:
        """Parse a file that maps names to items; return the sound ones."""
        found: dict[str, Model] = {}
        raw = self._collection(file, whole, field, dict)
        for name, entry in (raw or {}).items():
            parsed = self._item(file, f"{field}.{name}", item, entry)
            try:
                _NAME.validate_python(name)
            except ValidationError as error:
                self.faults += [
                    fault(f"{field}.{name}", one.message).within(file)
                    for one in faults_of(error, item)
                ]
                parsed = None
            if parsed is not None:
                found[name] = parsed
        self._places[file] = {name: index for index, name in enumerate(found)}
        if raw is None or len(found) < len(raw):
            self._unsound.add(file)
        return found

    def index_of(self, file: str, name: str) -> int:
        """Return where in its list an item stands."""
        return self._places[file][name]

    def is_missing(self, file: str, name: str) -> bool:
        """Tell whether a file has no item of that name; not where it may be one that is faulty."""
        return file not in self._unsound and name not in self._places[file]

    def item_names(self, file: str) -> list[str]:
        """Return the names of a file's items."""
        return list(self._places[file])

    def _collection(
        self, file: str, whole: type[BaseModel], field: str, kind: type[Raw]
    ) -> Raw | None:
        """Return what stands in ``field``, once the rest of the file is found sound or told."""
        text = self.files.get(file)
        if text is None:
            self.read_file(file, whole)
            return None
        try:
            data = strict_yaml.load(text)
        except InvalidInput as error:
            self.faults += strict_yaml.faults_in(error, file)
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
