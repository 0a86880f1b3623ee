"""The paper's tables: networks, prompts, training objective, rotations."""

from __future__ import annotations

from benchmarks.paper_tables.rows import COSTS, NETWORK_LABELS, PROCESSES, Entry, Row, Table, plain_row, text_row

_SCENE_COLUMNS = (
    "classifier_accuracy",
    "frechet_scene_distance",
    "category_kl",
    "median_total_penetration_cm",
    "feasible_fraction",
    "stable_fraction",
    "count_wasserstein",
)
_PROMPT_COLUMNS = ("prompt_following", "prompt_counts", "prompt_names", "prompt_relations")
_PLOTTED = ("classifier_accuracy", "frechet_scene_distance", "feasible_fraction")


def unconditional() -> Table:
    """Ours and the baselines, without prompts."""
    entries = [Entry(f"{label}, mixed", text_row(network)) for network, label in NETWORK_LABELS.items()]
    entries.append(Entry("DiffuScene, continuous (as published)", plain_row("diffuscene", "continuous")))
    return Table(
        "unconditional", "Unconditional generation",
        "Samples without a prompt. Equal parameters, data, steps, schedule and loss: the networks differ. The mixed "
        "rows are trained with prompts, one in ten of them withheld, and the continuous one without.",
        tuple(entries), (*_SCENE_COLUMNS, *COSTS), _PLOTTED,
    )  # fmt: skip


def conditional() -> Table:
    """The same priors, given prompts."""
    entries = tuple(
        Entry(f"{label}, mixed", text_row(network), prompted=True) for network, label in NETWORK_LABELS.items()
    )
    return Table(
        "conditional", "Generation from prompts",
        "The same priors as in the unconditional table, given the prompts of held-out real scenes: counts, names and "
        "relations in equal parts. The line of real scenes is of those scenes themselves.",
        entries, (*_PROMPT_COLUMNS, *_SCENE_COLUMNS), ("prompt_counts", "prompt_names", "prompt_relations"),
    )  # fmt: skip


def objective() -> Table:
    """Mixed and continuous diffusion with every network."""
    entries = tuple(
        Entry(f"{label}, {process}", plain_row(network, process))
        for network, label in NETWORK_LABELS.items()
        for process in PROCESSES
    )
    return Table(
        "objective", "Training objective",
        "Mixed discrete-continuous diffusion beside continuous DDPM of poses and categories together. No row reads "
        "prompts, so that the process alone differs.",
        entries, (*_SCENE_COLUMNS, *COSTS), ("classifier_accuracy", "category_kl", "feasible_fraction"),
    )  # fmt: skip


def rotation() -> Table:
    """Rotation representations of the continuous prior."""
    base = plain_row("flux", "continuous")
    entries = [Entry("matrix (R⁹ and SVD)", base)]
    for name, label in (("quaternion", "quaternion"), ("axis_angle", "axis-angle")):
        entries.append(Entry(label, Row(f"{base.name}_{name}", {**base.overrides, "process.rotation": name})))
    return Table(
        "rotation", "Rotation representation",
        "What the continuous prior diffuses as rotation; all else is equal.",
        tuple(entries), (*_SCENE_COLUMNS, *COSTS), _PLOTTED,
    )  # fmt: skip
