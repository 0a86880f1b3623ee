"""Groups of settings of a pretraining run; imports no torch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from agents.configuration.checks import at_least, finite, one_of, positive, shares
from agents.configuration.fields import nested
from agents.configuration.settings import LoggerSettings, OptimizerSettings
from scene_envs.errors import InvalidInputError


@dataclass
class ModuleSettings:
    """Modules that are added to the core of the mixed flux network; other networks do not read them.

    Attributes:
        observed_flags: the network is told which poses and categories are observed, for inpainting.
        pooled_text: the mean of the text tokens also modulates every block.
        count_embedding: the network is told how many slots it sees of each category, and how many are masked.
        relations: slots see where others stand, blurred along x, y and z by the noise of the ``axis`` itself, or of the
            one where it is ``largest``; ``none`` for plain attention.
        rotation_features: the network is told how far each rotation is off SO(3), and off upright, in units of the
            noise.
        contacts: the network learns at what distance two objects touch, and is told the gap that is left in units of
            the noise; only with relations.
    """

    RENAMED: ClassVar[Mapping[str, str]] = {"given_flags": "network.modules.observed_flags"}

    observed_flags: bool = True
    pooled_text: bool = True
    count_embedding: bool = True
    relations: str = "axis"
    rotation_features: bool = True
    contacts: bool = True

    def __post_init__(self) -> None:
        one_of(self, "relations", ("axis", "largest", "none"))


def registered_networks() -> list[str]:
    from agents.networks.registry import NETWORK_PROCESSES, list_networks

    return [name for process in NETWORK_PROCESSES for name in list_networks(process)]


@dataclass
class NetworkSettings:
    """The network of a fresh prior.

    Attributes:
        name: ``flux`` (ours), ``midiffusion``, ``diffuscene``, or a registered one.
        hidden: width of the network.
        depth: its blocks; single-stream ones where there are both.
        heads: attention heads.
        frequencies: octaves of Fourier features of each translation (flux only); 0 for none.
        double_blocks: double-stream blocks of the mixed flux network with text; null for a third of depth.
        embedding: width of the embedding of a slot (mixed flux only); null for hidden.
        pose_head: hidden width of the pose output (mixed flux only).
        time_scale: what the time is multiplied by before it is embedded (mixed flux only).
        text_reach: of the mixed flux network: text meets slots in its ``double``-stream blocks alone, which is quicker,
            or in ``all``, as in the paper's.
        modules: what is added to the core of the mixed flux network.
    """

    name: str = "flux"
    hidden: int = 128
    depth: int = 6
    heads: int = 4
    frequencies: int = 8
    double_blocks: int | None = None
    embedding: int | None = None
    pose_head: int = 64
    time_scale: float = 1.0
    text_reach: str = "double"
    modules: ModuleSettings = nested(ModuleSettings)

    def __post_init__(self) -> None:
        at_least(self, 1, "hidden", "depth", "heads")
        at_least(self, 0, "frequencies")
        at_least(self, 1, "pose_head", "double_blocks", "embedding")
        positive(self, "time_scale")
        one_of(self, "text_reach", ("double", "all"), "reach of text")


@dataclass
class ProcessSettings:
    """The diffusion process, and what is made of the network's output.

    Attributes:
        name: ``mixed`` (categories as discrete states) or ``continuous`` (categories as numbers).
        prediction: what the network predicts (``edm``, the preconditioning of Karras et al. 2022, ``epsilon``, ``x0``,
            ``v``).
        schedule: noise schedule (``karras``, ``linear``, ``cosine``).
        noise_floor: lowest noise-to-signal ratio of the karras schedule, in normalised units.
        noise_ceiling: highest noise-to-signal ratio of the karras schedule.
        moments: whose mean and spread scale what the network says: those of each ``category`` (of each feature, where
            the process is continuous), of each ``feature``, or of the ``scene`` as a whole.
        rotation: what a continuous prior diffuses as rotation: ``matrix``, ``quaternion`` or ``axis_angle``.
        kernel: of the categories of a mixed prior (``mask_and_replace``, ``absorbing``, ``early_absorbing``,
            ``squared_absorbing``, ``uniform``).
        empty_slots: whether slots known to be empty are ``attended`` (the paper's) or ``dropped`` from the network of a
            mixed prior, which needs an absorbing kernel and saves most of the work.
        unmasking: which masked slots a sampling step of an absorbing kernel unmasks: ``even``, as near to the expected
            number as can be, so that few categories are decided at once, or ``independent``.
        denoised_clip: bound on denoised scenes while sampling, normalised units; 0 for none.
    """

    name: str = "mixed"
    prediction: str = "edm"
    schedule: str = "karras"
    noise_floor: float = 0.002
    noise_ceiling: float = 20.0
    moments: str = "category"
    rotation: str = "matrix"
    kernel: str = "early_absorbing"
    empty_slots: str = "dropped"
    unmasking: str = "even"
    denoised_clip: float = 0.0

    def __post_init__(self) -> None:
        one_of(self, "name", ("mixed", "continuous"), "process")
        if self.prediction == "karras":
            raise InvalidInputError("prediction='karras' has another name now: prediction='edm'")
        one_of(self, "prediction", ("edm", "epsilon", "x0", "v"))
        one_of(self, "schedule", ("karras", "linear", "cosine"), "noise schedule")
        one_of(self, "moments", ("category", "feature", "scene"))
        one_of(self, "rotation", ("matrix", "quaternion", "axis_angle"))
        kernels = ("mask_and_replace", "absorbing", "early_absorbing", "squared_absorbing", "uniform")
        one_of(self, "kernel", kernels, "categorical kernel")
        one_of(self, "empty_slots", ("attended", "dropped"), "treatment of empty slots")
        one_of(self, "unmasking", ("even", "independent"))
        positive(self, "noise_floor", "noise_ceiling")
        at_least(self, 0, "denoised_clip")
        if not self.noise_floor < self.noise_ceiling:
            raise InvalidInputError(
                f"noise_floor={self.noise_floor} must be less than noise_ceiling={self.noise_ceiling}"
            )


@dataclass
class LossSettings:
    """The pretraining loss.

    Attributes:
        noise_mean: mean of ln(noise-to-signal) over training timesteps. Rooms, whose normalised unit is metres, need
            less noise than tables: about -2.6, with a floor of 0.0004.
        noise_std: its standard deviation.
        timesteps: distribution of training timesteps, ``lognormal`` (of the noise-to-signal ratio), ``uniform``, or
            ``both`` in equal parts: categories are decided at high noise, which the first rarely draws.
        weighting: of the loss by timestep, ``none`` or ``min_snr``.
        translation_weight: weight of x, y, z in the loss, rotations having 1.
        category: of a mixed prior, ``cross_entropy`` of the clean category, or ``bound``, the paper's.
        category_weight: weight of the loss of the categories beside that of the poses.
        observed_share: share of a mixed prior's training scenes in which some poses or categories are observed, for
            inpainting.
        open_empty_share: share of those in which whole slots are observed that observe no empty slot. A prior trained
            without them crowds a scene whose empty slots are all masked.
    """

    RENAMED: ClassVar[Mapping[str, str]] = {"given_share": "loss.observed_share"}

    noise_mean: float = -1.8
    noise_std: float = 2.1
    timesteps: str = "lognormal"
    weighting: str = "none"
    translation_weight: float = 3.0
    category: str = "cross_entropy"
    category_weight: float = 2.0
    observed_share: float = 0.3
    open_empty_share: float = 0.5

    def __post_init__(self) -> None:
        one_of(self, "timesteps", ("lognormal", "uniform", "both"), "distribution of timesteps")
        one_of(self, "weighting", ("none", "min_snr"), "loss weighting")
        one_of(self, "category", ("cross_entropy", "bound"), "category loss")
        finite(self, "noise_mean")
        positive(self, "noise_std")
        at_least(self, 0, "translation_weight", "category_weight")
        shares(self, "observed_share", "open_empty_share")


@dataclass
class TextSettings:
    """Text encoder of a mixed prior.

    Attributes:
        encoder: ``none`` for a prior that reads no prompts; ``vocabulary`` for a small encoder with a closed
            vocabulary, trained with the prior; or the folder or hub name of a BERT model, which stays as it is.
        width: width of the small text encoder.
        depth: its blocks.
        latents: tokens that it condenses a prompt to; 0 for one per word.
        window: of the small text encoder: words that are read together before they attend to each other, odd; 1
            reads each by itself.
        lr_share: learning rate of the small text encoder, as a fraction of optimizer.lr.
        count_conditioning: whether the small text encoder also says what is asked of each kind of object, which
            joins the logits of the mixed flux network beside what it sees; needs latents.
        warmup: steps in which the text encoder learns how many of each kind its prompts ask for, before a fresh
            prior takes the first of its own; at most iterations.
        numbers: of the small text encoder: whether words that are numbers say how many they are, so that counts
            need not be learned number by number.
        dropout: share of training scenes whose prompt is withheld, for classifier-free guidance.
    """

    encoder: str = "none"
    width: int = 128
    depth: int = 2
    latents: int = 16
    window: int = 3
    lr_share: float = 0.5
    count_conditioning: bool = True
    warmup: int = 400
    numbers: bool = True
    dropout: float = 0.1

    def __post_init__(self) -> None:
        at_least(self, 1, "width", "depth", "window")
        at_least(self, 0, "latents", "lr_share", "warmup")
        shares(self, "dropout")

    @property
    def is_read(self) -> bool:
        """Whether there is an encoder."""
        return self.encoder != "none"


@dataclass
class PretrainOptimizerSettings(OptimizerSettings):
    """The optimiser of a pretraining run.

    Attributes:
        name: ``adamw``, or ``muon`` for Muon on the matrices inside blocks and AdamW on the rest.
        final_lr: where the learning rate ends, as a fraction of the peak; 1 for no decay.
        decay_share: share of the steps, the last ones, over which it goes there along a cosine; 1 from the warm-up on.
        accumulate: parts in which a process takes its scenes, one after the other, to save memory.
        precision: number format of the network in training, ``float32`` or ``bfloat16`` (autocast).
        matmul_precision: of float32 products on GPUs, ``highest``, ``high`` (TF32) or ``medium``.
        compile: compile the network with ``torch.compile`` (needs a C++ compiler on CPU).
    """

    KNOWN = ("adamw", "muon")

    name: str = "muon"
    warmup: int = 100
    weight_decay: float = 0.01
    ema: float = 0.999
    final_lr: float = 0.01
    decay_share: float = 0.3
    accumulate: int = 1
    precision: str = "float32"
    matmul_precision: str = "highest"
    compile: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        shares(self, "final_lr", "decay_share")
        at_least(self, 1, "accumulate")
        one_of(self, "precision", ("float32", "bfloat16"))
        one_of(self, "matmul_precision", ("highest", "high", "medium"))


@dataclass
class PretrainLoggerSettings(LoggerSettings):
    """Files of a pretraining run, and how often they are written.

    Attributes:
        log_every: steps between log rows.
        evaluate_every: steps between held-out evaluations.
        pictures_every: steps between pictures of samples; 0 draws none.
    """

    checkpoint_every: int = 250
    log_every: int = 20
    evaluate_every: int = 250
    pictures_every: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        at_least(self, 1, "log_every", "evaluate_every")
        at_least(self, 0, "pictures_every")
