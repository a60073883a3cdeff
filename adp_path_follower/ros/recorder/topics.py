"""Decides which topics a recorder takes: by name or by regular expression."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from adp_path_follower.core.errors import SettingsError

_NAME = re.compile(r"[~/\w{}]+", re.ASCII)  # what is no topic name is a regular expression


@dataclass(frozen=True)
class TopicPatterns:
    """Names and regular expressions of topics."""

    names: frozenset[str]
    expressions: tuple[re.Pattern[str], ...]
    namespace: str

    def match(self, topic: str) -> bool:
        """Return whether a topic, by its full name, is meant.

        An expression must match the whole name: the full one, or the one within the namespace.
        """
        relative = topic.removeprefix(f"{self.namespace.rstrip('/')}/")
        return topic in self.names or any(
            expression.fullmatch(topic) or expression.fullmatch(relative)
            for expression in self.expressions
        )


def topic_patterns(
    setting: str, texts: Sequence[str], namespace: str, resolve: Callable[[str], str]
) -> TopicPatterns:
    """Return the patterns that a setting lists, for a node in a namespace.

    `resolve` takes a name and returns the full name, after remapping. Raises SettingsError for a
    text that is neither a name nor a regular expression.
    """
    names, expressions = set(), []
    for text in texts:
        if _NAME.fullmatch(text):
            names.add(_resolved(setting, text, resolve))
            continue
        try:
            expressions.append(re.compile(text))
        except re.error as error:
            raise SettingsError(
                f"setting '{setting}' lists {text!r}, which is no regular expression: {error}; "
                "write a topic's name, or an expression like '/robot/.*'"
            ) from None
    return TopicPatterns(frozenset(names), tuple(expressions), namespace)


def _resolved(setting: str, name: str, resolve: Callable[[str], str]) -> str:
    try:
        return resolve(name)
    except Exception as error:  # rclpy has several types for names that ROS does not allow
        reason = " ".join(str(error).split()).split(", at ")[0]
        raise SettingsError(
            f"setting '{setting}' lists {name!r}, which is no topic name: {reason}"
        ) from None
