"""Rules and unit costs -> the cheapest plan of a required quality, or the best one within a budget."""

from app.planning.optimise.plan import ChosenSite, FamilyModel, OptimisedPlan, optimise_plan, site_costs
from app.planning.plan import TradeOffPoint, pareto_points

__all__ = [
    "ChosenSite", "FamilyModel", "OptimisedPlan", "TradeOffPoint", "optimise_plan", "pareto_points", "site_costs",
]  # fmt: skip
