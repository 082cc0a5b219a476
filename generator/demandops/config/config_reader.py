"""The reader of configuration files: it reads item by item, to find the faults of every item."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from pydantic import BaseModel, TypeAdapter, ValidationError

from demandops import strict_yaml
from demandops.config.base_model import DnsLabel, faults_of, parse, parse_file
from demandops.config.config import collection_of, place_of_collection
from demandops.errors import MOST_FAULTS, Fault, InvalidInput, fault, field_path, suggestion

Model = TypeVar("Model", bound=BaseModel)
Valid = TypeVar("Valid")

_NAME = TypeAdapter(DnsLabel)


class ConfigReader:
    """Reads the configuration files of one state repo, and collects their faults."""

    def __init__(self, files: Mapping[str, str]) -> None:
        self.files = files
        self.faults: list[Fault] = []
        self._counts = Counter[str]()
        self._by_collection = defaultdict[str | None, list[str]](list)
        for path in sorted(files):
            self._by_collection[collection_of(path)].append(path)
        self._places: dict[str, dict[str, tuple[str, str]]] = {}
        self._incomplete: set[str] = set()
        self._heads: dict[str, BaseModel] = {}

    def add_fault(self, file: str, field: str, message: str) -> None:
        self._counts[file] += 1
        self.faults.append(fault(field, message).within(file))

    def read_file(self, file: str, model: type[Model]) -> Model | None:
        """Return a file as an instance of ``model``, or ``None`` after adding its faults."""
        text = self.files.get(file)
        if text is None:
            self.add_fault(file, "", "is missing; `demandops init` creates an example")
            return None
        try:
            return parse_file(model, text, file)
        except InvalidInput as error:
            self.faults += error.faults
            return None

    def files_of(self, collection: str) -> list[str]:
        """Return the files with entries of a collection, its usual file first."""
        return self._by_collection[collection]

    def read_items(
        self, collection: str, whole: type[BaseModel], field: str, item: type[Model], key: str = ""
    ) -> dict[str, Model]:
        """Return the valid items of a collection, by name; collect the faults of invalid ones.

        ``whole`` is the model of the collection's files, and ``field`` their field with the items:
        a list if ``key`` names the field with an item's name, else a mapping.
        """
        items: dict[str, Model] = {}
        places = self._places[collection] = {}
        kind: type[Any] = list if key else dict
        for file in self.files_of(collection) or [collection]:
            entries: Any = None
            try:
                data = strict_yaml.load(self.files.get(file, ""), file)
                raw = data.get(field) if isinstance(data, dict) else None
                if isinstance(raw, kind):
                    entries = raw
                    # without the items, each of which is parsed below, so that an invalid item
                    # hides neither the others nor the faults of the file's other fields
                    self._heads[file] = parse(whole, {**data, field: kind()}, file)
                else:
                    self.read_file(file, whole)
            except InvalidInput as error:
                self.faults += error.faults
            if entries is None:
                self._incomplete.add(collection)
                continue
            for place, entry in enumerate(entries) if key else entries.items():
                name: Any = place
                if key:
                    name = entry.get(key) if isinstance(entry, dict) else None
                at = (field, place)
                if isinstance(name, str) and name in places:
                    self.add_duplicate(name, places[name], (file, field_path(at)), key)
                    continue
                parsed = self._valid(item.model_validate, entry, item, file, at)
                label = key or self._valid(_NAME.validate_python, name, item, file, at)
                if parsed is None or label is None:
                    self._incomplete.add(collection)
                else:
                    items[name], places[name] = parsed, (file, field_path(at))
        return items

    def add_duplicate(
        self, name: str, first: tuple[str, str], second: tuple[str, str], key: str = ""
    ) -> None:
        """Add the faults of an entry that is at two places; a place is (file, field)."""
        dot_key = f".{key}" if key else ""
        if first[0] == second[0]:
            self.add_fault(
                second[0], f"{second[1]}{dot_key}", f"'{name}' appears twice; remove one"
            )
            return
        # both files, so that the changed one is quarantined, whichever of them a person changed
        for (file, field), (other, _) in ((first, second), (second, first)):
            self.add_fault(file, f"{field}{dot_key}", f"'{name}' is in {other} too; remove one")

    def entry_files(self) -> dict[str, dict[str, str]]:
        return {
            collection: {name: file for name, (file, _) in places.items()}
            for collection, places in self._places.items()
        }

    def head(self, file: str, model: type[Model]) -> Model | None:
        """Return a file that :meth:`read_items` has read, without its items, if it is valid."""
        head = self._heads.get(file)
        return head if isinstance(head, model) else None

    def place_of(self, collection: str, name: str) -> tuple[str, str]:
        """Return the file that has an item, and the item's path in this file, like ``nodes[3]``."""
        return self._places[collection][name]

    def add_alias(self, collection: str, name: str, item: str) -> None:
        self._places[collection][name] = self._places[collection][item]

    def is_complete(self, collection: str) -> bool:
        return collection not in self._incomplete

    def is_missing(self, collection: str, name: str) -> bool:
        # an invalid item may be the missing one, and has faults of its own
        return self.is_complete(collection) and name not in self._places[collection]

    def check_reference(self, file: str, field: str, name: str, collection: str) -> None:
        """Add a fault if the item ``name`` is missing in the collection."""
        if self.is_missing(collection, name):
            where = place_of_collection(collection, self.files_of(collection))
            where = where.replace("inventory/", "")
            # thousands of names may be unknown, and only the first faults of a file are listed
            is_listed = self._counts[file] < MOST_FAULTS
            hint = suggestion(name, self._places[collection]) if is_listed else ""
            self.add_fault(file, field, f"'{name}' is not in {where}{hint}")

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
