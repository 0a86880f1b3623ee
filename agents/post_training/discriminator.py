"""Reward: a discriminator of real scenes and samples that learns while a prior is post-trained."""

from __future__ import annotations

import logging
from copy import deepcopy
from dataclasses import replace
from typing import Any, ClassVar

import torch
from torch import Generator, Tensor, nn
from torch.nn import functional as F

from agents.evaluation.classifier import RESOLUTION
from agents.evaluation.set_network import ObjectNetwork, SceneTokens, TypicalPlaces, blurred, scene_tokens
from agents.utils.checkpoints import derived_generator, derived_seed
from rewards import RewardContext, RewardOutput, register_reward
from scene_envs.errors import InvalidInputError
from scene_envs.scene import SceneBatch

logger = logging.getLogger(__name__)

_MAX_REAL_SCENES = 1024
"""Number of real scenes that are kept."""


@register_reward("discriminator")
class Discriminator:
    """Mean probability, over the free objects, that an object is one of a real scene; from 0 to 1.

    A small network is trained online to separate the objects of real scenes from those of samples (Goodfellow et al.
    2014; one logit per object). It reads an object's asset and pose and its four nearest neighbours, not the rest of
    the scene, so that an object is not blamed for others far away. ``post-train`` trains it in every iteration.
    Untrained, it scores every object 0.5. A scene without free objects scores 0. Generated welded objects, such as the
    tables of rooms, are judged as well; they get credit, but do not change the value.

    Args:
        learning_rate: learning rate of AdamW.
        steps: number of optimiser steps of an iteration.
        batch_size: number of real scenes, and of samples, of a step.
        memory: number of latest samples from which steps draw.

    >>> Discriminator()(SceneBatch.empty("dimsum_table", 1), RewardContext()).value
    tensor([0.])
    """

    name: ClassVar[str] = "discriminator"
    maximum: ClassVar[float] = 1.0
    averages_objects: ClassVar[bool] = True

    def __init__(self, learning_rate: float = 1e-3, steps: int = 8, batch_size: int = 48, memory: int = 384) -> None:
        if isinstance(learning_rate, bool) or not isinstance(learning_rate, int | float) or not 0 < learning_rate < 1:
            raise InvalidInputError(f"discriminator: learning_rate={learning_rate!r} must be a number between 0 and 1")
        for name, number in (("steps", steps), ("batch_size", batch_size), ("memory", memory)):
            if isinstance(number, bool) or not isinstance(number, int) or number < 1:
                raise InvalidInputError(f"discriminator: {name}={number!r} must be a whole number of at least 1")
        self.learning_rate, self.steps, self.batch_size, self.memory = learning_rate, steps, batch_size, memory
        self._model: _Model | None = None
        self._warned = False

    def __repr__(self) -> str:
        return "Discriminator()"

    def __call__(self, batch: SceneBatch, context: RewardContext) -> RewardOutput:
        """Mean over the free objects. Term: ``free_objects``.

        ``per_object`` (B, N) is the probability of each free or generated welded object; ``object_flags["judged"]``
        marks these.
        """
        free = batch.is_free
        judged = free | batch.is_furniture
        if self._model is None:
            if not self._warned and bool(free.any()):
                logger.warning(
                    "discriminator has not seen any samples, so every object scores 0.5; "
                    "only post-train trains it, with reward=discriminator"
                )
                self._warned = True
            probability = torch.full(free.shape, 0.5, device=free.device)
        else:
            probability = self._model.probabilities(batch.to("cpu")).to(free.device)
        number = free.sum(dim=-1).float()
        value = (probability * free).sum(dim=-1) / number.clamp(min=1)
        return RewardOutput(
            value, per_object=probability * judged, terms={"free_objects": number}, object_flags={"judged": judged}
        )

    def begin(self, real: SceneBatch, seed: int) -> None:
        """Start with an untrained network, whose weights and draws follow from ``seed``; of ``real`` scenes, the
        first 1,024 are kept.
        """
        self._model = _Model(real[:_MAX_REAL_SCENES].to("cpu"), seed, self.learning_rate)

    def learn(self, samples: SceneBatch, steps: int | None = None) -> None:
        """Keep ``samples`` among the latest ones, and take optimiser steps.

        Raises:
            InvalidInputError: :meth:`begin` was not called.
        """
        model = self._begun()
        model.samples = torch.cat([model.samples, samples.with_slots(model.slots).tensor.cpu()])[-self.memory :]
        for _ in range(self.steps if steps is None else steps):
            model.step(self.batch_size)

    def state_dict(self) -> dict[str, Any]:
        """Weights, optimiser and latest samples."""
        model = self._begun()
        parts = {"network": model.network.state_dict(), "optimizer": model.optimizer.state_dict()}
        return deepcopy({**parts, "samples": model.samples, "updates": model.updates})

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of :meth:`state_dict`, after :meth:`begin` with the same real scenes."""
        model = self._begun()
        model.network.load_state_dict(state["network"])
        model.optimizer.load_state_dict(state["optimizer"])
        model.samples, model.updates = state["samples"], state["updates"]

    def _begun(self) -> _Model:
        if self._model is None:
            raise InvalidInputError("discriminator: call begin(real, seed) before it learns")
        return self._model


class _Model:
    """Network, optimiser, real scenes and latest samples of a discriminator."""

    def __init__(self, real: SceneBatch, seed: int, learning_rate: float) -> None:
        self.real, self.seed, self.updates = real, seed, 0
        self.slots = real.tensor.shape[1]
        self.samples = real.tensor[:0]
        self.typical = TypicalPlaces.of(scene_tokens(real), real.scene_type.num_assets + 1)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(derived_seed(seed))
            self.network = ObjectNetwork(replace(self.typical.network_config(outputs=1), blocks=0, hidden=64))
        self.optimizer = torch.optim.AdamW(self.network.parameters(), learning_rate, weight_decay=1e-2)
        self.fixed = torch.tensor(real.scene_type.fixed_categories, dtype=torch.long)

    @torch.no_grad()
    def probabilities(self, batch: SceneBatch) -> Tensor:
        """(B, N) probability that the object of each slot is one of a real scene."""
        tokens = scene_tokens(batch)
        found = self.network(*self.typical.inputs(tokens)).sigmoid()
        order = batch.is_empty.to(torch.uint8).argsort(dim=1, stable=True)[:, : found.shape[1]]  # as in the tokens
        return torch.zeros(batch.tensor.shape[:2]).scatter(1, order, found)

    def step(self, count: int) -> None:
        """One optimiser step on ``count`` real scenes and as many of the latest samples."""
        generator = derived_generator(self.seed, self.updates)
        self.updates += 1
        real, fake = (self._logits(scenes, count, generator) for scenes in (self.real.tensor, self.samples))
        if not (len(real) and len(fake)):  # no free object to learn from
            return
        loss = F.softplus(-real).mean() + F.softplus(fake).mean()  # -log of the probabilities of the right answers
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        if bool(torch.isfinite(nn.utils.clip_grad_norm_(self.network.parameters(), 1.0))):
            self.optimizer.step()

    def _logits(self, scenes: Tensor, count: int, generator: Generator) -> Tensor:
        """Logits of non-fixed objects of ``count`` scenes, drawn with replacement and blurred as for classifiers."""
        rows = torch.randint(len(scenes), (count,), generator=generator)
        tokens: SceneTokens = scene_tokens(
            blurred(SceneBatch(scenes[rows], self.real.scene_type), *RESOLUTION, generator)
        )
        judged = tokens.present & ~torch.isin(tokens.categories, self.fixed)
        logits: Tensor = self.network(*self.typical.inputs(tokens))[judged]
        return logits
