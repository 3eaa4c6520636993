"""Camera frame to readings of coded plates: `reader.decode_plates`.

A value without a source beside it was chosen by hand. `python -m benchmarks.plates` checks all of them together: frames
that are read, digits that are wrong, positions and times. `python -m benchmarks.plates.thresholds` takes the thresholds
of acceptance out one by one.
"""

from typing import Any

import numpy.typing as npt

DECODER_VERSION = "plate/9"
PAPER_VERSION = "plate-paper/1"
"""Of `paper.decode_plates_paper`, the paper's own algorithm."""
Array = npt.NDArray[Any]  # of whatever numbers
