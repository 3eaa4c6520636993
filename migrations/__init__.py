"""Schema migrations, applied by `waymark migrate` and by `waymark serve`."""
