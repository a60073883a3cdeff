"""Reads the entries of sweep and tuning files; errors name the file and the section."""

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path as FilePath
from typing import TypeVar

from adp_path_follower.core.errors import AdpError, SettingsError
from adp_path_follower.core.files import read_yaml
from adp_path_follower.core.settings.schema import build, setting_fields
from adp_path_follower.resources import did_you_mean

Tree = TypeVar("Tree")
Entries = dict[str, object]


def read_entries(file: FilePath) -> Entries:
    """Return the NAME: VALUE entries of a YAML file; FileError or SettingsError if it has none."""
    content = read_yaml(file)
    if not isinstance(content, Mapping):
        raise SettingsError(f"file {file} must hold NAME: VALUE entries (adp docs sweeps)")
    return {str(name): value for name, value in content.items()}


@contextlib.contextmanager
def errors_in(place: str) -> Iterator[None]:
    """Turn an AdpError of the block into a SettingsError that names its file or section first."""
    try:
        yield
    except AdpError as error:
        raise SettingsError(f"{place}: {error}") from None


def section(entries: Mapping[str, object], name: str) -> Entries:
    """Return an entry that holds entries itself, empty if missing; SettingsError if it is none."""
    found = entries.get(name, {})
    if not isinstance(found, Mapping):
        raise SettingsError(f"'{name}' is {found!r}, but must be NAME: VALUE entries")
    return {str(key): value for key, value in found.items()}


def build_entries(tree: type[Tree], entries: Mapping[str, object], others: Sequence[str]) -> Tree:
    """Return the settings tree of a file's entries but `others`; SettingsError if one is wrong."""
    fields = {field.name: field for field in setting_fields(tree)}
    values: Entries = {}
    for name, value in entries.items():
        if name in fields:
            single = fields[name].item_kind is str and isinstance(value, str)
            values[name] = [value] if single else value
        elif name not in others:
            raise SettingsError(f"unknown entry '{name}'{did_you_mean(name, [*others, *fields])}")
    return build(tree, values)
