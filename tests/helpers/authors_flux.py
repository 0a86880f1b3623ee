"""The mixed Flux model as its description says it, in plain float64 functions over the authors' tensor names."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from scene_envs.scene_types import get_scene_type

State = dict[str, Tensor]
DIMSUM = get_scene_type("dimsum_table")


def random_state(
    assets: int = 7,
    hidden: int = 24,
    heads: int = 3,
    width: int = 16,
    doubles: int = 2,
    singles: int = 2,
    text: int = 10,
) -> State:
    """Random tensors of every name and shape; without text there are no double blocks."""
    generator = torch.Generator().manual_seed(0)
    state: State = {}

    def linear(name: str, rows: int, columns: int) -> None:
        state[f"{name}.weight"] = 0.4 * torch.randn(rows, columns, generator=generator)
        state[f"{name}.bias"] = 0.2 * torch.randn(rows, generator=generator)

    def scales(name: str) -> None:
        for part in ("query_norm", "key_norm"):
            state[f"{name}.{part}.scale"] = 1.0 + 0.2 * torch.randn(hidden // heads, generator=generator)

    linear("continous_embedding.in_layer", width, 12)
    linear("continous_embedding.out_layer", width, width)
    state["object_model_emb.weight"] = torch.randn(assets + 2, width, generator=generator)
    linear("scene_in", hidden, width)
    linear("time_in.in_layer", hidden, 256)
    linear("time_in.out_layer", hidden, hidden)
    if text:
        linear("text_in", hidden, text)
        for i in range(doubles):
            for stream in ("scene", "text"):
                embedding = torch.randn(1, 1, hidden, generator=generator)
                state[f"double_blocks.{i}.{stream}_modality_embedding"] = embedding
            for s in ("x", "txt"):
                linear(f"double_blocks.{i}.{s}_modulation.lin", 6 * hidden, hidden)
                linear(f"double_blocks.{i}.{s}_qkv_linear", 3 * hidden, hidden)
                scales(f"double_blocks.{i}.{s}_qk_norm")
                linear(f"double_blocks.{i}.{s}_post_att_linear", hidden, hidden)
                linear(f"double_blocks.{i}.{s}_mlp.0", 4 * hidden, hidden)
                linear(f"double_blocks.{i}.{s}_mlp.2", hidden, 4 * hidden)
    for i in range(singles):
        linear(f"single_blocks.{i}.modulation.lin", 3 * hidden, hidden)
        linear(f"single_blocks.{i}.linear1", 7 * hidden, hidden)
        linear(f"single_blocks.{i}.linear2", hidden, 5 * hidden)
        scales(f"single_blocks.{i}.norm")
    linear("final_layer.adaLN_modulation.1", 2 * hidden, hidden)
    linear("final_layer.linear", width, hidden)
    linear("to_continous_out.in_layer", 12, width)
    linear("to_continous_out.out_layer", 12, 12)
    state["to_logits.0.weight"] = 1.0 + 0.2 * torch.randn(width, generator=generator)
    state["to_logits.0.bias"] = 0.2 * torch.randn(width, generator=generator)
    linear("to_logits.1", assets + 1, width)
    return state


def forward(state: State, pose: Tensor, category: Tensor, t: Tensor, text: Tensor | None) -> tuple[Tensor, Tensor]:
    """Noise on the pose (B, N, 12) and logits (B, N, C + 1), from t as the process counts it (0 to 999)."""
    s = {name: tensor.double() for name, tensor in state.items()}
    hidden = s["scene_in.weight"].shape[0]
    heads = hidden // s["single_blocks.0.norm.query_norm.scale"].shape[0]

    def linear(name: str, x: Tensor) -> Tensor:
        return x @ s[f"{name}.weight"].T + s[f"{name}.bias"]

    def silu(x: Tensor) -> Tensor:
        return x / (1 + torch.exp(-x))

    def gelu(x: Tensor) -> Tensor:
        return 0.5 * x * (1 + torch.tanh(math.sqrt(2 / math.pi) * (x + 0.044715 * x**3)))

    def norm(x: Tensor, eps: float) -> Tensor:
        centered = x - x.mean(-1, keepdim=True)
        return centered / (centered.square().mean(-1, keepdim=True) + eps).sqrt()

    def rms(x: Tensor, scale: Tensor) -> Tensor:
        return x / (x.square().mean(-1, keepdim=True) + 1e-6).sqrt() * scale

    def qkv(x: Tensor, name: str) -> tuple[Tensor, Tensor, Tensor]:
        q, k, v = x.reshape(*x.shape[:2], 3, heads, hidden // heads).permute(2, 0, 3, 1, 4)
        return rms(q, s[f"{name}.query_norm.scale"]), rms(k, s[f"{name}.key_norm.scale"]), v

    def attend(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
        weights = torch.softmax(q @ k.transpose(-1, -2) / math.sqrt(q.shape[-1]), dim=-1)
        return (weights @ v).permute(0, 2, 1, 3).flatten(-2)

    frequency = torch.exp(-math.log(10000.0) * torch.arange(128, dtype=torch.float64) / 128)
    angle = 1000.0 * t.double()[:, None] * frequency
    time = torch.cat([angle.cos(), angle.sin()], dim=-1)
    condition = linear("time_in.out_layer", silu(linear("time_in.in_layer", time)))
    tokens = linear("continous_embedding.out_layer", silu(linear("continous_embedding.in_layer", pose.double())))
    x = linear("scene_in", tokens + s["object_model_emb.weight"][category])
    count = 0
    if text is not None:
        words = linear("text_in", text.double())
        count = words.shape[1]
        for i in range(len({name.split(".")[1] for name in s if name.startswith("double_blocks")})):
            block = f"double_blocks.{i}"
            streams = {
                "txt": words + s[f"{block}.text_modality_embedding"],
                "x": x + s[f"{block}.scene_modality_embedding"],
            }
            rates = {
                n: linear(f"{block}.{n}_modulation.lin", silu(condition))[:, None].chunk(6, dim=-1) for n in streams
            }
            parts = []
            for n, stream in streams.items():
                modulated = (1 + rates[n][1]) * norm(stream, 1e-6) + rates[n][0]
                parts.append(qkv(linear(f"{block}.{n}_qkv_linear", modulated), f"{block}.{n}_qk_norm"))
            attended = attend(*(torch.cat([first, second], dim=2) for first, second in zip(*parts, strict=True)))
            results = {"txt": attended[:, :count], "x": attended[:, count:]}
            for n in streams:
                stream = streams[n] + rates[n][2] * linear(f"{block}.{n}_post_att_linear", results[n])
                inner = (1 + rates[n][4]) * norm(stream, 1e-6) + rates[n][3]
                inner = linear(f"{block}.{n}_mlp.2", gelu(linear(f"{block}.{n}_mlp.0", inner)))
                streams[n] = stream + rates[n][5] * inner
            words, x = streams["txt"], streams["x"]
        x = torch.cat([words, x], dim=1)
    for i in range(len({name.split(".")[1] for name in s if name.startswith("single_blocks")})):
        block = f"single_blocks.{i}"
        shift, scale, gate = linear(f"{block}.modulation.lin", silu(condition))[:, None].chunk(3, dim=-1)
        both = linear(f"{block}.linear1", (1 + scale) * norm(x, 1e-6) + shift)
        attended = attend(*qkv(both[..., : 3 * hidden], f"{block}.norm"))
        x = x + gate * linear(f"{block}.linear2", torch.cat([attended, gelu(both[..., 3 * hidden :])], dim=-1))
    shift, scale = linear("final_layer.adaLN_modulation.1", silu(condition))[:, None].chunk(2, dim=-1)
    out = linear("final_layer.linear", (1 + scale) * norm(x[:, count:], 1e-6) + shift)
    noise = linear("to_continous_out.out_layer", silu(linear("to_continous_out.in_layer", out)))
    logits = linear("to_logits.1", norm(out, 1e-5) * s["to_logits.0.weight"] + s["to_logits.0.bias"])
    return noise, logits


def _normalizer(features: int, kind: Callable[[list[float]], Any] = list) -> dict[str, object]:
    """The normaliser; a checkpoint has tensors in it, and the metadata lists."""
    return {
        "params": {
            "scale": kind([2.0] * features),
            "min": kind([0.0] * features),
            "input_stats": {"min": kind([-0.5] * features), "max": kind([0.5] * features)},
        },
        "is_fitted": True,
    }


def write_checkpoint(
    folder: Path, state: dict[str, torch.Tensor], *, order: list[str] | None = None, **extra: object
) -> tuple[Path, Path]:
    """A checkpoint of ``state`` and the metadata of its dataset, written into ``folder``."""
    names = order or list(DIMSUM.assets)
    metadata = {
        "model_paths": [f"package://some/models/{name}.sdf" for name in names],
        "normalizer_state": _normalizer(13 + len(names)),
        "welded_object_model_paths": ["package://some/models/cafe_table.sdf"],
        "max_num_objects_per_scene": 34,
    }
    (folder / "metadata.json").write_text(json.dumps(metadata))
    content = {
        "state_dict": {f"model.{name}": 0.0 * tensor for name, tensor in state.items()}
        | {f"ema.averaged_model.{name}": tensor for name, tensor in state.items()}
        | {"ema.optimization_step": torch.tensor(7), "txt_encoder.weight": torch.zeros(2)},
        "normalizer_state": _normalizer(12, torch.tensor),
        "global_step": 1234,
        "optimizer_states": [{"state": {}}],
        **extra,
    }
    torch.save(content, folder / "mixed.ckpt")
    return folder / "mixed.ckpt", folder / "metadata.json"
