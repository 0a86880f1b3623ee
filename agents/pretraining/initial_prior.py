"""Initial state of a pretraining run: prior, training scenes and held-out scenes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
import torch
from torch import Generator, Tensor

from agents.diffusion import Preconditioning
from agents.diffusion.gaussian import CategoryMoments
from agents.networks import TextConfig
from agents.networks.flux_modules import (
    CountConditioningConfig,
    CountEmbeddingConfig,
    ModuleConfig,
    ObservedFlagsConfig,
    PooledTextConfig,
)
from agents.networks.geometry import ContactsConfig, RelationsConfig, RotationFeaturesConfig
from agents.networks.registry import NetworkConfig, network_config
from agents.networks.text_encoders import VOCABULARY, AnyTextConfig, text_config
from agents.pretraining.settings import PretrainConfig
from agents.priors.claim_guidance import names_of
from agents.priors.config import MixedPriorConfig, PriorConfig
from agents.priors.continuous import ContinuousPrior, SceneCode
from agents.priors.files import PriorFacts
from agents.priors.mixed import MixedPrior
from agents.priors.prior import ScenePrior
from scene_envs.datasets import SceneDataset, to_union
from scene_envs.datasets.dataset import union_normalizer
from scene_envs.datasets.generation import fixed_normalizer
from scene_envs.datasets.prompts import describe_all
from scene_envs.errors import InvalidInputError
from scene_envs.grammars import Grammar, get_grammar
from scene_envs.normalizer import Normalizer
from scene_envs.scene import POSE_FEATURES, SceneBatch
from scene_envs.scene_types import get_scene_type, register_scene_type, union_scene_type

FITTED_ON = 20_000
"""Largest number of scenes to which moments are fitted."""
PROMPTS_PER_SCENE = 3

_SAMPLE, _HELD_OUT = 1024, 512
"""Scenes of a grammar to which the moments and the vocabulary are fitted, and held-out ones."""


def prepare(config: PretrainConfig) -> tuple[ScenePrior, TrainingData, Tensor]:
    """The prior that a run starts from, its training scenes, and held-out scenes (K, N, D). A run from an older prior
    takes the scene type of its data; if a grammar makes the data, it takes that of the prior.
    """
    older = PriorFacts.of(config.prior) if config.prior else None
    if config.module and older is None:
        raise InvalidInputError(f"module={config.module} is trained alone, so it needs a trained prior; give prior=")
    if older is not None and config.text.is_read and not older.text:
        raise InvalidInputError(
            f"text={config.text.encoder} with prior={config.prior!r}, which reads no prompts; leave text= out, or "
            "train a fresh prior"
        )
    if config.data == "grammar":
        if older is not None:
            config = replace(config, scene=older.scene_type)
        grammar = get_grammar(config.scene)
        sample = grammar.sample(np.random.default_rng([config.seed, _SAMPLE]), _SAMPLE)
        reads = config.text.is_read if older is None else bool(older.text)
        prompts = describe_all(sample, np.random.default_rng(config.seed), count=PROMPTS_PER_SCENE) if reads else []
        prior = build_prior(config, sample.tensor, fixed_normalizer(grammar), prompts)
        if config.heldout:
            held_out = SceneBatch(_heldout(config.heldout, prior.scene_type.name).tensor[:2048], prior.scene_type)
        else:
            held_out = grammar.sample(np.random.default_rng([config.seed, _SAMPLE, 1]), _HELD_OUT)
        return prior, GrammarStream(grammar, prior), prior.encode(held_out)
    if "," in config.data:
        return _prepare_union(config)
    if not config.data:
        raise InvalidInputError("data= names no dataset; scene-envs generate makes one, and data=grammar needs none")
    dataset = SceneDataset.load(config.data)
    name, asked = dataset.scene_type.name, str(getattr(config.scene, "name", config.scene))
    if older is not None:
        config = replace(config, scene=name)
    elif name != asked:
        raise InvalidInputError(f"data={config.data!r} holds scenes of {name!r}, and scene={asked}; give scene={name}")
    if len(dataset) < 2:
        raise InvalidInputError(
            f"data={config.data!r} has {len(dataset)} scenes; one is held out, so give at least two"
        )
    if config.heldout:
        return prepare_from(config, dataset, _heldout(config.heldout, name))
    return prepare_from(config, *split_heldout(dataset))


def _heldout(folder: str, scene_type: str) -> SceneDataset:
    """The dataset of held-out scenes, which must be of the scene type."""
    found = SceneDataset.load(folder)
    if found.scene_type.name != scene_type:
        raise InvalidInputError(
            f"heldout={folder!r} holds scenes of {found.scene_type.name!r}, the training scenes are of {scene_type!r}"
        )
    return found


def split_heldout(dataset: SceneDataset) -> tuple[SceneDataset, SceneDataset]:
    """Training scenes, and the last 2 % (at least one), which no run trains on."""
    split = len(dataset) - max(1, len(dataset) // 50)
    return dataset[:split], dataset[split:]


def prepare_from(
    config: PretrainConfig, training: SceneDataset, heldout: SceneDataset
) -> tuple[ScenePrior, TrainingData, Tensor]:
    """The initial prior, its training scenes, and at most 2,048 held-out scenes (K, N, D), both as it encodes them."""
    prior = build_prior(config, training.tensor, training.normalizer, training.prompt_sets)

    def encode(scenes: Tensor) -> Tensor:
        return torch.cat([prior.encode(SceneBatch(part, prior.scene_type)) for part in scenes.split(10_000)])

    return prior, SceneTable(encode(training.tensor), training.prompt_sets), encode(heldout.tensor[:2048])


def _prepare_union(config: PretrainConfig) -> tuple[ScenePrior, TrainingData, Tensor]:
    if config.heldout:
        raise InvalidInputError(
            f"heldout={config.heldout!r} is not read with several datasets: 2 % of each are held out; leave it out"
        )
    whole = [SceneDataset.load(folder.strip()) for folder in config.data.split(",")]
    union = register_scene_type(union_scene_type([dataset.scene_type for dataset in whole]))
    parts = [dataset.split((0.98, 0.02), seed=0) for dataset in whole]
    share = slice(min(5000, FITTED_ON // len(whole)))  # moments see scenes of every type
    some = torch.cat([to_union(dataset.batch(share), union).tensor for dataset, _ in parts])
    normalizer = union_normalizer([dataset.normalizer for dataset in whole], union)
    prompts = [prompt for dataset in whole for prompt in dataset.prompt_sets]
    prior = build_prior(replace(config, scene=union.name), some, normalizer, prompts)
    data = UnionTable([train for train, _ in parts], prior)
    heldout = torch.cat([data.encode(held.batch(slice(2048 // len(whole)))) for _, held in parts])
    return prior, data, heldout


def build_prior(
    config: PretrainConfig, raw: Tensor, normalizer: Normalizer, prompts: Sequence[Sequence[str]] = ()
) -> ScenePrior:
    """The prior that ``config`` starts from: an older one, or a fresh one, fitted to ``raw`` scenes (M, N, D). A fresh
    prior that reads prompts has the vocabulary of the ``prompts`` of every scene.
    """
    if config.prior:
        return _started(config, raw, prompts)
    if config.process.name == "continuous":
        return _continuous(config, raw, normalizer)
    return _mixed(config, raw, normalizer, prompts)


def _started(config: PretrainConfig, raw: Tensor, prompts: Sequence[Sequence[str]]) -> ScenePrior:
    """The prior that ``config`` names, for raw scenes (M, N, D) of its type; a warning lists words that it lacks. It
    keeps its normaliser, vocabulary and settings, except for ``open_empty_share``, which is that of ``config``.
    """
    slots = raw.shape[1]
    prior = ScenePrior.load(config.prior)
    found, expected = (prior.scene_type.name, prior.config.slots), (config.scene, slots)
    if found != expected:
        names = ("scene type", "slots")
        wrong = ", ".join(f"{n} {f!r}, not {a!r}" for n, f, a in zip(names, found, expected, strict=True) if f != a)
        raise InvalidInputError(f"the prior {config.prior!r} cannot be trained further on this data: it has {wrong}")
    _check_constants(prior, raw[:FITTED_ON, len(prior.scene_type.fixed) :], config.prior)
    prior.warn_unknown_words(prompt for group in prompts for prompt in group)
    prior = prior.with_open_empty(config.loss.open_empty_share)
    return prior.with_module(config.module) if config.module else prior


def _check_constants(prior: ScenePrior, free: Tensor, name: str) -> None:
    """Raise InvalidInputError if a feature varies in the scenes that the prior would overwrite with a constant."""
    normalizer = prior.normalizer
    constant = normalizer.is_constant.cpu().clone()
    if isinstance(prior, MixedPrior):
        constant[POSE_FEATURES:] = False  # its categories are discrete states
    objects = free[free[..., -1] == 0]
    off = ((objects - normalizer.input_min.cpu()).abs() > 1e-4).any(dim=0) & constant
    if bool(off.any()):
        raise InvalidInputError(
            f"the prior {name!r} cannot be trained further on this data: of a slot, features "
            f"{torch.nonzero(off)[:, 0].tolist()} never varied where it was trained, and do here; train a fresh prior"
        )


def _continuous(config: PretrainConfig, raw: Tensor, normalizer: Normalizer) -> ContinuousPrior:
    if config.text.is_read:
        raise InvalidInputError(
            f"text.encoder={config.text.encoder} needs process=mixed: the continuous prior reads no prompts"
        )
    scene_type, rotation = get_scene_type(config.scene), config.process.rotation
    code = SceneCode(scene_type, rotation, normalizer)
    moments = Preconditioning.fit(code.encode(SceneBatch(raw[:FITTED_ON], scene_type))[:, len(scene_type.fixed) :])
    prior_config = PriorConfig(
        config.scene,
        raw.shape[1],
        _network(config, code.features, normalizer, raw.shape[1]),  # type: ignore[arg-type]
        rotation=rotation,
        **_chain(config),
    )
    torch.manual_seed(config.seed)
    return ContinuousPrior(prior_config, normalizer, moments)


def _mixed(config: PretrainConfig, raw: Tensor, normalizer: Normalizer, prompts: Sequence[Sequence[str]]) -> MixedPrior:
    process = config.process
    if process.rotation != "matrix":
        raise InvalidInputError(
            f"rotation={process.rotation!r} needs process=continuous: mixed priors diffuse rotation matrices"
        )
    scene_type = get_scene_type(config.scene)
    text = _text(config, prompts)
    network = _network(config, scene_type.features, normalizer, raw.shape[1], 0 if text is None else text.width)
    prior_config = MixedPriorConfig(
        config.scene,
        raw.shape[1],
        network,  # type: ignore[arg-type]
        kernel=process.kernel,
        category_loss=config.loss.category,
        category_weight=config.loss.category_weight,
        observed_share=config.loss.observed_share,
        open_empty_share=config.loss.open_empty_share,
        text=text,
        empty_slots=process.empty_slots,
        unmasking=process.unmasking,
        **_chain(config),
    )
    torch.manual_seed(config.seed)
    free = raw[:FITTED_ON, len(scene_type.fixed) :]
    return MixedPrior(prior_config, normalizer, _pose_moments(process.moments, free, normalizer))


def _chain(config: PretrainConfig) -> dict[str, Any]:
    """Settings of noise and loss that both kinds of prior share."""
    process, loss = config.process, config.loss
    return {
        "schedule": process.schedule,
        "prediction": process.prediction,
        "noise_floor": process.noise.floor,
        "noise_ceiling": process.noise.ceiling,
        "noise_mean": loss.noise.mean,
        "noise_std": loss.noise.std,
        "timesteps": loss.timesteps,
        "loss_weighting": loss.weighting,
        "translation_weight": loss.translation_weight,
        "clip": process.denoised_clip,
    }


def _text(config: PretrainConfig, prompts: Sequence[Sequence[str]]) -> AnyTextConfig | None:
    if not config.text.is_read:
        return None
    encoder = text_config(config.text.encoder, (prompt for group in prompts for prompt in group))
    if not isinstance(encoder, TextConfig):
        return encoder
    sizes = {name: getattr(config.text.vocabulary, name) for name in ("width", "depth", "latents", "window", "numbers")}
    return replace(encoder, count_tokens=max(_kinds(config.scene)) + 2 if _conditions_counts(config) else 0, **sizes)


def _network(
    config: PretrainConfig, features: int, normalizer: Normalizer, slots: int, text_width: int = 0
) -> NetworkConfig:
    return network_config(
        process=config.process.name,
        features=features,
        categories=get_scene_type(config.scene).num_assets + 1,
        text_width=text_width,
        **{key: value for key, value in vars(config.network).items() if key not in ("flux", "modules")},
        **vars(config.network.flux),
        modules=_modules(config, slots, text_width),
        unit=_unit(normalizer),
        rotations=_rotations(normalizer),
    )


def _modules(config: PretrainConfig, slots: int, text_width: int) -> list[ModuleConfig]:
    """The modules of the mixed flux network, except for its Fourier features."""
    chosen = config.network.modules
    relations = chosen.relations != "none"
    offered: list[tuple[bool, Callable[[], ModuleConfig]]] = [
        (chosen.observed_flags, ObservedFlagsConfig),
        (chosen.pooled_text and text_width > 0, PooledTextConfig),
        (chosen.count_embedding, CountEmbeddingConfig),
        (_conditions_counts(config), lambda: CountConditioningConfig(slots, _kinds(config.scene))),
        (relations, lambda: RelationsConfig(chosen.relations)),
        (chosen.rotation_features, RotationFeaturesConfig),
        (relations and chosen.contacts, ContactsConfig),
    ]
    return [make() for used, make in offered if used]


def _kinds(scene: str) -> tuple[int, ...]:
    """The kind of each asset: assets with the same display name are one kind in prompts."""
    return tuple(names_of(get_scene_type(scene).library)[1].tolist())


def _conditions_counts(config: PretrainConfig) -> bool:
    """Whether the network reads how many objects of each kind a prompt asks for."""
    return (
        config.text.vocabulary.count_conditioning
        and config.network.name == "flux"
        and config.text.encoder == VOCABULARY
    )


def _pose_moments(kind: str, raw: Tensor, normalizer: Normalizer) -> Preconditioning:
    """Moments of the normalised poses of all objects of raw scenes (M, N, D)."""
    poses = normalizer.normalize(raw)[..., :POSE_FEATURES]
    moments = Preconditioning.fit(poses[raw[..., -1] == 0])
    if kind == "feature":
        return moments
    categories = raw[..., POSE_FEATURES:].argmax(dim=-1)
    count = raw.shape[-1] - POSE_FEATURES
    return replace(moments, by_category=CategoryMoments.fit(poses.flatten(0, 1), categories.flatten(), count))


def _unit(normalizer: Normalizer) -> tuple[float, float, float]:
    """Metres per normalised unit along x, y, z; 0 along an axis that never varies."""
    scale = normalizer.scale[:3]
    x, y, z = torch.where(scale == 0, torch.zeros_like(scale), 1.0 / scale.clamp(min=1e-9)).tolist()
    return x, y, z


def _rotations(normalizer: Normalizer) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Factors and offsets that turn nine normalised numbers into a rotation matrix."""
    low, high = normalizer.input_min[3:POSE_FEATURES], normalizer.input_max[3:POSE_FEATURES]
    return tuple(((high - low) / 2).tolist()), tuple(((high + low) / 2).tolist())


class TrainingData(Protocol):
    """Training scenes; a draw depends only on the generator, so that a run can be resumed at any step."""

    @property
    def size(self) -> int:
        """Number of distinct scenes; 0 for an endless stream."""

    def draw(self, count: int, generator: Generator, *, prompts: bool) -> tuple[Tensor, list[Sequence[str]]]:
        """(count, N, D) encoded scenes, and the prompts of each if ``prompts`` is True."""


class SceneTable:
    """Scenes (M, N, D) in memory as the prior encodes them, drawn with replacement, and the prompts of every scene."""

    def __init__(self, scenes: Tensor, prompts: Sequence[Sequence[str]] = ()) -> None:
        self.scenes = scenes
        self.prompts = prompts
        self.size = len(scenes)

    def draw(self, count: int, generator: Generator, *, prompts: bool) -> tuple[Tensor, list[Sequence[str]]]:
        """See :class:`TrainingData`."""
        index = torch.randint(len(self.scenes), (count,), generator=generator)
        return self.scenes[index], [self.prompts[i] for i in index.tolist()] if prompts else []


class UnionTable:
    """Scenes of several types in memory, as the prior of their union encodes them; all types are equally likely."""

    def __init__(self, datasets: Sequence[SceneDataset], prior: ScenePrior) -> None:
        self.datasets = datasets
        self.prior = prior
        self.size = sum(map(len, datasets))

    def draw(self, count: int, generator: Generator, *, prompts: bool) -> tuple[Tensor, list[Sequence[str]]]:
        """See :class:`TrainingData`."""
        chosen = torch.randint(len(self.datasets), (count,), generator=generator)
        places = torch.rand(count, generator=generator)
        scenes = torch.empty(count, self.prior.scene_type.slots, self.prior.features)
        texts: list[Sequence[str]] = [()] * count
        for number, dataset in enumerate(self.datasets):
            rows = torch.nonzero(chosen == number).flatten()
            index = (places[rows] * len(dataset)).long()
            if len(rows):
                scenes[rows] = self.encode(dataset.batch(index))
            for row, i in zip(rows.tolist(), index.tolist(), strict=True):
                texts[row] = dataset.prompt_sets[i]
        return scenes, texts if prompts else []

    def encode(self, batch: SceneBatch) -> Tensor:
        """Scenes of one type as the prior of the union encodes them."""
        union = to_union(batch, self.prior.scene_type)
        return self.prior.encode(union.to(self.prior.device)).cpu()


class GrammarStream:
    """Endless fresh scenes of a grammar as the prior encodes them, not verified by physics."""

    size = 0

    def __init__(self, grammar: Grammar, prior: ScenePrior) -> None:
        self.grammar = grammar
        self.prior = prior

    def draw(self, count: int, generator: Generator, *, prompts: bool) -> tuple[Tensor, list[Sequence[str]]]:
        """See :class:`TrainingData`."""
        seeds = torch.randint(2**62, (2,), generator=generator).tolist()
        raw = torch.from_numpy(self.grammar.sample_array(np.random.default_rng(seeds[0]), count))
        batch = SceneBatch(raw, self.prior.scene_type)
        texts = describe_all(batch, np.random.default_rng(seeds[1]), count=PROMPTS_PER_SCENE) if prompts else []
        return self.prior.encode(batch.to(self.prior.device)).cpu(), list(texts)
