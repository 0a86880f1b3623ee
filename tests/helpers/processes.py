"""Runs of post-training on several processes of this machine."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import multiprocessing
from torch.nn.modules.module import register_module_forward_pre_hook

from agents.post_training import PostTrainConfig, post_train
from agents.priors.testing import tiny_prior

Run = tuple[PostTrainConfig, str, torch.dtype]
"""A configuration, the process of its prior (``continuous`` or ``mixed``), and the dtype of everything."""


def train(run: Run) -> None:
    """Post-train an untrained prior that reads prompts where the run has some."""
    config, process, dtype = run
    before = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    hook = register_module_forward_pre_hook(lambda module, inputs: tuple(_as_default(x) for x in inputs))
    try:
        post_train(config, prior=tiny_prior(process=process, text=config.prompt is not None).to(dtype))
    finally:
        hook.remove()
        torch.set_default_dtype(before)


def _as_default(x: Any) -> Any:
    """Schedules are float32 constants, and a network reads one dtype."""
    return x.to(torch.get_default_dtype()) if isinstance(x, torch.Tensor) and x.is_floating_point() else x


def train_all(runs: Sequence[Run]) -> None:
    """Several runs, one after the other."""
    for run in runs:
        train(run)


def in_processes(function: Callable[..., None], *arguments: Any, count: int = 2) -> None:
    """Call ``function`` in ``count`` processes that find each other as under ``torchrun``; raises what one raises."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    multiprocessing.spawn(_launched, (count, port, function, arguments), nprocs=count)


def _launched(rank: int, count: int, port: int, function: Callable[..., None], arguments: tuple[Any, ...]) -> None:
    torch.set_num_threads(1)
    address = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    os.environ |= {"RANK": str(rank), "LOCAL_RANK": str(rank), "WORLD_SIZE": str(count), **address}
    function(*arguments)
