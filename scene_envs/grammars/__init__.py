"""Scene grammars: distributions over structures and exact poses, one short file per scene type."""

from scene_envs.grammars.catalogue import get_grammar, list_grammars
from scene_envs.grammars.containers import Heap, Standing
from scene_envs.grammars.distributions import Gaussian, Line, Moved, Uniform, Yaw
from scene_envs.grammars.dsl import (
    NOTHING,
    Cluster,
    Geometric,
    Group,
    Object,
    OneOf,
    Pile,
    Repeat,
    Stack,
    Tiers,
)
from scene_envs.grammars.grammar import Grammar, register_grammar
from scene_envs.grammars.plan import Disc, Rectangle
from scene_envs.grammars.surface import FreeSurface, Outline, Region
from scene_envs.grammars.towers import Filling, Node, Surface, Tower

__all__ = [
    "NOTHING",
    "Cluster",
    "Disc",
    "Filling",
    "FreeSurface",
    "Gaussian",
    "Geometric",
    "Grammar",
    "Group",
    "Heap",
    "Line",
    "Moved",
    "Node",
    "Object",
    "OneOf",
    "Outline",
    "Pile",
    "Rectangle",
    "Region",
    "Repeat",
    "Stack",
    "Standing",
    "Surface",
    "Tiers",
    "Tower",
    "Uniform",
    "Yaw",
    "get_grammar",
    "list_grammars",
    "register_grammar",
]
