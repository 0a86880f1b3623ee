"""Galleries of many images on one page."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scene_envs.errors import InvalidInputError

if TYPE_CHECKING:
    from PIL import Image

_PAGE, _INK = (255, 255, 255), (58, 62, 70)


def gallery(
    images: NDArray[np.uint8] | Sequence[NDArray[np.uint8]],
    columns: int = 4,
    captions: Sequence[str] | None = None,
    *,
    gap: int = 8,
) -> Image.Image:
    """Tile images on a white page, row by row, each with its caption below.

    Args:
        images: One or more (H, W, 3) uint8 images of one size.
        columns: Number of images per row; fewer images than columns make one shorter row.
        captions: One line per image.
        gap: Number of pixels between images and around the page.

    Returns:
        A PIL image.

    Raises:
        InvalidInputError: no images, sizes that differ, or another number of captions.

    >>> page = gallery(np.zeros((3, 24, 32, 3), np.uint8), columns=2, gap=4)
    >>> page.size
    (76, 60)
    """
    from PIL import Image, ImageDraw, ImageFont

    tiles = [np.asarray(image) for image in images]
    if not tiles:
        raise InvalidInputError("a gallery needs at least one image, got none")
    if columns < 1:
        raise InvalidInputError(f"columns must be at least 1, got {columns}")
    shapes = {tile.shape for tile in tiles}
    if len(shapes) > 1 or len(tiles[0].shape) != 3 or tiles[0].shape[2] != 3:
        raise InvalidInputError(f"a gallery needs (H, W, 3) images of one size, got shapes {sorted(shapes)}")
    if captions is not None and len(captions) != len(tiles):
        raise InvalidInputError(f"{len(tiles)} images need {len(tiles)} captions, got {len(captions)}")
    height, width = tiles[0].shape[:2]
    columns = min(columns, len(tiles))
    rows = -(-len(tiles) // columns)
    size = max(11, round(0.045 * width))
    line = round(1.7 * size) if captions is not None else 0
    page = Image.new("RGB", (columns * (width + gap) + gap, rows * (height + line + gap) + gap), _PAGE)
    draw = ImageDraw.Draw(page)
    font = ImageFont.load_default(size)
    for index, tile in enumerate(tiles):
        x = gap + (index % columns) * (width + gap)
        y = gap + (index // columns) * (height + line + gap)
        page.paste(Image.fromarray(tile.astype(np.uint8)), (x, y))
        if captions is not None:
            draw.text((x + width / 2, y + height + line / 2), captions[index], fill=_INK, font=font, anchor="mm")
    return page
