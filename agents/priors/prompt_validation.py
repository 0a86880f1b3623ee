"""Validation of prompts and guidance for a prior and a number of slots."""

from __future__ import annotations

import math
from collections.abc import Sequence

from scene_envs.datasets.prompts import parse_prompt
from scene_envs.envs.settings import check_claim_guidance
from scene_envs.errors import InvalidInputError
from scene_envs.scene_types import SceneType

Prompt = str | Sequence[str] | None
"""One text for all scenes, one per scene, or None for anything."""


def check_prompts(
    prompt: Prompt, guidance: float, count: int, *, scene_type: SceneType, slots: int, conditional: bool,
    claim_guidance: float = 0.0,
) -> list[str] | None:  # fmt: skip
    """One prompt per scene, or None for scenes without.

    Args:
        prompt: one text for all scenes, one per scene, or None.
        guidance: w of classifier-free guidance.
        count: scenes.
        scene_type: of the scenes.
        slots: slots per scene.
        conditional: whether the prior reads prompts.
        claim_guidance: strength of claim guidance.

    Raises:
        InvalidInputError: a prior that reads no prompts, not one prompt per scene, guidance without a prompt, claim
            guidance below 0, or more objects asked for than there are slots.
    """
    if not math.isfinite(guidance):
        raise InvalidInputError(f"guidance={guidance} must be a finite number; 0 follows the prompt as it is")
    check_claim_guidance(prompt, claim_guidance)
    if prompt is None:
        check_guidance(prompt, guidance)
        return None
    texts = [prompt] if isinstance(prompt, str) else prompt
    if not isinstance(texts, Sequence) or not all(isinstance(text, str) for text in texts):
        raise InvalidInputError(f"prompt={str(prompt)[:80]!r} must be a text, a list of texts, or null")
    prompts = [prompt] * count if isinstance(prompt, str) else list(prompt)
    if len(prompts) != count:
        raise InvalidInputError(f"{len(prompts)} prompts for {count} scenes; give one text, or one per scene")
    if not conditional:
        raise no_text(scene_type, next(iter(prompts), ""))
    check_guidance("".join(prompts), guidance)
    check_object_count(prompts, scene_type, slots)
    return prompts


def check_guidance(prompt: object, guidance: float) -> None:
    """Refuse guidance without a prompt; ``""`` is no prompt."""
    if guidance and not prompt:
        raise InvalidInputError(
            f"guidance={guidance:g} strengthens a prompt, and prompt={prompt!r} asks for none; "
            "give prompt=, or leave guidance=0"
        )


def no_text(scene_type: SceneType, prompt: str) -> InvalidInputError:
    """The error of a prompt for a prior that reads none."""
    return InvalidInputError(
        f"this prior of {scene_type.name!r} was trained without text and cannot follow the prompt {prompt!r}; "
        "leave prompt= out, or load a prior that reads prompts"
    )


def asked_objects(prompt: str, scene_type: SceneType) -> int:
    """Number of objects that a prompt asks for; 0 for free text.

    >>> from scene_envs.scene_types import get_scene_type
    >>> asked_objects("A scene with 12 objects.", get_scene_type("dimsum_table"))
    12
    """
    try:
        facts = parse_prompt(prompt, scene_type)
    except InvalidInputError:
        return 0
    return max(facts.count or 0, sum((facts.objects or {}).values()))


def check_object_count(prompts: Sequence[str], scene_type: SceneType, slots: int) -> None:
    """Refuse prompts that ask for more objects than a scene has slots; free text is not checked.

    Raises:
        InvalidInputError: names the prompt, the number and the remedy.
    """
    for prompt in dict.fromkeys(prompts):
        asked = asked_objects(prompt, scene_type)
        if asked > slots:
            raise InvalidInputError(
                f"the prompt {prompt!r} asks for {asked} objects, a scene has {slots} slots; give slots={asked} or more"
            )
