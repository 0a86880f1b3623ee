"""Weights of the training loss by timestep."""

from __future__ import annotations

import torch
from torch import Tensor

from agents.diffusion.gaussian import check_prediction
from agents.diffusion.schedules import NoiseSchedule
from scene_envs.errors import InvalidInputError, unknown_name

LOSS_WEIGHTINGS = ("none", "min_snr")
"""Weightings of the squared error by timestep; see :func:`loss_weights`."""

MIN_SNR_GAMMA = 5.0
"""Gamma of Hang et al. (2023), section 3.4: the largest signal-to-noise ratio in the weight."""


def check_weighting(kind: str, prediction: str) -> None:
    """Raise when ``kind`` is not a weighting, or does not go with ``prediction``.

    Raises:
        UnknownNameError: a name is not known.
        InvalidInputError: ``"min_snr"`` with ``"edm"`` prediction, whose target already weighs the levels.
    """
    if kind not in LOSS_WEIGHTINGS:
        raise unknown_name("loss weighting", kind, LOSS_WEIGHTINGS)
    check_prediction(prediction)
    if kind == "min_snr" and prediction == "edm":
        raise InvalidInputError(
            "loss_weighting='min_snr' does not go with prediction='edm', whose target has unit variance at every "
            "level already; use loss_weighting='none', or prediction 'epsilon', 'v' or 'x0'"
        )


def loss_weights(
    schedule: NoiseSchedule, t: Tensor, prediction: str, kind: str, gamma: float = MIN_SNR_GAMMA
) -> Tensor:
    """(B,) float32 weights of the mean squares of the network's error at timesteps ``t``.

    ``"none"`` is 1 everywhere. ``"min_snr"`` (Hang et al. 2023, Eq. 8) gives the error of the clean scene the weight
    min(SNR, gamma), SNR being alpha_t^2 / sigma_t^2. The squared error of the noise is SNR times that of the
    clean scene, and the squared error of v is SNR + 1 times that of the clean scene. So their weights are
    min(SNR, gamma) / SNR and min(SNR, gamma) / (SNR + 1).

    Args:
        schedule: noise schedule.
        t: (B,) int64 in 1..T.
        prediction: one of :data:`~agents.diffusion.gaussian.PREDICTIONS`.
        kind: one of :data:`LOSS_WEIGHTINGS`.
        gamma: largest signal-to-noise ratio in the weight.

    Raises:
        UnknownNameError, InvalidInputError: the errors of :func:`check_weighting`.

    >>> from agents.diffusion.schedules import make_schedule
    >>> loss_weights(make_schedule("linear"), torch.tensor([1, 1000]), "x0", "min_snr").tolist()[0]
    5.0
    """
    check_weighting(kind, prediction)
    if kind == "none":
        return torch.ones(t.shape, device=t.device)
    alpha_bar = schedule.alpha_bar[t.cpu()]
    snr = alpha_bar / (1.0 - alpha_bar)
    over = {"epsilon": snr, "v": snr + 1.0, "x0": torch.ones_like(snr)}[prediction]
    return (snr.clamp(max=gamma) / over).float().to(t.device)


def timestep_distribution(timesteps: str | None, prediction: str) -> str:
    """The distribution of training timesteps: the given one, or the one published with ``prediction``.

    >>> timestep_distribution(None, "epsilon"), timestep_distribution(None, "edm")
    ('uniform', 'lognormal')
    >>> timestep_distribution("lognormal", "v")
    'lognormal'
    """
    return timesteps or ("lognormal" if prediction == "edm" else "uniform")
