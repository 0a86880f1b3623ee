"""Import of the mixed Flux checkpoints of the paper's authors (PyTorch Lightning).

Of a checkpoint, only tensors, numbers, strings and containers are read. Every other object in the file becomes an inert
placeholder, so nothing in it is run.
"""

from __future__ import annotations

import logging
import os
import pickle
import re
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import torch
from torch import Tensor

from agents.diffusion import Preconditioning
from agents.networks.flux import MixedFluxConfig
from agents.networks.text_encoders import BERT_BASE, BertTextConfig
from agents.priors.config import MixedPriorConfig
from agents.priors.mixed import MixedPrior
from scene_envs.datasets import DatasetInfo, read_metadata
from scene_envs.errors import CorruptFileError, InvalidInputError, MissingDependencyError
from scene_envs.files import page_values
from scene_envs.normalizer import Normalizer
from scene_envs.scene import POSE_FEATURES
from scene_envs.scene_types import Camera, SceneType, get_scene_type, register_scene_type

_LOGGER = logging.getLogger(__name__)

_AVERAGED, _RAW = "ema.averaged_model.", "model."
_IGNORED = ("txt_encoder.", "discrete_diffusion.", "ema.optimization_step")


def import_checkpoint(
    file: str | os.PathLike[str],
    metadata: str | os.PathLike[str],
    *,
    scene: str | SceneType | None = None,
    aliases: Mapping[str, str] | None = None,
    text_encoder: str = "",
) -> MixedPrior:
    """A prior from a Lightning checkpoint of the authors' mixed Flux model and the ``metadata.json`` of its data.

    Averaged weights are preferred to raw ones, and the normalizer in the checkpoint to the one in the metadata.

    Args:
        file: the ``.ckpt``.
        metadata: the ``metadata.json``.
        scene: scene type of the prior; its assets are matched with the model paths by name. None makes a scene type
            from the metadata, whose assets have names but no geometry: its scenes can be sampled, without physics.
        aliases: asset names, by model path or by its stem.
        text_encoder: folder or hub name of the BERT that the checkpoint reads prompts with. Empty takes BERT-base if it
            can be loaded without a download. Otherwise a checkpoint with text becomes a prior without prompts, and a
            warning says so.

    Raises:
        MissingDependencyError: ``text_encoder`` is named and ``transformers`` is not installed.
        InvalidInputError: no such file; no such text encoder, or not one of the checkpoint's width; or checkpoint,
            metadata and scene type differ in their number of assets.
        UnknownNameError: a model path that is no asset of ``scene``.
        CorruptFileError: not such a checkpoint; missing, extra and misshapen tensors are named.
    """
    checkpoint = read_lightning(file)
    info = read_metadata(Path(metadata))
    tensors = rename(checkpoint["state_dict"], file)
    config = sizes(tensors, file)
    scene_type = _scene_type_of(info, Path(file).stem) if scene is None else get_scene_type(scene)
    numbers = {config.categories - 1, len(info.model_paths), scene_type.num_assets}
    if len(numbers) > 1:
        raise InvalidInputError(
            f"the checkpoint {str(file)!r} knows {config.categories - 1} assets, {str(metadata)!r} lists "
            f"{len(info.model_paths)}, the scene type {scene_type.name!r} has {scene_type.num_assets}; they must agree"
        )
    _reorder(tensors, info.categories_in(scene_type, aliases))
    state = checkpoint.get("normalizer_state")
    normalizer = Normalizer.from_state(state) if isinstance(state, dict) else info.normalizer
    prior_config = MixedPriorConfig(
        scene_type.name,
        info.slots or scene_type.slots,
        config,
        schedule="linear",
        prediction="epsilon",
        category_loss="bound",
        category_weight=1.0,
        text=_bert_of(config.text_width, text_encoder, file),
        observed_share=0.0,
        clip=1.0,
    )
    moments = Preconditioning(torch.zeros(POSE_FEATURES), torch.ones(POSE_FEATURES))
    card = {"imported_from": Path(file).name, "trained_steps": int(checkpoint.get("global_step", 0))}
    prior = MixedPrior(prior_config, _with_categories(normalizer, scene_type), moments, card)
    _fill(prior.denoiser.network, tensors, file)
    return prior.eval()


def _bert_of(width: int, name: str, file: str | os.PathLike[str]) -> BertTextConfig | None:
    """The BERT for text tokens of a ``width``, as :func:`import_checkpoint` chooses it; None for no prompts."""
    if not width:
        if name:
            raise InvalidInputError(f"{str(file)!r} was trained without text; leave text_encoder={name!r} out")
        return None
    try:
        config = BertTextConfig.from_model(name or BERT_BASE, download=bool(name))
        if config.width != width:
            raise InvalidInputError(
                f"{str(file)!r} reads text tokens of width {width}, and those of {config.model!r} have {config.width}"
            )
    except (MissingDependencyError, InvalidInputError) as error:
        if name:
            raise
        _LOGGER.warning(
            "%s reads prompts with BERT, and here it is imported without prompts: %s. Import it again with "
            "text_encoder=FOLDER for prompts",
            file,
            error,
        )
        return None
    return config


def _scene_type_of(info: DatasetInfo, name: str) -> SceneType:
    """A scene type from metadata alone, registered as ``name``; its workspace is the normalizer's, seen from above."""
    low, high = (tuple(float(v) for v in bound[:3]) for bound in (info.normalizer.input_min, info.normalizer.input_max))
    stems = dict(zip(info.model_paths, info.stems, strict=True))
    welded = tuple(stems[path] for path in info.welded_model_paths if path in stems)
    center = ((low[0] + high[0]) / 2, (low[1] + high[1]) / 2)
    distance = high[2] + 1.5 * max(high[0] - low[0], high[1] - low[1], 0.5)
    return register_scene_type(
        SceneType(
            name=name,
            assets=info.stems,
            slots=info.slots or 32,
            workspace=((low[0], low[1], low[2]), (high[0], high[1], high[2])),
            welded=welded,
            fixed=(),
            camera=Camera((*center, distance), (*center, low[2]), (-1.0, 0.0, 0.0)),
            description=f"Made from {info.path.name}.",
        )
    )


def _reorder(tensors: dict[str, Tensor], order: Tensor) -> None:
    """Move category c of the file to ``order[c]``; the mask token stays last."""
    if order.sort().values.tolist() != list(range(len(order))):
        raise InvalidInputError(
            f"aliases: the categories of the file become {order.tolist()}; each asset of the scene type must have one "
            "model path, and each model path its own asset"
        )
    rows = order.argsort()
    tensors["category_in.weight"] = tensors["category_in.weight"][torch.cat([rows, torch.tensor([len(order)])])]
    for name in ("logits_out.1.weight", "logits_out.1.bias"):
        if name in tensors:
            tensors[name] = tensors[name][rows]


def rename(state: Mapping[str, Any], file: str | os.PathLike[str]) -> dict[str, Tensor]:
    """Tensors under the names of this package; raises CorruptFileError that names tensors of another model."""
    prefix = _AVERAGED if any(name.startswith(_AVERAGED) for name in state) else _RAW
    tensors: dict[str, Tensor] = {}
    extra: list[str] = []
    for name, value in state.items():
        if not name.startswith(prefix):
            if not name.startswith((_RAW, _AVERAGED, *_IGNORED)):
                extra.append(name)
            continue
        ours = _our_name(name.removeprefix(prefix))
        if ours is None or not isinstance(value, Tensor):
            extra.append(name)
        else:
            tensors[ours] = value
    if extra or not tensors:
        what = f"tensors that the mixed Flux model does not have: {_list(extra)}" if extra else "no weights of a model"
        raise CorruptFileError(f"{str(file)!r} holds {what}; only the mixed Flux model of the paper can be imported")
    return tensors


def sizes(tensors: Mapping[str, Tensor], file: str | os.PathLike[str]) -> MixedFluxConfig:
    """The size of the network, read from its tensors; a CorruptFileError if one of them is missing."""
    try:
        hidden, width = tensors["scene_in.weight"].shape
        head = tensors["single_blocks.0.query_norm.weight"].shape[0]
        mlp = tensors["single_blocks.0.linear2.weight"].shape[1] - hidden
        return MixedFluxConfig(
            categories=tensors["logits_out.1.weight"].shape[0],
            hidden=hidden,
            double_blocks=_count(tensors, "double_blocks"),
            single_blocks=_count(tensors, "single_blocks"),
            heads=hidden // head,
            mlp_ratio=mlp / hidden,
            embedding=width,
            pose_head=tensors["pose_out.0.weight"].shape[0],
            text_width=tensors["text_in.weight"].shape[1] if "text_in.weight" in tensors else 0,
            time_scale=1000.0,
        )
    except (KeyError, ValueError, IndexError) as error:
        raise CorruptFileError(f"{str(file)!r} lacks tensors of the mixed Flux model: {error}") from error


def _fill(network: torch.nn.Module, tensors: dict[str, Tensor], file: str | os.PathLike[str]) -> None:
    expected = network.state_dict()
    for name in expected:
        if name.endswith(".bias") and name not in tensors:
            tensors[name] = torch.zeros_like(expected[name])
            _LOGGER.info("%s has no %s; zeros take its place", file, name)
    missing = [name for name in expected if name not in tensors]
    extra = [name for name in tensors if name not in expected]
    shapes = [
        f"{name} {tuple(tensors[name].shape)} instead of {tuple(expected[name].shape)}"
        for name in expected
        if name in tensors and tensors[name].shape != expected[name].shape
    ]
    if missing or extra or shapes:
        found = {"missing": missing, "extra": extra, "of another shape": shapes}
        parts = [f"{what}: {_list(names)}" for what, names in found.items() if names]
        raise CorruptFileError(f"{str(file)!r} does not fit the mixed Flux model (our names); {'; '.join(parts)}")
    network.load_state_dict({name: tensor.float() for name, tensor in tensors.items()})


def _our_name(name: str) -> str | None:
    """The name in this package of a tensor in the authors' checkpoints; None for one of another model."""
    for pattern, replacement in page_values("agents.priors", "checkpoint_names.yaml").items():
        ours, count = re.subn(f"^{pattern}", replacement, name)
        if count:
            return ours.replace("<x>", "scene").replace("<txt>", "text")
    return None


def _count(tensors: Mapping[str, Tensor], prefix: str) -> int:
    return len({name.split(".")[1] for name in tensors if name.startswith(f"{prefix}.")})


def _list(names: list[str]) -> str:
    shown = ", ".join(names[:8])
    return shown if len(names) <= 8 else f"{shown} and {len(names) - 8} more"


def _with_categories(normalizer: Normalizer, scene: SceneType) -> Normalizer:
    """The normalizer over all D features; the imported one covers poses, and may cover one-hots as well."""
    flags = torch.ones(scene.features - POSE_FEATURES)
    one_hot = Normalizer.from_range(0 * flags, flags)
    names = ("scale", "min", "input_min", "input_max")
    return Normalizer(*(torch.cat([getattr(normalizer, n)[:POSE_FEATURES], getattr(one_hot, n)]) for n in names))


# -- files of PyTorch Lightning -------------------------------------------------------------------


def read_lightning(file: str | os.PathLike[str]) -> dict[str, Any]:
    """The content of a Lightning checkpoint: tensors and plain data; everything else is a placeholder. An
    InvalidInputError without the file; a CorruptFileError if it is no checkpoint, or has no ``state_dict``.
    """
    path = Path(file)
    if not path.is_file():
        raise InvalidInputError(f"no checkpoint at {str(file)!r}")
    try:
        try:
            content = torch.load(path, map_location="cpu", weights_only=True)
        except pickle.UnpicklingError:
            content = torch.load(path, map_location="cpu", weights_only=False, pickle_module=_Inert)
    except Exception as error:  # a damaged file may raise any error; torch's message would advise to run its code
        raise CorruptFileError(
            f"{str(file)!r} is truncated or not a checkpoint of PyTorch ({type(error).__name__})"
        ) from error
    if not isinstance(content, dict) or not isinstance(content.get("state_dict"), Mapping):
        raise CorruptFileError(f"{str(file)!r} is not a Lightning checkpoint: it has no 'state_dict'")
    return content


class _Placeholder:
    """Stands for an object that is not read; takes anything and does nothing."""

    def __init__(self, *_: Any, **__: Any) -> None:
        pass

    def __call__(self, *_: Any, **__: Any) -> _Placeholder:
        return self

    append = extend = __setitem__ = __setstate__ = __init__


_ALLOWED = {
    ("collections", "OrderedDict"),
    ("torch._utils", "_rebuild_tensor_v2"),
    ("torch._utils", "_rebuild_parameter"),
    ("torch", "Size"),
    ("torch", "device"),
} | {
    ("torch", f"{kind}Storage")
    for kind in ("Float", "Double", "Half", "BFloat16", "Long", "Int", "Short", "Char", "Byte", "Bool")
}


class _Inert:
    """A pickle module for ``torch.load`` that builds tensors and plain containers, and placeholders for the rest."""

    class Unpickler(pickle.Unpickler):
        """Finds no class but those of tensors."""

        def find_class(self, module: str, name: str) -> Any:
            """The class if it is harmless; else the placeholder."""
            return super().find_class(module, name) if (module, name) in _ALLOWED else _Placeholder

    @classmethod
    def load(cls, file: IO[bytes], **options: Any) -> Any:
        """Object that :class:`Unpickler` reads from ``file``; torch calls it for files older than the zip format."""
        return cls.Unpickler(file, **options).load()
