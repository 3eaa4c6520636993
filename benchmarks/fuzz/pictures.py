"""Small pictures to damage."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np


def list_pictures() -> list[bytes]:
    """Small pictures of every kind that is accepted, as JPEG and PNG."""
    rows, columns = np.mgrid[0:96, 0:128]
    noise = np.random.default_rng(5).integers(0, 40, (96, 128, 3))
    colour = ((np.stack([rows, columns, rows + columns], 2) + noise) % 256).astype(np.uint8)
    grey, deep = colour[..., 0], (colour[..., 0].astype(np.uint16) * 211)
    clear = np.dstack([colour, grey])
    written: list[tuple[str, Any, list[int]]] = [
        (".jpg", colour, []),
        (".jpg", colour, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]),
        (".jpg", colour, [cv2.IMWRITE_JPEG_RST_INTERVAL, 2]),
        (".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, 20]),
        (".png", colour, []),
        (".png", grey, []),
        (".png", deep, []),
        (".png", clear, [cv2.IMWRITE_PNG_COMPRESSION, 0]),
    ]
    return [bytes(cv2.imencode(suffix, picture, options)[1]) for suffix, picture, options in written]
