"""Keep what a training has learned: checkpoints, its history, and the asset at its end."""
