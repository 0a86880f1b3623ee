"""The keys of a pretraining run; imports nothing, so that they can be listed quickly."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar


@dataclass
class PretrainConfig:
    """One pretraining run.

    Attributes:
        scene: scene type; with several datasets it is their union, and this key is not read.
        data: dataset directory of training scenes; several, joined by commas, train one prior on all their scene
            types with equal chances; ``grammar`` stands for fresh scenes of the grammar without end.
        heldout: dataset directory of held-out scenes; empty takes the last 2 % of ``data``, or 512 of the grammar;
            with several datasets it must be empty.
        prior: shipped name, or folder of a prior or a run, that training starts from, whatever the keys of its size
            and kind say; empty for a fresh one.
        output: run directory; an interrupted run in it goes on where it stopped.
        iterations: optimiser steps.
        batch_size: scenes per step, over all processes and parts.
        accumulate: parts in which a process takes its scenes, one after the other, to save memory.
        precision: number format of the network in training, ``float32`` or ``bfloat16`` (autocast).
        optimizer: ``adamw``, or ``muon`` for Muon on the matrices inside blocks and AdamW on the rest.
        learning_rate: peak learning rate.
        final_learning_rate: where the learning rate ends, as a fraction of the peak; 1 for no decay.
        decay_share: share of the steps, the last ones, over which it goes there along a cosine; 1 from the warm-up on.
        warmup: steps of linear warm-up.
        weight_decay: decoupled weight decay.
        clip: largest gradient norm.
        ema: decay of the weight average that is evaluated and saved.
        hidden: width of the network.
        depth: blocks of the network.
        heads: attention heads.
        recipe: a named set of the other keys: ``ours``, or ``paper`` for the paper's setting; keys given beside it win.
        network: ``flux`` (ours), ``midiffusion``, ``diffuscene``, or ``paper`` for the paper's flux network of 88.3 M
            parameters, whatever hidden, depth, heads, attention and frequencies say.
        attention: of the mixed flux network: ``plain``, or ``relative``, which sees where other objects stand.
        relation_blur: with attention=relative: the noise that blurs what is seen along x, y and z, of the ``axis``
            itself, or of the one where it is ``largest``.
        frequencies: octaves of Fourier features of each translation (flux only); 0 for none.
        rotation_features: the mixed flux network is told how far each rotation is off SO(3), and off upright, in units
            of the noise.
        contacts: with attention=relative: the network learns at what distance two objects touch, and is told the gap
            that is left in units of the noise.
        prediction: what the network predicts (``edm``, the preconditioning of Karras et al. 2022, ``epsilon``,
            ``x0``, ``v``).
        schedule: noise schedule (``karras``, ``linear``, ``cosine``).
        noise_floor: lowest noise-to-signal ratio of the karras schedule, in normalised units.
        noise_ceiling: highest noise-to-signal ratio of the karras schedule.
        noise_mean: mean of ln(noise-to-signal) over training timesteps. Rooms, whose normalised unit is metres, need
            less noise than tables: about -2.6, with a floor of 0.0004.
        noise_std: its standard deviation.
        timesteps: distribution of training timesteps, ``lognormal`` (of the noise-to-signal ratio), ``uniform``, or
            ``both`` in equal parts: categories are decided at high noise, which the first rarely draws.
        loss_weighting: of the loss by timestep, ``none`` or ``min_snr``.
        moments: whose mean and spread scale what the network says: those of each ``category`` (of each feature, where
            the process is continuous), of each ``feature``, or of the ``scene`` as a whole.
        translation_weight: weight of x, y, z in the loss, rotations having 1.
        category_loss: of a mixed prior, ``cross_entropy`` of the clean category, or ``bound``, the paper's.
        category_weight: weight of the loss of the categories beside that of the poses.
        given_share: share of a mixed prior's training scenes in which some poses or categories are given, for
            inpainting.
        denoised_clip: bound on denoised scenes while sampling, normalised units; 0 for none.
        rotation: what a continuous prior diffuses as rotation: ``matrix``, ``quaternion`` or ``axis_angle``.
        matmul_precision: of float32 products on GPUs, ``highest``, ``high`` (TF32) or ``medium``.
        compile: compile the network with ``torch.compile`` (needs a C++ compiler on CPU).
        process: ``continuous`` (categories as numbers) or ``mixed`` (categories as discrete states).
        kernel: of the categories of a mixed prior (``mask_and_replace``, ``absorbing``, ``early_absorbing``,
            ``squared_absorbing``, ``uniform``).
        empty_slots: whether slots known to be empty are ``attended`` (the paper's) or ``dropped`` from the network of a
            mixed prior, which needs an absorbing kernel and saves most of the work.
        unmasking: which masked slots a sampling step of an absorbing kernel unmasks: ``even``, as near to the expected
            number as can be, so that few categories are decided at once, or ``independent``.
        text: whether a mixed prior reads prompts.
        text_encoder: ``vocabulary`` for a small one with a closed vocabulary, trained with the prior; or the folder or
            hub name of a BERT model, which stays as it is.
        text_width: width of the small text encoder.
        text_depth: its blocks.
        text_latents: tokens that it condenses a prompt to; 0 for one per word.
        text_learning_rate: of the small text encoder, as a fraction of learning_rate.
        text_reach: of the mixed flux network: text meets slots in its ``double``-stream blocks alone, which is quicker,
            or in ``all``, as in the paper's.
        pooled_text: whether the mean of the text tokens also modulates every block of the mixed flux network.
        count_embedding: whether the mixed flux network is told how many slots it sees of each category, and how many
            are masked.
        text_window: of the small text encoder: words that are read together before they attend to each other, odd; 1
            reads each by itself.
        text_count_conditioning: whether the small text encoder also says what is asked of each kind of object, which
            joins the logits of the mixed flux network beside what it sees; needs text_latents.
        text_warmup: steps in which the text encoder learns how many of each kind its prompts ask for, before a fresh
            prior takes the first of its own; at most iterations.
        text_numbers: of the small text encoder: whether words that are numbers say how many they are, so that counts
            need not be learned number by number.
        prompt_dropout: share of training scenes whose prompt is withheld, for classifier-free guidance.
        seed: of weights, batches and noise.
        log_every: steps between log rows.
        evaluate_every: steps between held-out evaluations.
        checkpoint_every: steps between checkpoints.
        pictures_every: steps between pictures of samples; 0 draws none.
        tensorboard: also log for TensorBoard.
        device: torch device.
    """

    RENAMED: ClassVar[dict[str, str]] = {"tally": "count_embedding", "text_requests": "text_count_conditioning"}
    """Keys of earlier versions, and their names."""

    scene: str = "dimsum_table"
    data: str = "data/dimsum_table"
    heldout: str = ""
    prior: str = ""
    output: str = "runs/pretrain"
    iterations: int = 5000
    batch_size: int = 128
    accumulate: int = 1
    precision: str = "float32"
    optimizer: str = "muon"
    learning_rate: float = 1e-3
    final_learning_rate: float = 0.01
    decay_share: float = 0.3
    warmup: int = 100
    weight_decay: float = 0.01
    clip: float = 1.0
    ema: float = 0.999
    hidden: int = 128
    depth: int = 6
    heads: int = 4
    recipe: str = "ours"
    network: str = "flux"
    attention: str = "relative"
    relation_blur: str = "axis"
    frequencies: int = 8
    rotation_features: bool = True
    contacts: bool = True
    prediction: str = "edm"
    schedule: str = "karras"
    noise_floor: float = 0.002
    noise_ceiling: float = 20.0
    noise_mean: float = -1.8
    noise_std: float = 2.1
    timesteps: str = "lognormal"
    loss_weighting: str = "none"
    moments: str = "category"
    translation_weight: float = 3.0
    category_loss: str = "cross_entropy"
    category_weight: float = 2.0
    given_share: float = 0.3
    denoised_clip: float = 0.0
    rotation: str = "matrix"
    matmul_precision: str = "highest"
    process: str = "mixed"
    kernel: str = "early_absorbing"
    empty_slots: str = "dropped"
    unmasking: str = "even"
    text: bool = False
    text_encoder: str = "vocabulary"
    text_width: int = 128
    text_depth: int = 2
    text_latents: int = 16
    text_learning_rate: float = 0.5
    text_reach: str = "double"
    pooled_text: bool = True
    count_embedding: bool = True
    text_window: int = 3
    text_count_conditioning: bool = True
    text_warmup: int = 400
    text_numbers: bool = True
    prompt_dropout: float = 0.1
    compile: bool = False
    seed: int = 0
    log_every: int = 20
    evaluate_every: int = 250
    checkpoint_every: int = 250
    pictures_every: int = 0
    tensorboard: bool = False
    device: str = "cpu"
