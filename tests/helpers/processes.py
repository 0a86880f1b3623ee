"""Runs of post-training on several processes of this machine."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Iterable
from typing import Any
from unittest.mock import patch

import torch
from torch import multiprocessing
from torch.nn.modules.module import register_module_forward_pre_hook

from agents.networks.geometry import RelationsConfig
from agents.post_training import PostTrainConfig, post_train
from agents.priors.testing import tiny_prior
from tests.helpers.small_runs import one_quick_classifier, scenes_drawn_once, with_modules

Run = tuple[PostTrainConfig, str, torch.dtype]
"""A configuration, the process of its prior (``continuous`` or ``mixed``), and the dtype of everything."""


def train(runs: Iterable[Run]) -> None:
    """Post-train untrained priors, which read prompts where a run has some.

    Nobody looks at the curves.
    """
    for config, process, dtype in runs:
        before = torch.get_default_dtype()
        torch.set_default_dtype(dtype)
        hook = register_module_forward_pre_hook(lambda module, inputs: tuple(map(_as_default, inputs)))
        try:
            with patch("matplotlib.figure.Figure.savefig"), one_quick_classifier(), scenes_drawn_once():
                prior = tiny_prior(process=process, text=config.prompt is not None)
                if config.algorithm.name == "refinement":
                    prior = with_modules(prior, RelationsConfig())
                post_train(config, prior=prior.to(dtype))
        finally:
            hook.remove()
            torch.set_default_dtype(before)


def _as_default(x: Any) -> Any:
    """Schedules are float32 constants, and a network reads one dtype."""
    return x.to(torch.get_default_dtype()) if isinstance(x, torch.Tensor) and x.is_floating_point() else x


def in_processes(function: Callable[..., None], *arguments: Any, count: int = 2) -> list[int]:
    """Call ``function`` in ``count`` processes that find each other as under ``torchrun``; returns their statuses.

    They begin as copies of this process, which has imported what a run needs.
    """
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free.getsockname()[1]), "WORLD_SIZE": str(count)}
    context = multiprocessing.get_context("fork")
    processes = [
        context.Process(target=_launched, args=({"RANK": str(rank), **address}, function, arguments))
        for rank in range(count)
    ]
    for process in processes:
        process.start()
    for process in processes:
        process.join(timeout=500)
        if process.exitcode is None:
            process.kill()
            process.join()
    return [process.exitcode for process in processes]


def _launched(environment: dict[str, str], function: Callable[..., None], arguments: tuple[Any, ...]) -> None:
    torch.set_num_threads(1)
    os.environ |= environment
    function(*arguments)
