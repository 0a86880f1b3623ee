"""Runs of the tables of post-training: which prior, which keys of ``post-train``, how long."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

SCENES = 48
"""Scenes of an iteration, the default of ``post-train``."""

TYPES = (
    "dimsum_table", "living_room_shelf", "pantry_shelf", "breakfast_table_low_clutter", "breakfast_table_high_clutter",
    "restaurant_low_clutter", "restaurant_high_clutter",
)  # fmt: skip
FORWARD, CHAIN = "nft", "ddpo_sf"
DISTILLATION = "guidance_distillation"
PLUG_INS = ("udm_grpo", "crd", "gardo")
"""Algorithms of files in ``examples/``."""
_EXAMPLES = Path(__file__).parents[2] / "examples"
LENGTH = 300
"""Iterations of a row."""


@dataclass(frozen=True)
class Row:
    """One training run and its measured samples.

    Attributes:
        name: its folder, and the first column.
        prior: shipped prior that it starts from, and is compared with.
        keys: of ``post-train``, as on the command line.
        iterations: of training.
        slots: sampled slots, None for the trained number.
        guidance: weight of guidance of the samples with prompts.
    """

    name: str
    prior: str
    keys: tuple[str, ...]
    iterations: int
    slots: int | None = None
    guidance: float = 0.0


@dataclass(frozen=True)
class Table:
    """Rows that stand side by side.

    Attributes:
        title: heading.
        rows: one for each run.
        measures: groups of ``evaluate`` that the samples get; empty for tables of the training alone.
        columns: figures shown, by the names of ``COLUMNS``.
        evaluate: further keys of ``evaluate``.
    """

    title: str
    rows: tuple[Row, ...]
    measures: tuple[str, ...]
    columns: tuple[str, ...]
    evaluate: tuple[str, ...] = ()


def _stability() -> tuple[Row, ...]:
    """300 iterations: each algorithm on Dimsum with three seeds, and the forward process on two more scene types."""
    dimsum = [
        Row(f"dimsum_table-{name}-{seed}", "dimsum_table", _keys(name, "feasible_share", seed), 300)
        for name in (FORWARD, "awm", CHAIN, DISTILLATION)
        for seed in range(3)
    ]
    others = [
        Row(f"{prior}-{FORWARD}-0", prior, _keys(FORWARD, "feasible_share", 0), 300)
        for prior in ("living_room_shelf", "restaurant_low_clutter")
    ]
    return (*dimsum, *others)


def _placement() -> tuple[Row, ...]:
    """Two algorithms at equal sampled scenes, three seeds on Dimsum and one on the other types."""
    return tuple(
        Row(f"{prior}-{name}-{seed}", prior, _keys(name, "feasible_share", seed), LENGTH)
        for prior in TYPES
        for name in (FORWARD, CHAIN)
        for seed in range(3 if prior == "dimsum_table" else 1)
    )


_960_SCENES = ("batch_size=24", "guard.scenes=128", "guard.samples=128", "guard.every=20", "guard.samples_every=20")
"""Keys of 40 iterations with 960 sampled scenes."""
_LAST = ("batch_size=24", "guard.scenes=128", "guard.samples=0", "guard.every=40", "regularisation.bank_size=1152")
"""The same without samples of the guard, which checks the last prior only and so keeps it."""
_14400_SCENES = ("batch_size=24", "guard.scenes=128", "guard.samples=128", "guard.every=50", "guard.samples_every=50")
"""Keys of 600 iterations with 14,400 sampled scenes."""


def _equal_scenes() -> tuple[Row, ...]:
    """960 sampled scenes for each algorithm and scene type; the guard samples the base prior and the trained one."""
    return tuple(
        Row(f"{prior}-{name}-{seed}", prior, (*_keys(name, "feasible_share", seed), *_960_SCENES), 40)
        for prior in TYPES
        for name in (FORWARD, CHAIN, DISTILLATION)
        for seed in range(3 if prior == "dimsum_table" else 1)
    )


def _losses(iterations: int, *keys: str) -> tuple[Row, ...]:
    """Every loss on three scene types, the losses of ``examples/`` too: two rewards, three seeds on Dimsum."""
    learned = "algorithm.expectation_lr=3e-4"
    return tuple(
        Row(f"{prior}-{name}-{reward}-{seed}", prior, (*_keys(algorithm, reward, seed), *more, *keys), iterations,
            guidance=1.0 if prior == "dimsum_table" else 0.5)
        for prior, seeds in (("dimsum_table", 3), ("living_room_shelf", 1), ("restaurant_low_clutter", 1))
        for seed in range(seeds)
        for reward in ("feasible_share", "object_count")
        for name, algorithm, more in (
            *((name, name, ()) for name in (FORWARD, "awm", CHAIN, "ddpo_is", DISTILLATION, "refinement", *PLUG_INS)),
            ("udm_grpo_averaged", "udm_grpo", ("algorithm.sampler_decay=0.99", learned)),
            ("crd_averaged", "crd", (learned,)),
        )
    )  # fmt: skip


def _counts() -> tuple[Row, ...]:
    """The paper's figure: the number of objects on Living Room Shelf with 20 extra slots, and on Dimsum."""
    hold = "regularisation.hold=1.05"
    return (
        Row("living_room_shelf-count-0", "living_room_shelf",
            (*_keys(CHAIN, "object_count", 0), "slots=43", hold), 80, slots=43),
        Row("dimsum_table_continuous-count-0", "dimsum_table_continuous",
            (*_keys(CHAIN, "object_count", 0), hold), 80),
        Row("dimsum_table-count-0", "dimsum_table", (*_keys(CHAIN, "object_count", 0), hold), 80),
    )  # fmt: skip


def _prompts() -> tuple[Row, ...]:
    """Prompts as reward, and feasibility."""
    rewards = {"match": "reward=prompt_match", "feasible": "reward=feasible_share"}
    return tuple(
        Row(f"{prior}-{label}-0", prior, (f"algorithm={FORWARD}", reward, "prompt=grammar", "seed=0"), 60)
        for prior in ("dimsum_table", "restaurant_low_clutter")
        for label, reward in rewards.items()
    )


def _realism() -> tuple[Row, ...]:
    """A discriminator that learns online as reward, and the likelihood as reward."""
    return tuple(
        Row(f"{prior}-{label}-0", prior, (f"algorithm={FORWARD}", reward, "seed=0"), 100)
        for prior in ("breakfast_table_high_clutter", "restaurant_low_clutter", "restaurant_high_clutter")
        for label, reward in (
            ("discriminator", "reward=discriminator"),
            ("realism", f"reward={_EXAMPLES / 'scene_rewards.py'}:Realism"),
        )
    )


def _frontier() -> tuple[Row, ...]:
    """Reward against realism: weights of the regularisation."""
    return tuple(
        Row(f"dimsum_table-{name}-weight-{weight:g}", "dimsum_table",
            (*_keys(name, "feasible_objects", 0), f"regularisation.weight={weight:g}"), 60)
        for name in (FORWARD, "awm", CHAIN)
        for weight in (0.05, 0.2, 1.0, 5.0)
    )  # fmt: skip


def _keys(algorithm: str, reward: str, seed: int) -> tuple[str, ...]:
    if algorithm in PLUG_INS:
        algorithm = f"{_EXAMPLES / algorithm}.py:{algorithm}"
    return f"algorithm={algorithm}", f"reward={reward}", f"seed={seed}"


_LAYOUT = ("free", "share", "collision", "loss", "count_wasserstein", "category_kl", "classifier")
_MEASURES = ("layout", "physics", "classifier")
_WITH_PROMPTS = ("layout", "physics", "prompts", "classifier")

TABLES: dict[str, Table] = {
    "stability": Table("300 iterations at the defaults", _stability(), (), ("first", "best", "last", "fall")),
    "placement": Table("Feasible share, equal sampled scenes", _placement(), _WITH_PROMPTS,
                       (*_LAYOUT, "prompt_counts", "prompt_names", "prompt_relations")),
    "equal_scenes": Table("Feasible share after 960 scenes", _equal_scenes(), (),
                          ("base_reward", "guard_reward", "kept", "loss", "guard_counts", "base_classifier",
                           "guard_classifier")),
    "losses": Table("Losses after 960 scenes", _losses(40, *_LAST), ("layout", "physics"),
                    ("share", "free", "collision", "loss", "count_wasserstein", "category_kl", "spacing",
                     "training_seconds"),
                    ("num_steps=25", "pictures=0")),
    "long_losses": Table("Losses after 14,400 scenes", _losses(600, *_14400_SCENES), _WITH_PROMPTS,
                         ("last", "fall", "kept", *_LAYOUT, "spacing", "prompt_counts", "prompt_names",
                          "prompt_relations", "training_seconds"),
                         ("prompt_count=180", "pictures=0")),
    "counts": Table("Object counts past the data", _counts(), ("layout", "physics"),
                    ("free", "feasible", "share", "loss", "count_wasserstein", "category_kl")),
    "prompts": Table("Following prompts", _prompts(), _WITH_PROMPTS,
                     ("free", "share", "prompt_counts", "prompt_names", "prompt_relations", "loss", "classifier")),
    "realism": Table("Realism as reward", _realism(), _MEASURES, _LAYOUT),
    "frontier": Table("Reward against realism", _frontier(), _MEASURES,
                      ("feasible", "share", "free", "loss", "classifier")),
}  # fmt: skip
"""Tables by the name that ``table=`` takes."""
