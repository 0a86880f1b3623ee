"""How close scenes are to a reference: counts, categories, heights, overlaps. Pure functions, no simulator."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from scene_envs.errors import InvalidInputError
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import get_scene_type

KL_EPS = 1e-6
"""Probability added to every category before renormalising, so that a category never sampled stays finite."""


@dataclass(frozen=True)
class Support:
    """Where objects of a scene type may rest: a surface fixed in the world, or the top of another object.

    Attributes:
        kind: the name the height error is reported under, such as ``"table"`` or ``"stack"``.
        height: z of the surface (m), in the world, or above the frame of the supporting object.
        on: names of the supporting assets; None when the surface is fixed in the world.
        riders: names of the assets that can rest there; None means all free ones.
        reach: largest horizontal distance (m) between the frames of rider and supporting object.
    """

    kind: str
    height: float
    on: tuple[str, ...] | None = None
    riders: tuple[str, ...] | None = None
    reach: float = 0.06


SUPPORTS: dict[str, tuple[Support, ...]] = {
    "dimsum_table": (
        Support("table", height=0.0),
        Support("stack", height=0.091, on=("steamer_bottom",), riders=("steamer_bottom", "steamer_lid")),
    ),
}
"""Supports of each scene type, by name; scene types without an entry have no height figures."""


def category_distribution(batch: SceneBatch, eps: float = KL_EPS) -> Tensor:
    """Share of every asset among the objects of all scenes (welded ones included, empty slots ignored).

    Returns:
        (C,) float64, positive and summing to 1: ``eps`` is added to each share before renormalising.
    """
    assets = batch.scene_type.num_assets
    counts = torch.bincount(batch.categories.flatten().cpu(), minlength=assets + 1)[:assets].double()
    if not counts.sum():
        raise InvalidInputError(f"a batch of {len(batch)} scenes without any object has no category distribution")
    shares = counts / counts.sum() + eps
    return shares / shares.sum()


def category_kl(batch: SceneBatch, reference: SceneBatch, eps: float = KL_EPS) -> float:
    """KL(reference ‖ samples) of the category distributions, nats; 0 when they agree.

    The paper's category KL (section 4): it punishes assets that the samples lack.

    >>> from scene_envs.scene import SceneBatch
    >>> category_kl(SceneBatch.empty("dimsum_table", 3), SceneBatch.empty("dimsum_table", 5))
    0.0
    """
    _check_same_type(batch, reference)
    p, q = category_distribution(reference, eps), category_distribution(batch, eps)
    return float((p * (p / q).log()).sum())


def count_wasserstein(batch: SceneBatch, reference: SceneBatch) -> float:
    """Wasserstein-1 distance of the distributions of objects per scene, in objects."""
    from scipy.stats import wasserstein_distance

    _check_same_type(batch, reference)
    return float(wasserstein_distance(batch.counts.cpu().numpy(), reference.counts.cpu().numpy()))


def height_errors(batch: SceneBatch, supports: Sequence[Support] | None = None) -> dict[str, Tensor]:
    """Distance in height between every free object and the support nearest to it in height.

    A support on another object is a candidate when the rider's frame is above the supporter's and within
    ``reach`` of it horizontally; a surface fixed in the world is always one. An object is counted under the
    kind of the candidate that is nearest to its own z, so an error says how far it floats above (or is sunk
    into) what it seems to rest on.

    Args:
        batch: the scenes.
        supports: where objects may rest; None takes the ones of the scene type.

    Returns:
        One (K,) float tensor of absolute errors in m per kind, K being the objects of that kind in the batch.
    """
    if supports is None:
        supports = SUPPORTS.get(batch.scene_type.name, ())
    if not supports:
        return {}
    gaps = torch.stack([_height_gap(batch, support) for support in supports])  # (S, B, N)
    error, nearest = gaps.min(dim=0)
    supported = batch.is_free & torch.isfinite(error)
    return {support.kind: error[supported & (nearest == index)] for index, support in enumerate(supports)}


def workspace_fraction(batch: SceneBatch) -> float:
    """Share of the objects whose frame lies in the workspace, welded ones included."""
    present = int(batch.counts.sum())
    if not present:
        raise InvalidInputError(f"a batch of {len(batch)} scenes without any object has no workspace fraction")
    return int(batch.in_workspace.sum()) / present


def _height_gap(batch: SceneBatch, support: Support) -> Tensor:
    """(B, N) m: |z - height of the nearest such support|, infinite where there is none."""
    z = batch.translations[..., 2].double()
    if support.on is None:
        gap = (z - support.height).abs()
    else:
        xy = batch.translations[..., :2].double()
        distance = (xy.unsqueeze(2) - xy.unsqueeze(1)).norm(dim=-1)  # (B, rider, supporter)
        below = z.unsqueeze(1) < z.unsqueeze(2)
        carries = _is_one_of(batch, support.on).unsqueeze(1) & below & (distance <= support.reach)
        gaps = (z.unsqueeze(2) - z.unsqueeze(1) - support.height).abs()
        gap = gaps.masked_fill(~carries, torch.inf).amin(dim=-1)
    if support.riders is not None:
        gap = gap.masked_fill(~_is_one_of(batch, support.riders), torch.inf)
    return gap


def _is_one_of(batch: SceneBatch, names: Sequence[str]) -> Tensor:
    """(B, N) bool: the slot holds one of the assets ``names``."""
    assets = get_scene_type(batch.scene_type).assets
    wanted = [assets.index(name) for name in names]
    return torch.isin(batch.categories, torch.tensor(wanted, device=batch.tensor.device))


def _check_same_type(batch: SceneBatch, reference: SceneBatch) -> None:
    if batch.scene_type.assets != reference.scene_type.assets:
        raise InvalidInputError(
            f"samples of {batch.scene_type.name!r} cannot be compared with reference scenes of "
            f"{reference.scene_type.name!r}: their assets differ"
        )
