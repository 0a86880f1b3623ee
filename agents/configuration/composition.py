"""Configuration: nested dataclasses checked by type, and their values from registries and files by Hydra."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import math
import re
import sys
import types
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from importlib.util import find_spec
from numbers import Number
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin, get_type_hints

from agents.utils.loggers import LOGGERS
from scene_envs.envs.settings import check_claim_guidance, check_guidance
from scene_envs.errors import (
    Checked,
    CorruptFileError,
    Count,
    InvalidInputError,
    Limit,
    Natural,
    OneOf,
    Positive,
    Seed,
    unknown_name,
)
from scene_envs.progress import STYLES
from scene_envs.registry import plugin_entry_points
from scene_envs.scene_types import list_scene_types

Config = TypeVar("Config")
Kind = TypeVar("Kind", bound=type)
Texts = Annotated[Any, str | list[str] | None]
"""Type of a key that takes a text or several; OmegaConf has no union with a list, so the dataclass checks the value."""

_WANTED: dict[Any, str] = {
    int: "a whole number",
    float: "a number",
    bool: "true or false",
    str: "a text",
    NoneType: "null",
}


def check_types(kind: type, values: Mapping[str, Any]) -> None:
    """Refuse values of the wrong type for the fields of a dataclass that are numbers, texts or booleans.

    >>> from dataclasses import make_dataclass
    >>> check_types(make_dataclass("Size", [("depth", int)]), {"depth": "deep"})
    Traceback (most recent call last):
    scene_envs.errors.InvalidInputError: depth=deep is not a whole number
    """
    for name, wanted in _hints(kind)[0].items():
        plain = set(get_args(wanted) if get_origin(wanted) in (Union, types.UnionType) else (wanted,))
        if name not in values or not plain <= {int, float, str, bool, NoneType}:
            continue
        value = values[name]
        fits = type(value) in plain or (float in plain and type(value) is int)
        if not fits or (isinstance(value, float) and not math.isfinite(value)):
            raise _refusal(wanted, value, name)


# Dataclasses from nested mappings and back


def build(kind: type[Config], tree: Mapping[str, Any], path: str = "", command: str = "") -> Config:
    """An instance of the dataclass ``kind`` from a nested mapping, as a structured config of OmegaConf: missing keys
    keep their defaults, values are converted to the types of the fields, and interpolations are resolved. ``path`` is
    the place of ``tree`` in messages, such as ``"optimizer."``.

    Raises:
        UnknownNameError: a key that ``kind`` does not have; the nearest one is offered.
        InvalidInputError: a value is not of the type of its key.
    """
    from omegaconf import OmegaConf, errors

    OmegaConf.register_new_resolver("text", lambda code: bytes.fromhex(code[1:]).decode(), replace=True)
    values, parts = dict(tree), {}
    for field in dataclasses.fields(kind):  # type: ignore[arg-type]
        value = values.get(field.name)
        if field.metadata.get("kinds") and isinstance(value, Mapping):
            parts[field.name] = _kind_of(field, value)
        elif field.metadata.get("named") and field.name in values:
            if isinstance(value, int | float):
                typed = as_command_line_text(value)[:60]
                raise InvalidInputError(f"{path}{field.name}={typed} is neither a name nor a mapping with a name")
            values[field.name] = _shortest(value)
    schema = _schema(kind, tuple(parts.items()))  # type: ignore[arg-type]
    try:
        _check_kinds(schema, values, path)
        made: Any = OmegaConf.to_object(OmegaConf.merge(schema, values))
    except errors.InterpolationResolutionError as error:
        place = f"{command}: {path}{error.full_key}".removeprefix(": ")
        raise InvalidInputError(
            f"{place}: {reason_of(error)}; ${{KEY}} is the value of another key, ${{oc.env:NAME}} of the environment"
        ) from error
    except (errors.ConfigKeyError, errors.KeyValidationError) as error:
        known = [path + key for key in dotted(OmegaConf.to_container(schema))]  # type: ignore[arg-type]
        head = (error.full_key or "").partition(".")[0]
        option = values[head].get("name") if head in parts else None
        owner = f" with {path}{head}={option}," if option else ""
        raise unknown_name(f"{command} key{owner}".strip(), f"{path}{error.full_key}", known) from error
    except errors.OmegaConfBaseException as error:
        place = (error.full_key or "").partition("[")[0]
        parent, _, name = place.rpartition(".")
        hint = hint_of(OmegaConf.get_type(OmegaConf.select(schema, parent) if parent else schema), name)
        value = functools.reduce(lambda inner, key: inner[key], place.split("."), values)
        raise _refusal(hint, value, path + place) from error
    return made


@functools.cache
def _schema(kind: type, parts: tuple[tuple[str, type], ...]) -> Any:
    """The structured config of ``kind`` with other dataclasses for some groups; to be read only, as it is made once."""
    from omegaconf import OmegaConf

    schema = OmegaConf.structured(kind)
    for name, part in parts:
        schema[name] = OmegaConf.structured(part)
    return schema


def _check_kinds(schema: Any, values: Mapping[str, Any], path: str) -> None:
    """Refuse a value in the place of a group of keys, and a number in that of a boolean, which OmegaConf takes."""
    from omegaconf import DictConfig, OmegaConf

    for key, value in values.items():
        if isinstance(group := schema[key], DictConfig) and dataclasses.is_dataclass(OmegaConf.get_type(group)):
            if isinstance(value, Mapping):
                _check_kinds(group, value, f"{path}{key}.")
            elif not str(value).startswith("${"):
                raise _no_group(path + key, value, group)
        elif isinstance(group, bool) and isinstance(value, int | float) and not isinstance(value, bool):
            raise _refusal(bool, value, path + key)


def _no_group(path: str, value: Any, keys: Iterable[Any]) -> InvalidInputError:
    known = ", ".join(f"{path}.{key}" for key in keys)
    return InvalidInputError(f"{path}={as_command_line_text(value)}: {path} is a group of keys; give one of {known}")


def verbatim(value: Any) -> Any:
    """Nested values in which OmegaConf reads all texts as they stand, also those that look like an interpolation."""
    if isinstance(value, Mapping):
        return {key: verbatim(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [verbatim(item) for item in value]
    if isinstance(value, Number) and hasattr(value, "item"):
        return value.item()  # of NumPy
    is_plain = not isinstance(value, str) or ("${" not in value and value != "???")
    return value if is_plain else f"${{text:x{value.encode().hex()}}}"


def _as_given(message: str) -> str:
    """A message with the texts of :func:`verbatim` as they were given."""
    return re.sub(r"\$\{text:x(\w+)\}", lambda found: bytes.fromhex(found[1]).decode(), message)


def _shortest(value: Any) -> Any:
    """A component by its name alone, where a mapping holds no settings of it."""
    return value["name"] if isinstance(value, Mapping) and set(value) == {"name"} else value


def _kind_of(field: dataclasses.Field[Any], value: Mapping[str, Any]) -> Any:
    """The dataclass of a group; where its keys depend on the name of a component, that of the component."""
    kind: Any = field.default_factory
    return kinds(value.get("name", kind.name)) if (kinds := field.metadata.get("kinds")) else kind


def _group(field: dataclasses.Field[Any], value: Any) -> Any:
    """The value of a field; of a group, which may be given as a mapping, its dataclass."""
    kind: Any = field.default_factory
    if not dataclasses.is_dataclass(kind) or dataclasses.is_dataclass(value):
        return _shortest(value) if field.metadata.get("named") else value
    if not isinstance(value, Mapping):
        raise _no_group(field.name, value, [inner.name for inner in dataclasses.fields(kind)])
    return build(_kind_of(field, value), verbatim(value), f"{field.name}.")


def changed(config: Config, changes: Mapping[str, Any]) -> Config:
    """A copy of a config with some values changed, by dotted key.

    >>> changed(RewardLimitKeys(), {"reward_limits.timeout": 3})
    RewardLimitKeys(reward_limits=RewardLimits(timeout=3.0, memory=1.0))
    """
    fields = {field.name: field for field in dataclasses.fields(config)}  # type: ignore[arg-type]
    values: dict[str, Any] = {}
    for key, value in changes.items():
        head, *inner = key.split(".")
        if head not in fields:
            raise unknown_name("key", key, dotted_values(config))
        for part in reversed(inner):
            value = {part: value}
        before = plain_tree(values.get(head, getattr(config, head)))
        values[head] = layered(type(config), {head: before}, {head: value})[head] if inner else value
    groups = {name: _group(fields[name], value) for name, value in values.items() if isinstance(value, Mapping)}
    return dataclasses.replace(config, **{**values, **groups})  # type: ignore[type-var]


def dotted_values(config: Any) -> dict[str, Any]:
    """All values of a config; a key of a group stands behind the name of the group and a dot."""
    values: dict[str, Any] = {}
    for name in [field.name for field in dataclasses.fields(config)]:
        value = getattr(config, name)
        inner = dotted_values(value) if dataclasses.is_dataclass(value) else None
        values |= {name: value} if inner is None else {f"{name}.{key}": item for key, item in inner.items()}
    return values


def dotted(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested mappings as one flat mapping with dotted keys.

    >>> dotted({"optimizer": {"lr": 0.1}, "seed": 0})
    {'optimizer.lr': 0.1, 'seed': 0}
    """
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        flat |= dotted(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {prefix + key: value}
    return flat


def check_same_keys(
    folder: Path, before: Mapping[str, Any], now: Mapping[str, Any], may_differ: Collection[str], kind: type
) -> None:
    """Refuse to go on in a folder that was written with other values of keys, but for those that ``may_differ``; keys
    of only one of the two do not count, also in a group of the config ``kind``. Settings of a reward or mask do.
    """
    groups = [field.name for field in dataclasses.fields(kind) if dataclasses.is_dataclass(field.default_factory)]
    heads = [key for key in now if key in before and key not in may_differ and before[key] != now[key]]
    was, is_now = (dotted({key: values[key] for key in heads}) for values in (before, now))
    told = [
        f"{key} was {was.get(key)!r}, is {is_now.get(key)!r}"
        for key in {**was, **is_now}
        if was.get(key) != is_now.get(key) and (key.partition(".")[0] not in groups or (key in was and key in is_now))
    ]
    if told:
        raise InvalidInputError(
            f"output={str(folder)!r} was written with other keys ({'; '.join(told)[:500]}); give another output, or "
            "the same keys to go on there"
        )


def plain_tree(value: Any) -> Any:
    """A config as nested mappings, lists, numbers and strings; other values stay as they are."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain_tree(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {key: plain_tree(item) for key, item in value.items()}
    return [plain_tree(item) for item in value] if isinstance(value, list | tuple) else value


def config_text(values: Any) -> str:
    """All keys as the ``config.yaml`` that ``--config`` reads, of a config or a nested mapping; a class's own keys come
    before those of the classes that it extends.
    """
    import yaml

    tree = plain_tree(values)
    own_first = [name for part in type(values).__mro__ for name in inspect.get_annotations(part) if name in tree]
    return yaml.safe_dump({key: tree[key] for key in [*own_first, *tree]}, sort_keys=False)


def parse_config(text: str, place: str) -> dict[str, Any]:
    """The values in the text of a ``config.yaml``; a CorruptFileError, which names its ``place``, without a mapping."""
    import yaml

    try:
        found = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise CorruptFileError(f"{place} is not YAML ({str(error).splitlines()[0]})") from error
    if not isinstance(found, dict):
        raise CorruptFileError(f"{place} holds no keys")
    return found


def _refusal(hint: Any, value: Any, path: str) -> InvalidInputError:
    return InvalidInputError(f"{path}={as_command_line_text(value)[:300]} is not {_wanted(hint)}")


def hint_of(kind: Any, name: str) -> Any:
    """The type of a field, Any where only a component knows it."""
    plain, full = _hints(kind)
    hint = full.get(name, Any)
    return hint.__metadata__[0] if hint == Texts else plain.get(name, Any)


@functools.cache
def _hints(kind: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    """Types of the fields of a dataclass, without and with their annotations; once per class: it takes milliseconds."""
    return get_type_hints(kind), get_type_hints(kind, include_extras=True)


def _wanted(hint: Any) -> str:
    if get_origin(hint) in (Union, types.UnionType):
        return " or ".join(map(_wanted, get_args(hint)))
    if get_origin(hint) in (list, tuple):
        inner = {int: "whole numbers", float: "numbers", str: "texts"}.get((*get_args(hint), Any)[0], "values")
        return f"a list of {inner}"
    if get_origin(hint) is dict:
        return "a mapping, as {key: value}"
    return _WANTED.get(hint, str(hint))


def as_command_line_text(value: Any) -> str:
    """A value as it would be typed on the command line."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, list | tuple):
        return ",".join(map(as_command_line_text, value))
    if dataclasses.is_dataclass(value):
        return f"{{{', '.join(f'{key}: {as_command_line_text(item)}' for key, item in vars(value).items())}}}"
    return _as_given(str(value))


# Groups, their options, and recipes


def nested(
    make: type,
    *,
    folder: str = "",
    option: str = "",
    kinds: Callable[[str], type] | None = None,
    registered: Callable[[], Iterable[str]] = tuple,
    one_key: bool = False,
) -> Any:
    """A field that is a group of keys, a dataclass.

    Args:
        make: dataclass of the group.
        folder: name of the group of options in Hydra; empty where there is nothing to choose.
        option: option that is the default.
        kinds: function from the name of a component to the dataclass of its settings; None where all have the same.
        registered: function that lists the registered components; with a mapping, its values are their settings.
        one_key: whether the keys are listed as one key, a mapping, as those of every group inside a group.
    """
    metadata = {"folder": folder, "option": option, "kinds": kinds, "registered": registered, "one_key": one_key}
    return dataclasses.field(default_factory=make, metadata=metadata)


def named(default: Any, folder: str) -> Any:
    """A field that names a component, or is a mapping with its ``name`` and settings. ``folder`` is the group of
    options in Hydra: ``reward``, ``mask`` or ``scene``.
    """
    return dataclasses.field(
        default=default, metadata={"folder": folder, "named": True, "registered": _REGISTERED[folder]}
    )


def known_rewards() -> list[str]:
    """Names of rewards, as :func:`rewards.list_rewards`; reads the sources, as the package imports torch."""
    if "rewards.registry" in sys.modules:
        from rewards import list_rewards

        return list_rewards()
    folder = Path(str(getattr(find_spec("rewards"), "origin", ""))).parent
    texts = [file.read_text(encoding="utf-8") for file in folder.glob("*.py")]
    own = {name for text in texts for name in re.findall(r'^@register_reward\("(\w+)"\)', text, flags=re.MULTILINE)}
    return sorted({*own, *plugin_entry_points("scene_envs.rewards")})


def known_masks() -> list[str]:
    """Names of mask generators, as :func:`scene_envs.list_masks`; imports no torch."""
    if "scene_envs.envs.masks" in sys.modules:
        from scene_envs.envs.masks import list_masks

        return list_masks()
    from scene_envs.envs.settings import MASKS

    return sorted({*MASKS, *plugin_entry_points("scene_envs.masks")})


_REGISTERED = {"reward": known_rewards, "mask": known_masks, "scene": list_scene_types}


def group_options(folder: str, config_dir: str = "") -> list[str]:
    """Names of the YAML files of a group in ``configs`` and in the user's folder, sorted."""
    places = [resources.files("configs") / folder, *([Path(config_dir) / folder] if config_dir else [])]
    files = [file.name for place in places if folder and place.is_dir() for file in place.iterdir()]
    return sorted({name.removesuffix(".yaml") for name in files if name.endswith(".yaml")})


def field_options(field: dataclasses.Field[Any], config_dir: str = "") -> list[str]:
    """Options of a field: registered components and YAML files, sorted."""
    return sorted({*field.metadata["registered"](), *group_options(field.metadata["folder"], config_dir)})


def check_option(folder: str, option: str, known: Sequence[str]) -> None:
    """Refuse an option that a group does not have."""
    if option not in known:
        raise unknown_name(folder, option, known)


def named_options(
    values: Mapping[str, Any], fields: Mapping[str, dataclasses.Field[Any]], config_dir: str = ""
) -> dict[str, str]:
    """Options of groups among the values of fields, given by a text; refuses one that its group does not have."""
    texts = [name for name, value in values.items() if isinstance(value, str) and name in fields]
    chosen = {name: values[name] for name in texts if fields[name].metadata.get("option")}
    for name, value in chosen.items():
        check_option(name, value, field_options(fields[name], config_dir))
    return chosen


def composed(kind: Kind) -> Kind:
    """A config dataclass that is made in Python as on the command line.

    A group may be given as its dataclass, as a mapping of those of its keys that differ, or as the name of an option;
    ``recipe`` sets all values that are not given.
    """
    init = kind.__init__  # type: ignore[misc]
    signature = inspect.signature(init)
    fields = {field.name: field for field in dataclasses.fields(kind)}

    @functools.wraps(init)
    def __init__(self: Any, *arguments: Any, **keywords: Any) -> None:
        for key in keywords:
            if key not in fields:
                raise unknown_name(f"{kind.__name__} field", key, fields)
        given = dict(signature.bind(self, *arguments, **keywords).arguments)
        given.pop("self")
        init(self, **_complete(kind, given, fields))

    kind.__init__ = __init__  # type: ignore[misc]
    return kind


def _complete(kind: type, given: Mapping[str, Any], fields: Mapping[str, dataclasses.Field[Any]]) -> dict[str, Any]:
    """The values given in Python, over those of the recipe and of the named options."""
    choices = named_options(given, fields)
    options = [*choices]
    if "recipe" in given and given["recipe"] != fields["recipe"].default and len(given) < len(fields):
        choices["recipe"] = given["recipe"]
        check_option("recipe", given["recipe"], group_options("recipe"))
    tree = by_hydra(kind.__name__, kind, choices)
    for name in given.keys() - options:
        is_part = dataclasses.is_dataclass(fields[name].default_factory) and isinstance(given[name], Mapping)
        tree = layered(kind, tree, {name: given[name]}) if is_part else {**tree, name: given[name]}
    return {name: _group(fields[name], value) for name, value in with_implied(kind, tree).items()}


def with_implied(kind: type, tree: Mapping[str, Any]) -> dict[str, Any]:
    """The values of a config, with an option for each group that names none where the class method
    ``implied_options`` of ``kind`` has one for these values.
    """
    implied = getattr(kind, "implied_options", None)
    values = dict(tree)
    for name, option in (implied(tree) if implied else {}).items():
        if isinstance(group := tree.get(name, {}), Mapping):
            values[name] = {"name": option, **group}  # its own name wins
    return values


# Composition: Hydra composes the options chosen, its parser reads single values, OmegaConf resolves interpolations


def by_hydra(command: str, kind: type, choices: Mapping[str, str], config_dir: str = "") -> dict[str, Any]:
    """Values of the options chosen, as Hydra composes them; interpolations are not resolved. ``choices`` are options by
    field, ``recipe`` and ``+experiment``. An InvalidInputError if Hydra cannot read a file.
    """
    fields = {field.name: field for field in dataclasses.fields(kind)}
    sets = {key: option for key, option in choices.items() if key in ("recipe", "+experiment")}
    if sets and len(sets) < len(choices):  # options go over the values of the sets
        options = {key: option for key, option in choices.items() if key not in sets}
        return layered(kind, by_hydra(command, kind, sets, config_dir), by_hydra(command, kind, options, config_dir))
    if not sets and not (config_dir and choices):
        nodes = {key: _nodes(fields[key]).get(option) for key, option in choices.items()}
        if None not in nodes.values():  # nothing to compose
            return nodes
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    try:
        return _compose(kind, choices, config_dir)
    except (HydraException, OmegaConfBaseException) as error:
        if f"In 'recipe/{choices.get('recipe')}'" in str(error):
            raise InvalidInputError(
                f"recipe={choices['recipe']} is not for {command}: it chooses from groups that {command} does not have"
            ) from error
        raise InvalidInputError(f"{command}: {reason_of(error)}") from error


def _nodes(field: dataclasses.Field[Any], config_dir: str = "") -> dict[str, Any]:
    """The values of a field's registered options; a file of the same name takes the place of an option."""
    found, files = field.metadata["registered"](), group_options(field.metadata["folder"], config_dir)
    values = found if isinstance(found, Mapping) else {option: {"name": option} for option in found}
    return {option: dict(value) for option, value in values.items() if option not in files}


def _compose(kind: type, choices: Mapping[str, str], config_dir: str) -> dict[str, Any]:
    """The composition of a config whose groups are empty but for the options chosen."""
    from hydra import compose, initialize_config_module
    from hydra.core.config_store import ConfigStore
    from omegaconf import OmegaConf

    store, paths = ConfigStore.instance(), {}
    for field in dataclasses.fields(kind):
        if not (folder := field.metadata.get("folder")):
            continue
        paths[field.name] = folder if folder == field.name else f"{folder}@{field.name}"
        store.repo.pop(folder, None)
        for option, node in _nodes(field, config_dir).items():
            store.store(group=folder, name=option, node=node)
    recipe = ["recipe" for field in dataclasses.fields(kind) if field.name == "recipe"]
    defaults = ["_self_", *({path: None} for path in [*paths.values(), *recipe])]
    places = [f"file://{Path(config_dir).resolve()}"] if config_dir else []
    store.store(name="primary", node={"defaults": defaults, "hydra": {"searchpath": places}})
    words = [f"{paths.get(key, key)}={option}" for key, option in choices.items()]
    with initialize_config_module("configs", version_base="1.3"):
        made = OmegaConf.to_container(compose("primary", overrides=words), resolve=False)
    assert isinstance(made, dict)
    return {str(key): value for key, value in made.items()}


def layered(kind: type, first: Mapping[str, Any], second: Mapping[str, Any]) -> dict[str, Any]:
    """Values of the config ``kind``, those of ``second`` over those of ``first``; a component of another name takes the
    place of the first one with all its settings.
    """
    first = dict(first)
    for field in dataclasses.fields(kind):
        now = second.get(field.name)
        if isinstance(now, Mapping) and (field.metadata.get("kinds") or field.metadata.get("named")):
            before = first.pop(field.name, {})
            before = {"name": before} if isinstance(before, str) else before
            names = [part["name"] for part in (before, now) if isinstance(part, Mapping) and "name" in part]
            if isinstance(before, Mapping) and names[:1] == names[-1:]:
                first[field.name] = before
    return merged(first, second)


def merged(first: Mapping[str, Any], second: Mapping[str, Any]) -> dict[str, Any]:
    """Nested values, those of ``second`` over those of ``first``."""
    both = [key for key, value in second.items() if isinstance(value, Mapping) and isinstance(first.get(key), Mapping)]
    return {**first, **second, **{key: merged(first[key], second[key]) for key in both}}


def reason_of(error: BaseException) -> str:
    while error.__cause__ is not None:
        error = error.__cause__
    return _as_given(str(error).splitlines()[0].strip().rstrip("."))


# Keys that several commands share


MAX_GRADIENT_NORM = 1.0
"""Largest norm of a gradient in training; longer gradients are scaled down."""


OPTIMIZERS = ("adamw",)
"""Names of optimisers."""


@dataclass
class OptimizerSettings(Checked):
    """An optimiser of weights.

    Attributes:
        name: name of the optimiser: ``adamw``.
        lr: peak learning rate.
    """

    place = "optimizer."
    name: Annotated[str, OneOf(OPTIMIZERS, "optimizer")] = "adamw"
    lr: Positive = 1e-3


@dataclass
class LoggerSettings(Checked):
    """Files of a run, and how often they are written.

    Attributes:
        name: ``csv`` writes log.csv, which every run has; ``tensorboard`` and ``wandb`` (offline) write their own files
            as well.
        checkpoint_every: steps or iterations between resumable checkpoints.
    """

    place = "logger."
    name: Annotated[str, OneOf(LOGGERS, "logger")] = "csv"
    checkpoint_every: Count = 10


@dataclass
class DeviceKeys(Checked):
    """Device of the networks.

    Attributes:
        device: torch device, such as cpu, cuda or cuda:1; auto is the GPU where torch finds one, else the CPU.
    """

    device: str = "auto"


@dataclass
class PrecisionKeys(Checked):
    """Precision of the chains of a prior.

    Attributes:
        precision: number format of the products in the blocks of the network: float32, tf32 or bfloat16. Positions,
            contacts and the last steps are always in float32.
    """

    precision: str = "float32"


@dataclass
class ProgressKeys(Checked):
    """Progress of the work.

    Attributes:
        progress: progress display: ``bar`` (lines where there is no terminal), ``lines`` or ``none``.
    """

    progress: Annotated[str, OneOf(STYLES)] = "bar"


@dataclass
class EngineKeys(Checked):
    """Engine of the physics.

    Attributes:
        workers: physics worker processes; 0 computes physics in this process.
        physics: engine of motion: bullet, mujoco, warp, or auto for bullet where it is installed, else mujoco.
    """

    workers: Natural = 2
    physics: str = "auto"


@dataclass
class GuidanceKeys(Checked):
    """Guidance of the denoiser.

    Attributes:
        guidance: weight of classifier-free guidance, 0 for none; needs a prompt.
    """

    guidance: float = 0.0


@dataclass
class PromptKeys(GuidanceKeys):
    """Prompt of the scenes.

    Attributes:
        prompt: text that the scenes should match, for priors that read prompts; null for no prompt.
        claim_guidance: strength with which scenes are guided to the numbers and places that the prompt gives, 0 for
            none; 2 is a good choice; needs a prompt.
    """

    prompt: str | None = None
    claim_guidance: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_guidance(self.prompt, self.guidance)
        check_claim_guidance(self.prompt, self.claim_guidance)


@dataclass
class SamplingKeys(Checked):
    """Sampling of scenes.

    Attributes:
        num_steps: denoising steps per scene.
        slots: slots per scene, which may exceed the number in training; null takes the number in training.
        seed: seed of the noise.
    """

    num_steps: Count = 50
    slots: Count | None = None
    seed: Seed = 0


PhysicsGuidance = Annotated[float, Limit(lambda value: 0 <= value <= 1, "must be a number from 0 to 1")]


@dataclass
class DrawKeys(PrecisionKeys, DeviceKeys):
    """Samples of a prior.

    Attributes:
        num_steps: denoising steps per scene.
        physics_guidance: strength with which objects are moved out of overlaps and onto supports at the last steps, 0
            to 1; null takes that of the prior, 1 for shipped priors whose names end in _feasible and 0 for the others.
        seed: seed of the noise.
    """

    num_steps: Count = 50
    physics_guidance: PhysicsGuidance | None = None
    seed: Seed = 0


@dataclass
class RewardLimits(Checked):
    """Limits of a reward from outside this package.

    Attributes:
        timeout: most seconds for a batch, whose scenes are invalid after that, or for the import of a reward.
        memory: most memory that the reward may allocate, GiB.
    """

    timeout: Positive = 60.0
    memory: Positive = 1.0

    place = "reward_limits."


@dataclass
class RewardLimitKeys(Checked):
    """Rewards from outside this package.

    Attributes:
        reward_limits: limits of a reward from outside this package; it runs in its own process.
    """

    reward_limits: RewardLimits = nested(RewardLimits, one_key=True)

    def running(self, reward: Any) -> Any:
        """``reward`` as :func:`rewards.process.run_reward` gives it, under these limits and the keys ``seed``,
        ``workers`` and ``physics`` of the command; its caller closes it.
        """
        from rewards.process import run_reward

        keys: Any = self
        workers = 0 if keys.workers == "ray" else keys.workers
        return run_reward(reward, seed=keys.seed, workers=workers, physics=keys.physics, **vars(self.reward_limits))


@dataclass
class OutputKeys(EngineKeys, DeviceKeys):
    """Computation and output.

    Attributes:
        output: folder for the files that the command writes.
        pictures: number of scenes in the galleries; 0 draws none.
        batch_size: scenes denoised at once.
    """

    output: str = ""
    pictures: Natural = 12
    batch_size: Count = 64


@dataclass
class TrainingKeys(DeviceKeys):
    """Recipe and output of a training run.

    Attributes:
        recipe: a named set of values for the other keys; keys that are given as well override it.
        output: run folder; a run that was interrupted there is resumed; empty for runs/COMMAND-TIME on the command
            line.
    """

    recipe: str = "ours"
    output: str = ""


MEASURE_NAMES = ("layout", "physics", "ready", "stability", "fsd", "novelty", "prompts", "classifier", "renders")
"""Groups of measures, in the order in which they are computed: cheap ones first."""
