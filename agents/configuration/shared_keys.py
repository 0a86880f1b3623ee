"""Keys that several commands share, in parts; ``--help`` shows a paragraph for each part."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class SamplingKeys:
    """Sampling of scenes.

    Attributes:
        prompt: text that the scenes should match, for priors that read prompts; null for no prompt.
        guidance: weight of classifier-free guidance, 0 for none; needs a prompt.
        claim_guidance: strength with which scenes are guided to the numbers and places that the prompt gives, 0 for
            none; 2 is a good choice; needs a prompt.
        num_steps: denoising steps per scene.
        slots: slots per scene, which may exceed the number in training; null takes the number in training.
        seed: seed of the noise.
    """

    prompt: str | None = None
    guidance: float = 0.0
    claim_guidance: float = 0.0
    num_steps: int = 50
    slots: int | None = None
    seed: int = 0


@dataclass
class DrawKeys:
    """Sampling from a prior, with prior=.

    Attributes:
        num_steps: denoising steps per scene, with prior=.
        physics_guidance: strength with which objects are moved out of overlaps and onto supports at the last steps, 0
            to 1, with prior=; null takes that of the prior, 1 for shipped priors whose names end in _feasible and 0 for
            the others.
    """

    num_steps: int = 50
    physics_guidance: float | None = None


@dataclass
class RewardLimits:
    """Limits of a reward from outside this package; it runs in its own process.

    Attributes:
        reward_timeout: most seconds that the reward may take for a batch; after that the scenes of the batch are
            invalid.
        reward_memory: most memory that the reward may allocate, GiB.
    """

    reward_timeout: float = 60.0
    reward_memory: float = 1.0


@dataclass
class OutputKeys:
    """Computation and output.

    Attributes:
        output: folder for the files that the command writes.
        pictures: number of scenes in the galleries; 0 draws none.
        batch_size: scenes denoised at once.
        workers: physics worker processes; 0 computes physics in this process.
        device: torch device.
    """

    output: str = ""
    pictures: int = 12
    batch_size: int = 64
    workers: int = 2
    device: str = "cpu"


@dataclass
class TrainingKeys:
    """Recipe, output and device of a training run.

    Attributes:
        recipe: a named set of values for the other keys; keys that are given as well override it.
        output: run folder; a run that was interrupted there is resumed; empty for runs/COMMAND-TIME on the command
            line.
        device: torch device.
    """

    recipe: str = "ours"
    output: str = ""
    device: str = "cpu"
