"""Learning rate and optimisers of a pretraining run: AdamW, and Muon for the matrices inside transformer blocks."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from agents.pretraining.settings import PretrainConfig

_BETAS = (0.9, 0.99)
_MOMENTUM = 0.95
_COEFFICIENTS = (3.4445, -4.7750, 2.0315)
"""Coefficients of the quintic Newton-Schulz iteration (Jordan et al. 2024)."""


def learning_rate_at(step: int, config: PretrainConfig) -> float:
    """Linear warm-up, then the peak, then a cosine to ``final`` over the last part ``decay`` of the steps."""
    peak, rate = config.optimizer.lr, config.optimizer.rate
    if step < rate.warmup:
        return peak * (step + 1) / rate.warmup
    start = max(rate.warmup, config.iterations * (1.0 - rate.decay))
    progress = (step - start) / max(1.0, config.iterations - start)
    cosine = 0.5 * (1 + math.cos(math.pi * min(1.0, max(0.0, progress))))
    return peak * (rate.final + (1 - rate.final) * cosine)


def build_optimizer(
    name: str, network: nn.Module, weight_decay: float, text_rate: float = 1.0
) -> torch.optim.Optimizer:
    """An optimiser of ``network``; ``rate`` of a parameter group is its share of the learning rate. ``"muon"`` is Muon
    on matrices inside ``blocks`` and AdamW on the rest. ``text_rate`` is the ``rate`` under ``text_encoder``: few
    percent of the loss depend on prompts at first, and at the full rate all words get the same embedding before they
    are read.
    """
    named = [(key, parameter) for key, parameter in network.named_parameters() if parameter.requires_grad]
    text = [p for key, p in named if key.startswith("text_encoder.")]
    matrices = [p for key, p in named if p.ndim == 2 and "blocks." in key and name == "muon"]
    taken = {id(p) for p in (*text, *matrices)}
    others = [p for _, p in named if id(p) not in taken]
    optimizer: torch.optim.Optimizer
    if name == "adamw":
        optimizer = torch.optim.AdamW(others, betas=_BETAS, weight_decay=weight_decay)
    else:
        optimizer = MuonAdamW(matrices, others, weight_decay=weight_decay)
    if text:
        optimizer.add_param_group({"params": text, "kind": "adamw", "rate": text_rate})
    for group in optimizer.param_groups:
        group.setdefault("rate", 1.0)
    return optimizer


class MuonAdamW(torch.optim.AdamW):
    """Muon (Jordan et al. 2024) on matrices and AdamW on everything else, under one learning rate, with decoupled
    weight decay. A matrix's update is its momentum made orthogonal, scaled to the root mean square of an AdamW update
    (Liu et al. 2025), in float32, because ``torch.optim.Muon`` iterates in bfloat16, which is very slow on most CPUs.

    >>> weight = nn.Parameter(torch.eye(2))
    >>> optimizer = MuonAdamW([weight], [], lr=0.1, weight_decay=0.0)
    >>> weight.grad = torch.tensor([[1.0, 0.0], [0.0, 1e-3]])
    >>> optimizer.step()
    >>> bool((torch.eye(2) - weight)[0, 0] > 0.015)
    True
    """

    def __init__(
        self, matrices: list[nn.Parameter], others: list[nn.Parameter], lr: float = 1e-3, weight_decay: float = 0.01
    ) -> None:
        groups = [{"params": matrices, "kind": "muon"}, {"params": others, "kind": "adamw"}]
        used = [group for group in groups if group["params"]]
        super().__init__(used, lr, _BETAS, weight_decay=weight_decay, foreach=False)

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> None:  # type: ignore[override]
        """One update of every parameter that has a gradient; the gradients of matrices are None then. A closure is not
        supported.
        """
        for group in self.param_groups:
            for parameter in group["params"] if group["kind"] == "muon" else ():
                if parameter.grad is not None:
                    parameter.mul_(1.0 - group["lr"] * group["weight_decay"])
                    parameter.add_(self._muon(parameter.grad, self.state[parameter]), alpha=-group["lr"])
                    parameter.grad = None  # AdamW leaves such parameters as they are
        super().step()

    @staticmethod
    def _muon(gradient: Tensor, state: dict[str, Any]) -> Tensor:
        state.setdefault("step", torch.zeros(()))  # AdamW looks for it in every state that it loads
        momentum = state.setdefault("momentum", torch.zeros_like(gradient))
        momentum.lerp_(gradient, 1.0 - _MOMENTUM)
        direction = orthogonalised(gradient.lerp(momentum, _MOMENTUM))
        return 0.2 * math.sqrt(max(gradient.shape)) * direction


def orthogonalised(matrix: Tensor, steps: int = 5) -> Tensor:
    """``matrix`` (M, N) with its singular values moved near 1, between 0.7 and 1.2, by Newton-Schulz iterations."""
    a, b, c = _COEFFICIENTS
    tall = matrix.shape[0] > matrix.shape[1]
    x = matrix.T if tall else matrix
    x = x / x.norm().clamp(min=1e-7)
    for _ in range(steps):
        gram = x @ x.T
        x = torch.addmm(x, torch.addmm(gram, gram, gram, beta=b, alpha=c), x, beta=a)
    return x.T if tall else x
