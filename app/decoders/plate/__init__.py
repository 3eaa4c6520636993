"""Camera frame to readings of coded plates."""

from app.decoders.plate.reader import DECODER_VERSION, decode_plates

__all__ = ["DECODER_VERSION", "decode_plates"]
