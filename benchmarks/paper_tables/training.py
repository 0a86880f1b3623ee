"""Training the rows: equal parameters, exact resume."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from agents.configuration.composition import changed, dotted_values
from agents.pretraining.settings import PretrainConfig
from benchmarks.paper_tables.data import RowData, trained_numbers
from benchmarks.paper_tables.rows import Row
from benchmarks.paper_tables.settings import TablesConfig
from scene_envs.errors import CorruptFileError, InvalidInputError, unknown_name
from scene_envs.files import write_json

CONFIG_NAME, METRICS_NAME = "row.json", "metrics.json"
_RUN_ONLY = (
    "output",
    "device",
    "logger.log_every",
    "logger.evaluate_every",
    "logger.checkpoint_every",
    "logger.name",
)
"""Keys that may change between the parts of a resumed run."""
_SHAPING = (
    "network.name",
    "process.name",
    "text.encoder",
    "process.rotation",
    "network.flux.frequencies",
    "network.modules.relations",
    "network.modules.rotation_features",
    "network.modules.contacts",
    "network.hidden",
    "network.depth",
    "network.heads",
)
"""Keys that the number of parameters depends on."""


def run_config(row: Row, settings: TablesConfig, hidden: int | None = None) -> PretrainConfig:
    """The pretraining run of ``row`` in ``output/runs/NAME``.

    Raises:
        UnknownNameError: a key that ``pretrain`` does not have.
    """
    keys: dict[str, Any] = {**settings.common(), **row.overrides}
    known = list(dotted_values(PretrainConfig()))
    for key in keys:
        if key not in known:
            raise unknown_name("pretrain key", key, known)
    if hidden is not None:
        keys["network.hidden"] = hidden
    return changed(PretrainConfig(), {**keys, "output": str(run_folder(row, settings))})


def run_folder(row: Row, settings: TablesConfig) -> Path:
    """The folder of the run of ``row``."""
    return Path(settings.output) / "runs" / row.name


def match_width(parameters: int, heads: int, count: Callable[[int], int]) -> int:
    """The width, a multiple of ``heads``, at which ``count(width)`` is nearest to ``parameters``.

    ``count`` must grow with the width.

    >>> match_width(10_000, 4, lambda width: width**2)
    100
    """
    low, high = 1, 2
    while count(high * heads) < parameters:
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if count(middle * heads) < parameters else (low, middle)
    return min((low * heads, high * heads), key=lambda width: abs(count(width) - parameters))


class Sizes:
    """Widths of rows, each kind of network counted once.

    Args:
        settings: the keys of the command.
        data: the scenes for which priors are built.
    """

    def __init__(self, settings: TablesConfig, data: RowData) -> None:
        self.settings, self.data = settings, data
        self._counted: dict[tuple[Any, ...], int] = {}

    def config(self, row: Row) -> PretrainConfig:
        """The run of ``row``, as wide as its parameters ask for; a run that exists keeps its width."""
        before = read_json(run_folder(row, self.settings) / CONFIG_NAME)
        if before is not None:
            return run_config(row, self.settings, int(before["config"]["network.hidden"]))
        config = run_config(row, self.settings)
        if "network.hidden" in self.settings.common():
            return config
        width = match_width(
            target_parameters(row, self.settings),
            config.network.heads,
            lambda hidden: self._count(changed(config, {"network.hidden": hidden})),
        )
        return changed(config, {"network.hidden": width})

    def _count(self, config: PretrainConfig) -> int:
        shape = tuple(dotted_values(config)[key] for key in _SHAPING)
        if shape not in self._counted:
            self._counted[shape] = self.data.count_parameters(config)
        return self._counted[shape]


def check_runs(rows: Iterable[Row], settings: TablesConfig) -> None:
    """Refuse a folder that holds runs with other keys.

    Raises:
        InvalidInputError: keys of a run differ from those asked for now.
    """
    for row in rows:
        before = read_json(run_folder(row, settings) / CONFIG_NAME)
        if before is not None:
            config = run_config(row, settings, int(before["config"]["network.hidden"]))
            _check_unchanged(before, config, target_parameters(row, settings))


def target_parameters(row: Row, settings: TablesConfig) -> int:
    """The parameters that ``row`` should have."""
    return round(settings.target_parameters * row.capacity)


def train(config: PretrainConfig, target: int, data: RowData) -> dict[str, Any]:
    """Train the run, or go on with it, or read its metrics when it is done.

    Returns:
        ``trained_steps``, ``seconds``, ``parameters`` and the rest of the run's ``metrics.json``.
    """
    from agents.pretraining.trainer import Pretrainer

    directory = Path(config.output)
    done = read_json(directory / METRICS_NAME)
    if done is not None:
        return done
    write_json(directory / CONFIG_NAME, {"parameters": target, "config": _compared(config)})
    prior, scenes, heldout = data.prepare(config)
    trainer = Pretrainer(config, scenes, heldout, prior)
    trained = trainer.run()
    metrics = {
        **trained.card,
        "seconds": trainer.seconds,
        "parameters": trained_numbers(trained),
        "evaluations": trainer.evaluations,
    }
    write_json(directory / METRICS_NAME, metrics)
    trainer.checkpoint_path.unlink(missing_ok=True)
    return metrics


def read_json(path: Path) -> dict[str, Any] | None:
    """The content of a file by :func:`~scene_envs.files.write_json`, None without a file; raises CorruptFileError."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise CorruptFileError(f"{str(path)!r} is not valid JSON ({error}); delete it and run again") from error
    if not isinstance(content, dict):
        raise CorruptFileError(f"{str(path)!r} holds no mapping; delete it and run again")
    return content


def _compared(config: PretrainConfig) -> dict[str, Any]:
    return {key: value for key, value in dotted_values(config).items() if key not in _RUN_ONLY}


def _check_unchanged(before: Mapping[str, Any], config: PretrainConfig, target: int) -> None:
    old, new = {**before["config"], "parameters": before["parameters"]}, {**_compared(config), "parameters": target}
    differing = [key for key in new if key in old and old[key] != new[key]]
    if differing:
        differences = "; ".join(f"{key} was {old[key]!r}, is {new[key]!r}" for key in differing)
        raise InvalidInputError(
            f"{config.output!r} holds a run with other keys ({differences}); give another output, or the same keys to "
            "resume it"
        )
