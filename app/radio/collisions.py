"""Share of packets that are received where many markers share the channel: pure ALOHA with capture."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from app.radio.airtime import check_between, check_whole
from app.radio.link import LinkModel, sensitivity_dbm
from app.radio.settings import MAX_CHANNELS, RadioSettings

Floats = npt.NDArray[np.float64]

CAPTURE_DB = 6.0  # [dB] a packet survives others this much weaker; source: Bor et al., MSWiM 2016, "Do LoRa low-power
# wide-area networks scale?"
_LEVELS = 64  # of the interpolation in `harmful_to_each`; source: by hand, no measurement kept
_BIN = 0.02  # standard deviations of fading between the levels of `_binned`; source: its error bound, 0.242 _BIN^2 / 8


@dataclass(frozen=True, slots=True)
class Receiver:
    """The receiver in the vehicle.

    Parameters
    ----------
    channels : int
        That it receives at the same time; 1 for an SX1276, 8 for a gateway's chip.
    sensitivity_dbm : float, optional
        -150 to -60; the SX1276's by default. [dBm]
    capture_db : float, optional
        0 to 30; None where every overlap loses both packets. [dB]
    relocks : bool
        Whether it abandons a weak packet for a stronger one that begins later. An SX1276 does not.

    Raises
    ------
    InvalidParameter
        A value is outside its limits.
    """

    channels: int = 1
    sensitivity_dbm: float | None = None
    capture_db: float | None = CAPTURE_DB
    relocks: bool = False

    def __post_init__(self) -> None:
        check_whole("receiver.channels", self.channels, 1, MAX_CHANNELS, "")
        if self.sensitivity_dbm is not None:
            check_between("receiver.sensitivity_dbm", self.sensitivity_dbm, -150.0, -60.0, "dBm")
        if self.capture_db is not None:
            check_between("receiver.capture_db", self.capture_db, 0.0, 30.0, "dB")

    def threshold_dbm(self, settings: RadioSettings) -> float:
        """The weakest packet of these settings that it can read. [dBm]"""
        if self.sensitivity_dbm is not None:
            return self.sensitivity_dbm
        return sensitivity_dbm(settings.spreading_factor, settings.bandwidth_hz)


def aloha_success(others: npt.ArrayLike, time_on_air_s: float, interval_s: float, channels: int = 1) -> Floats:
    """Share of packets that no other overlaps: exp(-2 N ToA / (T K)).

    Parameters
    ----------
    others : array_like
        Markers in range besides the wanted one; fractions are allowed.
    time_on_air_s, interval_s : float
        Of a packet, and from one to the next of each marker. [s]
    channels : int
        That packets are spread over evenly.

    Returns
    -------
    ndarray
        Of the shape of `others`.

    Raises
    ------
    InvalidParameter
        A value is outside its limits.

    Notes
    -----
    Abramson's pure ALOHA: a packet is lost where another begins within a time on air before or after its beginning.
    """
    check_between("time_on_air_s", time_on_air_s, 0.0, 100.0, "s")
    check_between("interval_s", interval_s, 1e-3, 1e6, "s")
    check_whole("channels", channels, 1, MAX_CHANNELS, "")
    return np.asarray(np.exp(-2 * np.asarray(others, float) * time_on_air_s / (interval_s * channels)))


def harmful_others(
    wanted_dbm: npt.ArrayLike, others_dbm: npt.ArrayLike, threshold_dbm: float, link: LinkModel, receiver: Receiver
) -> Floats:
    """Number of other markers that can destroy a packet, each counted as in plain ALOHA.

    Parameters
    ----------
    wanted_dbm : array_like, shape (...)
        Mean level of the wanted marker. [dBm]
    others_dbm : array_like, shape (..., M)
        Mean levels of all other markers. [dBm]
    threshold_dbm : float
        The weakest packet that is read. [dBm]
    link : LinkModel
        For its fading.
    receiver : Receiver

    Returns
    -------
    ndarray, shape (..., Q)
        For equally likely levels of the packets that are strong enough (`LinkModel.read_levels_dbm`).

    Notes
    -----
    Another marker counts fully if its packet is less than `capture_db` weaker: it destroys packets that it overlaps. A
    weaker readable one counts half if the receiver does not relock: it hides packets that begin while it is read.
    Without capture all readable markers count fully, and the share of received packets is plain ALOHA's.

    Others are compared one by one. Weaker ones on the air together, whose powers add, destroy some packets more: at
    most 4 % of all where 40 % or more are received (a test plays it). The simulation (`app.simulation.radio`) adds.
    """
    levels = link.read_levels_dbm(wanted_dbm, threshold_dbm)
    return _harmful_at(levels, _binned(np.asarray(others_dbm, float), link), threshold_dbm, link, receiver)


class _Others(NamedTuple):
    """Other markers by their mean levels: how many have each of them."""

    levels_dbm: Floats  # (..., B)
    number: Floats  # (..., B)


def _binned(others_dbm: Floats, link: LinkModel) -> _Others:
    """Markers with levels of shape (..., M), counted on a grid of levels where that is shorter.

    A marker between two levels counts for both in proportion, so that a sum over the grid differs from the sum over the
    markers by less than 2e-5 a marker: the second derivative of a normal distribution is at most 0.242.
    """
    rows = others_dbm.reshape(-1, others_dbm.shape[-1])
    low, span_db = rows.min(initial=np.inf), np.ptp(rows) if rows.size else 0.0
    steps = math.ceil(span_db / (_BIN * link.fading_db)) + 1 if link.fading_db else rows.shape[-1]
    if 2 * steps >= rows.shape[-1]:
        return _Others(others_dbm, np.ones_like(others_dbm))
    grid = low + _BIN * link.fading_db * np.arange(steps + 1)
    count = np.empty((len(rows), steps + 1))
    for k, row in enumerate(rows):
        place = (row - low) / (_BIN * link.fading_db)
        below = place.astype(np.intp)
        upper = np.bincount(below, place - below, minlength=steps + 1)
        count[k] = np.bincount(below, minlength=steps + 1) - upper
        count[k, 1:] += upper[:-1]
    return _Others(grid, count.reshape(*others_dbm.shape[:-1], steps + 1))


def _harmful_at(
    levels_dbm: Floats, others: _Others, threshold_dbm: float, link: LinkModel, receiver: Receiver
) -> Floats:
    """Harmful others of packets with given levels, shape (..., Q), among others of shape (..., M)."""
    readable = (link.share_above(others.levels_dbm, threshold_dbm) * others.number).sum(-1)[..., None]
    if receiver.capture_db is None:
        return np.asarray(np.broadcast_to(readable, levels_dbm.shape))
    limits_dbm = levels_dbm - receiver.capture_db
    share = link.share_above(others.levels_dbm[..., None, :], limits_dbm[..., None])
    strong = np.einsum("...qm,...m->...q", share, others.number)
    if receiver.relocks:
        return np.asarray(strong)
    return np.asarray(strong + 0.5 * np.maximum(readable - strong, 0.0))


def harmful_to_each(levels_dbm: Floats, threshold_dbm: float, link: LinkModel, receiver: Receiver) -> Floats:
    """`harmful_others` for each of many markers in range of one place, shape (M, Q).

    With fading it is interpolated between 64 levels.
    """
    if len(levels_dbm) == 0:
        return np.empty((0, 1))
    wanted = link.read_levels_dbm(levels_dbm, threshold_dbm)
    itself = harmful_others(levels_dbm, levels_dbm[:, None], threshold_dbm, link, receiver)
    everyone = _binned(levels_dbm, link)
    if link.fading_db == 0.0:
        return _harmful_at(wanted[:, 0], everyone, threshold_dbm, link, receiver)[:, None] - itself
    grid = np.linspace(wanted.min(), wanted.max(), _LEVELS)
    harmful = np.interp(wanted, grid, _harmful_at(grid, everyone, threshold_dbm, link, receiver))
    return np.asarray(np.maximum(harmful - itself, 0.0))


def packet_success(
    wanted_dbm: npt.ArrayLike,
    harmful: npt.ArrayLike,
    settings: RadioSettings,
    link: LinkModel,
    receiver: Receiver,
) -> Floats:
    """Share of a marker's packets that are strong enough, on a received channel, and not destroyed.

    Levels have shape (...), harmful others (..., Q).
    """
    strong_enough = link.share_above(wanted_dbm, receiver.threshold_dbm(settings))
    channel_share = min(1.0, receiver.channels / settings.channels)
    clear = aloha_success(harmful, settings.time_on_air_s, settings.interval_s, settings.channels)
    return np.asarray(strong_enough * channel_share * clear.mean(-1))
