"""Denoisers: a network together with the diffusion process of a continuous prior, or the two of a mixed prior."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from agents.diffusion import CategoricalProcess, GaussianProcess
from agents.diffusion.gaussian import Moments
from agents.diffusion.reverse_steps import state_of
from agents.networks.text import Text, TextEncoder
from agents.networks.text_encoders import BertEncoder
from scene_envs.errors import InvalidInputError, unknown_name
from scene_envs.scene import POSE_FEATURES

_LOGGER = logging.getLogger(__name__)

PRECISIONS = ("float32", "tf32", "bfloat16")
"""Number formats of the products in the blocks of a network, while a chain is sampled."""
_FINE = 0.1
"""Noise-to-signal ratio up to which steps are always in float32: the error of a step is a share of its noise."""


def check_precision(name: str, device: torch.device) -> None:
    """Raise UnknownNameError for another name, and InvalidInputError for a precision that ``device`` lacks."""
    if name not in PRECISIONS:
        raise unknown_name("precision", name, PRECISIONS)
    recent = device.type == "cuda" and torch.cuda.get_device_capability(device) >= (8, 0)
    if name == "float32" or recent or (name == "bfloat16" and device.type == "cpu"):
        return
    raise InvalidInputError(
        f"precision={name!r} is not possible on device={str(device)!r}: tf32 needs an NVIDIA GPU of compute capability "
        "8.0 or higher, bfloat16 such a GPU or a CPU; use precision=float32"
    )


@contextmanager
def products_in(precision: str, like: Tensor) -> Iterator[None]:
    """The context in which products on the device of ``like`` are in ``precision``, one of :data:`PRECISIONS`."""
    if precision == "bfloat16":
        with torch.autocast(like.device.type, torch.bfloat16):
            yield
        return
    before = torch.get_float32_matmul_precision()
    if precision == "tf32":
        torch.set_float32_matmul_precision("high")
    try:
        yield
    finally:
        if precision == "tf32":
            torch.set_float32_matmul_precision(before)


# -- CUDA graphs ----------------------------------------------------------------------------------


_CAPTURED_AT = 3  # call of a layout that is captured: the first calls of a chain may be the only ones
_MAX_GRAPHS = 48  # layouts that are captured; calls of further ones launch their kernels one by one

Capture = Callable[[Callable[[], Any], Any], tuple[Callable[[], None], Any]]
"""``(call, pool) -> replay, outputs``: ``replay()`` repeats ``call`` on the same memory and fills ``outputs``."""


def capture_graph(call: Callable[[], Any], pool: Any) -> tuple[Callable[[], None], Any]:
    """A CUDA graph of ``call``, with memory of ``pool``."""
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        for _ in range(2):
            call()
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph, pool=pool):
        outputs = call()
    return graph.replay, outputs


class Replays:
    """Calls of a network that are captured as CUDA graphs and replayed, one graph for each layout of the inputs.

    A chain calls the network with the same layout step by step; on a GPU, launching its several hundred kernels one by
    one takes longer than computing them. Weights are read where they lie, so training may go on between calls. Calls
    with gradients, and on other devices, are plain. If a network cannot be captured, or its graph gives other values,
    a warning says so once, and all its calls are plain from then on.

    Args:
        capture: makes the graph of a call.
        on: type of the devices whose calls are captured.
    """

    def __init__(self, capture: Capture = capture_graph, on: str = "cuda") -> None:
        self._capture, self._on = capture, on
        self._known: dict[Any, Any] = {}  # calls so far, or inputs, replay and outputs
        self._pool: Any = None
        self._fails = False

    def __reduce__(self) -> tuple[Any, ...]:
        return Replays, (self._capture, self._on)  # a copy captures its own network

    def run(self, network: nn.Module, *inputs: Tensor, **named: Tensor | None) -> Any:
        """``network(*inputs, **named)``: a tensor or a tuple of tensors."""
        if inputs[0].device.type != self._on or self._fails or torch.is_grad_enabled():
            return _plain(network, *inputs, **named)
        given = [*inputs, *named.values()]
        layout = tuple((value.shape, value.dtype) if isinstance(value, Tensor) else value for value in given)
        weights = tuple(weight.data_ptr() for weight in network.parameters())
        state = [getattr(network, name, "") for name in ("body_precision", "left_out")]
        key = tuple(named), layout, inputs[0].device, *state, weights
        if len(self._known) >= 4 * _MAX_GRAPHS and key not in self._known:  # of weights that were replaced
            self._known.clear()
        known = self._known.setdefault(key, 0)
        if isinstance(known, int):
            self._known[key] = known + 1
            captured = sum(not isinstance(entry, int) for entry in self._known.values())
            is_due = known + 1 >= _CAPTURED_AT and captured < _MAX_GRAPHS
            known = self._captured(network, inputs, named) if is_due else None
            if known is None:
                return _plain(network, *inputs, **named)
            self._known[key] = known
        kept, replay, outputs = known
        for place, value in zip(kept, given, strict=True):
            if isinstance(value, Tensor):
                place.copy_(value)
        replay()
        return _copied(outputs)

    def _captured(self, network: nn.Module, inputs: Sequence[Tensor], named: dict[str, Tensor | None]) -> Any:
        """Inputs, replay and outputs of a captured call; None if it cannot be captured."""
        own = [value.clone() for value in inputs]
        others = {name: None if value is None else value.clone() for name, value in named.items()}
        try:
            if self._pool is None and self._on == "cuda":
                self._pool = torch.cuda.graph_pool_handle()  # one memory for all graphs: no two run at once
            replay, outputs = self._capture(lambda: network(*own, **others), self._pool)
            replay()
            pair = [(value,) if isinstance(value, Tensor) else value for value in (outputs, network(*own, **others))]
            if not all(torch.allclose(a, b, 1e-2, 1e-3) for a, b in zip(*pair, strict=True)):
                raise RuntimeError("the graph gives other values than the network")
        except Exception as error:  # what an operation raises during a capture is up to it
            self._fails, name = True, type(network).__name__
            _LOGGER.warning(
                "%s cannot be captured as a CUDA graph, so its kernels are launched one by one: %s", name, error
            )
            return None
        return [*own, *others.values()], replay, outputs


def _plain(network: nn.Module, *inputs: Tensor, **named: Tensor | None) -> Any:
    """A call that is not captured; without gradients in inference mode, in which operations do less beside their work.

    The outputs are copied, so that they may be used where gradients are recorded.
    """
    if torch.is_grad_enabled():
        return network(*inputs, **named)
    with torch.inference_mode():
        outputs = network(*inputs, **named)
    return _copied(outputs)


def _copied(outputs: Any) -> Any:
    return outputs.clone() if isinstance(outputs, Tensor) else tuple(output.clone() for output in outputs)


def autocast(like: Tensor, precision: torch.dtype) -> torch.autocast:
    """The context in which a network runs in ``precision`` on the device of ``like``; does nothing for float32."""
    return torch.autocast(like.device.type, precision, enabled=precision != torch.float32)


class _Denoiser(nn.Module):
    """A network together with the process of its continuous numbers.

    Attributes:
        precision: number format of the network in training (``torch.bfloat16`` for autocast); the chain is always
            float32.
        chain_precision: number format of the blocks in a chain, see :meth:`ScenePrior.with_precision`.
    """

    def __init__(self, network: nn.Module, process: GaussianProcess) -> None:
        super().__init__()
        self.network = network
        self.process = process
        self.precision, self.chain_precision = torch.float32, "float32"
        self.replays = Replays()

    def noise_levels(self, t: Tensor | int, like: Tensor) -> Tensor:
        """(B,) noise-to-signal ratio of scenes ``like`` (B, N, D) at ``t``, and the network told what precision its
        blocks have there: that of chains at one noisy timestep.
        """
        network: Any = self.network
        if hasattr(network, "body_precision"):
            noisy = isinstance(t, int) and float(self.process.sigma[t]) > _FINE * float(self.process.alpha[t])
            network.body_precision = self.chain_precision if noisy else "float32"
        alpha, sigma = self.process.rates(t, like)
        ratio = sigma / alpha
        return ratio.reshape(t.shape) if isinstance(t, Tensor) else ratio.expand(len(like))


class Denoiser(_Denoiser):
    """x_t (B, N, D) and t (B,) to the denoised scene x_0 (B, N, D)."""

    def output(self, x_t: Tensor, t: Tensor | int) -> Tensor:
        """The raw network output (B, N, D), in the units of ``process.target``."""
        process = self.process
        alpha, _ = process.rates(t, x_t)
        inputs = process.network_input(x_t, t), x_t / alpha, self.noise_levels(t, x_t)
        with autocast(x_t, self.precision):
            results = [
                self.replays.run(self.network, *(value[rows] for value in inputs)) for rows in parts_of(*x_t.shape[:2])
            ]
        return torch.cat(results).to(x_t.dtype)

    def forward(self, x_t: Tensor, t: Tensor | int) -> Tensor:
        """The denoised scene x_0 (B, N, D), normalised; ``t`` (B,), or one timestep of all scenes."""
        return self.process.x0_from_output(x_t, t, self.output(x_t, t))


_PAIRS = 2**20
"""Pairs of slots that a network reads at once: features of more would not make a device faster, but fill its memory."""


def parts_of(count: int, slots: int) -> list[slice]:
    """Rows of the parts of ``count`` scenes that a network reads at once; one part where gradients are recorded."""
    parts = 1 if torch.is_grad_enabled() else min(count, -(-count * slots**2 // _PAIRS))
    bounds = [count * part // max(1, parts) for part in range(max(1, parts) + 1)]
    return [slice(*pair) for pair in pairwise(bounds)]


EMPTY_SLOTS = ("attended", "dropped")
"""Treatments of slots that are known to be empty."""

_CERTAIN = 30.0
"""Difference (nats) of the logit of a known category to those of the others."""


@dataclass(frozen=True)
class Observed:
    """Entries of scenes that are observed exactly: the network sees them without noise, chains keep them.

    Attributes:
        x: (B, N, D) scenes; only observed entries are read.
        pose: (B, N) bool.
        category: (B, N) bool.
    """

    x: Tensor
    pose: Tensor
    category: Tensor

    def rows(self, rows: slice) -> Observed:
        """The observed entries of some of the scenes."""
        return Observed(self.x[rows], self.pose[rows], self.category[rows])

    def flags(self) -> Tensor:
        """(B, N) int64 as the network reads them: 1 where the pose is observed, plus 2 where the category is."""
        return self.pose.long() + 2 * self.category.long()

    def entries(self, pose_width: int = POSE_FEATURES) -> Tensor:
        """(B, N, D) bool; the first ``pose_width`` numbers of a slot are its pose."""
        is_pose = torch.arange(self.x.shape[-1], device=self.x.device) < pose_width
        return torch.where(is_pose, self.pose[..., None], self.category[..., None])

    def write(self, x: Tensor) -> Tensor:
        """``x`` (B, N, D) with the observed entries in place."""
        return torch.where(self.entries(), self.x, x)


class MixedDenoiser(_Denoiser):
    """x_t (B, N, 12 + K) and t (B,) to the clean pose (B, N, 12) and logits of the clean category (B, N, K)."""

    def __init__(
        self,
        network: nn.Module,
        poses: GaussianProcess,
        categories: CategoricalProcess,
        text_encoder: TextEncoder | BertEncoder | None,
        empty_slots: str,
    ) -> None:
        super().__init__(network, poses)
        if empty_slots not in EMPTY_SLOTS:
            raise unknown_name("treatment of empty slots", empty_slots, EMPTY_SLOTS)
        self.drops_empty = empty_slots == "dropped"
        if self.drops_empty and not categories.only_absorbs:
            raise InvalidInputError(
                f"empty_slots='dropped' needs a kernel that only absorbs, not {categories.schedule.name!r}: "
                "a slot that is visibly empty must be empty; take kernel='early_absorbing'"
            )
        by_category = poses.preconditioning.by_category
        mean, std = (None, None) if by_category is None else by_category.given_state(categories)
        self._mean: Tensor | None
        self._std: Tensor | None
        self._certain: Tensor
        certain = _CERTAIN * (torch.eye(categories.categories + 1, categories.categories) - 1.0)
        self.register_buffer("_certain", certain, persistent=False)
        self.register_buffer("_mean", mean, persistent=False)
        self.register_buffer("_std", std, persistent=False)
        self.reads_log_noise = getattr(network.config, "time_input", "timestep") == "log_noise"
        self.text_encoder = text_encoder
        self.categories = categories

    @property
    def reads_estimate(self) -> bool:
        """Whether the network reads the denoised scene."""
        return getattr(self.network.config, "reads_estimate", False)

    def groups_by_number(self, text: Text) -> Tensor | None:
        """(B, K) int64 groups of categories by the numbers that ``text`` gives; None if the network has none."""
        grouped = getattr(self.network, "groups_by_number", None)
        return None if grouped is None else grouped(text[0])

    def moments(self, states: Tensor, t: Tensor) -> Moments | None:
        """Mean and std (B, N, 12) of clean poses, given their categories in ``states`` (B, N) at ``t`` (B,).

        None where the preconditioning does not tell categories apart.
        """
        if self._mean is None or self._std is None:
            return None
        return self._mean[t[:, None], states], self._std[t[:, None], states]

    def output(
        self, x_t: Tensor, t: Tensor | int, observed: Observed | None = None, text: Text | None = None,
        left_out: Collection[str] = (),
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        """The raw pose output, in the units of ``process.target``, and logits.

        Args:
            x_t: (B, N, 12 + K), observed entries in place.
            t: (B,) timesteps, or one of all scenes.
            observed: entries that carry no noise.
            text: (B, L, W) tokens and (B, L) their mask.
            left_out: names of modules that this call leaves out: ``refinement``, ``count_logits``.
        """
        pose, states = x_t[..., :POSE_FEATURES], state_of(x_t[..., POSE_FEATURES:])
        alpha, _ = self.process.rates(t, pose)
        ratio = self.noise_levels(t, x_t)
        level = ratio[:, None].expand(pose.shape[:2])
        scaled = self.process.network_input(pose, t)
        position = pose / alpha
        if observed is not None:
            exact = observed.pose[..., None]
            scaled = torch.where(
                exact, self.process.network_input(pose, torch.zeros_like(t) if isinstance(t, Tensor) else 0), scaled
            )
            position = torch.where(exact, pose, position)
            level = torch.where(observed.pose, torch.zeros_like(level), level)
        steps = t if isinstance(t, Tensor) else torch.full((len(pose),), t, device=pose.device)
        time = 250.0 * ratio.log() if self.reads_log_noise else (steps - 1).to(pose.dtype)
        self.network.left_out = frozenset(left_out)  # type: ignore[assignment]
        clean = self._affine(pose, states, t) if self.reads_estimate and "refinement" not in left_out else ()
        inputs = [scaled, states, position, level, *clean, *([] if observed is None else [observed.flags()])]
        if self.drops_empty:
            output, logits = self._on_present(inputs, time, text)
            certain = F.embedding(states, self._certain).to(logits)
            return output, torch.where((states < self.categories.categories)[..., None], certain, logits)
        results = []
        for rows in parts_of(*pose.shape[:2]):
            words = None if text is None else (text[0][rows], text[1][rows])
            results.append(self._run([value[rows] for value in inputs], time[rows], words))
        output, logits = (torch.cat(side) for side in zip(*results, strict=True))
        return output, logits

    def _run(
        self, inputs: Sequence[Tensor], time: Tensor, text: Text | None, slot_mask: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """The network on scaled poses, states, positions, noise levels, what :meth:`_affine` gives if a refinement
        reads it, and observed flags where there are any.
        """
        scaled, states, position, level, *flags = inputs
        tokens, mask = (None, None) if text is None else text
        extra = {} if slot_mask is None else {"slot_mask": slot_mask}
        if len(flags) > 1:
            extra["clean_offset"], extra["clean_scale"], *flags = flags
        with autocast(scaled, self.precision):
            output, logits = self.replays.run(
                self.network, scaled, states, time, text=tokens, text_mask=mask, position=position, noise_level=level,
                observed=flags[0] if flags else None, **extra,
            )  # fmt: skip
        return output.to(scaled.dtype), logits.to(scaled.dtype)

    def _on_present(self, inputs: Sequence[Tensor], time: Tensor, text: Text | None) -> tuple[Tensor, Tensor]:
        """The network on the slots that are not known to be empty; 0 on the others."""
        present = inputs[1] != self.categories.categories - 1

        def run(rows: Tensor, index: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
            words = None if text is None else (text[0][rows], text[1][rows])
            attended = mask | ~mask.any(dim=1, keepdim=True)  # a scene of padding alone attends to it, unused
            return self._run([x[rows[:, None], index] for x in inputs], time[rows], words, attended)

        return run_packed(present, run, (POSE_FEATURES, self.categories.categories))

    def forward(
        self, x_t: Tensor, t: Tensor | int, observed: Observed | None = None, text: Text | None = None,
        left_out: Collection[str] = (),
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        """The clean pose (B, N, 12), normalised, and the logits of the clean category (B, N, K)."""
        output, logits = self.output(x_t, t, observed, text, left_out)
        pose, states = x_t[..., :POSE_FEATURES], state_of(x_t[..., POSE_FEATURES:])
        return self._denoised(pose, states, t, output), logits

    @torch.no_grad()
    def _affine(self, pose: Tensor, states: Tensor, t: Tensor | int) -> tuple[Tensor, Tensor]:
        """Offset and scale (B, N, 12): offset + scale * pose output is the clean pose."""
        offset = self._denoised(pose, states, t, torch.zeros_like(pose))
        return offset, self._denoised(pose, states, t, torch.ones_like(pose)) - offset

    def _denoised(self, pose: Tensor, states: Tensor, t: Tensor | int, output: Tensor) -> Tensor:
        """The clean pose (B, N, 12) of noisy poses and states, from the pose output."""
        if isinstance(t, Tensor) or self._mean is None or self._std is None or self.process.prediction != "edm":
            moments = self.moments(states, t) if isinstance(t, Tensor) else None
            return self.process.x0_from_output(pose, t, output, moments)
        of_states = self._mean[t], self._std[t]
        tables = self.process.once(
            t, pose, "states", lambda: (torch.stack(self.process.output_scaling(t, pose, of_states), 1),)
        )
        return self.process.x0_from_output(pose, t, output, None, tables[0][states].unbind(-2))


# -- packing: slots that are known to be empty are left out of a batch ----------------------------


_CHUNKS = 3
"""Parts of a batch on the CPU, each as wide as its fullest scene."""
_STRIDE = 4
"""On other devices, widths are multiples of this: few layouts, which :class:`Replays` captures."""


def pack(active: Tensor) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Parts of a batch: scenes with similar numbers of active slots, and which of their slots to keep.

    Args:
        active: (B, N) bool, slots that take part.

    Yields:
        rows (b,) int64 of the part, index (b, M) int64 of its slots with the active ones first, and mask (b, M) bool
        that is False on padding. Every scene is in one part. M is the largest number of active slots of a scene in the
        part, at least 1.
    """
    counts, on_cpu = active.sum(dim=1), active.device.type == "cpu"
    chunks = _CHUNKS if on_cpu and len(active) >= 4 * _CHUNKS else 1
    chunks = max(chunks, len(parts_of(len(active), max(1, int(counts.max())))))
    for rows in torch.argsort(counts, stable=True).tensor_split(chunks):
        width = max(1, int(counts[rows].max()))
        width = width if on_cpu else min(active.shape[1], -(-width // _STRIDE) * _STRIDE)
        index = torch.argsort(~active[rows], dim=1, stable=True)[:, :width]
        yield rows, index, active[rows].gather(1, index)


def run_packed(
    active: Tensor, run: Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]], widths: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """The two outputs of ``run`` on the active slots, (B, N, W) each, with zeros elsewhere.

    Args:
        active: (B, N) bool.
        run: function of rows, index and mask of :func:`pack` that gives two tensors (b, M, W).
        widths: W of the two outputs.
    """
    parts, order = [], []
    for rows, index, mask in pack(active):
        values = torch.cat(run(rows, index, mask), dim=-1).mul_(mask[..., None])
        blank = values.new_zeros(len(values), active.shape[1], sum(widths))
        parts.append(blank.scatter_(1, index[..., None].expand_as(values), values))
        order.append(rows)
    first, second = torch.cat(parts)[torch.argsort(torch.cat(order))].split(widths, dim=-1)
    return first, second
