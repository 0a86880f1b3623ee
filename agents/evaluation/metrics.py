"""Distances of scenes from a reference without a simulator: counts, categories, heights."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from agents.evaluation.layouts import CONTAINERS, SUPPORTS, Container, Support
from scene_envs.errors import InvalidInputError
from scene_envs.scene import SceneBatch, check_same_assets

KL_EPS = 1e-6
"""Probability added to every category before renormalising, so that the KL is finite if a category is never sampled."""

_CHUNK = 128
"""Scenes whose pairs of objects are in memory together."""


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
    check_same_assets(batch, reference)
    p, q = category_distribution(reference, eps), category_distribution(batch, eps)
    return float((p * (p / q).log()).sum())


def count_wasserstein(batch: SceneBatch, reference: SceneBatch) -> float:
    """Wasserstein-1 distance of the distributions of objects per scene, in objects."""
    from scipy.stats import wasserstein_distance

    check_same_assets(batch, reference)
    return float(wasserstein_distance(batch.counts.cpu().numpy(), reference.counts.cpu().numpy()))


def height_errors(batch: SceneBatch, supports: Sequence[Support] | None = None) -> dict[str, Tensor]:
    """Distance in height between objects and the support nearest to each in height.

    A surface fixed in the world is always a candidate. A support on another object is a candidate for the objects
    within ``reach`` of it horizontally; where the top of the supporting object is above its frame, they must also be
    above that frame. An object is counted under the kind of the candidate that is nearest to its own z. The error is
    how far the object floats above, or is sunk into, the support that it seems to rest on. Objects that lie in a
    container, see :data:`~agents.evaluation.layouts.CONTAINERS`, are left out.

    Args:
        batch: scenes to measure.
        supports: surfaces on which objects may rest; None takes those of the scene type.

    Returns:
        For each kind, a (K,) float tensor of absolute errors in m; K is the number of objects of that kind.
    """
    if supports is None:
        supports = SUPPORTS.get(batch.scene_type.name, ())
    if not supports:
        return {}
    errors: dict[str, list[Tensor]] = {support.kind: [] for support in supports}
    for start in range(0, len(batch), _CHUNK):
        for kind, error in _chunk_errors(batch[start : start + _CHUNK], supports):
            errors[kind].append(error)
    return {kind: torch.cat(parts) if parts else torch.empty(0) for kind, parts in errors.items()}


def workspace_fraction(batch: SceneBatch) -> float:
    """Share of the objects whose frame lies in the workspace, welded ones included."""
    present = int(batch.counts.sum())
    if not present:
        raise InvalidInputError(f"a batch of {len(batch)} scenes without any object has no workspace fraction")
    return int(batch.in_workspace.sum()) / present


def out_of_workspace_rate(batch: SceneBatch) -> float:
    """Share of the free objects whose frame is outside the workspace; 0 where there are none."""
    free = batch.is_free
    return int((free & ~batch.in_workspace).sum()) / max(int(free.sum()), 1)


def _chunk_errors(batch: SceneBatch, supports: Sequence[Support]) -> list[tuple[str, Tensor]]:
    gaps = torch.stack([_height_gap(batch, support) for support in supports])  # (S, B, N)
    catch = torch.tensor([support.catch for support in supports]).to(gaps)[:, None, None]
    nearest = (gaps - 1.0 * ((gaps <= catch) & (catch > 0))).argmin(dim=0)
    error = gaps.gather(0, nearest[None])[0]
    supported = torch.isfinite(error) & ~_contained(batch)
    return [(support.kind, error[supported & (nearest == index)]) for index, support in enumerate(supports)]


def _height_gap(batch: SceneBatch, support: Support) -> Tensor:
    """(B, N) m: |z - height of the nearest such support|, infinite where there is none."""
    z = batch.translations[..., 2].double()
    if support.on is None:
        gap = (z - support.height).abs()
    else:
        rise = z.unsqueeze(2) - z.unsqueeze(1)  # (B, rider, supporter)
        carries = _near(batch, support.on, support.reach)
        if support.height > 0:
            carries &= rise > 0
        gap = (rise - support.height).abs().masked_fill(~carries, torch.inf).amin(dim=-1)
    riders = batch.is_free if support.riders is None else _is_one_of(batch, support.riders)
    return gap.masked_fill(~riders, torch.inf)


def _near(batch: SceneBatch, names: Sequence[str], reach: float) -> Tensor:
    """(B, N, N) bool at [b, i, j]: object j is not i, is one of the assets ``names``, and is within ``reach`` of i."""
    xy = batch.translations[..., :2].double()
    near = (xy.unsqueeze(2) - xy.unsqueeze(1)).norm(dim=-1) <= reach
    near.diagonal(dim1=1, dim2=2).fill_(False)
    return near & _is_one_of(batch, names).unsqueeze(1)


def _contained(batch: SceneBatch, containers: Sequence[Container] = CONTAINERS) -> Tensor:
    z = batch.translations[..., 2].double()
    rise = z.unsqueeze(2) - z.unsqueeze(1)  # (B, rider, container)
    inside = torch.zeros_like(batch.is_empty)
    for container in containers:
        if not set(container.names) & set(batch.scene_type.assets):
            continue
        held = _near(batch, container.names, container.reach) & (rise > 0.01) & (rise <= container.depth)
        inside |= held.any(dim=-1) & _is_one_of(batch, container.riders)
    return inside


def _is_one_of(batch: SceneBatch, names: Sequence[str]) -> Tensor:
    """(B, N) bool: the slot holds one of the assets ``names``."""
    assets = batch.scene_type.assets
    wanted = [assets.index(name) for name in names if name in assets]
    return torch.isin(batch.categories, torch.tensor(wanted, device=batch.tensor.device))
