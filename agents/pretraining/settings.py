"""Groups of settings of a pretraining run; imports no torch."""

from __future__ import annotations

from dataclasses import dataclass

from agents.configuration.checks import at_least, finite, one_of, positive, shares
from agents.configuration.fields import nested
from agents.configuration.settings import LoggerSettings, OptimizerSettings
from scene_envs.errors import InvalidInputError


@dataclass
class ModuleSettings:
    """Modules that are added to the core of the mixed flux network; other networks do not read them.

    Attributes:
        observed_flags: give the network flags that say which poses and categories are observed in inpainting.
        pooled_text: also modulate every block by the mean of the text tokens.
        count_embedding: give the network the numbers of visible slots of each category and of masked slots.
        relations: give attention the relative positions of slots. ``axis`` blurs them along x, y and z by the noise of
            that axis, ``largest`` by the largest noise of the three; ``none`` is plain attention.
        rotation_features: give the network the difference of each rotation from SO(3) and from upright, in units of the
            noise.
        contacts: predict the distances at which two objects touch, and give the network the remaining gaps in units of
            the noise; needs relations.
    """

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
        name: name of the network: ``flux`` (ours), ``midiffusion``, ``diffuscene``, or a registered network.
        hidden: width of the network.
        depth: number of blocks; of single-stream blocks if the network has both kinds.
        heads: number of attention heads.
        frequencies: octaves of Fourier features of each translation (flux only); 0 for none.
        double_blocks: number of double-stream blocks of the mixed flux network with text; null for a third of depth.
        embedding: width of the embedding of a slot (mixed flux only); null takes hidden.
        pose_head: hidden width of the pose output (mixed flux only).
        time_scale: factor on the time before it is embedded (mixed flux only).
        text_reach: blocks of the mixed flux network in which text and slots attend to each other: ``double`` for the
            double-stream blocks, which is faster, or ``all``, as in the paper.
        modules: modules that are added to the core of the mixed flux network.
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
        prediction: target of the network: ``edm`` (preconditioning of Karras et al. 2022), ``epsilon``, ``x0`` or
            ``v``.
        schedule: noise schedule: ``karras``, ``linear`` or ``cosine``.
        noise_floor: lowest noise-to-signal ratio of the karras schedule, in normalised units.
        noise_ceiling: highest noise-to-signal ratio of the karras schedule.
        moments: mean and standard deviation that scale the network's output: of each ``category`` (of each feature in a
            continuous process), of each ``feature``, or of the whole ``scene``.
        rotation: numbers that a continuous prior diffuses for a rotation: ``matrix``, ``quaternion`` or ``axis_angle``.
        kernel: noise kernel of the categories of a mixed prior: ``mask_and_replace``, ``absorbing``,
            ``early_absorbing``, ``squared_absorbing`` or ``uniform``.
        empty_slots: treatment of slots that are known to be empty. ``attended`` keeps them in the network, as in the
            paper; ``dropped`` leaves them out, which saves most of the work and needs a mixed prior with an absorbing
            kernel.
        unmasking: choice of the slots that a sampling step of an absorbing kernel unmasks. ``even`` unmasks the
            expected number, rounded, so that a step decides few categories at once; with ``systematic`` the slots also
            share out the kinds of objects whose number a prompt gives; ``independent`` draws each slot on its own.
        denoised_clip: bound on denoised scenes during sampling, in normalised units; 0 for no bound.
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
    unmasking: str = "systematic"
    denoised_clip: float = 0.0

    def __post_init__(self) -> None:
        one_of(self, "name", ("mixed", "continuous"), "process")
        one_of(self, "prediction", ("edm", "epsilon", "x0", "v"))
        one_of(self, "schedule", ("karras", "linear", "cosine"), "noise schedule")
        one_of(self, "moments", ("category", "feature", "scene"))
        one_of(self, "rotation", ("matrix", "quaternion", "axis_angle"))
        kernels = ("mask_and_replace", "absorbing", "early_absorbing", "squared_absorbing", "uniform")
        one_of(self, "kernel", kernels, "categorical kernel")
        one_of(self, "empty_slots", ("attended", "dropped"), "treatment of empty slots")
        one_of(self, "unmasking", ("systematic", "even", "independent"))
        positive(self, "noise_floor", "noise_ceiling")
        finite(self, "noise_ceiling")
        at_least(self, 0, "denoised_clip")
        if not self.noise_floor < self.noise_ceiling:
            raise InvalidInputError(
                f"noise_floor={self.noise_floor} must be less than noise_ceiling={self.noise_ceiling}"
            )


@dataclass
class LossSettings:
    """The pretraining loss.

    Attributes:
        noise_mean: mean of ln(noise-to-signal ratio) of the training timesteps. The normalised unit of a room is metres
            long, so rooms need less noise than tables: about -2.6, with a noise floor of 0.0004.
        noise_std: standard deviation of ln(noise-to-signal ratio) of the training timesteps.
        timesteps: distribution of training timesteps: ``lognormal`` (of the noise-to-signal ratio), ``uniform``, or
            ``both`` in equal parts. Categories are decided at high noise, which ``lognormal`` rarely draws.
        weighting: weight of the loss by timestep: ``none`` or ``min_snr``.
        translation_weight: weight of x, y and z in the loss; the weight of rotations is 1.
        category: category loss of a mixed prior: ``cross_entropy`` of the clean category, or ``bound``, the paper's
            variational bound.
        category_weight: weight of the category loss; the weight of the pose loss is 1.
        observed_share: share of the training scenes of a mixed prior in which some poses or categories are observed, as
            in inpainting.
        open_empty_share: among training scenes in which whole slots are observed, the share in which all empty slots
            are masked. A prior that is trained with 0 adds too many objects when all empty slots are masked.
    """

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
            vocabulary, which is trained with the prior; or the folder or hub name of a BERT model, which is frozen.
        width: width of the small text encoder.
        depth: number of blocks of the small text encoder.
        latents: number of tokens to which the small text encoder condenses a prompt; 0 for one token per word.
        window: number of neighbouring words that the small text encoder combines before attention, odd; 1 reads each
            word alone.
        lr_share: learning rate of the small text encoder, as a fraction of optimizer.lr.
        count_conditioning: the small text encoder predicts how many objects of each kind the prompt asks for; these
            numbers, less the visible objects, are added to the logits of the mixed flux network; needs latents.
        warmup: steps in which only the text encoder is trained, to predict the numbers of its prompts, before the first
            step of a fresh prior; at most iterations.
        numbers: embeddings of number words in the small text encoder contain their value, so that counts need not be
            learned number by number.
        dropout: share of training scenes that get no prompt, for classifier-free guidance.
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
        name: ``adamw``, or ``muon``, which trains the matrices inside blocks with Muon and all other weights with
            AdamW.
        final_lr: final learning rate, as a fraction of the peak; 1 for no decay.
        decay_share: last share of the steps, in which the learning rate decays along a cosine; 1 decays from the
            warm-up on.
        accumulate: number of parts into which a process splits its batch, to save memory.
        precision: number format of the network in training: ``float32`` or ``bfloat16`` (autocast).
        matmul_precision: precision of float32 products on GPUs: ``highest``, ``high`` (TF32) or ``medium``.
        compile: compile the network with ``torch.compile`` (needs a C++ compiler on a CPU).
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
        log_every: steps between rows of log.csv.
        evaluate_every: steps between evaluations on held-out scenes.
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
