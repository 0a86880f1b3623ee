"""Composition by Hydra: the groups of ``configs`` and of a user's folder, recipes, experiments, single values."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from scene_envs.errors import InvalidInputError, unknown_name

_DOLLAR = "\ue0f0"
"""Character of private use that stands for a dollar sign."""


def group_options(folder: str, config_dir: str = "") -> list[str]:
    """Names of the YAML files of a group, those of the user's folder included, sorted."""
    places = [resources.files("configs") / folder, *([Path(config_dir) / folder] if config_dir else [])]
    return sorted(
        {file.name[: -len(".yaml")] for place in places if place.is_dir() for file in place.iterdir() if
         file.name.endswith(".yaml")}
    )  # fmt: skip


def compose_tree(
    command: str,
    kind: type,
    words: Sequence[str],
    *,
    base: Mapping[str, Any] | None = None,
    config_dir: str = "",
) -> dict[str, Any]:
    """Values of a config as nested mappings, from ``key=value`` words as Hydra reads them; not validated.

    Args:
        command: whose keys these are, for messages.
        kind: the config dataclass, whose fields say which groups there are.
        words: options of groups, ``+experiment=NAME``, and values by dotted key.
        base: values to start from, those of a ``config.yaml``, in place of the defaults.
        config_dir: a folder with further groups and experiments.

    Raises:
        InvalidInputError: Hydra cannot read a word or a file.
    """
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    folders = {
        field.name: field.metadata["folder"] for field in dataclasses.fields(kind) if field.metadata.get("folder")
    }
    whole = {field.name for field in dataclasses.fields(kind) if field.metadata.get("named")}
    chosen: dict[str, str] = {}
    values, overrides = [], []
    for word in words:
        key, _, value = word.partition("=")
        if key in folders and value.startswith("{"):
            values.append(f"++{word}")
            if key in whole and base is None:
                chosen[key] = ""
        elif key in folders or key == "recipe":
            chosen[key] = value
        elif key.startswith(("+", "~")):
            overrides.append(word)
        else:
            values.append(f"++{word}")
    if config_dir:
        if not Path(config_dir).is_dir():
            raise InvalidInputError(f"--config-dir {config_dir}: no such folder")
        overrides.append(f"hydra.searchpath=[file://{Path(config_dir).resolve()}]")
    tree = {key: value for key, value in (base or {}).items() if key not in chosen}
    defaults: list[Any] = ["_self_"]
    if base is None:
        defaults += [_entry(folders[field.name], field) for field in dataclasses.fields(kind) if field.name in folders]
        defaults += [{"recipe": "ours"}] if any(field.name == "recipe" for field in dataclasses.fields(kind)) else []
        for key, value in chosen.items():
            group = _group(folders.get(key, key), key)
            overrides.append(f"{group}={value}" if value else f"~{group}")
    else:
        if "recipe" in chosen:
            raise InvalidInputError("recipe= and --config exclude each other: the file says everything already")
        overrides += [f"+{_group(folders[key], key)}={value}" for key, value in chosen.items()]
    primary = {"defaults": defaults, **hidden(tree)}
    try:
        result = _quickly(command, primary, overrides, values) if base is None and not config_dir else None
        if result is None:
            result = _by_hydra(command, primary, [*overrides, *values])
    except ValueError as error:
        if isinstance(error, HydraException | OmegaConfBaseException):
            raise InvalidInputError(f"{command}: {_reason(error)}") from error
        raise InvalidInputError(f"{command}: a value cannot be read ({str(error)[:100]})") from None
    except (HydraException, OmegaConfBaseException) as error:
        if f"In 'recipe/{chosen.get('recipe')}'" in str(error):
            raise InvalidInputError(
                f"recipe={chosen['recipe']} is not for {command}: it chooses from groups that {command} does not have"
            ) from error
        raise InvalidInputError(f"{command}: {_reason(error)}") from error
    return result


def _by_hydra(command: str, primary: Mapping[str, Any], words: Sequence[str]) -> dict[str, Any]:
    """The composition by Hydra of a primary config and the words for it."""
    from hydra import compose, initialize_config_module
    from hydra.core.config_store import ConfigStore
    from omegaconf import OmegaConf

    name = f"{command.replace('-', '_')}_primary"
    ConfigStore.instance().store(name=name, node=dict(primary))
    with initialize_config_module("configs", version_base="1.3"):
        composed = compose(name, overrides=[hidden(word) for word in words])
    result = shown(OmegaConf.to_container(composed, resolve=False))
    assert isinstance(result, dict)
    return {str(key): value for key, value in result.items()}


_GROUPS: dict[tuple[str, ...], dict[str, Any]] = {}
"""Composed values of packaged groups, by the groups chosen; Hydra takes a tenth of a second to compose them."""


def _quickly(
    command: str, primary: Mapping[str, Any], groups: Sequence[str], values: Sequence[str]
) -> dict[str, Any] | None:
    """The composition of :func:`_by_hydra`, where each choice of groups is composed only once.

    Single values are set in a copy, as Hydra does in its last step.

    Returns:
        None where Hydra itself has to interpret a value, or to report what is wrong with it.
    """
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    key = (str(primary), *groups)
    if key not in _GROUPS:
        _GROUPS[key] = _by_hydra(command, primary, groups)
    tree = OmegaConf.create(hidden(_GROUPS[key]))
    try:
        for override in OverridesParser.create().parse_overrides([hidden(word) for word in values]):
            name, value = override.key_or_group, override.value()
            is_group = bool(group_options(name.replace(".", "/"))) and not isinstance(value, dict)
            if override.is_sweep_override() or override.package is not None or is_group:
                return None
            OmegaConf.update(tree, name, value, merge=True, force_add=True)
    except (HydraException, OmegaConfBaseException, ValueError):
        return None
    result = shown(OmegaConf.to_container(tree, resolve=False))
    return {str(key): value for key, value in result.items()}


def hidden(value: Any) -> Any:
    """``value`` with every ``${`` in its texts encoded, so that OmegaConf does not read it as an interpolation.

    >>> shown(hidden({"text": "${oc.env:HOME}"}))
    {'text': '${oc.env:HOME}'}
    """
    return _replaced(value, "${", _DOLLAR + "{")


def shown(value: Any) -> Any:
    """Inverse of :func:`hidden`."""
    return _replaced(value, _DOLLAR + "{", "${")


def _replaced(value: Any, old: str, new: str) -> Any:
    if isinstance(value, str):
        return value.replace(old, new)
    if isinstance(value, Mapping):
        return {_replaced(key, old, new): _replaced(item, old, new) for key, item in value.items()}
    return [_replaced(item, old, new) for item in value] if isinstance(value, list | tuple) else value


def check_option(folder: str, option: str, config_dir: str = "", others: Sequence[str] = ()) -> None:
    """Refuse an option that a group does not have.

    Raises:
        UnknownNameError: names the nearest one.
    """
    known = {*group_options(folder, config_dir), *others}
    if option not in known:
        raise unknown_name(folder, option, known)


def choice_word(field: dataclasses.Field[Any], value: str, config_dir: str = "") -> str:
    """The word that chooses the component ``value`` of a group: by its file, or by its name where it has none.

    Raises:
        UnknownNameError: no file and no registered component has that name.
    """
    folder = field.metadata["folder"]
    if value in group_options(folder, config_dir):
        return f"{field.name}={value}"
    check_option(folder, value, config_dir, field.metadata["registered"]())
    return f"{field.name}.name={value}"


def _group(folder: str, key: str) -> str:
    return folder if folder == key else f"{folder}@{key}"


def _entry(folder: str, field: dataclasses.Field[Any]) -> dict[str, Any]:
    option = field.metadata.get("option") or None
    return {_group(folder, field.name): option if option in group_options(folder) else None}


def _reason(error: BaseException) -> str:
    while error.__cause__ is not None:
        error = error.__cause__
    return str(error).splitlines()[0].strip().rstrip(".")
