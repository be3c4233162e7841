"""Estimate the memory that a training takes. Ray then runs as many trainings at once as fit."""

from refgs.settings import Settings

# Fitted to the peak memory of 30 trainings by `quick` at 256 to 1,600 pixels (0.9 to 3.1 GB), which it meets within a quarter,
# and of one by `standard` of 800 pixels and 130,000 surfels (2.1 GB).
BASE, PER_PIXEL, PER_SURFEL = 0.85e9, 850.0, 5000.0  # bytes: libraries; of a photo; with derivatives, moments and tiles


def memory(settings: Settings) -> int:
    """Estimate a training's peak memory in bytes, both main memory and the card's."""
    return int(BASE + PER_PIXEL * settings.image.max_side**2 + PER_SURFEL * settings.surfels.budget)


def card_share(settings: Settings, card: int) -> float:
    """Return the part of a GPU's memory that a training takes, as a fraction 0.01 … 1. Ray divides GPUs by such fractions.

    `card` is the memory of the GPU in bytes.
    """
    return round(min(max(memory(settings) / card, 0.01), 1.0), 2)
