"""Physical constants that simulation, closed forms and exports share."""

from __future__ import annotations

GRAVITY = 9.81
"""m/s^2."""
FRICTION = 0.6
"""Coulomb friction coefficient between any two objects."""
