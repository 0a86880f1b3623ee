"""Groups of settings of a pretraining run; imports no torch."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from agents.configuration.composition import (
    LoggerSettings,
    OptimizerSettings,
    ProgressKeys,
    TrainingKeys,
    composed,
    named,
    nested,
)
from agents.utils.loggers import LOGGERS
from scene_envs.errors import (
    BELOW_ONE,
    FINITE,
    Checked,
    Count,
    InvalidInputError,
    Natural,
    OneOf,
    Positive,
    Seed,
    Share,
    at_least,
)
from scene_envs.registry import plugin_entry_points


@dataclass
class ModuleSettings(Checked):
    """Modules that are added to the core of the mixed flux network; other networks do not read them.

    Attributes:
        observed_flags: whether the network reads flags of the poses and categories that are observed in inpainting.
        pooled_text: whether the mean of the text tokens also modulates every block.
        count_embedding: whether the network reads the numbers of visible slots of each category and of masked slots.
        relations: relative positions of slots that attention reads. ``axis`` blurs them along x, y and z by the noise
            of that axis, ``largest`` by the largest noise of the three; ``none`` is plain attention.
        rotation_features: whether the network reads the difference of each rotation from SO(3) and from upright, in
            units of the noise.
        contacts: whether the network predicts the distances at which two objects touch, and reads the remaining gaps in
            units of the noise; needs relations.
    """

    observed_flags: bool = True
    pooled_text: bool = True
    count_embedding: bool = True
    relations: Annotated[str, OneOf(("axis", "largest", "none"))] = "axis"
    rotation_features: bool = True
    contacts: bool = True


@dataclass
class FluxSettings(Checked):
    """Details of the flux network; other networks do not read them.

    Attributes:
        frequencies: octaves of Fourier features of each translation; 0 for none.
        double_blocks: number of double-stream blocks of the mixed network with text; null for a third of depth.
        embedding: width of the embedding of a slot (mixed only); null takes hidden.
        pose_head: hidden width of the pose output (mixed only).
        time_scale: factor on the time before it is embedded (mixed only).
        text_reach: blocks of the mixed network in which text and slots attend to each other: ``double`` for the
            double-stream blocks, which is faster, or ``all``, as in the paper.
    """

    frequencies: Natural = 8
    double_blocks: Count | None = None
    embedding: Count | None = None
    pose_head: Count = 64
    time_scale: Positive = 1.0
    text_reach: Annotated[str, OneOf(("double", "all"), "reach of text")] = "double"


NETWORKS = ("flux", "midiffusion", "diffuscene")
"""Networks of this package."""
PROCESSES = ("mixed", "continuous")
KERNELS = ("mask_and_replace", "early_absorbing", "squared_absorbing")
TEXT_ENCODERS = {
    "none": {"encoder": "none"},
    "vocabulary": {"encoder": "vocabulary"},
    "bert": {"encoder": "google-bert/bert-base-uncased"},
}
"""Options of ``text`` and their keys; ``text.encoder`` names another BERT."""


def registered_networks() -> Sequence[str]:
    """Names of networks; imports no torch, unless installed packages may have registered more."""
    if "agents.networks.registry" not in sys.modules and not plugin_entry_points("scene_envs.networks"):
        return NETWORKS
    from agents.networks.registry import NETWORK_PROCESSES, list_networks

    return sorted({name for process in NETWORK_PROCESSES for name in list_networks(process)})


@dataclass
class NetworkSettings(Checked):
    """The network of a fresh prior.

    Attributes:
        name: name of the network: ``flux`` (ours), ``midiffusion``, ``diffuscene``, or a registered network.
        hidden: width of the network.
        depth: number of blocks; of single-stream blocks if the network has both kinds.
        heads: number of attention heads.
        flux: details of the flux network.
        modules: modules that are added to the core of the mixed flux network.
    """

    place = "network."
    name: str = "flux"
    hidden: Count = 128
    depth: Count = 6
    heads: Count = 4
    flux: FluxSettings = nested(FluxSettings)
    modules: ModuleSettings = nested(ModuleSettings)


@dataclass
class NoiseRange(Checked):
    """Noise-to-signal ratios of a karras schedule.

    Attributes:
        floor: the lowest, in normalised units.
        ceiling: the highest.
    """

    floor: Positive = 0.002
    ceiling: Positive = 20.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.floor < self.ceiling:
            raise InvalidInputError(f"floor={self.floor} of the noise must be less than ceiling={self.ceiling}")


@dataclass
class ProcessSettings(Checked):
    """The diffusion process, and what is made of the network's output.

    Attributes:
        name: ``mixed`` (categories as discrete states) or ``continuous`` (categories as numbers).
        prediction: target of the network: ``edm`` (preconditioning of Karras et al. 2022), ``epsilon``, ``x0`` or
            ``v``.
        schedule: noise schedule: ``karras`` or ``linear``.
        noise: noise-to-signal ratios of the karras schedule.
        moments: mean and standard deviation that scale the network's output: of each ``category`` (of each feature in a
            continuous process), or of each ``feature``.
        rotation: numbers that a continuous prior diffuses for a rotation: ``matrix``, ``quaternion`` or ``axis_angle``.
        kernel: noise kernel of the categories of a mixed prior: ``mask_and_replace``,
            ``early_absorbing`` or ``squared_absorbing``.
        empty_slots: treatment of slots that are known to be empty. ``attended`` keeps them in the network, as in the
            paper; ``dropped`` leaves them out, which saves most of the work and needs a mixed prior with an absorbing
            kernel.
        unmasking: choice of the slots that a sampling step of an absorbing kernel unmasks. ``even`` unmasks the
            expected number, rounded, so that a step decides few categories at once; with ``systematic`` the slots also
            share out the kinds of objects whose number a prompt gives; ``independent`` draws each slot on its own.
        denoised_clip: bound on denoised scenes during sampling, in normalised units; 0 for no bound.
    """

    place = "process."
    name: Annotated[str, OneOf(PROCESSES, "process")] = "mixed"
    prediction: Annotated[str, OneOf(("edm", "epsilon", "x0", "v"))] = "edm"
    schedule: Annotated[str, OneOf(("karras", "linear"), "noise schedule")] = "karras"
    noise: NoiseRange = nested(NoiseRange)
    moments: Annotated[str, OneOf(("category", "feature"))] = "category"
    rotation: Annotated[str, OneOf(("matrix", "quaternion", "axis_angle"))] = "matrix"
    kernel: Annotated[str, OneOf(KERNELS, "categorical kernel")] = "early_absorbing"
    empty_slots: Annotated[str, OneOf(("attended", "dropped"), "treatment of empty slots")] = "dropped"
    unmasking: Annotated[str, OneOf(("systematic", "even", "independent"))] = "systematic"
    denoised_clip: Annotated[float, at_least(0)] = 0.0


@dataclass
class TrainingNoiseSettings(Checked):
    """Distribution of ln(noise-to-signal ratio) over the training timesteps.

    Attributes:
        mean: its mean. The normalised unit of a room is metres long, so rooms need less noise than tables: about -2.6,
            with a noise floor of 0.0004.
        std: its standard deviation.
    """

    mean: Annotated[float, FINITE] = -1.8
    std: Positive = 2.1


@dataclass
class LossSettings(Checked):
    """The pretraining loss.

    Attributes:
        noise: distribution of ln(noise-to-signal ratio) over the training timesteps.
        timesteps: distribution of training timesteps: ``lognormal`` (of the noise-to-signal ratio), ``uniform``, or
            ``both`` in equal parts. Categories are decided at high noise, which ``lognormal`` rarely draws.
        weighting: weight of the loss by timestep: ``none`` or ``min_snr``.
        translation_weight: weight of x, y and z in the loss; the weight of rotations is 1.
        category: category loss of a mixed prior: ``cross_entropy`` of the clean category, or ``bound``, the paper's
            variational bound.
        category_weight: weight of the category loss; the weight of the pose loss is 1.
        observed_share: share of the training scenes of a mixed prior in which some poses or categories are observed, as
            in inpainting.
        open_empty_share: share of scenes with masked empty slots among the training scenes in which whole slots are
            observed. A prior that is trained with 0 adds too many objects if all empty slots are masked.
    """

    place = "loss."
    noise: TrainingNoiseSettings = nested(TrainingNoiseSettings)
    timesteps: Annotated[str, OneOf(("lognormal", "uniform", "both"), "distribution of timesteps")] = "lognormal"
    weighting: Annotated[str, OneOf(("none", "min_snr"), "loss weighting")] = "none"
    translation_weight: Annotated[float, at_least(0)] = 3.0
    category: Annotated[str, OneOf(("cross_entropy", "bound"), "category loss")] = "cross_entropy"
    category_weight: Annotated[float, at_least(0)] = 2.0
    observed_share: Share = 0.3
    open_empty_share: Share = 0.5


@dataclass
class VocabularySettings(Checked):
    """The small text encoder with a closed vocabulary, which is trained with the prior.

    Attributes:
        width: width.
        depth: number of blocks.
        latents: number of tokens to which a prompt is condensed.
        window: number of neighbouring words that are combined before attention, odd; 1 reads each
            word alone.
        lr_share: learning rate, as a fraction of optimizer.lr.
        count_conditioning: it predicts how many objects of each kind the prompt asks for; these
            numbers, less the visible objects, are added to the logits of the mixed flux network.
        warmup: steps in which only the text encoder is trained, to predict the numbers of its prompts, before the first
            step of a fresh prior; at most iterations.
        numbers: embeddings of number words contain their value, so that counts need not be
            learned number by number.
    """

    width: Count = 128
    depth: Count = 2
    latents: Count = 16
    window: Count = 3
    lr_share: Annotated[float, at_least(0)] = 0.5
    count_conditioning: bool = True
    warmup: Natural = 400
    numbers: bool = True


@dataclass
class TextSettings(Checked):
    """Text encoder of a mixed prior.

    Attributes:
        encoder: ``none`` for a prior that reads no prompts; ``vocabulary`` for a small encoder with a closed
            vocabulary, which is trained with the prior; or the folder or hub name of a BERT model, which is frozen.
        vocabulary: the small text encoder.
        dropout: share of training scenes that get no prompt, for classifier-free guidance.
    """

    encoder: str = "none"
    vocabulary: VocabularySettings = nested(VocabularySettings)
    dropout: Share = 0.1

    @property
    def is_read(self) -> bool:
        """Whether there is an encoder."""
        return self.encoder != "none"


@dataclass
class RateSettings(Checked):
    """Course of the learning rate.

    Attributes:
        warmup: steps over which it rises linearly.
        final: its final value, as a fraction of the peak; 1 for no decay.
        decay: last share of the steps, in which it decays along a cosine; 1 decays from the warm-up on.
    """

    place = "optimizer.rate."
    warmup: Natural = 100
    final: Share = 0.01
    decay: Share = 0.3


@dataclass
class ComputeSettings(Checked):
    """How the steps are computed.

    Attributes:
        accumulate: number of parts into which a process splits its batch, to save memory.
        precision: number format of the network in training: ``float32`` or ``bfloat16`` (autocast).
        matmul_precision: precision of float32 products on GPUs: ``highest``, ``high`` (TF32) or ``medium``.
        compile: compile the network with ``torch.compile`` (needs a C++ compiler on a CPU).
    """

    accumulate: Count = 1
    precision: Annotated[str, OneOf(("float32", "bfloat16"))] = "float32"
    matmul_precision: Annotated[str, OneOf(("highest", "high", "medium"))] = "highest"
    compile: bool = False


PRETRAIN_OPTIMIZERS = ("adamw", "muon")
WEIGHT_DECAY = 0.01
"""Decoupled weight decay of pretraining."""


@dataclass
class PretrainOptimizerSettings(OptimizerSettings):
    """The optimiser of a pretraining run.

    Attributes:
        name: ``adamw``, or ``muon``, which trains the matrices inside blocks with Muon and all other weights with
            AdamW.
        ema: decay of the averaged weights, which are evaluated and saved; 0 uses the weights themselves.
        rate: course of the learning rate.
        compute: how the steps are computed.
    """

    name: Annotated[str, OneOf(PRETRAIN_OPTIMIZERS, "optimizer")] = "muon"
    ema: Annotated[float, BELOW_ONE] = 0.999
    rate: RateSettings = nested(RateSettings)
    compute: ComputeSettings = nested(ComputeSettings)


@dataclass
class PretrainLoggerSettings(LoggerSettings):
    """Files of a pretraining run, and how often they are written.

    Attributes:
        log_every: steps between rows of log.csv.
        evaluate_every: steps between evaluations on held-out scenes.
    """

    checkpoint_every: Count = 250
    log_every: Count = 20
    evaluate_every: Count = 250


@dataclass
class SceneKeys:
    """Scenes to train on; :class:`PretrainConfig` describes the keys."""

    scene: Any = named("dimsum_table", "scene")
    data: str = "data/dimsum_table"
    heldout: str = ""


@composed
@dataclass
class PretrainConfig(SceneKeys, TrainingKeys, ProgressKeys):
    """One pretraining run.

    Keys that are not listed are those of :class:`~agents.configuration.composition.TrainingKeys` and
    :class:`~agents.configuration.composition.ProgressKeys`.

    Attributes:
        scene: scene type. This key is ignored with ``prior=`` and with several datasets, which define the union of
            their scene types.
        data: dataset folder of training scenes. Several folders, joined by commas, train one prior on all their scene
            types with equal probability; ``grammar`` draws fresh scenes from the grammar without end.
        heldout: dataset folder of held-out scenes. Empty takes the last 2 % of ``data``, or 512 scenes of the grammar.
            It must be empty if there are several datasets.
        prior: prior from which training starts: a shipped name, or the folder of a prior or a run. Its scene type,
            network, process and text encoder stay as they are. Empty for a fresh prior.
        module: module of the network of ``prior=`` that alone is trained, and that it gets if it has none:
            ``count_logits``. Empty trains all weights.
        output: run folder; a run that was interrupted there is resumed; empty for runs/COMMAND-TIME on the command
            line, runs/pretrain in Python.
        iterations: optimiser steps.
        batch_size: scenes per step, over all processes and parts.
        seed: seed of weights, batches and noise.
        recipe: a named set of values for the other keys: ``ours``, or ``paper`` for the paper's setting. Keys that are
            given as well override it.
        network: the denoiser network.
        process: the diffusion process.
        loss: the training loss.
        text: the text encoder.
        optimizer: the optimiser of the weights.
        logger: log files.
    """

    prior: str = ""
    module: Annotated[str, OneOf(("", "count_logits"), "module to train")] = ""
    iterations: Natural = 5000
    batch_size: Count = 128
    seed: Seed = 0
    network: NetworkSettings = nested(NetworkSettings, folder="network", option="flux", registered=registered_networks)
    process: ProcessSettings = nested(ProcessSettings, folder="process", option="mixed", registered=lambda: PROCESSES)
    loss: LossSettings = nested(LossSettings)
    text: TextSettings = nested(TextSettings, folder="text", option="none", registered=lambda: TEXT_ENCODERS)
    optimizer: PretrainOptimizerSettings = nested(
        PretrainOptimizerSettings, folder="optimizer", option="muon", registered=lambda: PRETRAIN_OPTIMIZERS
    )
    logger: PretrainLoggerSettings = nested(
        PretrainLoggerSettings, folder="logger", option="csv", registered=lambda: LOGGERS
    )

    @property
    def directory(self) -> Path:
        """The run directory."""
        return Path(self.output or "runs/pretrain")
