"""Parts of the keys of commands, each shared by several; ``--help`` shows a paragraph for each."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class SamplingKeys:
    """Sampling of scenes.

    Attributes:
        prompt: what the scenes should hold, for priors that read prompts; null for anything.
        guidance: weight of classifier-free guidance, 0 for none; needs a prompt.
        num_steps: denoising steps per scene.
        slots: slots per scene, more than trained is allowed; null means as trained.
        seed: of the noise.
    """

    prompt: str | None = None
    guidance: float = 0.0
    num_steps: int = 50
    slots: int | None = None
    seed: int = 0


@dataclass
class RewardLimits:
    """Limits of a reward from outside this package, which runs in a process of its own.

    Attributes:
        reward_timeout: seconds that it may take for a batch; then the scenes of that batch are invalid.
        reward_memory: GiB that it may allocate.
    """

    reward_timeout: float = 60.0
    reward_memory: float = 1.0


@dataclass
class OutputKeys:
    """Computation and output.

    Attributes:
        output: folder for what the command writes.
        pictures: how many scenes the galleries show; 0 draws none.
        batch_size: scenes denoised at once.
        workers: physics worker processes; 0 computes in this one.
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
        recipe: a named set of the other keys; keys given beside it win.
        output: run directory; an interrupted run found there goes on where it stopped; empty for runs/COMMAND-TIME on
            the command line.
        device: torch device.
    """

    recipe: str = "ours"
    output: str = ""
    device: str = "cpu"
