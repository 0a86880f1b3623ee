"""Rewards: scores of scenes, their registry and their contract.

A reward is any callable ``(SceneBatch, RewardContext) -> RewardOutput``. The same reward, named once, serves
reinforcement learning, search and evaluation.
"""

from rewards.base import Reward, RewardContext, RewardOutput, averages_objects, counts_objects, depends_on_batch
from rewards.category_count import CategoryCount
from rewards.clutter import Clutter
from rewards.composite import Clip, Gate, Product, WeightedSum
from rewards.contract import check_reward
from rewards.coverage import Coverage
from rewards.diversity import Diversity
from rewards.evaluation import evaluate_reward
from rewards.feasible_objects import FeasibleObjects
from rewards.feasible_share import FeasibleShare
from rewards.isolation import IsolatedReward
from rewards.learned import LearnedReward, learned_parts
from rewards.local_files import allow_local_rewards
from rewards.object_count import ObjectCount
from rewards.penetration import Penetration
from rewards.prompt_match import PromptMatch
from rewards.reachability import Reachability
from rewards.realism import Realism
from rewards.registry import (
    RewardInfo,
    allow_reward_targets,
    list_rewards,
    make_reward,
    register_reward,
    resolve_reward,
    reward_info,
    reward_label,
    reward_name,
)
from rewards.relation import Relation
from rewards.stability import Stability

__all__ = [
    "CategoryCount",
    "Clip",
    "Clutter",
    "Coverage",
    "Diversity",
    "FeasibleObjects",
    "FeasibleShare",
    "Gate",
    "IsolatedReward",
    "LearnedReward",
    "ObjectCount",
    "Penetration",
    "Product",
    "PromptMatch",
    "Reachability",
    "Realism",
    "Relation",
    "Reward",
    "RewardContext",
    "RewardInfo",
    "RewardOutput",
    "Stability",
    "WeightedSum",
    "allow_local_rewards",
    "allow_reward_targets",
    "averages_objects",
    "check_reward",
    "counts_objects",
    "depends_on_batch",
    "evaluate_reward",
    "learned_parts",
    "list_rewards",
    "make_reward",
    "register_reward",
    "resolve_reward",
    "reward_info",
    "reward_label",
    "reward_name",
]
