"""Layout figures, which need no simulator: counts, categories, heights, spacing, stacks, nearest scenes."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor

from scene_envs.arrays import Array, Index
from scene_envs.errors import InvalidInputError
from scene_envs.files import page_values
from scene_envs.scene import (
    PlacedObjects,
    SceneBatch,
    SceneObjects,
    check_same_assets,
    counted_objects,
    cutoff,
    matching_distance,
)

SAME_HEIGHT = 0.02
"""Largest difference in height (m) between the frames of two neighbours."""
MAX_DISTANCE = 0.5
"""Bound of a distance (m), so that places on other tables of a room do not outweigh neighbours."""
MIN_DISTANCES = 30
"""Smallest number of distances of a pair of assets, in each of the two batches; rarer pairs are left out."""
KL_EPS = 1e-6
"""Probability added to every category before renormalising, so that the KL is finite if a category is never sampled."""
DUPLICATE = 0.01
"""Largest distance (m) between objects that count as at the same place."""
CANDIDATES = 32
"""Number of scenes, the nearest by their features, to which the exact distance is computed."""

_CHUNK = 128
"""Scenes whose pairs of objects are in memory together."""
_ROWS = 256
"""Number of scenes whose features are compared with all others at once."""
_WAVES = 12
"""Number of test functions of the position, for each asset."""


def spacing_wasserstein(batch: SceneBatch, reference: SceneBatch) -> float | None:
    """Distance of the distributions of distances between neighbours from those of real scenes of the same assets, m.

    For each ordered pair of assets (a, b), the horizontal distances from the free objects a to the nearest free object
    b at the same height form a distribution. The figure is the Wasserstein-1 distance of samples and reference, as a
    mean over the pairs, weighted by their number of distances in the reference. It shows whether objects are pushed
    apart or crowded, even if their number and categories are those of real scenes. None if no pair of assets has 30
    distances in both batches; an InvalidInputError if the batches have other assets.

    >>> spacing_wasserstein(SceneBatch.empty("dimsum_table", 3), SceneBatch.empty("dimsum_table", 5)) is None
    True
    """
    from scipy.stats import wasserstein_distance

    check_same_assets(batch, reference)
    samples, real = _distances(batch), _distances(reference)
    pairs = [pair for pair in real if min(len(real[pair]), len(samples.get(pair, ()))) >= MIN_DISTANCES]
    if not pairs:
        return None
    distances = [float(wasserstein_distance(samples[pair], real[pair])) for pair in pairs]
    return float(np.average(distances, weights=[len(real[pair]) for pair in pairs]))


def _distances(batch: SceneBatch) -> Mapping[tuple[int, int], np.ndarray[tuple[int], np.dtype[np.float64]]]:
    """Distances (K,) m from objects of an asset to the nearest object of another, or of the same one, by pair."""
    found = defaultdict(list)
    for start in range(0, len(batch), _CHUNK):
        chunk = batch[start : start + _CHUNK].to("cpu")
        places, free, categories = chunk.translations.double(), chunk.is_free, chunk.categories
        offset = places[:, :, None] - places[:, None]  # (B, N, N, 3)
        level = (offset[..., 2].abs() < SAME_HEIGHT) & free[:, :, None] & free[:, None]
        level.diagonal(dim1=1, dim2=2).fill_(False)
        distance = offset[..., :2].norm(dim=-1).masked_fill(~level, torch.inf)
        for other in categories[free].unique().tolist():
            nearest = distance.masked_fill((categories != other)[:, None], torch.inf).amin(dim=-1)  # (B, N)
            there = nearest.isfinite()
            for asset in categories[there].unique().tolist():
                values = nearest[there & (categories == asset)].clamp(max=MAX_DISTANCE)
                found[asset, other].append(values.numpy())
    return {pair: np.concatenate(parts) for pair, parts in found.items()}


@dataclass(frozen=True)
class Neighbors:
    """The nearest scene to each of B scenes.

    >>> from scene_envs.grammars import get_grammar
    >>> scenes = get_grammar("dimsum_table").sample(np.random.default_rng(0), 6)
    >>> found = nearest_scenes(scenes[2:4], scenes)
    >>> found.index.tolist(), found.distance.tolist(), found.copied.tolist()
    ([2, 3], [0.0, 0.0], [True, True])
    """

    distance: Tensor  # (B,) m, see :func:`scene_envs.scene.matching_distance`
    index: Tensor  # (B,) int64
    copied: Tensor  # (B,) bool, one of the other scenes has the same assets, each within 1 cm


def nearest_scenes(batch: SceneBatch, others: SceneBatch, *, candidates: int = CANDIDATES) -> Neighbors:
    """The scene of ``others`` that is nearest to each scene of ``batch``, by its :func:`distance
    <scene_envs.scene.matching_distance>`.

    The distance is computed exactly for the ``candidates`` scenes that are nearest by features. A feature is the sum of
    a function of the position over all objects of one asset. The functions are bounded and have slope 1 at most, so
    that a feature of two scenes never differs by more than the total cost of matching them (Kantorovich duality).

    Raises:
        InvalidInputError: no scenes, or scenes of other assets.
    """
    check_same_assets(batch, others)
    if not len(others) or not len(batch):
        raise InvalidInputError(f"{len(batch)} scenes have no nearest among {len(others)}: both need at least one")
    limit = cutoff(batch.scene_type)
    chosen = _nearest_features(_features(batch, limit), _features(others, limit), min(candidates, len(others)))
    mine, theirs = list(SceneObjects(batch)), SceneObjects(others)
    distance, index, copied = torch.zeros(len(batch), dtype=torch.float64), torch.zeros(len(batch)).long(), []
    for row, columns in enumerate(chosen.tolist()):
        found = [matching_distance(mine[row], theirs[column], limit) for column in columns]
        best = int(np.argmin(found))
        distance[row], index[row] = found[best], columns[best]
        copied.append(any(_is_copy(mine[row], theirs[column]) for column in columns))
    return Neighbors(distance, index, torch.tensor(copied))


def novelty(samples: Neighbors, real: Neighbors) -> float:
    """Median distance of samples to their nearest training scene, over that of held-out ``real`` scenes to theirs.

    At least 1 for samples that are as new as real scenes, 0 for copies; infinite when the held-out scenes are copies
    of training scenes themselves and the samples are not.
    """
    above, below = float(samples.distance.median()), float(real.distance.median())
    return above / below if below > 0 else (1.0 if above == 0 else math.inf)


def duplicates(batch: SceneBatch) -> float:
    """Share of the scenes that another scene of the batch repeats: same assets, each within 1 cm of its counterpart.

    >>> duplicates(SceneBatch.empty("dimsum_table", 4))
    1.0
    """
    objects = list(SceneObjects(batch))
    groups: dict[bytes, list[int]] = {}
    for row, (categories, _) in enumerate(objects):
        groups.setdefault(categories.tobytes(), []).append(row)
    repeated: set[int] = set()
    for rows in groups.values():
        for first, second in _close_pairs([objects[row][1] for row in rows]):
            pair = rows[first], rows[second]
            if not repeated.issuperset(pair) and _is_copy(objects[pair[0]], objects[pair[1]]):
                repeated.update(pair)
    return len(repeated) / len(batch)


def _is_copy(first: PlacedObjects, second: PlacedObjects) -> bool:
    """Whether the assets are the same and can be matched so that all are within :data:`DUPLICATE`."""
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import maximum_bipartite_matching

    if not np.array_equal(first[0], second[0]):
        return False
    near = ((first[1][:, None] - second[1][None]) ** 2).sum(axis=-1) <= DUPLICATE**2
    near &= first[0][:, None] == second[0][None]
    if not near.any(axis=1).all():
        return False
    return bool((maximum_bipartite_matching(csr_matrix(near)) >= 0).all())


def _close_pairs(positions: list[Array]) -> Index:
    """(P, 2): pairs of scenes of the same assets whose centres are near enough for them to be copies."""
    from scipy.spatial import KDTree

    if len(positions) < 2:
        return np.empty((0, 2), dtype=np.int64)
    centers = np.stack([scene.mean(axis=0) if len(scene) else np.zeros(3) for scene in positions])
    return KDTree(centers).query_pairs(DUPLICATE * 1.001, output_type="ndarray")


def _features(batch: SceneBatch, limit: float) -> Tensor:
    """(B, C * (1 + waves)) m: per asset, the sums over its objects of functions with slope <= 1 and range <= ``limit``:
    the constant ``limit`` / 2 and waves of the position in random directions, equal for all scenes.
    """
    generator = torch.Generator().manual_seed(0)
    direction = torch.nn.functional.normalize(torch.randn(3, _WAVES, generator=generator), dim=0)
    length = limit / 2 * torch.logspace(0, 1, _WAVES, 2.0)  # slope 1 at amplitude limit / 2 when length = limit / 2
    phase = 2 * math.pi * torch.rand(_WAVES, generator=generator)
    chunks = []
    for start in range(0, len(batch), 1024):
        part = batch[start : start + 1024].to("cpu")
        one_hot = part.tensor[..., 12:-1] * counted_objects(part).unsqueeze(-1)  # (b, N, C)
        waves = (limit / 2) * torch.sin(part.translations @ direction / length + phase)  # (b, N, waves)
        waves = torch.cat([torch.full_like(waves[..., :1], limit / 2), waves], dim=-1)
        chunks.append(torch.einsum("bnc,bnw->bcw", one_hot, waves).flatten(1))
    return torch.cat(chunks)


def _nearest_features(features: Tensor, others: Tensor, count: int) -> Tensor:
    """(B, count) int64: rows of ``others`` with the nearest features."""
    used = (features != 0).any(dim=0) | (others != 0).any(dim=0)
    features, others = features[:, used], others[:, used]
    chunks = features.split(_ROWS)
    return torch.cat([torch.cdist(chunk, others).topk(count, dim=1, largest=False).indices for chunk in chunks])


def tallest_stacks(batch: SceneBatch) -> Tensor:
    """Number of objects in the tallest stack of each scene, (B,) int64.

    A stack is a chain of free objects, each standing on the one below or lying in it
    (:attr:`SceneBatch.supports <scene_envs.scene.SceneBatch.supports>`). A lone object is a stack of one.
    A scene without free objects has 0.

    >>> tallest_stacks(SceneBatch.empty("dimsum_table", 2)).tolist()
    [0, 0]
    """
    below, free = batch.supports, batch.is_free
    on_free = (below >= 0) & free.gather(1, below.clamp(min=0))
    levels = free.long()  # (B, N): objects from each object down to the lowest free one below it
    for _ in range(below.shape[1]):
        deeper = torch.where(free & on_free, 1 + levels.gather(1, below.clamp(min=0)), free.long())
        if torch.equal(deeper, levels):
            break
        levels = deeper
    return levels.amax(dim=1)


def stack_wasserstein(batch: SceneBatch, reference: SceneBatch) -> float:
    """Wasserstein-1 distance of the tallest stack per scene from that of real scenes of the same assets, in objects.

    It shows whether stacks are lower than in real scenes, even if the number and categories of objects are those of
    real scenes. An InvalidInputError if the batches have other assets.

    >>> stack_wasserstein(SceneBatch.empty("dimsum_table", 3), SceneBatch.empty("dimsum_table", 5))
    0.0
    """
    from scipy.stats import wasserstein_distance

    check_same_assets(batch, reference)
    return float(wasserstein_distance(tallest_stacks(batch).cpu().numpy(), tallest_stacks(reference).cpu().numpy()))


@dataclass(frozen=True)
class Support:
    """Support of objects of a scene type: a surface fixed in the world, or the top of another object.

    >>> [support.kind for support in supports_of("dimsum_table")]
    ['table', 'stack']
    """

    kind: str  # name under which the height error is reported
    height: float  # m, in the world, or above the frame of the supporting object
    on: Sequence[str] | None = None  # names of the supporting assets; None if the surface is fixed in the world
    riders: Sequence[str] | None = None  # names of the assets that can rest there; None means all free ones
    reach: float = 0.06  # largest horizontal distance (m) between the frames
    catch: float = 0.0  # height error (m) up to which a rider within reach is assigned here; for thin supports


_tables = partial(page_values, "agents.evaluation", "supports.yaml")
"""Supports of scene types, and containers."""


def supports_of(scene_type: str) -> list[Support]:
    """The supports of a scene type of this package, by name; none of any other."""
    return [Support(**row) for row in _tables()["scene_types"].get(scene_type, ())]


def category_distribution(batch: SceneBatch, eps: float = KL_EPS) -> Tensor:
    """(C,) float64 share of every asset among the objects of all scenes (welded ones included, empty slots ignored),
    positive and summing to 1: ``eps`` is added to each share before renormalising.
    """
    assets = batch.scene_type.num_assets
    counts = torch.bincount(batch.categories.flatten().cpu(), minlength=assets + 1)[:assets].double()
    if not counts.sum():
        raise InvalidInputError(f"a batch of {len(batch)} scenes without any object has no category distribution")
    shares = counts / counts.sum() + eps
    return shares / shares.sum()


def category_kl(batch: SceneBatch, reference: SceneBatch) -> float:
    """KL(reference ‖ samples) of the category distributions, nats (the paper's section 4): it punishes assets that the
    samples lack.

    >>> category_kl(SceneBatch.empty("dimsum_table", 3), SceneBatch.empty("dimsum_table", 5))
    0.0
    """
    check_same_assets(batch, reference)
    p, q = category_distribution(reference), category_distribution(batch)
    return float((p * (p / q).log()).sum())


def count_wasserstein(batch: SceneBatch, reference: SceneBatch) -> float:
    """Wasserstein-1 distance of the distributions of objects per scene, in objects."""
    from scipy.stats import wasserstein_distance

    check_same_assets(batch, reference)
    return float(wasserstein_distance(batch.counts.cpu().numpy(), reference.counts.cpu().numpy()))


def height_errors(batch: SceneBatch, supports: Sequence[Support] | None = None) -> dict[str, Tensor]:
    """For each kind of support, (K,) m: how far each of its K objects floats above, or is sunk into, the support
    nearest to it in height. All fixed surfaces are candidates, and so are the objects within ``reach`` horizontally;
    the rider must be above the frame of an object whose top is above its frame. Objects that lie in a container as they
    fell are left out. ``supports`` None takes those of the scene type.
    """
    if supports is None:
        supports = supports_of(batch.scene_type.name)
    if not supports:
        return {}
    errors: dict[str, list[Tensor]] = {support.kind: [] for support in supports}
    for start in range(0, len(batch), _CHUNK):
        chunk = batch[start : start + _CHUNK]
        gaps = torch.stack([_height_gap(chunk, support) for support in supports])  # (S, B, N)
        catch = torch.tensor([support.catch for support in supports]).to(gaps)[:, None, None]
        nearest = (gaps - 1.0 * ((gaps <= catch) & (catch > 0))).argmin(dim=0)
        error = gaps.gather(0, nearest[None])[0]
        supported = torch.isfinite(error) & ~_contained(chunk)
        for index, support in enumerate(supports):
            errors[support.kind].append(error[supported & (nearest == index)])
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


def _contained(batch: SceneBatch) -> Tensor:
    """(B, N) bool: the object lies in a container."""
    z = batch.translations[..., 2].double()
    rise = z.unsqueeze(2) - z.unsqueeze(1)  # (B, rider, container)
    inside = torch.zeros_like(batch.is_empty)
    for container in _tables()["containers"]:
        if container["name"] in batch.scene_type.assets:
            held = _near(batch, [container["name"]], container["reach"]) & (rise > 0.01) & (rise <= container["depth"])
            inside |= held.any(dim=-1) & _is_one_of(batch, container["riders"])
    return inside


def _is_one_of(batch: SceneBatch, names: Sequence[str]) -> Tensor:
    """(B, N) bool: the slot holds one of the assets ``names``."""
    assets = batch.scene_type.assets
    wanted = [assets.index(name) for name in names if name in assets]
    return torch.isin(batch.categories, torch.tensor(wanted, device=batch.tensor.device))
