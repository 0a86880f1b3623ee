"""Whether there is room for what a prompt asks."""

from __future__ import annotations

from collections.abc import Sequence

from scene_envs.datasets.prompts import parse_prompt
from scene_envs.errors import InvalidInputError
from scene_envs.scene_types import SceneType


def check_room(prompts: Sequence[str], scene_type: SceneType, slots: int) -> None:
    """Refuse prompts that ask for more objects than a scene has slots; free text is not looked into.

    Raises:
        InvalidInputError: names the prompt, the number and the remedy.
    """
    for prompt in dict.fromkeys(prompts):
        try:
            facts = parse_prompt(prompt, scene_type)
        except InvalidInputError:
            continue
        asked = max(facts.count or 0, sum((facts.objects or {}).values()))
        if asked > slots:
            raise InvalidInputError(
                f"the prompt {prompt!r} asks for {asked} objects, a scene has {slots} slots; give slots={asked} or more"
            )
