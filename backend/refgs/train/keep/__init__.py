"""Save a training: checkpoints, previews, the history of its errors, and at its end the asset (surfels, light and mesh)."""
