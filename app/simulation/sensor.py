"""Radiance to grey levels: noise, colour mosaic, gains, tone, sharpening, JPEG.

Radiance is linear, 1 = the sensor's saturation; channels are blue, green, red.
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from app.errors import InvalidParameter
from app.simulation.plate_scene import Air, Sensor

FloatArray = npt.NDArray[np.float32]
Image = npt.NDArray[np.uint8]


@lru_cache(maxsize=1)
def linear_from_srgb() -> FloatArray:
    """Radiance of each value of an 8-bit photo, shape (256,)."""
    v = np.arange(256) / 255
    return np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4).astype(np.float32)


def tone(radiance: FloatArray, sensor: Sensor) -> FloatArray:
    """Encoded value, 0 to 255 and not rounded, of a radiance after gains: shoulder, clipping, gamma."""
    knee = sensor.shoulder
    x = np.clip(radiance, 0, None)
    if knee < 1:
        x = np.where(x > knee, knee + (1 - knee) * (1 - np.exp(-np.maximum(x - knee, 0) / (1 - knee))), x)
    x = np.minimum(x, 1)
    toe = 0.0031308
    encoded = np.where(x <= toe, 12.92 * x, 1.055 * np.power(np.maximum(x, toe), 1 / (sensor.gamma + 0.2)) - 0.055)
    return np.asarray(255 * encoded, np.float32)


def noise_sigma(radiance: FloatArray, sensor: Sensor) -> FloatArray:
    """Standard deviation of the sensor's noise before gains, as a share of saturation: shot and read noise."""
    electrons = np.clip(radiance, 0, None) * sensor.full_well_e + sensor.read_noise_e**2
    return np.asarray(np.sqrt(electrons) / sensor.full_well_e, np.float32)


def through_air(radiance: FloatArray, air: Air) -> FloatArray:
    """Radiance that reaches the lens through haze."""
    return np.asarray(radiance * (1 - air.haze) + air.airlight * air.haze, np.float32)


def develop(radiance: FloatArray, air: Air, sensor: Sensor, rng: np.random.Generator) -> Image:
    """Frame of a radiance, shape (H, W, 3): air, noise, colour mosaic, gains, tone, sharpening.

    The mosaic's first pixel is red, so a part of a frame must start at an even row and column.
    """
    light = through_air(radiance, air) * np.float32(sensor.gain)
    gains = np.array(sensor.white_balance, np.float32)
    if sensor.bayer:
        raw = _mosaic(light)
        raw = raw + noise_sigma(raw, sensor) * rng.standard_normal(raw.shape, dtype=np.float32)
        raw = raw * _mosaic(np.broadcast_to(gains, light.shape))
        codes = np.clip(raw * 16000 + 2000.5, 0, 65535).astype(np.uint16)  # an offset keeps the noise of black
        light = (cv2.cvtColor(codes, cv2.COLOR_BayerRGGB2BGR_EA).astype(np.float32) - 2000) / 16000
    else:
        light = light + noise_sigma(light, sensor) * rng.standard_normal(light.shape, dtype=np.float32)
        light = light * gains
    encoded = tone(light, sensor)
    if sensor.sharpen:
        encoded = encoded + sensor.sharpen * (encoded - cv2.GaussianBlur(encoded, (0, 0), 1.0))
    return np.asarray(np.clip(encoded + 0.5, 0, 255), np.uint8)


def _mosaic(light: FloatArray) -> FloatArray:
    """One colour a pixel: red top-left, blue bottom-right, green else."""
    raw = light[..., 1].copy()
    raw[0::2, 0::2] = light[0::2, 0::2, 2]
    raw[1::2, 1::2] = light[1::2, 1::2, 0]
    return raw


def blurred(light: FloatArray, sigma_px: float) -> FloatArray:
    """Light spread by a Gaussian lens."""
    return np.asarray(cv2.GaussianBlur(light, (0, 0), sigma_px, borderType=cv2.BORDER_REPLICATE), np.float32)


def shift_colours(radiance: FloatArray, shift_px: float) -> FloatArray:
    """Move blue and red sideways against each other."""
    out = radiance.copy()
    size = (radiance.shape[1], radiance.shape[0])
    for channel, sign in ((0, 0.5), (2, -0.5)):
        move = np.array([[1, 0, sign * shift_px], [0, 1, 0]])
        plane = np.ascontiguousarray(radiance[..., channel])
        out[..., channel] = cv2.warpAffine(plane, move, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return out


def encode_jpeg(image: Image, quality: int) -> Image:
    """JPEG with colour at half resolution (4:2:0), as cameras write it."""
    sampling = [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420]
    done, jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality, *sampling])
    if not done:
        raise InvalidParameter("the image cannot be coded as JPEG", field="image")
    return np.asarray(jpeg, np.uint8)
