"""Present fields of a mixed Flux network, and names of its weights, from those in files of earlier versions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

FLAT_FIELDS = (
    *("frequencies", "flags", "attention", "relation_blur", "pooled_text", "count_embedding", "tally"),
    *("count_conditioning", "requests", "kinds", "rotation_features", "contacts"),
)
"""Fields of earlier versions; they configured parts that are modules now."""

_MODULES = {"given_flags": "observed_flags"}
"""Former names of modules, and the present ones."""

_PREFIXES = {
    "given_in.": "observed_flags.embedding.",
    "given_flags.": "observed_flags.",
    "pooled_in.": "pooled_text.linear.",
    "tally.": "count_embedding.",
    "requests.": "count_conditioning.",
    "rotation_gates.": "rotation_features.gates.",
    "contact_gates.": "contacts.gates.",
}


def current_name(name: str) -> str:
    """The name of a weight of the network that a file, perhaps of an earlier version, calls ``name``.

    >>> current_name("tally.layers.0.weight"), current_name("scene_in.weight")
    ('count_embedding.layers.0.weight', 'scene_in.weight')
    """
    for old, new in _PREFIXES.items():
        if name.startswith(old):
            return new + name.removeprefix(old)
    return name


def current_fields(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Fields of a configuration with ``modules``, from the fields of a file that may lack ``modules``.

    >>> current_fields({"categories": 8, "frequencies": 0, "flags": 1})
    {'categories': 8, 'modules': [{'name': 'observed_flags'}], 'time_input': 'timestep'}
    >>> current_fields({"categories": 8, "modules": [{"name": "given_flags"}]})
    {'categories': 8, 'modules': [{'name': 'observed_flags'}]}
    """
    if "modules" in fields:
        modules = [{**module, "name": _MODULES.get(module["name"], module["name"])} for module in fields["modules"]]
        return {**fields, "modules": modules}
    old = {"frequencies": 8, "flags": 1, "attention": "plain", "relation_blur": "largest", **fields}
    conditioning = old.get("count_conditioning", old.get("requests", 0))
    text = old.get("text_width", 0)
    relative = old["attention"] == "relative"
    listed: list[tuple[Any, dict[str, Any]]] = [
        (old["flags"], {"name": "observed_flags"}),
        (text and old.get("pooled_text"), {"name": "pooled_text"}),
        (old.get("count_embedding", old.get("tally")), {"name": "count_embedding"}),
        (
            text and conditioning,
            {"name": "count_conditioning", "largest": conditioning, "kinds": tuple(old.get("kinds", ()))},
        ),
        (relative, {"name": "relations", "blur": old["relation_blur"]}),
        (old["frequencies"], {"name": "fourier_features", "octaves": old["frequencies"]}),
        (old.get("rotation_features"), {"name": "rotation_features"}),
        (relative and old.get("contacts"), {"name": "contacts"}),
    ]
    return {
        **{key: value for key, value in fields.items() if key not in FLAT_FIELDS},
        "modules": [module for used, module in listed if used],
        "time_input": "log_noise" if old["frequencies"] else "timestep",
    }
