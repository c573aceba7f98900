"""Planning with full knowledge of scene and simulator: collision checks, RRT-Connect, plans that were tried out."""
