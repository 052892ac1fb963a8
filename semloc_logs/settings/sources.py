"""Where settings come from: a method, a YAML file, the environment, flags."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import yaml
from pydantic import ValidationError

from semloc_logs.errors import SettingsError, did_you_mean
from semloc_logs.schemas import names, read_text
from semloc_logs.settings.configuration import Settings

_MOST_BYTES = 1 << 20  # of a YAML file
_BY_TOPIC = "logs.time_offset."  # the rest of such a key is a topic, which may have dots


class _Loader(yaml.SafeLoader):
    """Without aliases: a few lines of aliases of aliases stand for more than any memory holds."""

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            raise yaml.composer.ComposerError(None, None, "aliases are not supported", None)
        return super().compose_node(parent, index)


def _from_yaml(text: str) -> Any:
    """ValueError for other text; the values of tags and dates raise many other types."""
    try:
        return yaml.load(text, Loader=_Loader)
    except (
        yaml.YAMLError,
        ValueError,
        TypeError,
        LookupError,
        AttributeError,
        RecursionError,
    ) as problem:
        raise ValueError(" ".join(str(problem).split())[:200].rstrip(".")) from None


def read_yaml(path: Path, what: str) -> Any:
    """The content of the YAML file ``path``. SettingsError, which calls it ``what``, when it cannot
    be read or is larger than 1 MiB.
    """
    try:
        with path.open("rb") as file:
            content = file.read(_MOST_BYTES + 1)
        if len(content) > _MOST_BYTES:
            raise SettingsError(f"{what} {path} is larger than a megabyte: name another file.")
        return _from_yaml(content.decode())
    except (OSError, ValueError) as problem:
        raise SettingsError(f"{what} {path} cannot be read as YAML: {problem}.") from None


def load(
    file: Path | None = None,
    assignments: Mapping[str, str] | None = None,
    environment: Mapping[str, str] | None = None,
    method: str | None = None,
) -> Settings:
    """Settings from defaults < ``method`` < ``file`` (YAML) < ``environment`` < ``assignments``
    (``key.path`` -> YAML value).

    A ``method`` is a settings file of the package (schemas/methods). Raises SettingsError naming
    the key when it is unknown or its value impossible.
    """
    merged: dict[str, Any] = {}
    if file is not None:
        content = read_yaml(file, "Settings file")
        if content is not None and not isinstance(content, dict):
            raise SettingsError(
                f"Settings file {file} does not hold a mapping of sections such as 'fusion:'."
            )
        # a section may be empty
        merged = {str(k): {} if v is None else v for k, v in (content or {}).items()}
    if method is not None:
        for section, values in _method(method).items():
            given = merged.setdefault(section, {})
            merged[section] = {**values, **given} if isinstance(given, dict) else given
    for name, value in (environment or {}).items():
        if name.startswith("SEMLOC_") and "__" in name:
            _assign(merged, name[len("SEMLOC_") :].lower().replace("__", "."), value)
    for key, value in (assignments or {}).items():
        _assign(merged, key, value)
    return validated(merged)


def _method(name: str) -> dict[str, dict[str, Any]]:
    """The sections of a named method; SettingsError for another name."""
    known = names("methods", ".yaml")
    if name not in known:
        raise SettingsError(f"Unknown method '{name}': there are {', '.join(known)}.")
    content: dict[str, dict[str, Any]] = _from_yaml(read_text(f"methods/{name}.yaml"))
    return content


def validated(content: Mapping[str, Any]) -> Settings:
    """The settings of a mapping of sections. SettingsError names a key that is wrong."""
    try:
        return Settings.model_validate(content)
    except ValidationError as problem:
        first = problem.errors()[0]
        key = ".".join(str(p) for p in first["loc"])
        if first["type"] == "extra_forbidden":
            raise SettingsError(
                f"Unknown setting '{key}': 'semloc run --dump-config' prints every key."
                f"{did_you_mean(key, _keys())}"
            ) from None
        raise SettingsError(
            f"Setting '{key}' cannot be {first.get('input')!r}: {first['msg']}."
        ) from None


def _keys() -> list[str]:
    """Every section, and every setting by its key path."""
    sections = {name: type(values).model_fields for name, values in Settings()}
    return [*sections, *(f"{name}.{key}" for name, fields in sections.items() for key in fields)]


def choices() -> dict[str, tuple[str, ...]]:
    """The key of every setting, with its values where it has a few fixed ones."""
    by_key: dict[str, tuple[str, ...]] = {}
    for section, values in Settings():
        for name, field in type(values).model_fields.items():
            kinds = (field.annotation, *get_args(field.annotation))
            fixed = [v for kind in kinds if get_origin(kind) is Literal for v in get_args(kind)]
            of_switch = ("true", "false") if bool in kinds else ()
            by_key[f"{section}.{name}"] = tuple(map(str, fixed)) or of_switch
    return by_key


def _assign(tree: dict[str, Any], key: str, value: str) -> None:
    if key.startswith(_BY_TOPIC):
        *parents, last = (*_BY_TOPIC.strip(".").split("."), key.removeprefix(_BY_TOPIC))
    else:
        *parents, last = key.split(".")
    for part in parents:
        child = tree.setdefault(part, {})
        if not isinstance(child, dict):
            raise SettingsError(f"Unknown setting '{key}': '{part}' is not a section.")
        tree = child
    try:
        tree[last] = _from_yaml(value)
    except ValueError:
        raise SettingsError(f"Setting '{key}' has a value that is not YAML: {value!r}.") from None
