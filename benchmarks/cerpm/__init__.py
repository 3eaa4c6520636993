"""Lanes from CERPMs beside the paper's method and the vehicle's own track; their radio, forgeries, steering, speed."""
