"""The torchrl adapter of the denoising MDP: batched tensors in and out. Training samples through this one.

Training calls ``env.rollout``, not a torchrl ``Collector``. A collector resets the environment at the end of a batch,
so the first scenes of the next batch follow the seed of this one: a resumed run would draw others. With
``reset_at_each_iter=True`` its batches depend on their own seed alone, but it still hands no prompts to ``reset``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from gymnasium.utils import seeding
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from scene_envs.envs.denoising import DenoisingCore
from scene_envs.envs.settings import DenoisingSettings, takes
from scene_envs.envs.spaces import STATE_BOUND
from scene_envs.envs.trajectories import StepResult


class DenoisingTorchRLEnv(EnvBase):
    """B denoising episodes as a batch-locked torchrl environment; :class:`DenoisingEnv` describes them.

    Keys: ``scene`` (B, N, D) float32, ``timestep`` (B, 1) int64, ``object_mask`` (B, N) int8, ``valid`` (B, 1) bool
    (False where the reward could not score the finished scene, whose reward is then 0), ``prompt`` (B, L) int64 if the
    prior reads prompts, ``action`` (B, N, D), ``reward``, ``terminated``, ``truncated`` and ``done`` (B, 1). Everything
    lives on the prior's device.

    With the same seed, ``reset`` and ``step`` give bit for bit what ``DenoisingVectorEnv`` gives, and
    ``rollout(S, policy)`` gives B whole episodes as a TensorDict [B, S]. ``reset(prompts=...)`` takes one prompt per
    episode in place of drawn ones.

    Args:
        num_envs: B.
        **settings: fields of :class:`~scene_envs.envs.settings.DenoisingSettings`.

    Attributes:
        result: everything about the last step, such as the score of the scenes that it finished; None after a reset.

    >>> env = DenoisingTorchRLEnv(2, reward="object_count", num_steps=3)
    >>> env.rollout(3)["next", "terminated"].squeeze(-1).tolist()
    [[False, False, True], [False, False, True]]
    """

    @takes(DenoisingSettings)
    def __init__(self, num_envs: int = 1, **settings: Any) -> None:
        core = DenoisingCore(num_envs, **settings)
        super().__init__(device=core.device, batch_size=torch.Size([num_envs]))
        self.core = core
        self.result: StepResult | None = None
        self._rngs = [seeding.np_random()[0] for _ in range(num_envs)]
        self._make_specs()

    def _make_specs(self) -> None:
        core, batch, device = self.core, self.batch_size, self.device
        scene_shape = (*batch, core.slots, core.features)
        self.observation_spec = Composite(
            {
                "scene": Bounded(-STATE_BOUND, STATE_BOUND, scene_shape, device, torch.float32),
                "timestep": Bounded(0, core.first_timestep, (*batch, 1), device, torch.int64),
                "object_mask": Binary(core.slots, (*batch, core.slots), device, torch.int8),
                "valid": Binary(1, (*batch, 1), device, torch.bool),
            },
            shape=batch,
            device=device,
        )
        if core.prompting.space is not None:
            length, words = core.prompting.space
            self.observation_spec["prompt"] = Bounded(0, words - 1, (*batch, length), device, torch.int64)
        self.action_spec = Bounded(-core.max_action, core.max_action, scene_shape, device, torch.float32)
        self.reward_spec = Unbounded((*batch, 1), device, torch.float32)
        flag = Binary(1, (*batch, 1), device, torch.bool)
        self.done_spec = Composite(
            {"done": flag, "terminated": flag.clone(), "truncated": flag.clone()}, shape=batch, device=device
        )

    def _set_seed(self, seed: int | None) -> None:
        """Environment i gets the generator of ``seed + i``, as in the vector environment."""
        if seed is None:
            self._rngs = [seeding.np_random()[0] for _ in range(self.core.num_envs)]
        else:
            self._rngs = [seeding.np_random(int(seed) + i)[0] for i in range(self.core.num_envs)]

    def _reset(
        self, tensordict: TensorDictBase | None = None, prompts: Sequence[str] | None = None, **kwargs: Any
    ) -> TensorDictBase:
        flags = None if tensordict is None else tensordict.get("_reset", None)
        mask = None if flags is None else flags.reshape(self.core.num_envs).cpu().numpy()
        self.core.reset(self._rngs, mask, prompts)
        self.result = None
        return self._observe(None)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.result = self.core.step(tensordict["action"])
        observed = self._observe(self.result)
        observed["reward"] = self.result.reward.unsqueeze(-1)
        return observed

    def _observe(self, result: StepResult | None) -> TensorDict:
        finished = torch.from_numpy(self.core.finished).unsqueeze(-1).to(self.core.device)
        valid = torch.ones_like(finished) if result is None else result.valid.unsqueeze(-1)
        fields = {
            **self.core.observation(),
            "valid": valid,
            "done": finished,
            "terminated": finished.clone(),
            "truncated": torch.zeros_like(finished),
        }
        return TensorDict(fields, batch_size=self.batch_size, device=self.device)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Stop physics workers, if any."""
        self.core.close()
        if not self.is_closed:
            super().close(raise_if_closed=raise_if_closed)
