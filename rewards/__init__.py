"""Rewards: scores of scenes, their registry and their contract.

A reward is any callable ``(SceneBatch, RewardContext) -> RewardOutput``. The same reward, named once, serves
reinforcement learning, search and evaluation.
"""

from rewards.base import LearnedReward, Reward, RewardContext, RewardOutput, facts_of, learned_parts
from rewards.check import check_reward
from rewards.clearance import Clearance
from rewards.clutter import Clutter
from rewards.composite import Clip, Product, WeightedSum
from rewards.counts import CategoryCount, ObjectCount
from rewards.evaluation import evaluate_reward
from rewards.feasible import FeasibleObjects, FeasibleShare, Stability
from rewards.penetration import Penetration
from rewards.process import IsolatedReward
from rewards.prompt_match import PromptMatch
from rewards.reachability import Reachability
from rewards.registry import (
    RewardInfo,
    allow_local_rewards,
    allow_reward_targets,
    list_rewards,
    make_reward,
    register_reward,
    resolve_reward,
    reward_info,
    reward_label,
    reward_name,
)

__all__ = [
    "CategoryCount",
    "Clearance",
    "Clip",
    "Clutter",
    "FeasibleObjects",
    "FeasibleShare",
    "IsolatedReward",
    "LearnedReward",
    "ObjectCount",
    "Penetration",
    "Product",
    "PromptMatch",
    "Reachability",
    "Reward",
    "RewardContext",
    "RewardInfo",
    "RewardOutput",
    "Stability",
    "WeightedSum",
    "allow_local_rewards",
    "allow_reward_targets",
    "check_reward",
    "evaluate_reward",
    "facts_of",
    "learned_parts",
    "list_rewards",
    "make_reward",
    "register_reward",
    "resolve_reward",
    "reward_info",
    "reward_label",
    "reward_name",
]
