"""Flow matching in one file: a process that takes the place of the Karras-preconditioned one in a mixed prior.

    python examples/flow_matching.py pretrain data=data/dimsum_table output=runs/flow
    python examples/flow_matching.py sample prior=runs/flow count=16
    python examples/flow_matching.py post-train prior=runs/flow algorithm=ddpo_sf reward=feasible_share

The first command has the keys of ``scene-envs pretrain`` and ``shift``; all others are those of ``scene-envs``, for
which this file makes the process known. Rectified flow (Liu et al. 2022; Lipman et al. 2022) puts a noised pose on the
straight line z_t = (1 - t) x_0 + t eps, and the network predicts the velocity eps - x_0. Categories are masked and
drawn as in every mixed prior, so that the process of the poses alone differs.

How the line fits the chain of the package:
 1. x_t = z_t / sqrt((1 - t)^2 + t^2) is a variance-preserving process of noise-to-signal ratio t / (1 - t). Chains,
    policies and guidance hold x_t; the network reads z_t = x_t / (alpha_t + sigma_t).
 2. The levels are evenly spaced in t, and ``noise_floor`` and ``noise_ceiling`` give the first and the last ratio.
    ``shift`` moves them, t -> shift t / (1 + (shift - 1) t) (Esser et al. 2024, Eq. 23): below 1 to lower noise.
 3. A deterministic step (``eta=0``) is an Euler step of dz / dt = v: both join the denoised scene to the predicted
    noise, and x_t differs from z_t by a factor only.
 4. A stochastic step is normal with known mean and deviation, so its log-probability is exact. To first order in its
    length it is Flow-GRPO's Euler step of noise level a = sqrt(2) eta (Liu et al. 2025, Eq. 9): a = 0.7, the default
    there, is eta = 0.5, and eta = 1, with which policies sample, is a = 1.41. The coefficients of the steps here keep
    the marginal distributions at any length (as those of Wang and Yu 2025 do), where the Euler step adds noise.
 5. ``loss.timesteps=lognormal`` draws logit(t) from a normal of ``loss.noise`` (logit-normal, Esser et al. 2024, Eq.
    19), ``uniform`` draws t evenly. Other keys of the target (prediction, schedule, weighting, moments) have no effect.

On Dimsum Table, at equal steps of training and sampling, heights are less exact than those of the Karras-preconditioned
process; with ``shift=0.2`` they are equal, objects are more often feasible, and their number is less exact
(docs/processes.md). One short training of each does not carry a new default, so this is an example.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from agents.cli.main import main as scene_envs
from agents.cli.main import main_of
from agents.cli.run_folder import Run
from agents.configuration.composition import composed
from agents.diffusion import GaussianProcess, Preconditioning
from agents.diffusion.gaussian import Moments, NoiseSchedule, timestep_weights
from agents.networks.denoisers import MixedDenoiser
from agents.pretraining.initial_prior import prepare
from agents.pretraining.settings import PretrainConfig
from agents.pretraining.trainer import Pretrainer
from agents.priors.config import MixedPriorConfig
from agents.priors.mixed import MixedPrior
from agents.priors.prior import ScenePrior
from scene_envs.errors import InvalidInputError, Positive


def flow_schedule(num_timesteps: int, floor: float, ceiling: float, shift: float = 1.0) -> NoiseSchedule:
    """Levels of the straight line, evenly spaced in t but for ``shift``, as signal rates of x_t.

    Args:
        num_timesteps: number T of levels, at least 2.
        floor: noise-to-signal ratio t / (1 - t) of the first level.
        ceiling: noise-to-signal ratio of the last level.
        shift: factor by which the ratios between the two are multiplied before the range is fitted to them again.

    >>> flow_schedule(3, 0.25, 4.0).noise_to_signal.float()
    tensor([0.0000, 0.2500, 1.0000, 4.0000])
    """
    if num_timesteps < 2 or not 0.0 < floor < ceiling or shift <= 0.0:
        raise InvalidInputError(
            f"a flow of num_timesteps={num_timesteps}, noise from {floor:g} to {ceiling:g} and shift={shift:g} is not "
            "possible; it needs two levels or more, increasing positive noise and a positive shift"
        )
    first, last = (ratio / shift / (1.0 + ratio / shift) for ratio in (floor, ceiling))
    t = torch.linspace(first, last, num_timesteps, dtype=torch.float64)
    ratio = torch.cat([torch.zeros(1, dtype=torch.float64), shift * t / (1.0 - t)])
    return NoiseSchedule("flow", 1.0 / (1.0 + ratio.square()))


class FlowProcess(GaussianProcess):
    """Straight lines from data to noise, z_t = (1 - t) x_0 + t eps with t = sigma_t / (alpha_t + sigma_t).

    Tensors x_t are z_t / sqrt((1 - t)^2 + t^2); their reverse steps are those of every variance-preserving process.

    Args:
        schedule: levels, as :func:`flow_schedule` gives them.
        preconditioning: moments of the data; only the guidance of a prior without a measured error reads them.

    >>> process = FlowProcess(flow_schedule(3, 0.25, 4.0), Preconditioning(torch.zeros(1), torch.ones(1)))
    >>> x0, noise, t = torch.full((1, 1, 1), 3.0), torch.full((1, 1, 1), -1.0), torch.tensor([2])
    >>> x_t = process.add_noise(x0, t, noise)
    >>> torch.cat([process.network_input(x_t, t), process.target(x0, x_t, t, noise)]).flatten()  # at t = 1/2
    tensor([ 1.0000, -4.0000])
    """

    def __init__(self, schedule: NoiseSchedule, preconditioning: Preconditioning) -> None:
        super().__init__(schedule, "v", preconditioning)  # the target below takes the place of that v

    def network_input(self, x_t: Tensor, t: Tensor | int) -> Tensor:
        """z_t, the noised scene on the straight line."""
        alpha, sigma = self.rates(t, x_t)
        return x_t / (alpha + sigma)

    def x0_from_output(
        self, x_t: Tensor, t: Tensor | int, output: Tensor, moments: Moments | None = None,
        scaling: tuple[Tensor, ...] | None = None,
    ) -> Tensor:  # fmt: skip
        """The denoised scene z_t - t v that follows from a velocity; moments and scaling are not read."""
        alpha, sigma = self.rates(t, x_t)
        return (x_t - sigma * output) / (alpha + sigma)

    def target(self, x0: Tensor, x_t: Tensor, t: Tensor, noise: Tensor, moments: Moments | None = None) -> Tensor:
        """The velocity eps - x_0 of the line."""
        return noise - x0


@dataclass(frozen=True)
class FlowPriorConfig(MixedPriorConfig):
    """Configuration of a flow prior: that of a mixed prior, whose prediction and schedule are not read.

    Attributes:
        shift: shift of the levels, see :func:`flow_schedule`.
    """

    shift: float = 1.0


class FlowPrior(MixedPrior):
    """A mixed prior whose poses flow along straight lines.

    >>> from agents.priors.testing import tiny_prior
    >>> prior = FlowPrior.like(tiny_prior("dimsum_table", process="mixed"))
    >>> prior.sample(2, num_steps=3, seed=0, eta=0.0)
    SceneBatch('dimsum_table', (2, 34, 20))
    """

    process_name = "flow"
    config_type = FlowPriorConfig
    config: FlowPriorConfig

    @classmethod
    def like(cls, prior: ScenePrior, shift: float = 1.0) -> FlowPrior:
        """A flow prior with the network, weights, normaliser and settings of a mixed prior, which is to be trained.

        Of a flow prior, it is the same prior with other levels; its measured error, which is by level, is left out.
        """
        if not isinstance(prior, MixedPrior):
            raise InvalidInputError(f"a flow prior is made from a mixed prior, not {prior.process_name!r}")
        config = FlowPriorConfig(**{**vars(prior.config), "shift": shift})
        flow = cls(config, prior.normalizer, prior.preconditioning)
        flow.load_weights(prior.weights())
        return flow

    @classmethod
    def config_from_state(cls, fields: dict[str, Any]) -> FlowPriorConfig:
        """Inverse of :meth:`config_state`; the network is one of mixed priors."""
        rest = {name: value for name, value in fields.items() if name != "shift"}
        return FlowPriorConfig(**vars(MixedPrior.config_from_state(rest)), shift=float(fields["shift"]))

    def _denoiser(self) -> MixedDenoiser:
        config = self.config
        schedule = flow_schedule(config.num_timesteps, config.noise_floor, config.noise_ceiling, config.shift)
        self.process = FlowProcess(schedule, self.preconditioning)
        self._timestep_weights = timestep_weights(config.timesteps, schedule, config.noise_mean, config.noise_std)
        return super()._denoiser()


@composed
@dataclass
class FlowPretrainConfig(PretrainConfig):
    """One pretraining run of a flow prior; keys that are not listed are those of ``scene-envs pretrain``.

    Attributes:
        shift: shift of the levels of noise, 1 for even spacing and below 1 for more steps at low noise.
    """

    shift: Positive = 1.0


def pretrain_flow(config: FlowPretrainConfig) -> ScenePrior:
    """Train a flow prior as ``config`` says; resumes a run found in ``config.output``."""
    prior, data, heldout = prepare(config)
    flow = prior if isinstance(prior, FlowPrior) else FlowPrior.like(prior, config.shift)
    return Pretrainer(config, data, heldout, flow).run()


def run(settings: FlowPretrainConfig, run: Run) -> None:
    """The command ``pretrain`` of this file."""
    prior = pretrain_flow(settings)
    run.write_metrics(prior.card)
    run.say(f"sample it: python {sys.argv[0]} sample prior={run.directory}")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status."""
    command, *words = sys.argv[1:] if argv is None else argv
    if command == "pretrain":
        return main_of("pretrain", "train a flow prior on a dataset", sys.modules[__name__], words)
    return scene_envs([command, *words])


if __name__ == "__main__":
    sys.exit(main())
