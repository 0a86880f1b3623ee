"""Size and details of the Flux-style transformer of mixed scenes."""

from __future__ import annotations

from dataclasses import dataclass

from scene_envs.errors import InvalidInputError, unknown_name
from scene_envs.scene import POSE_FEATURES as POSE

ATTENTIONS = ("plain", "relative")
"""How slots attend to each other: by content alone, or seeing where the others stand as well."""
TEXT_REACHES = ("all", "double")
"""Blocks in which slots meet text."""

RENAMED = {"tally": "count_embedding", "requests": "count_conditioning"}
"""Fields and modules as files of earlier versions call them, and their names."""


@dataclass(frozen=True)
class MixedFluxConfig:
    """Size of a :class:`~agents.networks.MixedFlux`.

    Attributes:
        categories: K = C + 1, assets and *empty*; the mask token is one more.
        hidden: width of the token streams; a multiple of ``heads``.
        double_blocks: blocks in which text and slots have weights of their own; used only with text.
        single_blocks: blocks on text and slots together.
        heads: attention heads.
        mlp_ratio: width of the MLPs over ``hidden``.
        embedding: width of the embedding of a slot, and of what leaves the last layer.
        pose_head: hidden width of the pose output.
        text_width: width of the text tokens; 0 for none.
        frequencies: octaves of Fourier features of each translation, damped by the noise (0: none, as the paper).
        time_scale: what timesteps are multiplied by before they are embedded.
        flags: 1 to tell the network which poses and categories are given (inpainting), 0 as the paper.
        attention: ``"plain"``, or ``"relative"`` for attention that sees where other slots stand.
        unit: metres per normalised unit along x, y, z, which ``"relative"`` needs.
        relation_blur: the noise that blurs what ``"relative"`` sees along an axis: of the ``"axis"``, or the
            ``"largest"`` of all (:class:`~agents.networks.relations.Relations`).
        text_reach: how far text goes: to the ``"double"``-stream blocks, or through ``"all"`` blocks, as the paper's.
        pooled_text: 1 to add the mean of the text tokens to the embedded time, which modulates every block (as Flux
            does with a pooled embedding), 0 as the paper.
        count_embedding: 1 to add what is counted in the scene as well
            (:class:`~agents.networks.count_embedding.CountEmbedding`), 0 as the paper.
        rotation_features: 1 to tell how far each rotation is off SO(3) and off upright in units of the noise
            (:func:`~agents.networks.rotation_features.rotation_features`), 0 as the paper.
        contacts: 1 for displacements along the gaps between objects (:class:`~agents.networks.contacts.Contacts`),
            0 as the paper; without relative attention there are none.
        rotations: what the nine normalised numbers of a rotation are multiplied by, and what is then added, to be that
            of an object, which ``rotation_features`` and ``contacts`` need.
        count_conditioning: where the first text tokens say what is asked of each kind of object, and last of all
            objects, and that joins the logits (:class:`~agents.networks.count_conditioning.CountConditioning`): the
            largest number told apart; 0 where not, as the paper.
        kinds: (K - 1,) the kind of each category, as prompts call it; empty where each is one of its own.
    """

    categories: int
    hidden: int = 128
    double_blocks: int = 2
    single_blocks: int = 4
    heads: int = 4
    mlp_ratio: float = 4.0
    embedding: int = 128
    pose_head: int = 64
    text_width: int = 0
    frequencies: int = 8
    time_scale: float = 1.0
    flags: int = 1
    attention: str = "plain"
    unit: tuple[float, float, float] = (1.0, 1.0, 1.0)
    relation_blur: str = "largest"
    text_reach: str = "all"
    pooled_text: int = 0
    count_embedding: int = 0
    count_conditioning: int = 0
    kinds: tuple[int, ...] = ()
    rotation_features: int = 0
    contacts: int = 0
    rotations: tuple[tuple[float, ...], tuple[float, ...]] = ((1.0,) * 9, (0.0,) * 9)

    def __post_init__(self) -> None:
        if self.text_reach not in TEXT_REACHES:
            raise unknown_name("reach of text", self.text_reach, TEXT_REACHES)
        object.__setattr__(self, "unit", tuple(self.unit))  # lists, when they come from JSON
        object.__setattr__(self, "rotations", tuple(tuple(numbers) for numbers in self.rotations))
        object.__setattr__(self, "kinds", tuple(self.kinds) or tuple(range(self.categories - 1)))
        if self.attention not in ATTENTIONS:
            raise unknown_name("attention", self.attention, ATTENTIONS)
        if self.hidden % self.heads:
            raise InvalidInputError(f"hidden={self.hidden} is not a multiple of heads={self.heads}")

    @classmethod
    def paper(cls, categories: int, text_width: int = 768) -> MixedFluxConfig:
        """The size and the details of the paper: 88.3 M parameters with text."""
        return cls(categories, 512, 5, 10, 16, 4.0, 256, POSE, text_width, 0, 1000.0, 0)


def current_name(name: str) -> str:
    """The name of a tensor of the network that a file, perhaps of an earlier version, calls ``name``.

    >>> current_name("tally.out.weight"), current_name("scene_in.weight")
    ('count_embedding.out.weight', 'scene_in.weight')
    """
    module, dot, rest = name.partition(".")
    return RENAMED.get(module, module) + dot + rest
