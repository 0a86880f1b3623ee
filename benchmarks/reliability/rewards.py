"""Trials of hostile rewards."""

from __future__ import annotations

import random
import tempfile
import time
from pathlib import Path

from benchmarks.reliability.figures import Figures


def hostile_rewards(count: int, seed: int = 0) -> Figures:
    """Rewards that exit, hang, crash, fill memory or talk; each must give invalid scenes and one sentence, in time."""
    from rewards import IsolatedReward, allow_local_rewards, evaluate_reward
    from scene_envs import SceneBatch

    bodies = (
        "import sys; sys.exit(0)", "import os; os._exit(0)", "import os; os._exit(7)", "import time; time.sleep(1e6)",
        "import ctypes; ctypes.string_at(0)", "x = bytearray(2**31)", "raise ValueError('x' * 2**20)", "return None",
        "return torch.full((len(batch),), float('nan'))", "batch.tensor.numpy()[:] = 7; return batch.counts",
        "import os, signal; os.kill(os.getpid(), signal.SIGKILL)", "raise KeyboardInterrupt", "raise MemoryError",
        "def deep(n): return deep(n + 1)\n    return deep(0)",
        "import os; os.close(4); os.close(5); return batch.counts",
        "while True: pass",
    )  # fmt: skip
    rng, figures = random.Random(seed), Figures()
    batch = SceneBatch.empty("dimsum_table", 3)
    with tempfile.TemporaryDirectory() as place:
        for number in range(count):
            body = bodies[number % len(bodies)]
            at_import = rng.random() < 0.2 and "return" not in body and "batch" not in body
            path = Path(place) / f"mine_{number}.py"
            outside, inside = (body, "return batch.counts") if at_import else ("", body)
            path.write_text(f"import torch\n{outside}\ndef mine(batch):\n    {inside}\n")
            allow_local_rewards(path)
            figures.tried += 1
            started = time.monotonic()
            try:
                with IsolatedReward(f"{path}:mine", timeout=4, memory=0.5) as reward:
                    output = evaluate_reward(reward, batch)
                told, lost = output.problem, not bool(output.is_valid.any())
            except Exception as error:
                told, lost = str(error), True
            if not lost or (not told and "nan" not in body) or len(told) > 2000 or time.monotonic() - started > 60:
                figures.silent += 1
                figures.note(f"{body!r}{' at import' * at_import}: {told!r} in {time.monotonic() - started:.1f} s")
    return figures
