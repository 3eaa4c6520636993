"""Use case on radio plans: check one, and recommend settings. Nothing is stored."""

from __future__ import annotations

from app.planning.radio_checks import RadioPlan, check_radio
from app.planning.radio_recommendation import recommend_settings
from app.services.plans.radio_check_documents import RadioCheckDocument, radio_check_document


def check_plan(plan: RadioPlan, *, recommend: bool) -> RadioCheckDocument:
    """The result of checking a radio plan, with recommended settings if asked for.

    Raises
    ------
    InvalidParameter
        More markers are in range of one receiver than a check allows.
    """
    advice = recommend_settings(plan) if recommend else None
    return radio_check_document(check_radio(plan), advice)
