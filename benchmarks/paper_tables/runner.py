"""One command that makes the tables: train every row once, measure it once, write tables and picture."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.paper_tables.catalogue import list_rows, make_tables
from benchmarks.paper_tables.data import HeldoutScenes, RowData
from benchmarks.paper_tables.measuring import measure_real, sample_and_measure
from benchmarks.paper_tables.rows import Row, Table
from benchmarks.paper_tables.settings import TablesConfig
from benchmarks.paper_tables.tables import REAL, FilledTable, Line, csv_text, markdown
from benchmarks.paper_tables.training import Sizes, check_runs, read_json, target_parameters, train
from scene_envs.errors import InvalidInputError, SceneEnvsError, TrainingError
from scene_envs.files import write_json, write_text

if TYPE_CHECKING:
    from scene_envs.physics import PhysicsPool

logger = logging.getLogger(__name__)

REAL_NAME = "real.json"
LOCK_NAME = "tables.lock"

Say = Callable[[str], None]


@dataclass
class RowResult:
    """What is known of one row.

    Attributes:
        figures: of samples without prompts, or with prompts (True).
        failure: why it failed, empty where it did not.
        pending: whether it has not been tried yet.
    """

    figures: dict[bool, dict[str, float]]
    failure: str = ""
    pending: bool = False


def run_tables(settings: TablesConfig, say: Say) -> dict[str, Any]:
    """Train and measure every row of the tables that ``settings`` asks for, and write them into ``output``.

    Rows that an earlier call in the same folder has finished are read; rows that it has begun go on where they stopped.
    Tables are written anew after every row.

    Args:
        settings: the keys of the command.
        say: takes a line of progress.

    Returns:
        ``rows``: the figures of each row, ``real``: those of real scenes, ``failed``: names and reasons.

    Raises:
        InvalidInputError: the settings are impossible; no row was begun.
        TrainingError: some rows failed; the tables say which and why, and have the others.
    """
    with _alone_in(Path(settings.output)):
        return _run_tables(settings, say)


def _run_tables(settings: TablesConfig, say: Say) -> dict[str, Any]:
    from scene_envs.physics import PhysicsPool

    tables = make_tables(settings.tables, settings.rows)
    rows = list_rows(tables)
    say(f"{len(rows)} rows for {len(tables)} tables; reading {settings.data}")
    check_runs(rows, settings)
    data = RowData.load(settings)
    real, sizes = HeldoutScenes.of(data, settings), Sizes(settings, data)
    results = {row.name: RowResult({}, pending=True) for row in rows}
    with PhysicsPool(workers=settings.workers) as pool:
        floor = _measured_once(
            Path(settings.output) / REAL_NAME, _evaluation(settings, real), lambda: measure_real(real, settings, pool)
        )
        started, worked = time.perf_counter(), 0
        for number, row in enumerate(rows, 1):
            begun = time.perf_counter()
            results[row.name], fresh = _run_row(row, tables, sizes, real, pool)
            worked += fresh
            write_tables(tables, results, floor, settings, real)
            each = (time.perf_counter() - started) / max(1, worked)
            done = results[row.name].failure or f"done in {time.perf_counter() - begun:.0f} s"
            left = f"; about {_duration(each * (len(rows) - number))} left" if number < len(rows) else ""
            say(f"row {number} of {len(rows)}, {row.name}: {done}{left}")
    failed = {name: result.failure for name, result in results.items() if result.failure}
    summary = {
        "rows": {name: {_kind(k): v for k, v in result.figures.items()} for name, result in results.items()},
        "real": floor,
        "failed": failed,
    }
    write_json(Path(settings.output) / "metrics.json", summary)
    if failed:
        raise TrainingError(
            f"{len(failed)} of {len(rows)} rows failed: {', '.join(failed)}; tables.md says why, and the same command "
            "tries them again"
        )
    return summary


@contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Refuse a folder in which another command makes tables; the lock goes with the process that holds it."""
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / LOCK_NAME).open("w") as file:
        try:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except ImportError:  # no such locks on this system
            pass
        except BlockingIOError:
            raise InvalidInputError(
                f"another command is making tables in {str(folder)!r}; wait for it, or give another output"
            ) from None
        except OSError as error:
            logger.debug("%s cannot be locked: %s", folder, error)
        yield


def write_tables(
    tables: Sequence[Table],
    results: dict[str, RowResult],
    floor: dict[str, float],
    settings: TablesConfig,
    real: HeldoutScenes,
) -> None:
    """``tables.md``, ``tables.csv``, ``plot.png`` and, with the precision table, ``precision.md``."""
    from benchmarks.paper_tables.plot import draw

    filled = [_fill(table, results, floor, settings) for table in tables]
    directory, lead = Path(settings.output), _lead(settings, real)
    write_text(directory / "tables.md", markdown(filled, f"Priors of {settings.scene}", lead))
    write_text(directory / "tables.csv", csv_text(filled))
    precision = [one for one in filled if one.table.name == "precision"]
    if precision:
        write_text(directory / "precision.md", markdown(precision, f"Precision of priors of {settings.scene}", lead))
    draw(filled, directory / "plot.png")


def _run_row(
    row: Row,
    tables: Sequence[Table],
    sizes: Sizes,
    real: HeldoutScenes,
    pool: PhysicsPool,
) -> tuple[RowResult, bool]:
    """The row's result, and whether work was needed; a row that fails says why and does not stop the others."""
    settings = sizes.settings
    kinds = sorted({entry.prompted for table in tables for entry in table.entries if entry.row.name == row.name})
    result, fresh = RowResult({}), False
    try:
        config = sizes.config(row)
        directory = Path(config.output)
        fresh = not all((directory / f"{_kind(prompted)}.json").exists() for prompted in kinds)
        trained = train(config, target_parameters(row, settings), sizes.data)
        costs = {
            "parameters": float(trained["parameters"]),
            "seconds_per_step": trained["seconds"] / max(1, trained["trained_steps"]),
        }
        for prompted in kinds:

            def compute(prompted: bool = prompted) -> dict[str, float]:
                from agents.priors.prior import ScenePrior

                prior = ScenePrior.load(directory).to(settings.device).eval()
                return sample_and_measure(prior, real, settings, prompted=prompted, pool=pool)

            asked = _evaluation(settings, real, prompted)
            figures = _measured_once(directory / f"{_kind(prompted)}.json", asked, compute)
            result.figures[prompted] = {**figures, **costs}
    except Exception as error:
        result.failure = str(error) if isinstance(error, SceneEnvsError) else f"{type(error).__name__}: {error}"
        logger.debug("row %s failed", row.name, exc_info=True)
    return result, fresh


def _measured_once(path: Path, asked: dict[str, Any], compute: Callable[[], dict[str, float]]) -> dict[str, float]:
    """The figures in ``path`` if they were measured for ``asked``; otherwise they are computed and written there."""
    found = read_json(path)
    if found is not None and found.get("asked") == asked:
        return dict(found["figures"])
    figures = compute()
    write_json(path, {"asked": asked, "figures": figures})
    return figures


def _evaluation(settings: TablesConfig, real: HeldoutScenes, prompted: bool | None = None) -> dict[str, Any]:
    """The settings that figures depend on beside the prior; ``prompted`` is None for real scenes."""
    asked: dict[str, Any] = {
        "count": settings.measured,
        "real_scenes": len(real.reference),
        "data": settings.data,
        "heldout": settings.heldout,
        "seed": settings.seed,
    }
    if prompted is not None:
        asked["num_steps"] = settings.steps
    if prompted:
        asked["guidance"] = settings.guidance
    return asked


def _fill(table: Table, results: dict[str, RowResult], floor: dict[str, float], settings: TablesConfig) -> FilledTable:
    lines = []
    for entry in table.entries:
        result = results[entry.row.name]
        figures = result.figures.get(entry.prompted, {})
        shown = {} if result.failure else figures
        lines.append(Line(entry.label, entry.row.name, entry.group, shown, result.failure, result.pending))
    lines.append(Line(REAL, "", "real scenes" if any(line.group for line in lines) else "", floor))
    note = table.note
    if any(entry.prompted for entry in table.entries):
        note += f" Guidance w = {settings.guidance:g}.{_chance(floor)}"
    return FilledTable(table, tuple(lines), note)


def _chance(floor: dict[str, float]) -> str:
    """A sentence on the score by chance, which a prior that ignores its prompts would get."""
    kinds = ("counts", "names", "relations")
    found = [f"{kind} {100 * floor[name]:.0f} %" for kind in kinds if (name := f"chance_prompt_{kind}") in floor]
    return f" Real scenes that were given the prompts of others follow {', '.join(found)}." if found else ""


def _lead(settings: TablesConfig, real: HeldoutScenes) -> str:
    """The introduction, with the settings that hold for all tables."""
    common = settings.common()
    return (
        f"Scene type `{settings.scene}`; each row trained for {common['iterations']:,} steps of {common['batch_size']} "
        f"scenes with about {settings.target_parameters:,} parameters, seed {settings.seed}. {settings.measured:,} raw "
        f"samples per row, {settings.steps} denoising steps, beside {len(real.reference):,} held-out real scenes. The "
        "last line of each table measures other real scenes against them: no sampler can be expected to do better. "
        "± is the standard error of a share, and the standard deviation over splits of the classifier accuracy. One "
        "training run per row: small differences may be chance."
    )


def _kind(prompted: bool) -> str:
    return "prompted" if prompted else "unprompted"


def _duration(seconds: float) -> str:
    """A duration in words, rounded, in a suitable unit.

    >>> _duration(40.0), _duration(600.0), _duration(9000.0)
    ('40 s', '10 min', '2.5 h')
    """
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
