"""Scene grammars: distributions over structures and exact poses, one short file per scene type."""

from scene_envs.grammars import dimsum_table as _dimsum_table  # noqa: F401  (registers itself)
from scene_envs.grammars.containers import Filling, Heap, Standing
from scene_envs.grammars.dsl import (
    NOTHING,
    Geometric,
    Group,
    Node,
    Object,
    OneOf,
    Pile,
    Repeat,
    Stack,
    Surface,
    Tower,
)
from scene_envs.grammars.grammar import Grammar, get_grammar, list_grammars, register_grammar
from scene_envs.grammars.plan import Disc, Rectangle
from scene_envs.grammars.surface import FreeSurface, Gaussian, Line, Outline, Region, Uniform, Yaw

__all__ = [
    "NOTHING",
    "Disc",
    "Filling",
    "FreeSurface",
    "Gaussian",
    "Geometric",
    "Grammar",
    "Group",
    "Heap",
    "Line",
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
    "Tower",
    "Uniform",
    "Yaw",
    "get_grammar",
    "list_grammars",
    "register_grammar",
]
