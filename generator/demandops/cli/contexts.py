"""Contexts: the fleets that a person works with. A file in the user's config folder lists them.

A context replaces options that a person would repeat: the state repo, the access to the clusters,
the signing key. docs/commands.md describes the file.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, StringConstraints, model_validator

from demandops import strict_yaml
from demandops.config.base_model import CamelModel, DnsLabel, FileModel, parse_file
from demandops.errors import InvalidInput, suggestion
from demandops.field_lines import located_in
from demandops.settings import API_VERSION

Filled = Annotated[str, StringConstraints(min_length=1)]


class Context(CamelModel):
    """The values that a context gives to a command; :mod:`demandops.cli.target` says when."""

    state_repo: Filled
    clusters: Filled | None = None
    signing_key: Filled | None = None


class ContextsFile(FileModel):
    """``~/.config/demandops/contexts.yaml``: contexts by name, and the one in use."""

    kind: Literal["Contexts"]
    current: DnsLabel | None = None
    contexts: dict[DnsLabel, Context] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _known(self) -> ContextsFile:
        if self.current is not None and self.current not in self.contexts:
            raise ValueError(
                f"current: there is no context '{self.current}'"
                f"{suggestion(self.current, self.contexts)}"
            )
        return self


def path() -> Path:
    root = os.environ.get("XDG_CONFIG_HOME") or str(Path.home() / ".config")
    return Path(root) / "demandops" / "contexts.yaml"


def read() -> ContextsFile:
    """Return the contexts in the file; without a file there are none."""
    try:
        text = path().read_text(encoding="utf-8")
    except FileNotFoundError:
        return ContextsFile(apiVersion=API_VERSION, kind="Contexts")
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidInput.at(
            "", f"cannot be read: {error}; replace the file", file=str(path())
        ) from None
    with located_in(text):
        return parse_file(ContextsFile, text, str(path()))


def write(content: ContextsFile) -> None:
    """Write the contexts to the file, which only its owner may read."""
    file = path()
    file.parent.mkdir(parents=True, exist_ok=True)
    data = content.model_dump(by_alias=True, exclude_none=True)
    # written beside the file and then renamed, so that no other command reads half a file
    new = file.with_name(f".{file.name}.new")
    new.write_text(strict_yaml.dump(data), encoding="utf-8")
    new.chmod(0o600)
    new.replace(file)


def named(name: str, field: str = "") -> Context:
    """Return the context of this name; a fault names ``field`` as the place of the name."""
    contexts = read().contexts
    if name not in contexts:
        message = f"there is no context '{name}'{suggestion(name, contexts)}"
        raise InvalidInput.at(field, message, file=str(path()))
    return contexts[name]
