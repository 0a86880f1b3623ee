"""A BERT of a few hundred weights, written as the hub's are, and what tests with it share."""

from __future__ import annotations

from pathlib import Path

_TEXT = "[PAD] [UNK] [CLS] [SEP] [MASK] a scene with two cups and table . 12 objects ##s cup an the on of 3"
WORDS = _TEXT.split()


def write_bert(folder: Path, *, width: int = 24, seed: int = 0, longest: int = 20) -> Path:
    """A folder with a randomly initialised BERT and its vocabulary."""
    import torch
    from transformers import BertConfig, BertModel, BertTokenizer

    folder.mkdir(parents=True, exist_ok=True)
    (folder / "vocab.txt").write_text("\n".join(WORDS) + "\n")
    size = BertConfig(
        vocab_size=len(WORDS),
        hidden_size=width,
        num_hidden_layers=2,
        num_attention_heads=2,
        intermediate_size=32,
        max_position_embeddings=longest,
        initializer_range=0.5,
    )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        BertModel(size).save_pretrained(folder)
    BertTokenizer(str(folder / "vocab.txt")).save_pretrained(folder)
    return folder
