"""A prior without a network: every free entry of its data is an independent Gaussian, so all is in closed form."""

from __future__ import annotations

import torch
from torch import Generator, Tensor

from agents.diffusion import GaussianStep, StepTable
from scene_envs.errors import InvalidInputError
from scene_envs.normalizer import Normalizer
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import SceneType, get_scene_type

T = 100


class ToyPrior:
    """x_0 ~ N(mean, std²) per entry; variance-preserving noise with alpha_bar(t) = (1 - t/T)².

    The denoiser E[x_0 | x_t] is linear, hence so is the whole chain.
    """

    conditional = False

    def __init__(self, scene_type: str | SceneType = "dimsum_table", mean: float = 0.2, std: float = 0.5) -> None:
        self.scene_type = get_scene_type(scene_type)
        self.data_mean, self.data_std = mean, std
        low, high = (torch.tensor(corner) for corner in self.scene_type.workspace)
        flags = self.scene_type.num_assets + 1
        self.normalizer = Normalizer.from_range(
            torch.cat([low, -torch.ones(9), torch.zeros(flags)]), torch.cat([high, torch.ones(9), torch.ones(flags)])
        )
        self.fixed = len(self.scene_type.fixed)
        self._known = self.normalizer.normalize(SceneBatch.empty(self.scene_type, 1, self.fixed).tensor)
        self.calls = 0

    def alpha_bar(self, t: int) -> float:
        return max((1.0 - t / T) ** 2, 1e-4) if t else 1.0

    def step_table(self, num_steps: int) -> StepTable:
        return StepTable.spaced(T, num_steps)

    def clamp(self, x: Tensor) -> Tensor:
        return torch.cat([self._known.to(x).expand(x.shape[0], -1, -1), x[:, self.fixed :]], dim=1)

    def initial(self, count: int, slots: int, generator: Generator | None = None) -> Tensor:
        return self.clamp(torch.randn(count, slots, self.scene_type.features, generator=generator))

    def linear_step(self, step: int, table: StepTable) -> tuple[float, float, float]:
        """(a, b, std) of the reverse step x_{t-1} = a x_t + b + std noise on free entries (Ho et al. 2020, Eq. 7)."""
        bar, bar_prev = (self.alpha_bar(int(v[step])) for v in (table.timesteps, table.previous))
        gain = bar**0.5 * self.data_std**2 / (bar * self.data_std**2 + 1 - bar)  # of E[x_0 | x_t]
        ratio = bar / bar_prev
        to_x0 = bar_prev**0.5 * (1 - ratio) / (1 - bar)
        to_xt = ratio**0.5 * (1 - bar_prev) / (1 - bar)
        shift = self.data_mean * (1 - gain * bar**0.5)
        return to_xt + to_x0 * gain, to_x0 * shift, ((1 - ratio) * (1 - bar_prev) / (1 - bar)) ** 0.5

    def posterior(self, x_t: Tensor, step: int, table: StepTable) -> tuple[Tensor, Tensor]:
        self.calls += 1
        a, b, std = self.linear_step(step, table)
        std_map = torch.full(x_t.shape[1:], std)
        std_map[: self.fixed] = 0.0
        return self.clamp(a * x_t + b), std_map

    def transition(self, x_t: Tensor, step: int, table: StepTable) -> GaussianStep:
        return GaussianStep(*self.posterior(x_t, step, table))

    def inpaint(
        self, batch: SceneBatch, mask: Tensor, *, num_steps: int, generators: list[Generator] | None = None
    ) -> SceneBatch:
        if generators is None or len(generators) != len(batch):
            raise InvalidInputError("the toy prior wants one generator per scene")
        table, shape = self.step_table(num_steps), batch.tensor.shape[1:]

        def noise() -> Tensor:
            return torch.stack([torch.randn(shape, generator=generator) for generator in generators])

        x = self.clamp(noise())
        for step in range(num_steps):
            mean, std = self.posterior(x, step, table)
            x = mean + std * noise()
        new = SceneBatch.from_tensor(self.clamp(x), self.scene_type, normalised=self.normalizer)
        return SceneBatch(torch.where(mask.unsqueeze(-1), new.tensor, batch.tensor), self.scene_type)
