"""A mask: the objects far from the middle of the table."""


def outer(scene, score, rng):
    """Free objects more than 30 cm from the middle, and two of the empty slots."""
    far = scene.is_free[0] & (scene.translations[0, :, :2].norm(dim=-1) > 0.3)
    empty = scene.is_empty[0].nonzero().flatten()
    far[empty[rng.permutation(len(empty))[:2]]] = True
    return far
