"""Named sets of the keys of ``scene-envs pretrain``."""
