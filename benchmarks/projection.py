"""Projection beside a general NLP solver: scenes free of overlap, time per scene, and distances that objects move.

    python benchmarks/projection.py [--count 40] [--small 20] [--starts 6] [--seed 0] [--types ...] [--heaps]

*Each type*: generated scenes whose free objects were moved by Gaussian noise of 1 and 2 cm along every axis. Times
are CPU time of one thread, scene by scene.

*Small scenes*: 2 to 8 free objects that overlap, cut out of the jittered scenes. Projection and scipy's SLSQP solve
the same problem: the least sum of squared translations, with the signed distance of every near pair of convex parts
at least the clearance that projection asks for, and the workspace as bounds. SLSQP solves it with the fine parts and
with the coarse hulls, from the given poses and from random poses 1 cm around them. It also solves it with the fine
parts from the result of projection. The best of its solutions that are free of overlap counts. The ratio is between
the square roots of the minimised sums. *Alone* is the number of scenes that SLSQP solves without the start from the
result of projection.

``--heaps`` measures degenerate scenes alone, at the largest count of each type. All free objects are at one point of
the workspace or 10 m outside it, at one place in pairs, in a tower 10 mm apart, in a cube of 5 cm, or inside a welded
object. Their assets are random, or all the one with most convex parts. *Left* is the deepest overlap that is left,
the largest over the scenes.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import fcl
import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy.optimize import minimize
from scipy.spatial import ConvexHull

from scene_envs.assets.shapes import convex_hull
from scene_envs.grammars import get_grammar
from scene_envs.physics import project
from scene_envs.physics.motion import Physics, physics_of
from scene_envs.physics.placement import Level, Objects, PlacedParts, flatten, part_pairs, place, separations
from scene_envs.physics.projection import CLEARANCE, TOLERANCE
from scene_envs.rotations import yaw_matrix
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import list_scene_types

Array = NDArray[np.float64]

_AROUND = 0.03
"""Parts within this distance (m) of each other at the start are constraints of the NLP."""


def jittered(batch: SceneBatch, scale: float, generator: torch.Generator) -> SceneBatch:
    """Gaussian noise of ``scale`` m along every axis on the translations of free objects."""
    noise = scale * torch.randn(batch.translations.shape, generator=generator) * batch.is_free.unsqueeze(-1)
    return batch.with_poses(batch.translations + noise, batch.rotations)


HEAPS = ("point", "outside", "pairs", "nested", "cube", "buried")
"""Kinds of degenerate scenes."""


def heap(name: str, kind: str, rng: np.random.Generator, *, one_asset: bool) -> SceneBatch:
    """One degenerate scene of a type, all slots taken."""
    batch = SceneBatch.empty(name, 1)
    scene_type = batch.scene_type
    free = [index for index in range(scene_type.num_assets) if index not in scene_type.welded_categories]
    if one_asset:
        free = [max(free, key=lambda index: len(scene_type.library.assets[index].fine))]
    slots = torch.nonzero(batch.is_empty[0]).flatten().tolist()
    low, high = (np.array(corner) for corner in scene_type.workspace)
    center, count = (low + high) / 2, len(slots)
    places: Array = np.tile(center, (count, 1))
    if kind == "outside":
        places += [10.0, 0.0, 0.0]
    elif kind == "pairs":
        places = np.repeat(rng.uniform(low, high, (count, 3)), 2, axis=0)[:count]
    elif kind == "nested":
        places[:, 2] += 0.01 * np.arange(count)
    elif kind == "cube":
        places += rng.uniform(-0.025, 0.025, (count, 3))
    elif kind == "buried":
        places = rng.uniform([-0.1, -0.1, -0.15], [0.1, 0.1, -0.01], (count, 3))
    chosen, turns = rng.choice(free, count), rng.uniform(0.0, 2.0 * np.pi, count)
    if kind == "pairs":
        chosen, turns = np.repeat(chosen, 2)[:count], np.zeros(count)
    translations, rotations, categories = batch.translations.clone(), batch.rotations.clone(), batch.categories.clone()
    translations[0, slots] = torch.from_numpy(places).float()
    rotations[0, slots] = yaw_matrix(torch.from_numpy(turns).float())
    categories[0, slots] = torch.from_numpy(chosen)
    if kind == "buried" and "cafe_table" in scene_type.welded:
        categories[0, slots[0]] = scene_type.assets.index("cafe_table")
        translations[0, slots[0]], rotations[0, slots[0]] = torch.zeros(3), torch.eye(3)
    return SceneBatch.from_parts(translations, rotations, categories, scene_type)


def measure_heaps(name: str, count: int, seed: int, table: Table) -> None:
    """Two rows: random assets, and one asset; the slowest of ``count`` scenes of each kind."""
    project(get_grammar(name).sample(np.random.default_rng(seed), 1))
    for one_asset in (False, True):
        cells, solved, left, total = [], 0, 0.0, 0
        for kind in HEAPS:
            spent = []
            for index in range(count):
                batch = heap(name, kind, np.random.default_rng([seed, index]), one_asset=one_asset)
                start = time.process_time()
                result = project(batch)
                spent.append(1e3 * (time.process_time() - start))
                solved, total = solved + int(result.converged[0]), total + 1
                left = max(left, 1e3 * float(result.residual_depth[0]))
            cells.append(f"{max(spent):.0f}")
        table.add_row(name, "one" if one_asset else "random", *cells, f"{solved} of {total}", f"{left:.1f}")


def small_scenes(batch: SceneBatch, rng: np.random.Generator) -> SceneBatch:
    """From each scene, one of 2 to 8 free objects: a random object, its nearest neighbours, and the welded objects."""
    categories = batch.categories.clone()
    for index in range(len(batch)):
        free = torch.nonzero(batch.is_free[index]).flatten()
        seed = free[int(rng.integers(len(free)))]
        distance = (batch.translations[index, free] - batch.translations[index, seed]).norm(dim=-1)
        kept = free[distance.argsort()[: int(rng.integers(2, 9))]]
        dropped = torch.isin(torch.arange(categories.shape[1]), kept, invert=True) & batch.is_free[index]
        categories[index, dropped] = batch.scene_type.num_assets
    return SceneBatch.from_parts(batch.translations, batch.rotations, categories, batch.scene_type)


class SmallProgram:
    """The projection of one small scene as a nonlinear programme.

    Args:
        physics: of the scene's assets.
        objects: of one scene.
        workspace: lowest and highest corner, m.
        level: which parts are kept apart.
    """

    def __init__(
        self, physics: Physics, objects: Objects, workspace: tuple[tuple[float, ...], ...], level: Level
    ) -> None:
        self.physics, self.objects, self.level = physics, objects, level
        self.shapes: dict[tuple[int, int], fcl.CollisionObject] = {}
        self.free = np.flatnonzero(~objects.fixed)
        self.column = np.full(len(objects), -1)
        self.column[self.free] = np.arange(len(self.free))
        self.home = objects.translation[self.free].ravel()
        first, second = np.triu_indices(len(objects), k=1)
        pair_free = ~(objects.fixed[first] & objects.fixed[second])
        self.first, self.second = first[pair_free], second[pair_free]
        placed = place(physics.library, objects, level)
        pair, a, b = part_pairs(placed, self.first, self.second)
        near = ((placed.low[a] <= placed.high[b] + _AROUND) & (placed.low[b] <= placed.high[a] + _AROUND)).all(axis=1)
        self.pair, self.a, self.b = pair[near], a[near], b[near]
        low, high = np.array(workspace[0]), np.array(workspace[1])
        self.bounds = list(zip(np.tile(low, len(self.free)), np.tile(high, len(self.free)), strict=True))

    def constraint(self, x: Array) -> tuple[Array, Array]:
        """Signed distances (m, m) of all near part pairs less the clearance, and their Jacobian (m, 3 free)."""
        translation = self.objects.translation.copy()
        translation[self.free] = x.reshape(-1, 3)
        moved = replace(self.objects, translation=translation)
        parts = place(self.physics.library, moved, self.level).parts
        gap, normal = separations(self.physics.library, parts, self.a, self.b)
        for row in np.flatnonzero(gap < 0):  # the bound from face planes is not exact
            gap[row], normal[row] = self._overlap(parts, self.a[row], self.b[row])
        jacobian = np.zeros((len(gap), len(self.free) + 1, 3))
        for row in np.flatnonzero(gap > 0):  # the gap is at most the distance: two corners may be nearest
            way = self._nearest(parts, self.a[row], self.b[row])
            distance = float(np.linalg.norm(way))
            if distance > gap[row] + 1e-6:
                gap[row], normal[row] = distance, way / distance
        line = np.arange(len(gap))
        jacobian[line, self.column[self.second[self.pair]]] += normal
        jacobian[line, self.column[self.first[self.pair]]] -= normal
        return gap - CLEARANCE, jacobian[:, :-1].reshape(len(gap), -1)

    def _overlap(self, parts: PlacedParts, a: int, b: int) -> tuple[float, Array]:
        """Gap (m, negative for an overlap) of two placed parts, and the direction (3,) that takes the second out."""
        one, other = (self.physics.library.parts[parts.part[i]].vertices @ parts.rotation[i].T for i in (a, b))
        shift = parts.translation[b] - parts.translation[a]
        faces = ConvexHull((one[:, None] - (other + shift)[None]).reshape(-1, 3)).equations
        nearest = faces[faces[:, 3].argmax()]
        return float(nearest[3]), nearest[:3]

    def _nearest(self, parts: PlacedParts, a: int, b: int) -> Array:
        """(3,) m: vector from the nearest point of one placed part to that of another, when the two are apart."""
        result = fcl.DistanceResult()
        shapes = [self._shape(int(parts.part[i]), side) for side, i in enumerate((a, b))]
        for shape, i in zip(shapes, (a, b), strict=True):
            shape.setTransform(fcl.Transform(parts.rotation[i], parts.translation[i]))
        fcl.distance(*shapes, fcl.DistanceRequest(enable_nearest_points=True), result)
        return np.asarray(result.nearest_points[1]) - np.asarray(result.nearest_points[0])

    def _shape(self, part: int, side: int) -> fcl.CollisionObject:
        if (part, side) not in self.shapes:
            hull = convex_hull(self.physics.library.parts[part].vertices)
            table = np.column_stack([np.full(len(hull.faces), 3), hull.faces]).astype(np.int32).ravel()
            self.shapes[part, side] = fcl.CollisionObject(fcl.Convex(hull.vertices.copy(), len(hull.faces), table))
        return self.shapes[part, side]

    def solve(self, start: Array) -> Array:
        """SLSQP from one start."""
        last: dict[bytes, tuple[Array, Array]] = {}

        def at(x: Array) -> tuple[Array, Array]:
            key = x.tobytes()
            if key not in last:
                last.clear()
                last[key] = self.constraint(x)
            return last[key]

        scale = 1e3  # millimetres: SLSQP stops on absolute changes
        result = minimize(
            lambda x: (scale**2 * ((x - self.home) ** 2).sum(), 2 * scale**2 * (x - self.home)),
            np.clip(start, [b[0] for b in self.bounds], [b[1] for b in self.bounds]),
            jac=True,
            method="SLSQP",
            bounds=self.bounds,
            constraints={"type": "ineq", "fun": lambda x: scale * at(x)[0], "jac": lambda x: scale * at(x)[1]},
            options={"maxiter": 100, "ftol": 1e-6},
        )
        return np.asarray(result.x)

    def way(self, x: Array) -> float | None:
        """Root of the summed squares of all translations (m), or None when something overlaps."""
        translation = self.objects.translation.copy()
        translation[self.free] = x.reshape(-1, 3)
        pairs = self.physics.collider.pairs(replace(self.objects, translation=translation))
        return float(np.linalg.norm(x - self.home)) if pairs.depth.max(initial=0.0) <= TOLERANCE else None


def objects_of(batch: SceneBatch) -> Objects:
    """The objects of a batch of one scene."""
    return flatten(
        physics_of(batch.scene_type, "bullet").library,
        batch.translations.double().numpy(),
        batch.rotations.double().numpy(),
        batch.categories.numpy(),
        batch.is_welded.numpy(),
    )


def compare(batch: SceneBatch, starts: int, rng: np.random.Generator) -> tuple[list[float], int, int]:
    """Ratios of the distance moved by projection to that by SLSQP, and the numbers of scenes that each solved alone."""
    physics = physics_of(batch.scene_type, "bullet")
    ratios, solved, alone = [], 0, 0
    for index in range(len(batch)):
        one = batch[index]
        objects = objects_of(one)
        fine, coarse = (
            SmallProgram(physics, objects, batch.scene_type.workspace, level) for level in ("fine", "coarse")
        )
        projected = objects_of(project(one).batch).translation[fine.free].ravel()
        ours = fine.way(projected)
        tries = [fine.home, *(fine.home + 0.01 * rng.standard_normal(len(fine.home)) for _ in range(starts - 1))]
        ends = [fine.solve(fine.home), *(coarse.solve(start) for start in tries)]
        found = [way for way in map(fine.way, ends) if way is not None]
        solved += ours is not None
        alone += bool(found)
        polished = fine.way(fine.solve(projected))
        if polished is not None:
            found.append(polished)
        if ours is not None and found and min(found) > 1e-3:
            ratios.append(ours / min(found))
    return ratios, solved, alone


def measure_type(name: str, count: int, seed: int, table: Table) -> None:
    """Two rows: jittered by 1 and 2 cm."""
    batch = get_grammar(name).sample(np.random.default_rng(seed), count)
    project(batch[0])
    for scale in (0.01, 0.02):
        noisy = jittered(batch, scale, torch.Generator().manual_seed(seed))
        spent, free, moved, outside = [], [], [], 0
        for index in range(len(noisy)):
            start = time.process_time()
            result = project(noisy[index])
            spent.append(1e3 * (time.process_time() - start))
            free.append(bool(result.converged[0]))
            moved.append(1e3 * float(result.moved[result.batch.is_free].mean()))
            outside += int((result.batch.is_free & ~result.batch.in_workspace).sum())
        table.add_row(
            name, f"{100 * scale:.0f} cm", f"{float(batch.counts.float().mean()):.1f}", f"{np.mean(free):.1%}",
            f"{np.median(spent):.0f}", f"{np.percentile(spent, 90):.0f}", f"{np.mean(moved):.1f}", str(outside),
        )  # fmt: skip


def measure_small(name: str, count: int, starts: int, seed: int, table: Table) -> None:
    """One row: how far projection moves small scenes, relative to SLSQP."""
    rng = np.random.default_rng(seed)
    noisy = jittered(get_grammar(name).sample(rng, 2 * count), 0.02, torch.Generator().manual_seed(seed))
    noisy = noisy[torch.nonzero(noisy.is_free.sum(dim=1) >= 2).flatten()[:count]]
    ratios, solved, alone = compare(small_scenes(noisy, rng), starts, rng)
    if not ratios:
        return
    spread = np.percentile(ratios, [10, 50, 90])
    table.add_row(
        name, str(len(noisy)), f"{np.mean(ratios):.3f}", *(f"{value:.3f}" for value in spread), f"{max(ratios):.2f}",
        str(solved), str(alone),
    )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=40, help="scenes per type")
    parser.add_argument("--small", type=int, default=20, help="small scenes per type for the comparison")
    parser.add_argument("--starts", type=int, default=6, help="starts of SLSQP per scene")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--heaps", action="store_true", help="measure degenerate scenes, and nothing else")
    parser.add_argument("--types", nargs="*", default=list_scene_types())
    options = parser.parse_args()
    torch.set_num_threads(1)
    console = Console()
    if options.heaps:
        table = Table(
            *("scene type", "assets", *HEAPS, "free of overlap", "left mm"),
            title="heaps: slowest scene of each kind, ms",
        )
        for name in options.types:
            measure_heaps(name, options.count, options.seed, table)
        console.print(table)
        return
    if options.count:
        table = Table(
            *("scene type", "jitter", "objects", "free of overlap", "median ms", "90 % ms", "moved mm", "outside"),
            title="each type",
        )
        for name in options.types:
            measure_type(name, options.count, options.seed, table)
        console.print(table)
    if options.small:
        table = Table(
            *("scene type", "scenes", "mean", "10 %", "median", "90 %", "largest", "we solve", "SLSQP alone"),
            title="way of projection / way of SLSQP, 2 to 8 objects, jitter 2 cm",
        )
        for name in options.types:
            measure_small(name, options.small, options.starts, options.seed, table)
        console.print(table)


if __name__ == "__main__":
    main()
