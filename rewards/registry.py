"""Registry of rewards, by decorator, by entry point of installed packages, and by mapping in a configuration."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import EntryPoint
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

import torch
from torch import Tensor

from rewards.base import Reward, RewardContext, RewardOutput, facts_of
from scene_envs.errors import InvalidInputError, RewardError, SceneEnvsError
from scene_envs.registry import ALLOWED, PluginError, Registry, load_plugin, run_file
from scene_envs.scene import SceneBatch

ENTRY_POINT_GROUP = "scene_envs.rewards"
"""Entry-point group under which packages register rewards; the entry's name is the reward's name."""

Maker = TypeVar("Maker", bound=Callable[..., Any])

_REWARDS: Registry[Callable[..., Any]] = Registry("reward", ENTRY_POINT_GROUP, read=lambda point: _of_plugin(point))
_LOCAL = re.compile(r"(?P<path>.+\.py):(?P<name>[A-Za-z_]\w*)", re.DOTALL)
_allowed_targets: list[str] = ["rewards"]


class FunctionReward:
    """A function of ``(batch)`` or ``(batch, context)`` and keyword ``settings``, which returns (B,) numbers or a
    :class:`RewardOutput`, as a reward; ``name`` in logs is the function's own by default.

    >>> FunctionReward(lambda batch: batch.counts, name="count")(SceneBatch.empty("dimsum_table", 2), RewardContext())
    RewardOutput(value=tensor([1., 1.]), per_object=None, terms={}, valid=None, object_flags={}, problem='')
    """

    def __init__(self, function: Callable[..., Any], name: str | None = None, **settings: Any) -> None:
        self.function = function
        self.name = str(name or getattr(function, "__name__", type(function).__name__))
        self.settings = settings
        self.maximum = getattr(function, "maximum", None)
        vars(self).update(facts_of(function))
        self._takes_context = _takes_context(function, settings, self.name)

    def __call__(self, batch: SceneBatch, context: RewardContext) -> RewardOutput:
        arguments = (batch, context) if self._takes_context else (batch,)
        return as_output(self.function(*arguments, **self.settings))

    def __repr__(self) -> str:
        return f"FunctionReward({self.name!r})"


def as_output(result: Any) -> Any:
    """A bare tensor as a RewardOutput, whole numbers as floats; anything else as it is."""
    if not isinstance(result, Tensor):
        return result
    is_whole = not result.is_floating_point() and not result.is_complex()
    return RewardOutput(result.to(torch.float32) if is_whole else result)


def _takes_context(function: Callable[..., Any], settings: Mapping[str, Any], name: str) -> bool:
    """Whether ``function`` takes (batch, context) and ``settings``, or else (batch); raises InvalidInputError."""
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):
        return True
    for arguments in ((None, None), (None,)):
        with suppress(TypeError):
            signature.bind(*arguments, **settings)
            return len(arguments) == 2
    raise InvalidInputError(
        f"reward {name!r} has the signature {signature} and was given the settings {sorted(settings)}; "
        "it must take (batch) or (batch, context), and its settings as keywords"
    )


def is_local(reward: Any) -> bool:
    """Whether a name of a reward names a function or class in a file.

    >>> is_local("./my_rewards.py:clutter"), is_local("clutter")
    (True, False)
    """
    return isinstance(reward, str) and _LOCAL.fullmatch(reward) is not None


def local_files(reward: Any) -> list[Path]:
    """The files whose code a reward would run, those of its parts included."""
    found = (_LOCAL.fullmatch(name) for name in names_in(reward))
    return sorted({Path(match["path"]).expanduser().resolve() for match in found if match})


def names_in(reward: Any) -> Iterator[str]:
    """All texts in a reward's name or mapping that may name a reward."""
    if isinstance(reward, str):
        yield reward
    elif isinstance(reward, Mapping):
        for value in reward.values():
            yield from names_in(value)
    elif isinstance(reward, list | tuple):
        for value in reward:
            yield from names_in(value)


def allow_local_rewards(path: str | Path) -> None:
    """Let ``reward="PATH.py:NAME"`` run the file ``path``. Every other file is refused."""
    ALLOWED.add(Path(path).expanduser().resolve())


def allowed_files() -> list[Path]:
    """The files that may be run."""
    return sorted(ALLOWED)


def load_local(reward: str) -> Callable[..., Any]:
    """The function or class that ``PATH.py:NAME`` names; runs the file once per process. Raises InvalidInputError where
    the file was not allowed, does not exist, cannot be run or has no such callable.
    """
    match = _LOCAL.fullmatch(reward)
    assert match is not None
    path = Path(match["path"]).expanduser().resolve()
    if path not in ALLOWED:
        raise InvalidInputError(
            f"reward {reward!r} would run the file {str(path)!r}, which was not allowed: give --allow-local on the "
            "command line, or call rewards.allow_local_rewards(path) in Python"
        )
    if not path.is_file():
        raise InvalidInputError(f"reward {reward!r}: there is no file {str(path)!r}")
    try:
        found = getattr(run_file(path), match["name"], None)
    except PluginError as error:
        raise InvalidInputError(f"reward {reward!r}: {error}") from error
    if not callable(found):
        raise InvalidInputError(f"reward {reward!r}: {str(path)!r} has no function or class {match['name']!r}")
    return found  # type: ignore[no-any-return]


@dataclass(frozen=True)
class RewardInfo:
    """One line of a list of rewards.

    Attributes:
        name: name to write after ``reward=``.
        summary: first sentence of the reward's docstring.
        parameters: settings and their defaults, as ``"name=default"``.
        source: module that defines the reward.
    """

    name: str
    summary: str
    parameters: tuple[str, ...]
    source: str


def register_reward(name: str) -> Callable[[Maker], Maker]:
    """Make a reward available under ``name`` to RL, search and the command line.

    Decorates a reward class, which is built with the settings of the reward, or a function of ``(batch)`` or
    ``(batch, context)`` that returns (B,) numbers or a :class:`RewardOutput`.

    Raises:
        InvalidInputError: the name is taken by another reward, or the decorated object is not callable.

    >>> @register_reward("doctest_low")
    ... def low(batch, context):
    ...     return -batch.translations[..., 2].sum(dim=-1)
    >>> make_reward("doctest_low")
    FunctionReward('doctest_low')
    """
    if not isinstance(name, str) or not name or not name.replace("_", "").isalnum():
        raise InvalidInputError(f"reward name {name!r}: use letters, digits and underscores, such as 'open_space'")

    def register(maker: Maker) -> Maker:
        if not callable(maker):
            raise InvalidInputError(f"reward {name!r}: {maker!r} cannot be called; decorate a class or a function")
        taken = _REWARDS.get(name)
        if taken is not None and _origin(taken) != _origin(maker):
            raise InvalidInputError(f"reward name {name!r} is taken by {_origin(taken)}; choose another name")
        _REWARDS[name] = maker
        return maker

    return register


def list_rewards() -> list[str]:
    """Names of all rewards, those of installed packages included, sorted. Imports no plug-in."""
    return _REWARDS.names()


def reward_info(name: str) -> RewardInfo:
    """Description of ``name`` for listings; imports its plug-in."""
    maker = _find(name)
    lines = (inspect.getdoc(maker) or "").split("\n\n")[0].split()
    try:
        parameters = list(inspect.signature(maker).parameters.values())
    except (TypeError, ValueError):
        parameters = []
    if not inspect.isclass(maker):
        parameters = [p for p in parameters if p.kind is p.KEYWORD_ONLY]
    settings = tuple(f"{p.name}={p.default!r}" if p.default is not p.empty else p.name for p in parameters)
    return RewardInfo(name, " ".join(lines), settings, maker.__module__)


def make_reward(name: str, **settings: Any) -> Reward:
    """The reward called ``name``, built with ``settings``.

    Raises:
        UnknownNameError: no reward has that name; the message gives the nearest known one.
        InvalidInputError: the reward does not take these settings.
        RewardError: the reward's plug-in cannot be imported.
    """
    return _build(_find(name), name, settings)


def allow_reward_targets(package: str) -> None:
    """Let ``{"_target_": "<package>.…"}`` mappings name classes and functions defined in ``package``.

    The packages of installed plug-ins and ``rewards`` itself are always allowed. Other packages are refused, so that an
    untrusted config file cannot run code of its choice.
    """
    if not all(part.isidentifier() for part in package.split(".")):
        raise InvalidInputError(f"{package!r} is not a package name; give one such as 'my_package'")
    if package not in _allowed_targets:
        _allowed_targets.append(package)


def resolve_reward(reward: Any) -> Reward:
    """The reward object that ``reward`` describes.

    Args:
        reward: a registered name; a mapping ``{"name": …, **settings}`` or ``{"_target_": "package.Class", …}``;
            a function; a reward class; or a reward, which is returned unchanged.

    >>> resolve_reward({"name": "clip", "reward": "object_count", "high": 20.0})
    Clip(reward=ObjectCount(), low=None, high=20.0)
    """
    if isinstance(reward, str):
        return make_reward(reward)
    if isinstance(reward, Mapping):
        settings = {str(key): value for key, value in reward.items()}
        if "_target_" in settings:
            target = settings.pop("_target_")
            return _build(_find_target(target), target, settings)
        if not isinstance(settings.get("name"), str):
            raise InvalidInputError(
                f"a reward mapping needs 'name' (or '_target_'), a text, got {settings}; "
                "for example {'name': 'object_count'}"
            )
        return make_reward(settings.pop("name"), **settings)
    if not callable(reward):
        raise InvalidInputError(
            f"reward={reward!r} is neither a name, a mapping with 'name' or '_target_', nor a callable; "
            f"known names: {', '.join(list_rewards())}"
        )
    if inspect.isclass(reward):
        return _build(reward, reward.__name__, {})
    # a reward object is of a class that defines ``__call__`` in Python, unlike a partial or a builtin
    if inspect.isroutine(reward) or not inspect.isfunction(getattr(type(reward), "__call__", None)):  # noqa: B004
        return FunctionReward(reward)
    return reward  # type: ignore[no-any-return]


def reward_name(reward: Any) -> str:
    """A short stable name of a reward, for logs and reports.

    >>> reward_name("object_count"), reward_name(resolve_reward("object_count"))
    ('object_count', 'object_count')
    """
    if isinstance(reward, str):
        return reward
    if isinstance(reward, Mapping):
        return str(reward.get("name") or reward.get("_target_") or "reward")
    name = getattr(reward, "name", None)
    return name if isinstance(name, str) and name else getattr(reward, "__qualname__", type(reward).__qualname__)


def reward_label(reward: Any) -> str:
    """A reward's name in words, for headings; for a reward in a file, the names of the file and of the function.

    >>> reward_label("object_count"), reward_label("rewards/my_rewards.py:clutter")
    ('object count', 'my_rewards.py:clutter')
    """
    name = reward_name(reward)
    return Path(name).name if is_local(name) else name.rpartition("<locals>.")[2].replace("_", " ")


def allowed_targets() -> list[str]:
    """The packages that ``_target_`` may name, without those of installed plug-ins."""
    return list(_allowed_targets)


def registered_module(name: str) -> str | None:
    """The module of the reward registered under ``name`` in this process; None if there is none."""
    return getattr(_REWARDS.get(name), "__module__", None)


def plugin_module(name: str) -> str | None:
    """The module of the installed plug-in that has ``name``, without an import; None if there is none."""
    point = _REWARDS.points().get(name)
    return None if point is None else point.module


def is_own(reward: Any) -> bool:
    """Whether the code of a reward object belongs to this package; the code of its parts is not considered.

    >>> is_own(resolve_reward("object_count")), is_own(print)
    (True, False)
    """
    code = reward.function if isinstance(reward, FunctionReward) else reward
    module = getattr(code, "__module__", None) or type(code).__module__
    return _within(str(module), {"rewards", "agents"})


def _find(name: str) -> Callable[..., Any]:
    return load_local(name) if name not in _REWARDS and is_local(name) else _REWARDS[name]


def _of_plugin(point: EntryPoint) -> Callable[..., Any]:
    """The reward of an installed package; importing its module may register it."""
    name = point.name
    package = point.dist.name if point.dist is not None else point.module
    try:
        loaded = load_plugin(point)
    except PluginError as error:
        raise RewardError(
            f"reward {name!r} of the installed package {package!r} cannot be loaded from {point.value!r}: {error}"
        ) from error
    if isinstance(loaded, ModuleType):  # its decorators have run
        if name not in _REWARDS:
            raise RewardError(f"module {point.value!r} of package {package!r} registers no reward called {name!r}")
    elif not callable(loaded):
        raise RewardError(f"reward {name!r} of package {package!r}: {point.value!r} is not a class or a function")
    return _REWARDS.get(name, loaded)


def _find_target(target: Any) -> Callable[..., Any]:
    """The class or function ``target`` names, if an allowed package itself defines it."""
    allowed = {*_allowed_targets, *(point.module.split(".")[0] for point in _REWARDS.points().values())}
    module, _, attribute = str(target).rpartition(".")
    if not _within(module, allowed):
        raise InvalidInputError(
            f"_target_ {target!r} is outside the packages rewards may come from ({', '.join(sorted(allowed))}); "
            "call rewards.allow_reward_targets('your_package') first, or register the reward under a name"
        )
    try:
        found = getattr(import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise InvalidInputError(f"_target_ {target!r} cannot be found: {error}") from error
    if not callable(found) or not _within(getattr(found, "__module__", ""), allowed):
        raise InvalidInputError(f"_target_ {target!r} is not a class or function defined in {module!r}")
    return found  # type: ignore[no-any-return]


def _within(module: str, packages: set[str]) -> bool:
    return any(module == package or module.startswith(package + ".") for package in packages)


def _build(maker: Callable[..., Any], name: str, settings: dict[str, Any]) -> Reward:
    if not inspect.isclass(maker):
        return FunctionReward(maker, name, **settings)
    try:
        reward = maker(**settings)
    except SceneEnvsError:
        raise
    except (TypeError, ValueError) as error:  # a setting that the class does not have, or of another type
        known = str(inspect.signature(maker)).split(" -> ")[0]
        raise InvalidInputError(f"reward {name!r}, made with {settings}: {error}; its settings are {known}") from error
    if not callable(reward):
        raise RewardError(f"reward {name!r}: {maker.__qualname__} has no __call__(batch, context) method")
    return reward  # type: ignore[no-any-return]


def _origin(maker: Any) -> str:
    return f"{maker.__module__}.{getattr(maker, '__qualname__', type(maker).__qualname__)}"
