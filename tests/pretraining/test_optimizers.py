"""Muon and AdamW under one rate, against PyTorch's own."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from agents.pretraining.optimizers import MuonAdamW, build_optimizer, orthogonalised
from agents.pretraining.settings import PretrainOptimizerSettings
from scene_envs.errors import UnknownNameError


@pytest.mark.parametrize("shape", [(8, 24), (24, 8), (16, 16)])
def test_orthogonalised_keeps_singular_vectors_and_levels_singular_values(shape: tuple[int, int]) -> None:
    generator = torch.Generator().manual_seed(0)
    u, _, vt = torch.linalg.svd(torch.randn(shape, generator=generator), full_matrices=False)
    values = torch.linspace(0.2, 1.0, min(shape))
    found = u.T @ orthogonalised(u @ values.diag() @ vt) @ vt.T
    torch.testing.assert_close(found, found.diagonal().diag(), atol=1e-4, rtol=0)
    assert float(found.diagonal().min()) > 0.65
    assert float(found.diagonal().max()) < 1.25


def test_matrices_move_as_under_torch_muon() -> None:
    """PyTorch iterates in bfloat16, so the agreement is to its precision."""
    generator = torch.Generator().manual_seed(1)
    start, gradients = torch.randn(12, 30, generator=generator), torch.randn(4, 12, 30, generator=generator)
    ours, theirs = nn.Parameter(start.clone()), nn.Parameter(start.clone())
    optimizers = (
        MuonAdamW([ours], [], lr=0.01, weight_decay=0.1),
        torch.optim.Muon([theirs], lr=0.01, weight_decay=0.1, momentum=0.95, adjust_lr_fn="match_rms_adamw"),
    )
    for gradient in gradients:
        for parameter, optimizer in zip((ours, theirs), optimizers, strict=True):
            parameter.grad = gradient.clone()
            optimizer.step()
    moved = (theirs.detach() - start).norm()
    assert float((ours - theirs).detach().norm() / moved) < 0.02


def test_the_rest_moves_as_under_torch_adamw() -> None:
    generator = torch.Generator().manual_seed(2)
    start, gradients = torch.randn(7, generator=generator), torch.randn(5, 7, generator=generator)
    ours, theirs = nn.Parameter(start.clone()), nn.Parameter(start.clone())
    optimizers = (
        MuonAdamW([], [ours], lr=0.01, weight_decay=0.1),
        torch.optim.AdamW([theirs], lr=0.01, betas=(0.9, 0.99), weight_decay=0.1),
    )
    for gradient in gradients:
        for parameter, optimizer in zip((ours, theirs), optimizers, strict=True):
            parameter.grad = gradient.clone()
            optimizer.step()
    torch.testing.assert_close(ours, theirs, atol=1e-6, rtol=1e-5)


def test_its_state_resumes_exactly() -> None:
    def make() -> tuple[nn.Module, torch.optim.Optimizer]:
        torch.manual_seed(0)
        network = nn.ModuleDict({"blocks": nn.ModuleList([nn.Linear(4, 6)]), "out": nn.Linear(6, 1)})
        return network, build_optimizer("muon", network, 0.01)

    def step(network: nn.Module, optimizer: torch.optim.Optimizer, seed: int) -> None:
        x = torch.randn(3, 4, generator=torch.Generator().manual_seed(seed))
        network["out"](network["blocks"][0](x).tanh()).square().sum().backward()  # type: ignore[index]
        optimizer.step()
        optimizer.zero_grad()

    straight = make()
    for seed in range(4):
        step(*straight, seed)
    first = make()
    for seed in range(2):
        step(*first, seed)
    second = make()
    second[0].load_state_dict(first[0].state_dict())
    second[1].load_state_dict(first[1].state_dict())
    for seed in range(2, 4):
        step(*second, seed)
    for a, b in zip(straight[0].parameters(), second[0].parameters(), strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("name", ["muon", "adamw"])
def test_a_text_encoder_has_a_share_of_the_learning_rate(name: str) -> None:
    network = nn.ModuleDict({"blocks": nn.Linear(4, 4), "text_encoder": nn.Linear(4, 4), "out": nn.Linear(4, 4)})
    optimizer = build_optimizer(name, network, 0.0, text_rate=0.1)
    rates = {id(p): group["rate"] for group in optimizer.param_groups for p in group["params"]}
    assert {key: rates[id(p)] for key, p in network.named_parameters() if key.endswith("bias")} == {
        "blocks.bias": 1.0,
        "text_encoder.bias": 0.1,
        "out.bias": 1.0,
    }
    assert len(rates) == 6


def test_an_unknown_optimizer_is_named() -> None:
    with pytest.raises(UnknownNameError, match="muon"):
        PretrainOptimizerSettings("mion")
