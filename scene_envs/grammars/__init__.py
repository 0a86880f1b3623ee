"""Scene grammars: distributions over structures and exact poses, one short file per scene type."""

from scene_envs.grammars.dsl import NOTHING, Cluster, Geometric, Group, Object, OneOf, Pile, Repeat, Stack, Tiers
from scene_envs.grammars.grammar import Grammar, get_grammar, list_grammars, register_grammar
from scene_envs.grammars.layout import Filling, Heap, Node, Standing, Surface, Tower
from scene_envs.grammars.surface import Gaussian, Line, Region, Uniform, Yaw

__all__ = [
    "NOTHING",
    "Cluster",
    "Filling",
    "Gaussian",
    "Geometric",
    "Grammar",
    "Group",
    "Heap",
    "Line",
    "Node",
    "Object",
    "OneOf",
    "Pile",
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
