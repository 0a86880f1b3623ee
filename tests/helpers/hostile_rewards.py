"""Rewards that harm the process they run in, as a user's file."""

import ctypes
import os
import random
import sys
import time

import numpy as np
import torch

DRAWN = random.random() + float(np.random.rand()) + float(torch.rand(()))  # noqa: NPY002


class Unspeakable(Exception):
    """An error whose text cannot be read."""

    def __str__(self):
        raise RuntimeError("no text")


def honest(batch):
    return batch.translations[..., 2].sum(dim=-1) / 3.0 + batch.counts.sqrt()


def noisy(batch):
    numpy_part = torch.from_numpy(np.random.rand(len(batch))).float()  # noqa: NPY002
    return torch.rand(len(batch)) + numpy_part + random.random()


def leaves(batch):
    sys.exit(0)


def quits(batch):
    os._exit(0)


def hangs(batch):
    time.sleep(1e6)


def holds_the_interpreter(batch):
    ctypes.PyDLL(None).sleep(100000)  # in C, with the interpreter's lock


def segfaults(batch):
    ctypes.string_at(0)


def fills_memory(batch):
    kept = []
    while True:
        kept.append(torch.ones(32 * 2**20))


def talks(batch):
    raise ValueError("x" * 2**20)


def mumbles(batch):
    raise Unspeakable


def rewrites(batch):
    batch.tensor.numpy()[0, 0, 0] += 1.0
    return batch.counts


def shrinks(batch):
    batch.tensor.resize_(0)
    return torch.ones(2)


def has_few(batch):
    return batch.counts.float().to_sparse()


def complex_numbers(batch):
    return torch.ones(len(batch), dtype=torch.complex64)


class Unnamed(type):
    """A class whose name cannot be read."""

    @property
    def __name__(cls):
        raise RuntimeError("no name")


class Nameless(Exception, metaclass=Unnamed):
    """An error whose type cannot be named."""


def nameless(batch):
    raise Nameless("x")


class DrawsWhenMade:
    """A reward whose weight is random, as is that of its file."""

    def __init__(self):
        self.weight = DRAWN + random.random() + float(np.random.rand()) + float(torch.rand(()))  # noqa: NPY002

    def __call__(self, batch, context):
        return torch.full((len(batch),), self.weight)


def forks(batch):
    os.fork()
    return honest(batch)


def writes_into_pipes(batch):
    os.write(int(sys.argv[2]), b"\0\0\0\7garbage")  # the pipe of the worker's answers
    return batch.counts


def closes_pipes(batch):
    os.closerange(int(sys.argv[1]), int(sys.argv[2]) + 1)  # both pipes of the worker


def closes_pipes_and_works(batch):
    closes_pipes(batch)
    time.sleep(0.5)


def closes_pipes_and_hangs(batch):
    closes_pipes(batch)
    time.sleep(3600)


def named(batch, context):
    """The reward of this file whose name is the first prompt."""
    return globals()[context.prompts[0]](batch)
