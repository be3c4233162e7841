"""Train a capture into a run folder."""
