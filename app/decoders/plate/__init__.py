"""Camera frame to readings of coded plates: `reader.decode_plates`."""

DECODER_VERSION = "plate/7"
