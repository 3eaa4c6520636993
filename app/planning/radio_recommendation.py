"""Recommended radio settings: a search for lawful settings under which markers are read in time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from app.errors import InvalidParameter
from app.markers.cerpm import MESSAGE_BYTES
from app.planning.radio_checks import RadioPlan, markers_of
from app.radio.airtime import BANDWIDTHS_HZ, SPREADING_FACTORS
from app.radio.battery import battery_life_days
from app.radio.lorawan import DATA_RATES
from app.radio.reception import Air, Approach, approach, read_probability
from app.radio.regulation import is_permitted
from app.radio.settings import RadioSettings

INTERVALS_S = tuple(float(f"{v:.2g}") for v in np.geomspace(0.1, 20.0, 16))  # [s] source: by hand, ratio of 1.42
POWERS_DBM = (20.0, 17.0, 14.0, 11.0, 8.0)  # [dBm] source: by hand, halves of the SX1276's maximum
MORE_CHANNELS = (2, 4, 8, 16, 32)  # source: by hand, up to four gateway chips
_WANTED = 8  # markers that are approached; source: by hand, bounds the time of the search


@dataclass(frozen=True, slots=True)
class Recommendation:
    """The best lawful settings found for a plan.

    Attributes
    ----------
    settings : RadioSettings or None
        Those with the longest battery life that reach the required probability; if none does, those with the highest
        probability. None if no settings are lawful.
    receiver_channels : int
        Channels that the receiver must receive at the same time.
    read_probability : float
    battery_days : float
        [day]
    reaches : bool
        Whether the required probability is reached.
    sentence : str
        For people.
    """

    settings: RadioSettings | None
    receiver_channels: int
    read_probability: float
    battery_days: float
    reaches: bool
    sentence: str


def recommend_settings(plan: RadioPlan, *, more_channels: bool = True) -> Recommendation:
    """Find interval, spreading factor, bandwidth and power under which the preview distance is readable.

    Parameters
    ----------
    plan : RadioPlan
        Its spreading factor, bandwidth, interval and power are varied; all other settings are kept.
    more_channels : bool
        If one channel is not enough, spread fixed markers over 2, 4, 8, 16 or 32 channels, all received.

    Returns
    -------
    Recommendation

    Notes
    -----
    Tried are spreading factors 6 (without a header) or 7 to 12, the three bandwidths, 16 intervals and 5 powers. On a
    road with its own markers, 8 of them are approached: 4 along the road, and 4 that have most others in reach.
    """
    approaches = _ApproachesByLink(plan)
    best = _best(plan, approaches)
    if best.reaches or not more_channels or plan.settings.hopping:
        return best
    for channels in MORE_CHANNELS:
        if channels <= plan.settings.channels:
            continue
        wider = replace(
            plan,
            settings=replace(plan.settings, channels=channels),
            receiver=replace(plan.receiver, channels=max(channels, plan.receiver.channels)),
        )
        found = _best(wider, approaches)
        if found.reaches:
            return found
        best = max(best, found, key=lambda one: one.read_probability)
    return best


def _best(plan: RadioPlan, approaches_by_link: _ApproachesByLink) -> Recommendation:
    reaching: tuple[float, RadioSettings, float] | None = None
    likeliest: tuple[float, RadioSettings] | None = None
    for first in _modulations(plan):
        approaches = approaches_by_link.find(first)
        for settings in _intervals(first, plan) if approaches else ():
            air = Air(settings, plan.link, plan.receiver)
            probability = min(read_probability(one, plan.design_speed_mps, air) for one in approaches)
            if likeliest is None or probability > likeliest[0]:
                likeliest = probability, settings
            if probability >= plan.min_probability:
                days = battery_life_days(settings, plan.battery)
                if reaching is None or days > reaching[0]:
                    reaching = days, settings, probability
    if reaching is not None:
        return _recommendation(plan, reaching[1], reaching[2])
    return _recommendation(plan, likeliest[1], likeliest[0]) if likeliest else _recommendation(plan, None, 0.0)


def _modulations(plan: RadioPlan) -> Iterator[RadioSettings]:
    """Settings with the longest interval: one for each spreading factor, bandwidth and power that may be lawful."""
    room = {(r.spreading_factor, r.bandwidth_hz) for r in DATA_RATES[plan.region] if r.payload_bytes >= MESSAGE_BYTES}
    for bandwidth_hz in BANDWIDTHS_HZ:
        for spreading_factor in SPREADING_FACTORS[1 if plan.settings.explicit_header else 0 :]:
            if plan.settings.lorawan and (spreading_factor, bandwidth_hz) not in room:
                continue
            for power_dbm in POWERS_DBM:
                settings = replace(
                    plan.settings,
                    spreading_factor=spreading_factor,
                    bandwidth_hz=bandwidth_hz,
                    power_dbm=power_dbm,
                    interval_s=INTERVALS_S[-1],
                )
                reaches = Air(settings, plan.link, plan.receiver).reach_m > plan.preview_m
                if reaches and is_permitted(replace(settings, interval_s=3600.0), plan.region):
                    yield settings


def _intervals(first: RadioSettings, plan: RadioPlan) -> Iterator[RadioSettings]:
    """These settings with each interval that is lawful and long enough."""
    for interval_s in INTERVALS_S:
        try:
            settings = replace(first, interval_s=interval_s)
        except InvalidParameter:
            continue
        if is_permitted(settings, plan.region):
            yield settings


class _ApproachesByLink:
    """Approaches of a plan's markers, each computed once: they depend on sensitivity and power, not on channels."""

    def __init__(self, plan: RadioPlan) -> None:
        self._plan = plan
        self._found: dict[tuple[float, float], list[Approach]] = {}

    def find(self, settings: RadioSettings) -> list[Approach]:
        """Approaches with these settings; none where more markers are in range than a check allows."""
        plan = replace(self._plan, settings=settings)
        key = plan.air.threshold_dbm, settings.power_dbm
        if key not in self._found:
            try:
                self._found[key] = _approaches(plan)
            except InvalidParameter:
                self._found[key] = []
        return self._found[key]


def _approaches(plan: RadioPlan) -> list[Approach]:
    markers, wanted = markers_of(plan)
    air, at_m = plan.air, markers.chainage_m
    if len(wanted) > _WANTED:
        ordered = np.sort(at_m)
        first, last = at_m[wanted] - 2 * air.range_m, at_m[wanted] + air.range_m - plan.preview_m
        others = np.searchsorted(ordered, last, "right") - np.searchsorted(ordered, first)
        crowded = np.argsort(-others, kind="stable")[: _WANTED // 2]  # they lose most packets
        spread = np.linspace(0, len(wanted) - 1, _WANTED - len(crowded)).astype(int)
        wanted = [wanted[k] for k in np.unique(np.concatenate([crowded, spread]))]
    return [approach(markers, index, plan.preview_m, air) for index in wanted]


def _recommendation(plan: RadioPlan, settings: RadioSettings | None, probability: float) -> Recommendation:
    receives = plan.receiver.channels
    if settings is None:
        sentence = f"no settings are lawful in {plan.region} and reach {plan.preview_m:.0f} m"
        return Recommendation(None, receives, 0.0, 0.0, False, sentence)
    days = battery_life_days(settings, plan.battery)
    reaches = probability >= plan.min_probability
    channels = f"{settings.channels} channel{'s' if settings.channels > 1 else ''}"
    sentence = (
        f"SF{settings.spreading_factor} at {settings.bandwidth_hz / 1000:g} kHz and {settings.power_dbm:g} dBm, every "
        f"{settings.interval_s:g} s on {channels}: {probability:.1%} of markers are read {plan.preview_m:.0f} m ahead"
    )
    if not reaches:
        sentence += f"; no lawful settings tried reach {plan.min_probability:.1%}"
    return Recommendation(settings, receives, probability, days, reaches, sentence)
