"""Mass, centre of mass and inertia of an imported model: kept where plausible, computed elsewhere."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from scene_envs.arrays import Array
from scene_envs.assets.base import ConvexPart, bounds_of
from scene_envs.assets.importing.model import Inertial
from scene_envs.assets.shapes import MassProperties, mass_properties

DEFAULT_DENSITY = 500.0
"""Density (kg/m^3) used where neither the file nor the user gives one: wood, or a ceramic vessel with its air."""
_POSSIBLE = (1.0, 23_000.0)
"""Possible densities, kg/m^3, from air to osmium."""
_FACTOR = 10.0
"""Largest factor between a moment of inertia and that of the same shape filled evenly."""


class Weight(NamedTuple):
    """Mass properties of an asset, with remarks for the report."""

    properties: MassProperties
    notes: tuple[str, ...]
    warnings: tuple[str, ...]


def weigh(
    given: Inertial | None,
    parts: Sequence[ConvexPart],
    volume: float,
    *,
    mass: float | None = None,
    density: float | None = None,
) -> Weight:
    """Mass properties of an asset.

    The file's properties are kept when they can belong to a body of this shape. A user's ``mass`` keeps the
    file's distribution of mass; a user's ``density`` fills the shape evenly.

    Args:
        given: Inertial of the file; None when the file has none.
        parts: Fine convex parts, m.
        volume: Volume of the shape, m^3.
        mass: The user's mass, kg.
        density: The user's density, kg/m^3.
    """
    if density is not None:
        return Weight(mass_properties(parts, density * volume), (), ())
    if given is None or given.mass <= 0:
        known = density_note = ""
        if mass is None:
            known, density_note = "mass and inertia", f" at {DEFAULT_DENSITY:g} kg/m^3"
            mass = DEFAULT_DENSITY * volume
        else:
            known = "inertia"
        why = "the file gives none" if given is None else f"the file gives a mass of {given.mass:g} kg"
        return Weight(mass_properties(parts, mass), (f"{known} computed from the shape{density_note}: {why}",), ())
    if mass is None:
        low, high = _POSSIBLE
        found = given.mass / volume
        if not low <= found <= high:
            mass = DEFAULT_DENSITY * volume
            reason = f"the file's {given.mass:g} kg would be {found:.3g} kg/m^3"
            text = f"mass and inertia recomputed at {DEFAULT_DENSITY:g} kg/m^3: {reason}"
            return Weight(mass_properties(parts, mass), (), (text,))
        mass = given.mass
    computed = mass_properties(parts, mass)
    inertia = given.inertia * (mass / given.mass)
    wrong = why_impossible(inertia, given.center_of_mass, parts, computed)
    if wrong:
        return Weight(computed, (), (f"centre of mass and inertia recomputed from the shape: {wrong}",))
    return Weight(MassProperties(mass, given.center_of_mass, 0.5 * (inertia + inertia.T)), (), ())


def why_impossible(inertia: Array, center: Array, parts: Sequence[ConvexPart], computed: MassProperties) -> str:
    """Reason why a body of this shape cannot have this inertia (3, 3) and centre of mass (3,); empty if possible.

    >>> from scene_envs.assets.shapes import box
    >>> cube = [box((0.1, 0.1, 0.1))]
    >>> why_impossible(np.eye(3), np.zeros(3), cube, mass_properties(cube, 1.0))
    'the inertia, moments (1, 1, 1) kg m^2, is 600 times that of the shape'
    """
    moments = np.linalg.eigvalsh(0.5 * (inertia + inertia.T))
    shown = f"the inertia, moments ({', '.join(f'{m:.3g}' for m in moments)}) kg m^2,"
    if moments[0] <= 0:
        return f"{shown} is not positive"
    if moments[2] > (moments[0] + moments[1]) * (1.0 + 1e-4):
        return f"{shown} breaks the triangle inequality"
    expected = np.linalg.eigvalsh(computed.inertia)
    ratio = moments / expected
    worst = ratio[np.abs(np.log(ratio)).argmax()]
    if not 1.0 / _FACTOR <= worst <= _FACTOR:
        return f"{shown} is {worst:.3g} times that of the shape"
    low, high = bounds_of(parts)
    margin = 1e-3 * np.linalg.norm(high - low)
    if (center < low - margin).any() or (center > high + margin).any():
        return f"the centre of mass ({', '.join(f'{c:.3g}' for c in center)}) m lies outside the shape"
    return ""
