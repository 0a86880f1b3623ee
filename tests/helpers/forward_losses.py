"""What tests of forward-process losses share."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Generator, Tensor

from agents.post_training.algorithms.forward_process import ForwardProcessLoss
from agents.priors.prior import ScenePrior


def minimum(loss, start: Tensor, steps: int = 400) -> Tensor:
    """The argument that minimises ``loss``, by L-BFGS."""
    x = start.clone().requires_grad_()
    optimizer = torch.optim.LBFGS(
        [x], max_iter=steps, tolerance_grad=1e-12, tolerance_change=1e-14, line_search_fn="strong_wolfe"
    )

    def closure() -> Tensor:
        optimizer.zero_grad()
        value = loss(x)
        value.backward()
        return value

    optimizer.step(closure)
    return x.detach()


def gradient(loss: ForwardProcessLoss, scenes: TensorDict) -> Tensor:
    loss.prior.zero_grad()
    loss.generator = Generator().manual_seed(3)
    loss(scenes)["loss_objective"].backward()
    return torch.cat([p.grad.flatten().double() for p in loss.prior.parameters() if p.grad is not None])


def own_scenes(prior: ScenePrior, **advantages: Tensor) -> TensorDict:
    return TensorDict({"scene": prior.encode(prior.sample(4, num_steps=3, seed=1)), **advantages}, [4])
