"""Rewards shown in the README and the documentation: conformance with the contract, as printed there."""

import re
from pathlib import Path

import pytest

from rewards import check_reward, make_reward, resolve_reward

ROOT = Path(__file__).parents[2]


def python_blocks(path: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", (ROOT / path).read_text(), re.DOTALL)


def test_the_readmes_reward_is_short_and_keeps_the_contract(cups):
    (block,) = [block for block in python_blocks("README.md") if "@register_reward" in block]
    assert len([line for line in block.splitlines() if line.strip()]) < 15
    definition = block.partition("env =")[0]
    exec(definition, {})
    check_reward("spread")
    assert make_reward("spread")(cups, None).value.tolist() == pytest.approx([0.2, 0.4])


def test_the_rewards_of_the_documentation_keep_the_contract():
    blocks = python_blocks("docs/rewards/README.md")
    for name in ("spread", "upright"):
        (block,) = [block for block in blocks if f'@register_reward("{name}")' in block]
        exec(block, {})
        check_reward(name)
    (mapping,) = [block for block in blocks if "weighted_sum" in block]
    resolve_reward(eval(mapping))
