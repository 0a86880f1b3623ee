"""English for claims: numbers, articles, plurals, ordinals, places, lists."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from scene_envs.assets.base import indefinite_article
from scene_envs.datasets.prompts.claims import (
    Claim,
    NameCount,
    ObjectCount,
    PairCount,
    Place,
    PlaceCount,
    Reference,
    Side,
    SideClaim,
    SupportCount,
)
from scene_envs.scene_types import SceneType

# fmt: off
NUMBERS = (
    "no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve", "thirteen",
    "fourteen", "fifteen", "sixteen", "seventeen", "eighteen", "nineteen", "twenty",
)
# fmt: on
"""Numbers in words; larger ones are written in digits."""
ORDINALS = ("first", "second", "third", "fourth", "fifth", "sixth", "seventh", "eighth", "ninth", "tenth")
SIDE_PHRASES: dict[Side, str] = {
    "left": "to the left of",
    "right": "to the right of",
    "front": "in front of",
    "back": "behind",
    "next": "next to",
}


class Nouns:
    """Display names of a scene type with their articles and plurals.

    >>> from scene_envs.scene_types import get_scene_type
    >>> nouns = Nouns(get_scene_type("dimsum_table"))
    >>> nouns.counted(1, "teapot"), nouns.counted(3, "cup"), nouns.counted(21, "cup")
    ('a teapot', 'three cups', '21 cups')
    """

    def __init__(self, scene_type: SceneType) -> None:
        self.plural = {asset.display_name: asset.plural for asset in scene_type.library}
        self.article = {name: indefinite_article(name) for name in self.plural}

    def counted(self, number: int, name: str) -> str:
        """A number of objects: "a cup", "two cups"."""
        if number == 1:
            return f"{self.article[name]} {name}"
        return f"{NUMBERS[number] if number < len(NUMBERS) else number} {self.plural[name]}"

    def say(self, claim: Claim) -> str:
        """A claim as a noun phrase (counts, names) or a clause (relations)."""
        match claim:
            case ObjectCount(number):
                return f"{number} object{'' if number == 1 else 's'}"
            case NameCount(name, number):
                return self.counted(number, name)
            case PlaceCount(name, number, place):
                return f"{self._are(number, name)} on {say_place(place)}"
            case SupportCount(name, number, inside, landmark):
                return f"{self._are(number, name)} {_held(inside)} {say_reference(landmark)}"
            case PairCount(name, number, inside, under):
                each = "" if number == 1 else " each"
                return f"{self._are(number, name)}{each} {_held(inside)} {self.counted(1, under)}"
            case SideClaim(subject, side, landmark):
                other = say_reference(landmark, near=subject.place)
                return f"{say_reference(subject)} is {SIDE_PHRASES[side]} {other}"
        raise AssertionError(claim)

    def sentence(self, claims: Sequence[Claim]) -> str:
        """A prompt that makes these claims: all of them counts and names, or all of them relations."""
        where = not isinstance(claims[0], ObjectCount | NameCount)
        return f"A scene {'where' if where else 'with'} {join(self.say(claim) for claim in claims)}."

    def _are(self, number: int, name: str) -> str:
        return f"{self.counted(number, name)} {'is' if number == 1 else 'are'}"


def say_reference(reference: Reference, *, near: Place | None = None) -> str:
    """One object: "the second cup from the left on the top shelf", or "… on the same shelf" if it is ``near``."""
    first = f"{ORDINALS[reference.ordinal - 1]} " if reference.ordinal else ""
    last = f" from the {reference.edge}" if reference.ordinal else ""
    place = reference.place
    where = f" on {say_place(place) if place != near else f'the same {place_word(place)}'}" if place else ""
    return f"the {first}{reference.name}{last}{where}"


def place_word(place: Place) -> str:
    """Noun of a place; tiers of the only shelf in a scene are called shelves."""
    if place.tier is None:
        return place.unit.name
    return "shelf" if place.unit == Reference("shelf") else "tier"


def say_place(place: Place) -> str:
    """A table, shelf or tier: "the second table from the left", "the top shelf", "the top tier of the shelf"."""
    if place.tier is None:
        return say_reference(place.unit)
    word = place_word(place)
    end, count = ("top", place.tier) if place.tier >= 0 else ("bottom", -1 - place.tier)
    tier = f"the {ORDINALS[count]} {word} from the {end}" if count else f"the {end} {word}"
    return tier if word == "shelf" else f"{tier} of {say_reference(place.unit)}"


def join(phrases: Iterable[str]) -> str:
    """A list in English.

    >>> join(["a cup", "two plates", "a teapot"])
    'a cup, two plates and a teapot'
    """
    *first, last = phrases
    return f"{', '.join(first)} and {last}" if first else last


def _held(inside: bool) -> str:
    return "in" if inside else "on top of"
