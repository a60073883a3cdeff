"""The configuration of a controller, as text in a bag: written by nodes, read by analyses."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields

import yaml

from adp_path_follower import __version__
from adp_path_follower.core.driving.output import Counts
from adp_path_follower.core.errors import FileError
from adp_path_follower.core.files import parse_yaml
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.route import Route
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build, flatten, yaml_text

NO_STEP = -1
_NOTHING = Counts()


@dataclass(frozen=True)
class Configuration:
    """The configuration of a controller from some control step on."""

    values: Mapping[str, object]  # setting -> value, as far as the bag says
    path_digest: str = ""  # `Route.digest` of the route that is followed, empty without one
    # Stamp of the last control step before it was in force [ns], `NO_STEP` if none.
    after_step: int = NO_STEP
    counts: Counts = _NOTHING  # resets, restarts and stops since the node's start
    saved_weights: str = ""  # digest of the weights file that it started from, empty without one

    @property
    def settings(self) -> Settings:
        """Return the settings; raise SettingsError if they are none of this version."""
        return build(Settings, self.values)


def configuration_text(
    settings: Settings,
    path: Route | Path | None,
    after_step: int = NO_STEP,
    counts: Counts = _NOTHING,
    saved_weights: str = "",
) -> str:
    """Return the text that says what a controller runs with, as YAML."""
    lines = [f"version: {__version__}"]
    if path is not None:
        lines.append(f"path: {{digest: '{path.digest()}', length: {path.length!r}}}")
    lines.append(f"after_step: {after_step}")
    lines += [f"{name}: {count}" for name, count in asdict(counts).items()]
    if saved_weights:
        lines.append(f"saved_weights: '{saved_weights}'")
    lines.append("settings:")
    lines += [f"  {name}: {yaml_text(value)}" for name, value in flatten(settings).items()]
    return "\n".join(lines) + "\n"


def parse_configuration(text: str) -> Configuration:
    """Return the configuration in a text; raise FileError if no controller wrote it."""
    try:
        content = parse_yaml(text)
    except yaml.YAMLError:
        content = None
    values = content.get("settings") if isinstance(content, dict) else None
    if (
        not isinstance(content, dict)
        or not isinstance(values, dict)
        or not all(isinstance(name, str) for name in values)
    ):
        raise FileError("the bag has no sound path_follower/configuration: it names no settings")
    path = content.get("path")

    def whole(name: str, default: int) -> int:
        value = content.get(name)
        return value if isinstance(value, int) else default

    return Configuration(
        values=values,
        path_digest=str(path.get("digest", "")) if isinstance(path, dict) else "",
        after_step=whole("after_step", NO_STEP),
        counts=Counts(**{field.name: whole(field.name, 0) for field in fields(Counts)}),
        saved_weights=str(content.get("saved_weights", "")),
    )
