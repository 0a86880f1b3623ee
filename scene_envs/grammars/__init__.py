"""Scene grammars: distributions over structures and exact poses, one short file per scene type."""

from scene_envs.grammars import dimsum_table as _dimsum_table  # noqa: F401  (registers itself)
from scene_envs.grammars.dsl import NOTHING, Geometric, Group, Node, Object, OneOf, Repeat, Stack, Tower
from scene_envs.grammars.grammar import Grammar, Surface, get_grammar, list_grammars, register_grammar
from scene_envs.grammars.surface import FreeSurface, Gaussian, Region

__all__ = [
    "NOTHING",
    "FreeSurface",
    "Gaussian",
    "Geometric",
    "Grammar",
    "Group",
    "Node",
    "Object",
    "OneOf",
    "Region",
    "Repeat",
    "Stack",
    "Surface",
    "Tower",
    "get_grammar",
    "list_grammars",
    "register_grammar",
]
