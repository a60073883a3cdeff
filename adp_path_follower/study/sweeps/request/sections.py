"""YAML files of named entries: what is read, checked, and refused in one sentence."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path as FilePath

from adp_path_follower.core.errors import SettingsError
from adp_path_follower.core.files import expanded, read_yaml


class Section:
    """A mapping in a file; it knows what to call itself when something in it is wrong."""

    def __init__(self, place: str, folder: FilePath, content: Mapping[object, object]) -> None:
        """Take the content of a place, as messages call it; files are named from the folder."""
        self._place = place
        self._folder = folder
        self._content = {str(name): value for name, value in content.items()}

    def problem(self, text: str) -> SettingsError:
        """Return the error that says where something is wrong."""
        return SettingsError(f"{self._place}: {text}")

    def items(self) -> Iterator[tuple[str, object]]:
        """Return names and values."""
        return iter(self._content.items())

    def __contains__(self, name: str) -> bool:
        """Return whether there is an entry of this name."""
        return name in self._content

    def only(self, known: Sequence[str]) -> None:
        """Refuse entries that have other names.

        Raises:
            SettingsError: There is one; the message proposes the nearest known name.

        """
        for name in self._content:
            if name not in known:
                near = difflib.get_close_matches(name, known, n=1)
                hint = f"did you mean '{near[0]}'?" if near else f"known are {', '.join(known)}"
                raise self.problem(f"unknown entry '{name}'; {hint}")

    def get(self, name: str, default: object = None) -> object:
        """Return an entry as the file has it."""
        return self._content.get(name, default)

    def section(self, name: str) -> Section:
        """Return an entry that is a mapping itself; an empty one if it is not there."""
        found = self._content.get(name, {})
        if not isinstance(found, Mapping):
            raise self.problem(f"'{name}' is {found!r}, but must be NAME: VALUE entries")
        return Section(f"{self._place}, {name}", self._folder, found)

    def number(
        self, name: str, default: float, *, low: float = 0.0, high: float = math.inf
    ) -> float:
        """Return an entry that is a finite number within bounds."""
        value = self._content.get(name, default)
        plain = not isinstance(value, bool)
        if (
            plain
            and isinstance(value, int | float)
            and math.isfinite(value)
            and low <= value <= high
        ):
            return float(value)
        bounds = [f"at least {low:g}"] if math.isfinite(low) else []
        bounds += [f"at most {high:g}"] if math.isfinite(high) else []
        wanted = ", ".join(["must be a finite number", *bounds])
        raise self.problem(f"'{name}' is {value!r}, but {wanted}")

    def whole(self, name: str, default: int, *, low: int, high: int) -> int:
        """Return an entry that is an integer."""
        value = self._content.get(name, default)
        if not isinstance(value, int) or isinstance(value, bool) or not low <= value <= high:
            raise self.problem(
                f"'{name}' is {value!r}, but must be an integer from {low} to {high}"
            )
        return value

    def choice(self, name: str, default: str, known: Sequence[str]) -> str:
        """Return an entry that is one of some words."""
        value = self._content.get(name, default)
        if value not in known:
            raise self.problem(f"'{name}' is {value!r}, but must be one of {', '.join(known)}")
        return str(value)

    def words(self, name: str, default: Sequence[str]) -> tuple[str, ...]:
        """Return an entry that is a list of texts, or one text."""
        value = self._content.get(name, list(default))
        value = [value] if isinstance(value, str) else value
        if not isinstance(value, list) or not value or not all(isinstance(v, str) for v in value):
            raise self.problem(f"'{name}' is {value!r}, but must be a list of names")
        if len(set(value)) < len(value):
            raise self.problem(f"'{name}' has a name twice: {', '.join(value)}")
        return tuple(value)

    def file_entry(self, name: str) -> FilePath | None:
        """Return the file that an entry names."""
        value = self._content.get(name)
        if value is None:
            return None
        if not isinstance(value, str):
            raise self.problem(f"'{name}' is {value!r}, but must be a file name")
        return self.beside(value)

    def beside(self, name: str) -> FilePath:
        """Return a file by its name as seen from the folder of the content.

        Raises:
            FileError: Its name begins with nobody's home.

        """
        return self._folder / expanded(name)


def read_sections(file: FilePath) -> Section:
    """Return the content of a YAML file of named entries.

    Raises:
        FileError: The file cannot be read.
        SettingsError: It holds something else than named entries.

    """
    content = read_yaml(file)
    if not isinstance(content, Mapping):
        raise SettingsError(f"file {file} must hold NAME: VALUE entries (adp docs sweeps)")
    return Section(f"file {file}", file.parent, content)
