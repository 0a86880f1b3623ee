"""Tea Table: a pot, cups around it, and toast on a plate or apples in a bowl."""

import scene_envs.grammars as sg
from scene_envs.scene_types import Camera, FixedObject, SceneType, register_scene_type

TEA_TABLE = register_scene_type(
    SceneType(
        name="tea_table",
        assets=("apple_gala", "bread_slice", "cafe_table", "fruit_bowl", "shared_plate", "teacup", "teapot"),
        slots=13,
        workspace=((-0.5, -0.5, -0.02), (0.5, 0.5, 0.4)),
        welded=("cafe_table",),
        fixed=(FixedObject("cafe_table"),),
        camera=Camera(position=(0.0, 0.0, 1.7), target=(0.0, 0.0, 0.0), up=(-1.0, 0.0, 0.0)),
        description="A round table with tea, toast and apples.",
    )
)


@sg.register_grammar("tea_table")
def tea_table() -> sg.Grammar:
    """The whole table."""
    toast = sg.Stack("bread_slice", {"bread_slice": 0.5, None: 0.5}, at_most=4)
    middle = sg.Surface([toast], sg.Region(0.01, 0.01), height=None)
    plate = sg.Object("shared_plate", sg.Gaussian(along=0.2), on=[middle])
    apples = sg.Heap(sg.Repeat(sg.Object("apple_gala"), sg.Geometric(p=0.5, low=1, high=3)))
    bowl = sg.Object("fruit_bowl", sg.Gaussian(along=0.2), inside=apples)
    cups = sg.Repeat(sg.Object("teacup", sg.Gaussian(along=0.3)), sg.Geometric(p=0.3, low=2, high=6))
    food = sg.OneOf((0.8, plate), (0.2, bowl))
    top = sg.Surface([sg.Object("teapot"), cups, food], sg.Region(0.45, 0.45, radius=0.625))
    return sg.Grammar("tea_table", TEA_TABLE, [top])
