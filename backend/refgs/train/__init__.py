"""From a capture to a run: the start, the losses, the loop, densification, checkpoints."""
