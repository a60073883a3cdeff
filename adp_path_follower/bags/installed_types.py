"""Definitions of message types: as they are installed, else as ROS 2 Jazzy has them."""

import functools
import os
import re
import sys
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from adp_path_follower.core.errors import FileError

_TYPE_NAME = re.compile(r"([A-Za-z]\w*)/msg/([A-Za-z]\w*)", re.ASCII)
_SEPARATOR = "=" * 80


class UnknownTypeError(FileError):
    """Report a message type whose definition is not known."""


@dataclass(frozen=True)
class TypeText:
    """A message type as a bag describes it."""

    # The text of its .msg file, and behind it those of all types in it, as rosbag2 joins them.
    definition: str
    type_hash: str  # its hash (RIHS01)


@functools.lru_cache(maxsize=1024)
def type_text(type_name: str) -> TypeText:
    """Return definition and hash of a type; UnknownTypeError if it is defined nowhere."""
    try:
        return _installed(type_name)
    except Exception as error:  # rosbags' parser has no common error
        found = text_of_jazzy(type_name)
        if found is not None:
            return found
        reason = " ".join(str(error).split()).rstrip(".")
        raise UnknownTypeError(
            f"unknown type {type_name}: {reason}; install its package, or source its workspace"
        ) from None


def text_of_jazzy(type_name: str) -> TypeText | None:
    """Return ROS 2 Jazzy's own definition of a type, if it knows the type."""
    store = get_typestore(Stores.ROS2_JAZZY)
    if type_name not in store.fielddefs:
        return None
    definition, _ = store.generate_msgdef(type_name, ros_version=2)
    return TypeText(definition, store.hash_rihs01(type_name))


def _installed(type_name: str) -> TypeText:
    """Return definition and hash as the .msg files of the installed packages say."""
    texts: dict[str, str] = {}
    _collect(type_name, texts)
    first, *others = texts.values()
    names = [name.replace("/msg/", "/") for name in texts][1:]
    definition = first + "".join(
        f"\n{_SEPARATOR}\nMSG: {name}\n{text}" for name, text in zip(names, others, strict=True)
    )
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(definition, type_name))
    return TypeText(definition, store.hash_rihs01(type_name))


def _collect(type_name: str, texts: dict[str, str]) -> None:
    """Gather the text of a type and then of those in it, in the order of rosbag2."""
    texts[type_name] = _message_file(type_name).read_text(encoding="utf-8")
    _, fields = get_types_from_msg(texts[type_name], type_name)[type_name]
    for inner in sorted(set(filter(None, (_inner_type(kind) for _, kind in fields)))):
        if inner not in texts:
            _collect(inner, texts)


def _inner_type(kind: tuple[Nodetype, Any]) -> str:
    """Return the name of the message type in a field's type, empty for numbers and texts."""
    node, content = kind
    if node == Nodetype.NAME:
        return str(content)
    if node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        return _inner_type(content[0])  # and the length
    return ""


def _message_file(type_name: str) -> FilePath:
    match = _TYPE_NAME.fullmatch(type_name)
    if match is None:
        raise UnknownTypeError("only types named PACKAGE/msg/NAME can be recorded")
    package, name = match.groups()
    # Wheels of ROS 2 install below Python's own prefix, where no setup file has to be sourced.
    prefixes = [*os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep), sys.prefix]
    for prefix in filter(None, prefixes):
        file = FilePath(prefix, "share", package, "msg", f"{name}.msg")
        if file.is_file():
            return file
    raise UnknownTypeError(f"no installed package has the file share/{package}/msg/{name}.msg")
