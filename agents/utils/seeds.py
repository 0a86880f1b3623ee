"""Seeds of independent random streams, derived from keys; a resumed run needs no state of a generator."""

from __future__ import annotations

import numpy as np
from torch import Generator


def derived_seed(*key: int) -> int:
    """A seed below 2^31 that depends on all numbers of ``key``, such as (seed, purpose, iteration); none is negative.

    >>> derived_seed(0, 1) != derived_seed(1, 0)
    True
    """
    return int(np.random.SeedSequence(key).generate_state(1)[0]) >> 1


def derived_generator(*key: int) -> Generator:
    """A CPU generator with a seed below 2^63 that depends on all numbers of ``key``, none of them negative."""
    return Generator().manual_seed(int(np.random.SeedSequence(key).generate_state(1, np.uint64)[0]) >> 1)
