"""Parser of prompts into claims."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from functools import lru_cache

from scene_envs.assets.base import indefinite_article
from scene_envs.datasets.prompts.claims import (
    Claim,
    NameCount,
    ObjectCount,
    PairCount,
    Place,
    PlaceCount,
    PromptFacts,
    Reference,
    Side,
    SideClaim,
    SupportCount,
)
from scene_envs.datasets.prompts.facts import SIDES
from scene_envs.errors import InvalidInputError
from scene_envs.scene_types import SceneType, get_scene_type

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


_SIDES = {phrase: side for side, phrase in SIDE_PHRASES.items()}
_INSIDE = {"on top of": False, "in": True}
_ENDS = ("top", "bottom")
_COUNTS = {"a": 1, "an": 1, **{word: number for number, word in enumerate(NUMBERS)}}
_ORDINALS = {word: number for number, word in enumerate(ORDINALS, start=1)}


def parse_prompt(text: str, scene_type: str | SceneType) -> PromptFacts:
    """Read a prompt made by :func:`describe`, or written by hand in the same English, into its claims.

    Capitals and the full stop do not matter, and numbers may be words or digits.

    Raises:
        InvalidInputError: the text is not such a prompt; the place where reading stopped is named.

    >>> parse_prompt("A scene with 12 objects.", "dimsum_table").count
    12
    >>> parse_prompt("A scene where the teapot is behind the second cup from the left.", "dimsum_table").claims[0].side
    'back'
    """
    return _Reader(text, *_names(get_scene_type(scene_type))).prompt()


@lru_cache(maxsize=32)
def _names(scene_type: SceneType) -> tuple[dict[str, str], dict[str, str]]:
    """Display names by their singular and by their plural, both in lower case."""
    plurals = Nouns(scene_type).plural
    return {name.lower(): name for name in plurals}, {plural.lower(): name for name, plural in plurals.items()}


class _Reader:
    """Recursive descent over the text; every method reads one phrase and moves on."""

    def __init__(self, text: str, singular: dict[str, str], plural: dict[str, str]) -> None:
        self.text, self.singular, self.plural = text, singular, plural
        self.rest = re.sub(r"\s+", " ", text).strip().lower().removesuffix(".").rstrip()

    def prompt(self) -> PromptFacts:
        self.need(["a scene"], "'A scene with …' or 'A scene where …'")
        read = self.amount if self.need(["with", "where"], "'with' or 'where'") == "with" else self.clause
        claims = [read()]
        while self.rest:
            self.need([", and", ",", "and"], "a comma, 'and' or the end")
            claims.append(read())
        if len(claims) > 1 and any(isinstance(claim, ObjectCount) for claim in claims):
            raise self.error("only one number of objects and no other claims")
        return PromptFacts(tuple(claims))

    def amount(self) -> Claim:
        number = self.number()
        if self.take(["object" if number == 1 else "objects"]):
            return ObjectCount(number)
        return NameCount(self.noun(plural=number != 1), number)

    def clause(self) -> Claim:
        if self.rest.startswith("the "):
            subject = self.reference()
            self.need(["is"], "'is'")
            side = _SIDES[self.need(_SIDES, "a side, such as 'to the left of' or 'behind'")]
            return SideClaim(subject, side, self.reference(near=subject.place))
        number = self.number()
        name = self.noun(plural=number != 1)
        self.need(["is" if number == 1 else "are"], "'is' for one object and 'are' for several")
        each = self.take(["each"])
        how = self.need(_INSIDE if each else [*_INSIDE, "on"], "'on', 'on top of' or 'in'")
        if how == "on":
            return PlaceCount(name, number, self.place())
        if not each and self.rest.startswith("the "):
            return SupportCount(name, number, _INSIDE[how], self.reference())
        self.need(["a", "an"], "an object with 'a' or 'an'")
        return PairCount(name, number, _INSIDE[how], self.noun(plural=False))

    def reference(self, *, near: Place | None = None, placed: bool = True) -> Reference:
        self.need(["the"], "'the' and an object")
        ordinal = _ORDINALS.get(self.take(_ORDINALS), 0)
        name = self.noun(plural=False)
        edge = self.edge() if ordinal else ""
        at_place = placed and not self.rest.startswith("on top of") and self.take(["on"])
        if near and at_place and self.take(["the same"]):
            self.need([place_word(near)], f"{place_word(near)!r}")
            return Reference(name, ordinal, edge, near)
        return Reference(name, ordinal, edge, self.place() if at_place else None)

    def place(self) -> Place:
        """A tier if the text names one, else a piece of furniture."""
        before = self.rest
        self.need(["the"], "'the' and a place")
        ordinal = _ORDINALS.get(self.take(_ORDINALS), 1)
        end = self.take(_ENDS)
        word = self.take(["shelf", "tier"])
        if word and not end and self.take(["from the"]):
            end = self.take(_ENDS)
        if not word or not end:
            self.rest = before
            return Place(self.reference(placed=False))
        tier = ordinal - 1 if end == "top" else -ordinal
        if word == "shelf":
            return Place(Reference("shelf"), tier)
        self.need(["of"], "'of' and the object to which the tier belongs")
        return Place(self.reference(placed=False), tier)

    def number(self) -> int:
        digits = re.match(r"\d{1,9}\b", self.rest)
        if digits:
            self.rest = self.rest[digits.end() :].lstrip()
            return int(digits.group())
        return _COUNTS[self.need(_COUNTS, "a number")]

    def noun(self, *, plural: bool) -> str:
        names, kind = (self.plural, "plural") if plural else (self.singular, "singular")
        return names[self.need(names, f"a {kind} name of this scene type: {', '.join(names)}")]

    def edge(self) -> str:
        self.need(["from the"], "'from the left', 'right', 'front' or 'back'")
        return self.need(SIDES, "'left', 'right', 'front' or 'back'")

    def take(self, options: Iterable[str]) -> str:
        """The longest of ``options`` that comes next as whole words, or the empty string."""
        for words in sorted(options, key=len, reverse=True):
            if self.rest.startswith(words) and not re.match(r"[\w-]", self.rest[len(words) :]):
                self.rest = self.rest[len(words) :].lstrip()
                return words
        return ""

    def need(self, options: Iterable[str], what: str) -> str:
        found = self.take(options)
        if not found:
            raise self.error(what)
        return found

    def error(self, what: str) -> InvalidInputError:
        where = f"at {self.rest!r}" if self.rest else "at its end"
        return InvalidInputError(f"cannot read the prompt {self.text!r} {where}; expected {what}")
