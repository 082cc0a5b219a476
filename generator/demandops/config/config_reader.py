"""The reader of configuration files: it reads item by item, to find the faults of every item."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from pydantic import BaseModel, TypeAdapter, ValidationError

from demandops import strict_yaml
from demandops.config.base_model import DnsLabel, faults_of, field_path, parse, parse_file
from demandops.config.config import collection_of, place_of_collection
from demandops.errors import MOST_FAULTS, Fault, InvalidInput, fault, suggestion

Model = TypeVar("Model", bound=BaseModel)
Valid = TypeVar("Valid")

_NAME = TypeAdapter(DnsLabel)


class ConfigReader:
    """Reads the configuration files of one state repo, and collects their faults."""

    def __init__(self, files: Mapping[str, str]) -> None:
        self.files = files
        self.faults: list[Fault] = []
        self._by_collection = defaultdict[str | None, list[str]](list)
        for path in sorted(files):
            self._by_collection[collection_of(path)].append(path)
        self._places: dict[str, dict[str, tuple[str, str]]] = {}
        self._incomplete: set[str] = set()
        self._heads: dict[str, BaseModel] = {}

    def add_fault(self, file: str, field: str, message: str) -> None:
        """Add a fault to :attr:`faults`."""
        self.faults.append(fault(field, message).within(file))

    def read_file(self, file: str, model: type[Model]) -> Model | None:
        """Return a file as an instance of ``model``.

        If the file is missing or invalid, add its faults and return ``None``.
        """
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

        Args:
            collection: one of :data:`demandops.config.config.COLLECTIONS`.
            whole: the model of the collection's files.
            field: the field of these files that has the items, a list or a mapping.
            item: the model of an item.
            key: the field with an item's name; empty if ``field`` is a mapping.
        """
        items: dict[str, Model] = {}
        places = self._places[collection] = {}
        for file in self.files_of(collection) or [collection]:
            raw = self._items(file, whole, field, list if key else dict)
            if raw is None:
                self._incomplete.add(collection)
                continue
            for place, entry in enumerate(raw) if key else raw.items():
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
        """Add the faults of an entry that is at two places, ``first`` and ``second``.

        A place is (file, field). If the places are in two files, both files get a fault. So the
        changed file is quarantined, no matter which of the two a person changed.
        """
        dot_key = f".{key}" if key else ""
        if first[0] == second[0]:
            self.add_fault(
                second[0], f"{second[1]}{dot_key}", f"'{name}' appears twice; remove one"
            )
            return
        for (file, field), (other, _) in ((first, second), (second, first)):
            self.add_fault(file, f"{field}{dot_key}", f"'{name}' is in {other} too; remove one")

    def entry_files(self) -> dict[str, dict[str, str]]:
        """Return each entry's file, by collection and entry.

        The result has the collections that :meth:`read_items` has read.
        """
        return {
            collection: {name: file for name, (file, _) in places.items()}
            for collection, places in self._places.items()
        }

    def head(self, file: str, model: type[Model]) -> Model | None:
        """Return a file without its items, as an instance of ``model``.

        :meth:`read_items` must have read the file. Return ``None`` if the file has no items, or if
        its other fields are not valid.
        """
        head = self._heads.get(file)
        return head if isinstance(head, model) else None

    def place_of(self, collection: str, name: str) -> tuple[str, str]:
        """Return the file that has an item, and the item's path in this file, like ``nodes[3]``."""
        return self._places[collection][name]

    def add_alias(self, collection: str, name: str, item: str) -> None:
        """Register ``name`` as a further name of ``item``."""
        self._places[collection][name] = self._places[collection][item]

    def is_complete(self, collection: str) -> bool:
        """Return whether every item of a collection, and every file with items, is valid."""
        return collection not in self._incomplete

    def is_missing(self, collection: str, name: str) -> bool:
        """Return whether a collection lacks an item.

        Return False if an item of the collection is invalid, because it may be the missing item.
        """
        return self.is_complete(collection) and name not in self._places[collection]

    def check_reference(self, file: str, field: str, name: str, known_in: str) -> None:
        """Add a fault if the collection ``known_in`` has no item ``name`` (:meth:`is_missing`)."""
        if self.is_missing(known_in, name):
            where = place_of_collection(known_in, self.files_of(known_in))
            where = where.replace("inventory/", "")
            few = len(self.faults) <= MOST_FAULTS  # further ones are only counted
            known = suggestion(name, self._places[known_in]) if few else ""
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

    def _items(self, file: str, whole: type[BaseModel], field: str, kind: type[Any]) -> Any:  # noqa: ANN401 - raw data of the kind
        """Return the unchecked items of a file: the value of ``field``.

        Check the other fields of the file, and add their faults. Return ``None`` if the file cannot
        be read as YAML, or if ``field`` is missing or not of the type ``kind``.
        """
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
