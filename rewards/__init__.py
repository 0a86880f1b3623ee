"""Rewards: scores of scenes, their registry and their contract.

A reward is any callable ``(SceneBatch, RewardContext) -> RewardOutput``. The same reward, named once, serves
reinforcement learning, search and evaluation.
"""

from rewards.base import Reward, RewardContext, RewardOutput
from rewards.composite import Clip, Gate, Product, WeightedSum
from rewards.contract import check_reward
from rewards.evaluation import evaluate_reward
from rewards.feasible_objects import FeasibleObjects
from rewards.feasible_share import FeasibleShare
from rewards.object_count import ObjectCount
from rewards.prompt_match import PromptMatch
from rewards.registry import (
    RewardInfo,
    allow_reward_targets,
    list_rewards,
    make_reward,
    register_reward,
    resolve_reward,
    reward_info,
    reward_name,
)

__all__ = [
    "Clip",
    "FeasibleObjects",
    "FeasibleShare",
    "Gate",
    "ObjectCount",
    "Product",
    "PromptMatch",
    "Reward",
    "RewardContext",
    "RewardInfo",
    "RewardOutput",
    "WeightedSum",
    "allow_reward_targets",
    "check_reward",
    "evaluate_reward",
    "list_rewards",
    "make_reward",
    "register_reward",
    "resolve_reward",
    "reward_info",
    "reward_name",
]
