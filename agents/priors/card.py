"""Packaging of priors as folders to publish, with model cards."""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agents.configuration.composition import dotted
from agents.configuration.prior_names import CONFIG_NAME
from agents.priors.files import PriorFacts, read_config, write_config
from scene_envs.errors import InvalidInputError
from scene_envs.files import claimed, read_json, read_sealed, write_text

if TYPE_CHECKING:
    from agents.priors.prior import ScenePrior

README = "README.md"
_TITLE = "# Prior `"
"""Start of the first line of a model card."""
OWN_LICENSE = "MIT, as this package, whose grammars and assets made the scenes."
"""Licence of the data of priors that were trained on scenes of ``scene-envs generate``."""
_OPTIMIZERS = {"adamw": "AdamW", "muon": "Muon and AdamW"}


def package_prior(
    source: str | os.PathLike[str] | ScenePrior, output: str | os.PathLike[str], *,
    evaluation: str | os.PathLike[str] | None = None, precision: str = "float16", data: str = "", license: str = "",
    machine: str = "", limits: str = "", physics_guidance: float | None = None,
) -> Path:  # fmt: skip
    """Write a prior as a folder to publish: ``config.json``, ``model.safetensors`` and the model card ``README.md``.

    Args:
        source: name, prior directory or run directory; a run's metrics tell how it was trained.
        output: the folder; its name is the prior's. An earlier packaged prior in it is replaced.
        evaluation: ``metrics.json`` of ``scene-envs evaluate``, or the folder it is in; None for a prior that was not
            measured.
        precision: number format of the weights, ``"float16"`` or ``"float32"``.
        data: the training data, in a sentence.
        license: licence of the data; empty for that of this package, unless the prior was imported.
        machine: the hardware of the training, as in ``"one NVIDIA H200"``.
        limits: weaknesses of the prior, in sentences.
        physics_guidance: strength of physics guidance of samples of the package where a caller gives none; None keeps
            that of the source.

    Raises:
        InvalidInputError: no such evaluation, one of another prior, ``physics_guidance`` outside 0 to 1, a weight that
            half precision cannot hold, or a folder that holds anything but a packaged prior.
        CorruptFileError: the evaluation is not a JSON mapping, as the command writes it.
    """
    from agents.priors.prior import ScenePrior

    _check_folder(Path(output))

    measures, measured = ({}, None) if evaluation is None else read_measures(evaluation)
    prior = ScenePrior.load(source)
    if measured is not None and measured != prior_digest(prior):
        raise InvalidInputError(
            f"evaluation={str(evaluation)!r} has figures of other weights than those of the prior (digest {measured}, "
            f"and {prior_digest(prior)}); run scene-envs evaluate on this prior"
        )
    config = prior.config
    if physics_guidance is not None:
        prior.with_physics_guidance(physics_guidance)
    known = str(prior.card.get("license") or ("" if "imported_from" in prior.card else OWN_LICENSE))
    given = {"data": data, "license": license or known, "machine": machine, "limits": limits}
    kept = prior.card
    # the settings of a post-training run describe the post-training; the card has those of the pretraining
    steered = bool(kept.get("post_training"))
    trained = {} if isinstance(source, ScenePrior) or steered else _training_of(Path(source))
    prior.card = {**kept, **trained, **{key: text for key, text in given.items() if text}}
    if measures:
        prior.card["measures"] = measures
    try:
        with claimed(output, "the packaging of a prior"):
            _check_folder(Path(output))
            folder = prior.save(output, precision=precision)
            write_config(folder, _without_folders(read_config(folder)))
            write_text(folder / README, card_page(folder.name, prior, PriorFacts.of(folder)))
    finally:
        prior.card, prior.config = kept, config
    return folder


def _check_folder(folder: Path) -> None:
    """Refuse a folder that holds a run, a dataset or a prior that was not packaged."""
    if not folder.is_dir():
        return
    found = sorted(path.name for path in folder.iterdir() if not path.name.startswith("."))
    if not found:
        return
    runs = [name for name in found if name in ("config.yaml", "metadata.json", "checkpoint.pt", "log.txt")]
    with suppress(OSError), (folder / README).open(encoding="utf-8", errors="replace") as file:
        if CONFIG_NAME in found and not runs and file.readline().startswith(_TITLE):
            return
    raise InvalidInputError(
        f"output={str(folder)!r} holds {(runs or found)[0]} and is no packaged prior; give a new folder"
    )


def prior_digest(prior: ScenePrior) -> str:
    """Digest of the configuration and the weights of a prior, 16 characters; the strength of guidance is no part."""
    state = {key: value for key, value in prior.config_state().items() if key != "physics_guidance"}
    digest = hashlib.sha256(json.dumps(state, sort_keys=True).encode())
    for name, tensor in sorted(prior.weights().items()):
        digest.update(name.encode())
        digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]


def read_measures(path: str | os.PathLike[str]) -> tuple[dict[str, float], str | None]:
    """The figures of ``scene-envs evaluate`` that are numbers, and the digest of the prior that was measured, if any,
    from its ``metrics.json`` or the folder it is in. An InvalidInputError without such a file, or a figure in it; a
    CorruptFileError if it is not JSON.
    """
    file = Path(path) / "metrics.json" if Path(path).is_dir() else Path(path)
    try:
        content = read_json(file)
    except FileNotFoundError:
        raise InvalidInputError(f"no evaluation at {str(file)!r}; scene-envs evaluate writes one") from None
    figures = {
        name: float(value)
        for name, value in content.items()
        if isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    }
    if "scenes" not in figures:
        raise InvalidInputError(
            f"{str(file)!r} holds no figures of samples; give the metrics.json that scene-envs evaluate writes"
        )
    return figures, ((content.get("evaluation") or {}).get("identity") or {}).get("digest")


def card_page(name: str, prior: ScenePrior, facts: PriorFacts) -> str:
    """The model card, Markdown."""
    card = facts.card
    kind, strength = "A text-conditioned" if facts.text else "An unconditional", prior.config.physics_guidance
    prompt = " prompt='A scene with 12 objects.'" if facts.text else ""
    rows = {
        "scene type": f"{facts.scene_type}: {prior.scene_type.num_assets} assets, {facts.slots} slots",
        "network": _network(prior, facts),
        "process": _process(prior, facts),
        "prompts": facts.text or "none",
        "data": _data(card),
        "training": _training(card),
        "post-training": _post_training(card),
        "sampling": f"with physics guidance of strength {strength:g}; `physics_guidance=0` turns it off"
        if strength
        else "",
        "licence of the data": str(card.get("license") or "not stated"),
    }
    table = "\n".join(["| | |", "|---|---|", *(f"| {key} | {text} |" for key, text in rows.items() if text)])
    parts = [
        f"{_TITLE}{name}`",
        f"{kind} {facts.process} diffusion prior over scenes of type `{facts.scene_type}`.",
        table,
        "## How good it is",
        _measured(prior, facts.measures),
        "## What it is not good at",
        str(card.get("limits") or "Not stated."),
        "## Use",
        f"```sh\nscene-envs sample prior={name}{prompt} count=16 project=true\n```",
    ]
    return "\n\n".join(parts) + "\n"


def _measured(prior: ScenePrior, measures: Mapping[str, float]) -> str:
    from agents.evaluation import figure_table

    if not measures:
        return "Not measured."
    steps = f" at {measures['num_steps']:.0f} steps" if "num_steps" in measures else ""
    strength = measures.get("physics_guidance", 0.0)
    guided = f", with physics guidance of strength {strength:g}" if strength else ""
    if prior.config.physics_guidance and not strength:
        guided = ", without physics guidance"
    intro = f"{measures['scenes']:.0f} raw samples{steps}{guided}, none selected."
    return f"{intro} *Real* is the same figure of real scenes: what a perfect sampler would score.\n\n" + figure_table(
        measures
    )


def _network(prior: ScenePrior, facts: PriorFacts) -> str:
    network = prior.denoiser.network
    sizes = [
        f"{field.name} {getattr(network.config, field.name)}"
        for field in fields(network.config)
        if field.name in ("hidden", "depth", "double_blocks", "single_blocks", "heads")
    ]
    modules = [module.name for module in getattr(network.config, "modules", ())]
    sizes += [f"modules {', '.join(modules)}"] if modules else []
    return (
        f"{type(network).__name__}, {facts.parameters / 1e6:.1f} M parameters ({facts.megabytes:.1f} MB): "
        f"{', '.join(sizes)}"
    )


def _process(prior: ScenePrior, facts: PriorFacts) -> str:
    config = prior.config
    text = f"{facts.process}, T = {config.num_timesteps}, schedule {config.schedule}, prediction {config.prediction}"
    return f"{text}, categories {config.kernel}" if hasattr(config, "kernel") else text


def _data(card: Mapping[str, Any]) -> str:
    scenes = card.get("training_scenes")
    parts = [str(card.get("data") or ""), f"{scenes:,} training scenes" if isinstance(scenes, int) else ""]
    return "; ".join(part.rstrip(".") for part in parts if part)


def _training(card: Mapping[str, Any]) -> str:
    run, base = card.get("training") or {}, card.get("base") or {}
    base_steps = f" ({base['trained_steps']:,} steps)" if base.get("trained_steps") else ""
    parts = [
        f"{card['trained_steps']:,} steps" + (f" of {card['batch_size']} scenes" if card.get("batch_size") else "")
        if "trained_steps" in card
        else "",
        f"from `{base['name']}`{base_steps}" if base.get("name") else "",
        _OPTIMIZERS.get(run.get("optimizer", ""), ""),
        f"peak learning rate {run['learning_rate']:g}, EMA {run['ema']:g}" if "learning_rate" in run else "",
        f"{card['seconds'] / 60:.0f} minutes" if card.get("seconds") else "",
        str(card.get("machine") or ""),
        f"held-out loss {card['heldout_loss']:.4g}" if card.get("heldout_loss") else "",
        f"imported from {card['imported_from']}" if "imported_from" in card else "",
    ]
    return ", ".join(part.rstrip(".") for part in parts if part)


def _post_training(card: Mapping[str, Any]) -> str:
    run = card.get("post_training") or {}
    if "sum" in run:
        terms = " + ".join(f"{part['factor']:g} x ({_iterations(part)})" for part in run["sum"])
        return f"the weights of `{run['base']}` + {terms}; a bracket is the change of all weights by a run"
    if not run.get("iteration"):
        return ""
    base = f" from `{run['base']}`" if "base" in run else ""
    return f"{_iterations(run)}{base}, held-out loss {run['guard_ratio']:.3f} times the base prior's"


def _iterations(run: Mapping[str, Any]) -> str:
    """Iterations, algorithm and reward of a run, or the name of the prior that it made."""
    if "reward" not in run:
        return f"`{run.get('name', 'a run without a card')}`"
    algorithm = f" of {run['algorithm'].upper().replace('_', '-')}" if "algorithm" in run else ""
    reward = run["reward"]
    if isinstance(reward, Mapping) and isinstance(reward.get("rewards"), list):
        reward = f"{reward.get('name', 'composite')} of {', '.join(map(str, reward['rewards']))}"
    return f"{run.get('iteration', 0)} iterations{algorithm} toward `{reward}`"


def _training_of(source: Path) -> dict[str, Any]:
    """Training settings of a run, from the ``config.yaml`` of its folder."""
    import yaml

    folder = source.parent if source.name == "prior" else source
    if not (folder / "config.yaml").is_file():
        return {}
    config = yaml.safe_load(read_sealed(folder / "config.yaml"))
    optimizer = config.get("optimizer") if isinstance(config, dict) else None
    if not isinstance(optimizer, dict):
        return {}
    flat = dotted(optimizer)
    names = {"rate.warmup": "warmup", "compute.precision": "precision"}
    wanted = {"name": "optimizer", "lr": "learning_rate", "ema": "ema", **names}
    trained = {name: flat[key] for key, name in wanted.items() if key in flat}
    return {"training": {**trained, "seed": config.get("seed")}}


def _without_folders(state: dict[str, Any]) -> dict[str, Any]:
    """A configuration without absolute paths: of the folder of a BERT model, only the last part stays."""
    text = state["prior"].get("text")
    if not text or not os.path.isabs(text.get("model", "")):
        return state
    return {**state, "prior": {**state["prior"], "text": {**text, "model": os.path.basename(text["model"])}}}
