"""Lanes from CERPMs beside the paper's way and the vehicle's own track; their radio, forgeries, steering, speed."""
